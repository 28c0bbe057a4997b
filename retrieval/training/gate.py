"""The gate between a rig and its recording: gel images of a grasp in, whether it succeeded out.

As in the authors' collection code, one network serves every finger and sees the change since the gel was untouched;
a grasp succeeded when ANY finger says so with probability 1/2 or more. The network is smaller.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.data.images import to_float
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, CheckpointError, ConfigError, NumericalError
from retrieval.model.checkpoint import load_weights, read_tensors
from retrieval.model.encode import one_thread, touch_batch

TASK = "grasp-success"
MOMENTS = ("after", "during")


@dataclass(frozen=True)
class GateSettings:
    """What a gate looks at. touch_px: side of the square it reads; frame: one of MOMENTS, compared with before."""

    touch_px: int = 64
    frame: str = "after"

    def __post_init__(self) -> None:
        self.preprocessing()
        if self.frame not in MOMENTS:
            raise ConfigError(f"the frame that a gate judges must be one of {', '.join(MOMENTS)}; got {self.frame!r}")

    def preprocessing(self) -> Preprocessing:
        """From two frames to their difference (touch_px, touch_px, 3) in -1..1, in float32."""
        return Preprocessing(touch_px=self.touch_px, background="difference")


class GraspNet(nn.Module):
    """Differences (B, fingers, 3, px, px) in -1..1 to one logit for each finger (B, fingers), by shared weights.

    Nothing normalises a single image: how strong the change is tells contact from noise. Strength counts by its
    logarithm, or a firm touch would be a thousand times as sure as a light one. A change of the whole
    picture is a lamp and no contact, so edges are repeated: padding with zeros would draw a frame round it.
    """

    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(1.0))  # root mean square of the training differences
        self.layers = nn.Sequential(*_convolution(3, 16, 5), *_convolution(16, 32, 3), *_convolution(32, 32, 3))
        self.last = nn.Linear(64, 1)

    def forward(self, differences: Tensor) -> Tensor:
        """The logits (B, fingers) that a grasp succeeded; the class says of what."""
        maps = self.layers(differences.flatten(0, 1) / self.scale).flatten(2)
        logits: Tensor = self.last(torch.cat([maps.mean(2), maps.amax(2)], dim=1).log1p())
        return logits.view(differences.shape[:2])


def _convolution(inputs: int, outputs: int, kernel: int) -> list[nn.Module]:
    layer = nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2, padding_mode="replicate")
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    return [layer, nn.ReLU()]


class FingerFrames(Protocol):
    """One finger's pictures, (H, W, 3) uint8 RGB; None where the rig does not take them. `robot.grasping.gates` makes
    them.
    """

    @property
    def before(self) -> NDArray[np.uint8] | None: ...
    @property
    def during(self) -> NDArray[np.uint8]: ...
    @property
    def after(self) -> NDArray[np.uint8] | None: ...


class GraspSuccessGate:
    """Judges grasps, as a function of {finger: frames}. It is independent of the number of fingers."""

    def __init__(self, net: GraspNet, settings: GateSettings) -> None:
        self.net, self.settings = net.eval(), settings
        self._preprocessing = settings.preprocessing()

    def __call__(self, fingers: Mapping[str, FingerFrames]) -> bool:
        """Whether the grasp succeeded: whether any finger's probability is 1/2 or more. Raises BadInput."""
        return max(self.logits(fingers).values()) >= 0

    def probabilities(self, fingers: Mapping[str, FingerFrames]) -> dict[str, float]:
        """Each finger's probability of success, at even odds before looking."""
        return {finger: float(torch.tensor(logit).double().sigmoid()) for finger, logit in self.logits(fingers).items()}

    def logits(self, fingers: Mapping[str, FingerFrames]) -> dict[str, float]:
        """Each finger's log-odds of success. Raises BadInput for no fingers, a missing frame, or what is no picture."""
        if not fingers:
            raise BadInput("a grasp must have the frames of at least one finger; got none")
        names = sorted(fingers)
        return dict(zip(names, self.score([[self._difference(name, fingers[name]) for name in names]])[0], strict=True))

    @torch.inference_mode()
    def score(self, differences: Sequence[Sequence[NDArray[np.float32]]]) -> list[list[float]]:
        """Logits of grasps, each a sequence of its fingers' differences. Raises NumericalError for a NaN or infinite
        one: it is not above 0, and the grasp would count as failed.
        """
        with one_thread():
            logits = self.net(touch_batch(differences))
        bad = torch.nonzero(~torch.isfinite(logits))
        if len(bad):
            grasp, finger = bad[0].tolist()
            raise NumericalError(
                f"every logit of a gate must be finite; finger {finger} of grasp {grasp} has "
                f"{logits[grasp, finger].item()}; train the gate again"
            )
        found: list[list[float]] = logits.tolist()
        return found

    def _difference(self, finger: str, frames: FingerFrames) -> NDArray[np.float32]:
        judged, before = getattr(frames, self.settings.frame), frames.before
        if judged is None or before is None:
            missing = "before" if before is None else self.settings.frame
            raise BadInput(
                f"this gate compares the frames before and {self.settings.frame}; finger {finger} has none {missing}"
            )
        return self._preprocessing.touch(to_float(judged), to_float(before))


def load_gate(path: Path) -> GraspSuccessGate:
    """Read a gate that `train_gate` wrote. Raises CheckpointError with what is wrong and what to do."""
    state, header = read_tensors(path)
    if header.get("task") != TASK:
        raise CheckpointError(
            f"{path} is no grasp-success gate but another checkpoint, such as a matcher; "
            f"`retrieve train --task {TASK}` makes gates"
        )
    net = GraspNet()
    try:
        settings = GateSettings(**header["gate"])
        load_weights(net, state)
    except (BadInput, TypeError, KeyError) as error:
        raise CheckpointError(f"{path} is not a gate that this version can use: {error}") from error
    return GraspSuccessGate(net, settings)
