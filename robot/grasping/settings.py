"""How grasps are drawn, and how attempts at them are made: forces, places, speeds, waits, and what is recorded."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robot.devices import Arm, Gripper
from robot.errors import RobotConfigError
from robot.settings import TypedSettings, bounded, build

OUTPUTS = ("depth", "before", "after")
"""What may be left out of a recording: the depth picture, and gel images of the moments before and after a grasp."""


@dataclass(frozen=True)
class GraspSettings(TypedSettings):
    """How grasps are drawn. Lengths in mm, forces in N.

    force_n: range of the clamping force. jitter_mm: the pose strays so far from the axis in x and in y.
    floor_mm: lowest point between the fingertips, above the table. top_margin_mm, reach_mm: that point lies at least
    and at most so far below the object's top. finger_mm: width of a finger. clearance_mm: room on either side of the
    object when the jaws are open. lift_mm: how high an object is lifted, and how far above its grasp a plan begins.
    """

    force_n: tuple[float, float] = (5.0, 25.0)
    jitter_mm: float = bounded(0, 1e6, 1.0)
    floor_mm: float = bounded(0, 1e6, 10.0)
    top_margin_mm: float = bounded(0, 1e6, 15.0)
    reach_mm: float = bounded(1, 1e6, 110.0)
    finger_mm: float = bounded(1, 1e6, 25.0)
    clearance_mm: float = bounded(0, 1e6, 5.0)
    lift_mm: float = bounded(1, 1e6, 180.0)

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        if not 0 < self.force_n[0] <= self.force_n[1]:
            raise RobotConfigError(f"force_n must be a range of forces above 0, lower first, got {self.force_n}")

    def check(self, arm: Arm, gripper: Gripper) -> None:
        """Raise RobotConfigError where this rig cannot do what is asked."""
        low, high = self.force_n
        if low < gripper.min_force_n or high > gripper.max_force_n:
            raise RobotConfigError(
                f"force_n must be within {gripper.min_force_n:g} to {gripper.max_force_n:g} N, the range of "
                f"{gripper.name}; got {low:g} to {high:g}"
            )
        if self.floor_mm > arm.workspace.upper[2]:
            raise RobotConfigError(f"floor_mm must lie below the workspace's top {arm.workspace.upper[2]:g} mm")


@dataclass(frozen=True)
class AttemptSettings(TypedSettings):
    """How attempts are made. outputs: which of OUTPUTS are recorded; nothing is asked of a device for the others.

    settle_s: wait between closing and the picture. hold_s: wait between lifting and judging. release_mm: an object is
    let go so far above where it was grasped, on the inner `table_share` of the workspace. retries: how often an attempt
    is begun again after a device has failed. jpeg_quality: of colour pictures, 0 to 100; depth is kept exactly.
    """

    grasp: GraspSettings = field(default_factory=GraspSettings)
    outputs: tuple[str, ...] = OUTPUTS
    travel_mm_s: float = bounded(1e-3, 1e6, 200.0)
    approach_mm_s: float = bounded(1e-3, 1e6, 50.0)
    closing_mm_s: float = bounded(1e-3, 1e6, 80.0)
    settle_s: float = bounded(0, 1e6, 1.0)
    hold_s: float = bounded(0, 1e6, 1.0)
    release_mm: float = bounded(0, 1e6, 5.0)
    table_share: float = bounded(0, 1, 0.7)
    retries: int = bounded(0, 1000, 2)
    jpeg_quality: int = bounded(0, 100, 95)

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        if unknown := sorted(set(self.outputs) - set(OUTPUTS)):
            raise RobotConfigError(f"outputs must be of {', '.join(OUTPUTS)}; got {unknown[0]!r}")


def parse_attempt_settings(attempt: Mapping[str, Any], grasp: Mapping[str, Any]) -> AttemptSettings:
    """From the tables [attempt] and [grasp] of a rig's file. Raises RobotConfigError."""
    return build(AttemptSettings, attempt, where="[attempt]", grasp=build(GraspSettings, grasp, where="[grasp]"))
