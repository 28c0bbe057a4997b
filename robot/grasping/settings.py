"""How attempts at a grasp are made: speeds, waits, and what is recorded."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robot.errors import RobotConfigError
from robot.grasping.plan import GraspSettings
from robot.settings import TypedSettings, build, limited

OUTPUTS = ("depth", "before", "after")
"""What may be left out of a recording: the depth picture, and gel images of the moments before and after a grasp."""


@dataclass(frozen=True)
class AttemptSettings(TypedSettings):
    """How attempts are made. outputs: which of OUTPUTS are recorded; nothing is asked of a device for the others.

    settle_s: wait between closing and the picture. hold_s: wait between lifting and judging. release_mm: an object is
    let go so far above where it was grasped, on the inner `table_share` of the workspace. retries: how often an attempt
    is begun again after a device has failed. jpeg_quality: of colour pictures, 0 to 100; depth is kept exactly.
    """

    grasp: GraspSettings = field(default_factory=GraspSettings)
    outputs: tuple[str, ...] = OUTPUTS
    travel_mm_s: float = limited(1e-3, 1e6, 200.0)
    approach_mm_s: float = limited(1e-3, 1e6, 50.0)
    closing_mm_s: float = limited(1e-3, 1e6, 80.0)
    settle_s: float = limited(0, 1e6, 1.0)
    hold_s: float = limited(0, 1e6, 1.0)
    release_mm: float = limited(0, 1e6, 5.0)
    table_share: float = limited(0, 1, 0.7)
    retries: int = limited(0, 1000, 2)
    jpeg_quality: int = limited(0, 100, 95)

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        if unknown := sorted(set(self.outputs) - set(OUTPUTS)):
            raise RobotConfigError(f"outputs must be of {', '.join(OUTPUTS)}; got {unknown[0]!r}")


def attempt_of(attempt: Mapping[str, Any], grasp: Mapping[str, Any]) -> AttemptSettings:
    """From the tables [attempt] and [grasp] of a rig's file. Raises RobotConfigError."""
    return build(AttemptSettings, attempt, where="[attempt]", grasp=build(GraspSettings, grasp, where="[grasp]"))
