"""Settings of grasps and of attempts: forces, positions, speeds, waits and recorded outputs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from _touch_retrieval.documents import NonNegative, Positive
from robot.devices import Arm, Gripper
from robot.errors import RobotConfigError
from robot.settings import TypedSettings, build

Output = Literal["depth", "before", "after"]
"""Optional output: the depth picture, the no-contact gel images, or those after the lift (object held)."""


@dataclass(frozen=True)
class GraspSettings(TypedSettings):
    """Settings of random grasps. Lengths in mm, forces in N.

    Attributes:
        force_n: Range of the force on each finger.
        jitter_mm: Largest offset of the pose from the axis, in x and in y.
        floor_mm: Smallest height of the fingertips above the table.
        top_margin_mm: Smallest distance of the fingertips below the object's top; floor_mm has priority.
        reach_mm: Largest distance of the fingertips below the object's top.
        finger_mm: Width of a finger.
        clearance_mm: Room on either side of the object when the jaws are open.
        lift_mm: Height of the lift, and of the approach pose above the grasp.
    """

    force_n: tuple[float, float] = (5.0, 25.0)
    jitter_mm: NonNegative = 1.0
    floor_mm: NonNegative = 10.0
    top_margin_mm: NonNegative = 15.0
    reach_mm: Annotated[float, Meta(ge=1)] = 110.0
    finger_mm: Annotated[float, Meta(ge=1)] = 25.0
    clearance_mm: NonNegative = 5.0
    lift_mm: Annotated[float, Meta(ge=1)] = 180.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.force_n[0] <= self.force_n[1]:
            raise RobotConfigError(f"force_n must be a range of forces above 0, lower first, got {self.force_n}")

    def check(self, arm: Arm, gripper: Gripper) -> None:
        """Raise RobotConfigError if the settings exceed the limits of this arm and gripper."""
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
    """Settings of attempts.

    Attributes:
        grasp: Settings of the random grasps.
        outputs: Outputs to record; the others are not read from the devices.
        travel_mm_s: Speed of the arm between objects.
        approach_mm_s: Speed of the arm near the object.
        closing_mm_s: Speed of the closing jaws.
        settle_s: Wait between closing and the gel images.
        hold_s: Wait between the lift and the query of the gripper's outcome.
        release_mm: Height of the release above the height of the grasp.
        table_share: Inner fraction of the workspace in which objects are put down.
        retries: Maximum number of repetitions of an attempt after device failures.
        jpeg_quality: Quality of colour pictures, 0 to 100; depth is stored exactly.
    """

    grasp: GraspSettings = field(default_factory=GraspSettings)
    outputs: tuple[Output, ...] = ("depth", "before", "after")
    travel_mm_s: Positive = 200.0
    approach_mm_s: Positive = 50.0
    closing_mm_s: Positive = 80.0
    settle_s: NonNegative = 1.0
    hold_s: NonNegative = 1.0
    release_mm: NonNegative = 5.0
    table_share: Annotated[float, Meta(ge=0, le=1)] = 0.7
    retries: Annotated[int, Meta(ge=0, le=1000)] = 2
    jpeg_quality: Annotated[int, Meta(ge=0, le=100)] = 95


def parse_attempt_settings(attempt: Mapping[str, Any], grasp: Mapping[str, Any]) -> AttemptSettings:
    """Return the settings of the tables [attempt] and [grasp] of a rig's file; raise RobotConfigError if invalid."""
    return build(AttemptSettings, attempt, where="[attempt]", grasp=build(GraspSettings, grasp, where="[grasp]"))
