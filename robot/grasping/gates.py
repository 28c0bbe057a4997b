"""Gates: from the gel images of a grasp to whether it is kept.

A gate is a callable that takes {finger: GraspFrames} and returns whether the grasp succeeded, or the probability that
it did, which must be 1/2 or more. A learned one is trained elsewhere and handed to the collector like this one here. A
gate that looks at the images on which a matcher is trained later chooses easy contacts: what it rejects is logged.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import RobotConfigError, RobotError

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class GraspFrames:
    """What one finger saw, (H, W, 3) uint8 RGB: the untouched gel, the closed jaws, and after the lift."""

    before: Picture | None
    during: Picture
    after: Picture | None = None


Gate = Callable[[Mapping[str, GraspFrames]], bool | float]


def apply_gate(gate: Gate, touches: Mapping[str, GraspFrames]) -> tuple[bool, float]:
    """Ask a gate; returns its decision, and its answer as a number. Raises RobotError for an answer that is none."""
    answer = float(gate(touches))
    if not 0.0 <= answer <= 1.0:  # also refuses NaN
        raise RobotError(f"a gate must answer true, false or a probability, got {answer}")
    return answer >= 0.5, answer


def difference(frame: Picture, before: Picture) -> npt.NDArray[np.float32]:
    """Signed change of colour in grey levels, (H, W, 3) float32: uint8 would wrap round below 0."""
    return np.subtract(frame, before, dtype=np.float32)


@dataclass(frozen=True)
class ContactAreaGate:
    """A grasp is kept when the gel of any finger (or of all) has changed its colour over a large enough area.

    A pixel has changed when some channel, averaged over `blur_px` x `blur_px`, differs from the untouched gel by more
    than `noise_levels` grey levels; at least the share `least_share` of the pixels must have. It looks at the frame
    after the lift where there is one, because what has slipped leaves an untouched gel, else at the frame during.
    """

    noise_levels: float = 8.0
    least_share: float = 0.01
    blur_px: int = 5
    every_finger: bool = False

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting out of range."""
        if not 0 < self.noise_levels < 255:
            raise RobotConfigError(f"noise_levels must lie between 0 and 255, got {self.noise_levels}")
        if not 0 < self.least_share <= 1:
            raise RobotConfigError(f"least_share must lie above 0 and at most at 1, got {self.least_share}")
        if self.blur_px < 1:
            raise RobotConfigError(f"blur_px must be at least 1, got {self.blur_px}")

    def __call__(self, touches: Mapping[str, GraspFrames]) -> bool:
        """Raises RobotConfigError without frames of the untouched gel."""
        enough = (self._changed_fraction(finger, frames) >= self.least_share for finger, frames in touches.items())
        return (all if self.every_finger else any)(enough)  # which look no further than they must

    def changed_fractions(self, touches: Mapping[str, GraspFrames]) -> dict[str, float]:
        """Share of changed pixels, 0 to 1, by finger."""
        return {finger: self._changed_fraction(finger, frames) for finger, frames in touches.items()}

    def _changed_fraction(self, finger: str, frames: GraspFrames) -> float:
        if frames.before is None:
            raise RobotConfigError(
                f"the contact-area gate compares with the untouched gel: record frames before the grasp; finger "
                f"{finger} has none"
            )
        change = difference(frames.during if frames.after is None else frames.after, frames.before)
        smooth = cv2.blur(change, (self.blur_px, self.blur_px), borderType=cv2.BORDER_REPLICATE)
        within = cv2.inRange(smooth, (-self.noise_levels,) * 3, (self.noise_levels,) * 3)
        return float((within.size - cv2.countNonZero(within)) / within.size)
