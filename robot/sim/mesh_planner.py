"""Grasp planner for simulated meshes. It uses the true mesh and pose, up to the camera's calibration error."""

import math
from typing import Any

import numpy as np

from robot.errors import PlanError, RobotConfigError, UngraspableError
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Pose, Region
from robot.rig import GraspPlan, GraspPlanner, Rig
from robot.sim.antipodal import AntipodalGrasps, Array
from robot.sim.camera import Placement
from robot.sim.meshes import grasps_of
from robot.sim.objects.mesh import MeshBody
from robot.sim.rig import SimRig
from robot.sim.scene import GRAVITY_M_S2, SAFETY, Scene


class MeshPlanner(GraspPlanner):
    """Draw one of the grasps of a mesh: first the approach (from above or from a side), then uniformly."""

    needs_depth = False

    def check(self, rig: Rig) -> None:
        """Raise RobotConfigError unless `rig` is simulated and has meshes."""
        if not isinstance(rig, SimRig) or rig.meshes is None:
            raise RobotConfigError(
                '[planner]: name = "mesh" plans for meshes of the simulated rig only. Set meshes = FOLDER, or '
                'name = "cylinder".'
            )

    def plan(self, rig: Rig, image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Draw a grasp of the object on the table; the image is not used.

        Raises:
            UngraspableError: No attempt on this object can succeed.
            PlanError: No grasp lies in the arm's workspace.
        """
        assert isinstance(rig, SimRig), "check() rejects other rigs"
        scene = rig.sim_state.current_scene()
        assert isinstance(scene.obj.body, MeshBody)
        grasps = grasps_of(scene.obj.body, settings)
        _check_graspable(scene, grasps, settings, rig.gripper.stroke_mm)
        jitter = rng.uniform(-settings.jitter_mm, settings.jitter_mm, 2)
        force = round(float(rng.uniform(*settings.force_n)), 3)
        shift = rig.error_mm + np.array([*jitter, 0.0])
        poses = _PlacedGrasps(grasps, scene.placement, shift, rig.arm.workspace, settings)
        tilted = grasps.tilt_rad != 0
        approaches = [kind for kind in (~tilted, tilted) if (poses.is_reachable & kind).any()]
        if not approaches:
            raise PlanError(f"no grasp of the object lies in the workspace {rig.arm.workspace}")
        number = int(rng.choice(np.flatnonzero(poses.is_reachable & approaches[rng.integers(len(approaches))])))
        fit = {"method": "mesh", "width_mm": round(float(grasps.width_mm[number]), 3)}
        return poses.plan(number, rig.gripper.stroke_mm, force, fit)


def _check_graspable(scene: Scene, grasps: AntipodalGrasps, settings: GraspSettings, stroke_mm: float) -> None:
    """Raise UngraspableError if no attempt can succeed."""
    if not len(grasps):
        if math.isinf(grasps.min_width_mm):
            raise UngraspableError(
                f"no two opposite sides that the fingers could hold, {settings.floor_mm:g} mm above the table or higher"
            )
        if grasps.min_width_mm + 2 * settings.clearance_mm > stroke_mm:
            raise UngraspableError(
                f"wider than the gripper opens: {grasps.min_width_mm:.0f} mm at least between opposite sides, "
                f"{stroke_mm:.0f} mm less {settings.clearance_mm:g} mm of clearance on either side"
            )
        raise UngraspableError("no approach from above or from a side is clear of the object and the table")
    weight, friction = SAFETY * scene.obj.mass_kg * GRAVITY_M_S2, scene.obj.material.friction
    if 2 * friction * settings.force_n[1] < weight:
        raise UngraspableError(
            f"too heavy to lift: {scene.obj.mass_kg:.2f} kg of {scene.obj.material.name} need "
            f"{weight / (2 * friction):.0f} N on each finger, and force_n ends at {settings.force_n[1]:g} N"
        )


class _PlacedGrasps:
    """Grasps in the rig's frame, with a mask of those that the arm reaches."""

    def __init__(
        self, grasps: AntipodalGrasps, placement: Placement, shift_mm: Array, workspace: Region, settings: GraspSettings
    ) -> None:
        self._top = workspace.upper[2]
        self._points = grasps.points @ placement.rotation().T + [placement.x_mm, placement.y_mm, 0.0] + shift_mm
        turns, self._yaw = np.divmod(grasps.yaw_rad + placement.yaw_rad, math.pi)
        # Half a turn of the jaws swaps the fingers, and with them the side to which a tilted hand leans.
        self._tilt = np.where(turns % 2 == 1, -grasps.tilt_rad, grasps.tilt_rad)
        back = np.stack([np.sin(self._yaw), -np.cos(self._yaw)], axis=1) * np.sin(self._tilt)[:, None]
        self._start = self._points.copy()
        self._start[:, :2] += grasps.retreat_mm[:, None] * back
        self._lift = np.minimum(self._points[:, 2] + settings.lift_mm, self._top)
        lower, upper = (np.asarray(bound) for bound in (workspace.lower, workspace.upper))
        inside = [((points >= lower) & (points <= upper)).all(axis=1) for points in (self._points, self._start)]
        rises = self._lift - self._points[:, 2] >= np.where(grasps.tilt_rad == 0, grasps.retreat_mm, 0.0)
        self.is_reachable = inside[0] & inside[1] & rises

    def plan(self, number: int, stroke_mm: float, force_n: float, fit: dict[str, Any]) -> GraspPlan:
        """Return the plan of one grasp."""
        yaw, tilt = math.floor(self._yaw[number] * 1e6) / 1e6, float(self._tilt[number])
        (x, y, z), (start_x, start_y, start_z) = self._points[number].round(3), self._start[number].round(3)
        pose = Pose(float(x), float(y), float(z), yaw, tilt)
        above = Pose(float(x), float(y), round(float(self._lift[number]), 3), yaw, tilt)
        if not tilt:
            return GraspPlan(pose, above, stroke_mm, force_n, fit=fit)
        start = Pose(float(start_x), float(start_y), float(start_z), yaw, tilt)
        high = Pose(start.x_mm, start.y_mm, self._top, yaw, tilt)
        return GraspPlan(pose, above, stroke_mm, force_n, approach=(high, start), fit=fit)
