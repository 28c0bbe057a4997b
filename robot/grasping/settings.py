"""How attempts at a grasp are made: speeds, waits, and what is recorded."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robot.errors import RobotConfigError
from robot.grasping.plan import GraspSettings
from robot.settings import build, check_range

OUTPUTS = ("depth", "before", "after")
"""What may be left out of a recording: the depth picture, and gel images of the moments before and after a grasp."""


@dataclass(frozen=True)
class AttemptSettings:
    """How attempts are made. outputs: which of OUTPUTS are recorded; nothing is asked of a device for the others.

    settle_s: wait between closing and the picture. hold_s: wait between lifting and judging. release_mm: an object is
    let go so far above where it was grasped, on the inner `table_share` of the workspace. retries: how often an attempt
    is begun again after a device has failed. jpeg_quality: of colour pictures, 0 to 100; depth is kept exactly.
    """

    grasp: GraspSettings = field(default_factory=GraspSettings)
    outputs: tuple[str, ...] = OUTPUTS
    travel_mm_s: float = 200.0
    approach_mm_s: float = 50.0
    closing_mm_s: float = 80.0
    settle_s: float = 1.0
    hold_s: float = 1.0
    release_mm: float = 5.0
    table_share: float = 0.7
    retries: int = 2
    jpeg_quality: int = 95

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting out of range."""
        if unknown := sorted(set(self.outputs) - set(OUTPUTS)):
            raise RobotConfigError(f"outputs must be of {', '.join(OUTPUTS)}; got {unknown[0]!r}")
        for name in ("travel_mm_s", "approach_mm_s", "closing_mm_s"):
            check_range(name, getattr(self, name), 1e-3, math.inf)
        for name in ("settle_s", "hold_s", "release_mm", "retries"):
            check_range(name, getattr(self, name), 0.0, 1e6)
        check_range("table_share", self.table_share, 0.0, 1.0)
        check_range("jpeg_quality", self.jpeg_quality, 0, 100)


def attempt_of(attempt: Mapping[str, Any], grasp: Mapping[str, Any]) -> AttemptSettings:
    """From the tables [attempt] and [grasp] of a rig's file. Raises RobotConfigError."""
    drawn = GraspSettings.from_dict(grasp, where="[grasp]")
    return build(AttemptSettings, attempt, where="[attempt]", grasp=drawn)
