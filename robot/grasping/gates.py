"""Gates: decide from the gel images of a grasp whether it is accepted.

A gate is a callable from {finger: GraspFrames} to a decision or to the probability of success; a grasp is accepted
if this is at least 1/2. A learned gate is trained in `retrieval` and passed to the collector. A gate selects easy
contacts, because it uses the images on which a matcher is trained later; therefore rejected grasps are recorded too.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from robot.errors import RobotConfigError, RobotError
from robot.settings import TypedSettings
from robot.storage import decode_picture

Picture = npt.NDArray[np.uint8]
_TOUCH = re.compile(r"touch_([a-z])")


@dataclass(frozen=True, eq=False)
class GraspFrames:
    """Frames of one finger, (H, W, 3) uint8 RGB: without contact, with closed jaws, and after the lift."""

    before: Picture | None
    during: Picture
    after: Picture | None = None


def recorded_touches(images: Mapping[str, bytes]) -> dict[str, GraspFrames]:
    """Return each finger's frames from the content of image files by column: the gate gets the pixels of training."""
    pixels: dict[str, Any] = {column: decode_picture(data) for column, data in images.items() if "touch" in column}
    return {
        match[1]: GraspFrames(pixels.get(f"{column}_before"), pixels[column], pixels.get(f"{column}_after"))
        for column in images
        if (match := _TOUCH.fullmatch(column))
    }


Gate = Callable[[Mapping[str, GraspFrames]], bool | float]


def apply_gate(gate: Gate, touches: Mapping[str, GraspFrames]) -> tuple[bool, float]:
    """Return the decision of a gate on the frames by finger, and its score; raise RobotError unless it is in 0..1."""
    score = float(gate(touches))
    if not 0.0 <= score <= 1.0:  # also rejects NaN
        raise RobotError(f"a gate must return true, false or a probability, got {score}")
    return score >= 0.5, score


@dataclass(frozen=True)
class ContactAreaGate(TypedSettings):
    """A gate that accepts a grasp when the gel of any finger changed its colour over a large enough area.

    It compares the frame after the lift, if recorded, with the no-contact frame, because after a slip the gel has
    no contact. If there is no frame after the lift, it uses the frame with closed jaws.

    Attributes:
        noise_levels: A pixel has changed if some channel, averaged over `blur_px` x `blur_px`, differs by more than
            this number of grey levels.
        least_share: Smallest fraction of changed pixels, 0 to 1.
        blur_px: Side of the average.
    """

    noise_levels: Annotated[float, Meta(ge=0.1, le=254)] = 8.0
    least_share: Annotated[float, Meta(ge=1e-6, le=1)] = 0.01
    blur_px: Annotated[int, Meta(ge=1, le=1000)] = 5

    def __call__(self, touches: Mapping[str, GraspFrames]) -> bool:
        """Return whether the grasp is accepted; raise RobotConfigError if a no-contact frame is missing."""
        return any(self.changed_fraction(frames) >= self.least_share for frames in touches.values())

    def changed_fraction(self, frames: GraspFrames) -> float:
        """Return the fraction of changed pixels, 0 to 1."""
        if frames.before is None:
            raise RobotConfigError("the contact-area gate requires no-contact frames; record the output `before`")
        touch = frames.during if frames.after is None else frames.after
        change = np.subtract(touch, frames.before, dtype=np.float32)  # uint8 would wrap round below 0
        smooth = cv2.blur(change, (self.blur_px, self.blur_px), borderType=cv2.BORDER_REPLICATE)
        within = cv2.inRange(smooth, (-self.noise_levels,) * 3, (self.noise_levels,) * 3)
        return float((within.size - cv2.countNonZero(within)) / within.size)
