"""The grasp-success gate between a rig and its recording: it classifies the gel images of a grasp.

As in the authors' collection code, one network serves all fingers, and its input is the difference from the no-contact
frame. A grasp succeeds if ANY finger's probability is at least 1/2. This network is smaller than theirs.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import to_float
from retrieval.errors import BadInput, CheckpointError, NumericalError
from retrieval.model.checkpoint import load_weights, read_tensors
from retrieval.model.encode import one_thread, touch_batch

TASK = "grasp-success"


class GraspNet(nn.Module):
    """Network with shared weights: differences (B, fingers, 3, px, px) in -1..1 to logits (B, fingers).

    Single images are not normalised, since the strength of the change distinguishes contact from noise. The logits
    depend on the logarithm of the strength; otherwise a firm touch would have a thousand times the logit of a light
    one. A lamp changes the whole picture, contact only a part of it. So the pictures are padded with their edge pixels:
    with zeros, a lamp's change would end at the edge and look like contact.
    """

    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(1.0))  # root mean square of the training differences
        self.layers = nn.Sequential(*_convolution(3, 16, 5), *_convolution(16, 32, 3), *_convolution(32, 32, 3))
        self.last = nn.Linear(64, 1)

    def forward(self, differences: Tensor) -> Tensor:
        """Return the logits (B, fingers) of a successful grasp."""
        maps = self.layers(differences.flatten(0, 1) / self.scale).flatten(2)
        logits: Tensor = self.last(torch.cat([maps.mean(2), maps.amax(2)], dim=1).log1p())
        return logits.view(differences.shape[:2])


def _convolution(inputs: int, outputs: int, kernel: int) -> list[nn.Module]:
    layer = nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2, padding_mode="replicate")
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    return [layer, nn.ReLU()]


FingerFrames = Any
"""One finger's `before` (no contact), `during` and `after` (the lift): (H, W, 3) uint8 RGB, or None if the rig takes no
such frame (`robot.grasping.gates.GraspFrames`)."""


class GraspSuccessGate:
    """Classifier of grasps, a function of {finger: frames} for any number of fingers.

    Attributes:
        frame: The frame that is compared with the no-contact frame: "after" the lift, or "during" the grasp.
    """

    preprocessing: ClassVar = Preprocessing(touch_px=64, background="difference")

    def __init__(self, net: GraspNet, frame: str) -> None:
        self.net, self.frame = net.eval(), frame

    def __call__(self, fingers: Mapping[str, FingerFrames]) -> bool:
        """Return whether the grasp succeeded: whether any finger's probability is at least 1/2.

        Raises:
            BadInput: There are no fingers, a frame is missing, or a frame is not a picture.
        """
        if not fingers:
            raise BadInput("a grasp must have the frames of at least one finger; got none")
        differences = [self._difference(name, frames) for name, frames in sorted(fingers.items())]
        return max(self.score(touch_batch([differences]))[0]) >= 0

    @torch.inference_mode()
    def score(self, differences: Tensor) -> list[list[float]]:
        """Return the logits of grasps' fingers, given differences (B, fingers, 3, px, px).

        Raises:
            NumericalError: A logit is not finite. A NaN is not above 0, so the grasp would be classified as failed.
        """
        with one_thread():
            logits: list[list[float]] = self.net(differences).tolist()
        if not np.isfinite(logits).all():
            raise NumericalError(f"logits of a gate must be finite, got {logits}; train the gate again")
        return logits

    def _difference(self, finger: str, frames: FingerFrames) -> NDArray[np.float32]:
        frame, before = getattr(frames, self.frame), frames.before
        if frame is None or before is None:
            missing = "before" if before is None else self.frame
            raise BadInput(f"this gate compares the frames before and {self.frame}; finger {finger} has none {missing}")
        return self.preprocessing.touch(to_float(frame), to_float(before))


def load_gate(path: Path) -> GraspSuccessGate:
    """Read a gate that `train_gate` wrote.

    Raises:
        CheckpointError: The file is not a usable gate.
    """
    state, header = read_tensors(path)
    if header.get("task") != TASK:
        raise CheckpointError(
            f"{path} is not a grasp-success gate but another checkpoint, such as a matcher; "
            f"train a gate with `retrieve train --task {TASK}`"
        )
    net = GraspNet()
    load_weights(net, state)
    return GraspSuccessGate(net, header["frame"])
