"""One grasp attempt with any rig: photograph, plan, close, lift, put down.

All random numbers of an attempt derive from (seed, object, number). On the simulated rig, the whole attempt depends
only on these three values, and on earlier grasps if the planner uses them: it can be repeated in another process or
after a crash.
"""

import contextlib
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from _touch_retrieval.documents import Seed, typed
from robot.devices import MAX_AGE_S, read_together
from robot.errors import DeviceError, PlanError, RobotConfigError, UngraspableError
from robot.grasping.settings import AttemptSettings
from robot.readings import Pose
from robot.recording.attempt_log import AttemptOutcome
from robot.recording.grasp import Outcome
from robot.rig import GraspPlan, Rig
from robot.storage import file_content

_OUTCOME_FROM: Mapping[str, Outcome] = {"holding": "held", "no_part": "missed", "part_lost": "slipped"}


@dataclass(frozen=True)
class GraspAttempt:
    """Result of one attempt, picklable; times count from the photo.

    Attributes:
        object_id: The object.
        number: Number of the attempt at this object.
        outcome: As the gripper reports after the lift. Without images: "no_plan", or "ungraspable" if no further
            attempt can succeed.
        images: Content of JPEG and PNG files by column.
        fields: Further fields of the recorded grasp.
        fit: The plan's description of the object.
        reason: Message of the PlanError, if any.
    """

    object_id: str
    number: int
    outcome: AttemptOutcome
    images: Mapping[str, bytes] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)
    fit: Mapping[str, Any] = field(default_factory=dict)
    reason: str | None = None
    touch_time_s: float = 0.0
    duration_s: float = 0.0


