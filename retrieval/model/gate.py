"""The grasp-success gate between a rig and its recording: it classifies the gel images of a grasp.

As in the authors' collection code, one network serves all fingers, and its input is the difference from the no-contact
frame. A grasp succeeds if ANY finger's probability is at least 1/2. This network is smaller than theirs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from _touch_retrieval.documents import check_fields
from retrieval.data.preprocessing import Preprocessing, Side
from retrieval.data.resize import to_float
from retrieval.errors import BadInput, CheckpointError, ConfigError, NumericalError
from retrieval.model.checkpoint import load_weights, read_tensors
from retrieval.model.encode import one_thread, touch_batch

TASK = "grasp-success"


@dataclass(frozen=True)
class GateSettings:
    """Input of a gate: side of the image in pixels, and the frame that it compares with the no-contact frame."""

    touch_px: Side = 64
    frame: Literal["after", "during"] = "after"

    def __post_init__(self) -> None:
        check_fields(self, "gate", ConfigError)

    def preprocessing(self) -> Preprocessing:
        """Return the preprocessing that makes float32 differences (touch_px, touch_px, 3) in -1..1."""
        return Preprocessing(touch_px=self.touch_px, background="difference")


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
    """Classifier of grasps, a function of {finger: frames} for any number of fingers."""

    def __init__(self, net: GraspNet, settings: GateSettings) -> None:
        self.net, self.settings = net.eval(), settings
        self._preprocessing = settings.preprocessing()

    def __call__(self, fingers: Mapping[str, FingerFrames]) -> bool:
        """Return whether the grasp succeeded: whether any finger's probability is at least 1/2.

        Raises:
            BadInput: As for `logits`.
        """
        return max(self.logits(fingers).values()) >= 0

    def logits(self, fingers: Mapping[str, FingerFrames]) -> dict[str, float]:
        """Return each finger's log-odds of success.

        Raises:
            BadInput: A frame is missing, or is not a picture.
        """
        names = sorted(fingers)
        return dict(zip(names, self.score([[self._difference(name, fingers[name]) for name in names]])[0], strict=True))

    @torch.inference_mode()
    def score(self, differences: Sequence[Sequence[NDArray[np.float32]]]) -> list[list[float]]:
        """Return the logits of grasps, each given by its fingers' differences.

        Raises:
            NumericalError: A logit is not finite. A NaN is not above 0, so the grasp would be classified as failed.
        """
        with one_thread():
            logits: list[list[float]] = self.net(touch_batch(differences)).tolist()
        if bad := [number for number, each in enumerate(logits) if not all(map(math.isfinite, each))]:
            raise NumericalError(f"logits of a gate must be finite, got {logits[bad[0]]}; train the gate again")
        return logits

    def _difference(self, finger: str, frames: FingerFrames) -> NDArray[np.float32]:
        frame, before = getattr(frames, self.settings.frame), frames.before
        if frame is None or before is None:
            missing = "before" if before is None else self.settings.frame
            raise BadInput(
                f"this gate compares the frames before and {self.settings.frame}; finger {finger} has none {missing}"
            )
        return self._preprocessing.touch(to_float(frame), to_float(before))


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
    try:
        settings = GateSettings(**header["gate"])
        load_weights(net, state)
    except (BadInput, TypeError, KeyError) as error:
        raise CheckpointError(f"{path} is not a gate that this version can use: {error}") from error
    return GraspSuccessGate(net, settings)