class AttemptRunner:
    """Makes attempts with a connected rig; raises RobotConfigError if a setting is outside the rig's limits."""

    def __init__(self, rig: Rig, seed: int, settings: AttemptSettings) -> None:
        typed(seed, Seed, "seed", error=RobotConfigError)
        settings.grasp.check(rig.arm, rig.gripper)
        self.rig, self.seed, self.settings = rig, seed, settings

    def run(self, object_id: str, number: int) -> GraspAttempt:
        """Make attempt `number`; after a DeviceError, recover the rig and repeat it, or raise after all retries.

        After any exception, Ctrl-C included, the jaws are opened. If this fails, the exception states it.
        """
        for retry in range(self.settings.retries + 1):
            try:
                if retry:
                    self.rig.recover()
                return self._attempt_once(object_id, number)
            except DeviceError as error:
                note = self._open_jaws()
                if retry == self.settings.retries:
                    raise DeviceError(
                        f"attempt {number} at {object_id} failed {retry + 1} time(s), last: {error}{note}"
                    ) from error
            except BaseException as error:
                if note := self._open_jaws():
                    error.add_note(note)
                raise
        raise AssertionError("the loop returns or raises")

    def _open_jaws(self) -> str:
        """Open the jaws, after recovery if necessary; return "" or a note about the failure."""
        gripper = self.rig.gripper
        try:
            with contextlib.suppress(DeviceError):
                gripper.open(gripper.stroke_mm)
                return ""
            gripper.recover()
            gripper.open(gripper.stroke_mm)
        except Exception as second:
            return f"; and the jaws could not be opened: {second}"
        return ""

    def _attempt_once(self, object_id: str, number: int) -> GraspAttempt:
        rig = self.rig
        rng = np.random.default_rng([self.seed, zlib.crc32(object_id.encode()), number])
        rig.gripper.open(rig.gripper.stroke_mm)
        self._rise()
        rig.arm.move_to(rig.home, self.settings.travel_mm_s)
        rig.prepare(object_id, number)
        start = rig.clock()
        records_depth = rig.camera.has_depth and "depth" in self.settings.outputs
        image = rig.camera.read(depth=records_depth or (rig.object_fit is None and rig.planner.needs_depth))
        try:
            plan = rig.planner.plan(rig, image, self.settings.grasp, rng)
        except PlanError as error:
            failed: AttemptOutcome = "ungraspable" if isinstance(error, UngraspableError) else "no_plan"
            return GraspAttempt(object_id, number, failed, reason=str(error), duration_s=round(rig.clock() - start, 3))
        images = {"photo": self._jpeg(image.colour)}
        if "depth" in self.settings.outputs and image.depth_m is not None:
            images["depth"], _ = file_content("depth", depth_in_mm(image.depth_m))
        touches, fields, touch_time = self._grasp(plan)
        status = rig.gripper.state().status
        if status not in _OUTCOME_FROM:
            raise DeviceError(
                f"{rig.gripper.name} must report holding, no_part or part_lost after a lift, got {status}"
            )
        outcome = _OUTCOME_FROM[status]
        if "after" in self.settings.outputs:
            touches |= self._read_touches("_after", self.settings.hold_s)[0]
        self._put_down(plan, outcome == "held", rng)
        return GraspAttempt(
            object_id,
            number,
            outcome,
            {**images, **touches},
            fields,
            plan.fit,
            touch_time_s=round(touch_time - start, 3),
            duration_s=round(rig.clock() - start, 3),
        )

    def _rise(self) -> None:
        """Move straight up; on another path, the open jaws would hit an object between them."""
        arm = self.rig.arm
        if arm.is_manual:
            return
        here = arm.pose()
        above = replace(here, z_mm=arm.workspace.upper[2])
        if here.z_mm < above.z_mm and arm.workspace.contains(above):
            arm.move_to(above, self.settings.approach_mm_s)

    def _grasp(self, plan: GraspPlan) -> tuple[dict[str, bytes], dict[str, Any], float]:
        """Approach, close and lift; return touches, fields of the recorded grasp, and the time of the touch."""
        rig, settings = self.rig, self.settings
        for pose in plan.approach or (plan.above,):
            rig.arm.move_to(pose, settings.travel_mm_s)
        rig.gripper.open(plan.opening_mm)
        reached = rig.arm.move_to(plan.pose, settings.approach_mm_s)
        touches = self._read_touches("_before", MAX_AGE_S)[0] if "before" in settings.outputs else {}
        closed = rig.gripper.grasp(plan.force_n, settings.closing_mm_s)
        rig.sleep(settings.settle_s)
        touch_time = rig.clock()
        during, skew_s = self._read_touches("", settings.settle_s)
        rig.arm.move_to(plan.above, settings.approach_mm_s)
        rig.sleep(settings.hold_s)
        fields = {
            "force_n": plan.force_n,
            "opening_mm": closed.opening_mm,
            "pose": reached.as_tuple(),
            "touch_skew_s": round(skew_s, 6),
        }
        return touches | during, fields, touch_time

    def _read_touches(self, moment: str, since_s: float) -> tuple[dict[str, bytes], float]:
        """Read gel images by key, at most `since_s` old, and their skew in s.

        With contact, `since_s` is the wait after the last motion, so no frame is older than the end of that motion.
        """
        frames, skew_s = read_together(self.rig.sensors, max_age_s=min(MAX_AGE_S, since_s))
        return {f"touch_{finger}{moment}": self._jpeg(frame.pixels) for finger, frame in frames.items()}, skew_s

    def _put_down(self, plan: GraspPlan, held: bool, rng: np.random.Generator) -> None:
        """Release a held object on the table at a random position and yaw, and open the jaws.

        It is released at the position of the grasp with a given `object_fit`, which fixes the position of the object,
        and after a tilted grasp, because a tilted hand has room to withdraw there.
        """
        rig, settings = self.rig, self.settings
        low, high = np.array(rig.arm.workspace.lower), np.array(rig.arm.workspace.upper)
        x, y = (low + high)[:2] / 2 + settings.table_share * rng.uniform(-0.5, 0.5, 2) * (high - low)[:2]
        yaw = float(rng.uniform(0.0, math.pi))
        is_returned = rig.object_fit is not None or bool(plan.pose.tilt_rad)
        if is_returned:
            x, y, yaw = plan.pose.x_mm, plan.pose.y_mm, plan.pose.yaw_rad
        if held:
            z = min(plan.pose.z_mm + settings.release_mm, float(high[2]))
            over = Pose(float(x), float(y), plan.above.z_mm, yaw, plan.pose.tilt_rad)
            rig.arm.move_to(over, settings.travel_mm_s)
            rig.arm.move_to(replace(over, z_mm=z), settings.approach_mm_s)
        rig.gripper.open(rig.gripper.stroke_mm)
        if held:
            rig.arm.move_to(plan.approach[-1] if plan.approach and is_returned else over, settings.approach_mm_s)

    def _jpeg(self, pixels: npt.NDArray[np.uint8]) -> bytes:
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.settings.jpeg_quality]
        bgr = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2BGR)
        return bytes(cv2.imencode(".jpg", bgr, quality)[1].tobytes())


def depth_in_mm(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Return depth in whole millimetres as a recording stores it, 0 where unknown or beyond 65 m."""
    depth = np.rint(depth_m.astype(np.float64) * 1000)
    return np.where((np.isfinite(depth) & (depth > 0) & (depth < 65536)), depth, 0).astype(np.uint16)
