"""Training of the network that estimates the roll of a photo (`retrieval.data.upright`).

    python -m models.upright PHOTOS [PHOTOS ...] --out retrieval/shipped/upright.onnx
    python -m models.upright OTHER-PHOTOS --score retrieval/shipped/upright.onnx

PHOTOS are folders of varied photos (`models.pictures`), whose rolls are known. `--score` prints the share of photos
whose most probable roll is right within 20 degrees. `build-index` uses the mean over the photos of a catalogue.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from models.pictures import LabelledPicture
from models.recognition import mean_interval
from models.small_networks import convolution, fit, run_command, to_onnx
from retrieval.data.images import read_rgb
from retrieval.data.object_finder import crop_square, find_object
from retrieval.data.resize import resize
from retrieval.data.upright import DISC, INPUT_PX, ROLLS, RollEstimator, masked

STEPS, PHOTOS_PER_STEP, LEARNING_RATE = 3000, 64, 2e-3
WIDTHS = (24, 48, 64, 96)
"""Channels at a half to a sixteenth of the input's resolution."""
STORED_PX, STORED_SIDE = 96, 1.3
"""Side in pixels of the squares around the objects that are kept in memory, and relative to the disc."""
SPREAD = 0.75
"""Standard deviation of the target over rolls, in steps."""
GOOD_ROLL = math.radians(20)
EXAMPLE = torch.zeros(1, 3, INPUT_PX, INPUT_PX)


class RollNetwork(nn.Sequential):
    """Maps discs (B, 3, INPUT_PX, INPUT_PX) in 0..1 to logits (B, ROLLS) of the rolls."""

    def __init__(self) -> None:
        """Create random weights."""
        layers: list[nn.Module] = []
        for before, width in zip((3, *WIDTHS), WIDTHS, strict=False):
            layers += [convolution(before, width, stride=2), convolution(width, width)]
        side = INPUT_PX >> len(WIDTHS)
        super().__init__(*layers, nn.Flatten(), nn.Dropout(0.3), nn.Linear(WIDTHS[-1] * side**2, ROLLS))


def main(argv: Sequence[str] | None = None) -> int:
    """Train and write a network, or score one."""
    return run_command(
        argv,
        __doc__,
        lambda pictures: to_onnx(train(pictures), EXAMPLE),
        lambda file, pictures: score(RollEstimator(file), pictures),
    )


def train(pictures: Sequence[LabelledPicture], steps: int = STEPS) -> RollNetwork:
    """Return a network that was trained on photos, each turned by another random angle in every step."""
    torch.manual_seed(0)
    rng, network = np.random.default_rng(97), RollNetwork().to(memory_format=torch.channels_last)  # faster on a CPU
    squares = [stored_square(each) for each in pictures]
    squares += [np.ascontiguousarray(square[:, ::-1]) for square in squares]
    rolls = np.array([each.roll_rad for each in pictures])
    rolls = np.concatenate([rolls, -rolls])  # of the mirrored photos

    def loss_of_step() -> Tensor:
        rows = rng.integers(len(squares), size=PHOTOS_PER_STEP)
        turns = rng.uniform(0, 2 * math.pi, len(rows))
        shown = [draw_disc(squares[row], turn, rng) for row, turn in zip(rows, turns, strict=True)]
        logits = network(torch.from_numpy(np.stack(shown)).permute(0, 3, 1, 2))
        return functional.cross_entropy(logits, torch.from_numpy(target(rolls[rows] + turns)))

    fit(network, loss_of_step, "roll network", steps, LEARNING_RATE, weight_decay=1e-2)
    return network


def stored_square(picture: LabelledPicture) -> NDArray[np.float32]:
    """Return the surroundings (STORED_PX, STORED_PX, 3) of the object in a photo, larger than the disc."""
    photo = read_rgb(picture.file)
    found = find_object(photo)
    return resize(crop_square(photo, found, STORED_SIDE * DISC * found.side), (STORED_PX, STORED_PX))


def draw_disc(square: NDArray[np.float32], turn: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a disc from a stored square, turned anticlockwise by `turn`, at a random place, size and brightness."""
    scale = STORED_SIDE * INPUT_PX / STORED_PX * math.exp(rng.normal(0, 0.12))
    matrix = cv2.getRotationMatrix2D(((STORED_PX - 1) / 2,) * 2, math.degrees(turn), scale)
    matrix[:, 2] += (INPUT_PX - STORED_PX) / 2 + rng.normal(0, 0.03 * INPUT_PX, 2)
    shown = cv2.warpAffine(square, matrix, (INPUT_PX, INPUT_PX), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
    return masked(np.clip(shown * np.float32(math.exp(rng.normal(0, 0.2))), 0, 1))


def target(rolls: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the probabilities (B, ROLLS) that the network should give for these rolls in radians."""
    steps = np.arange(ROLLS) - rolls[:, None] * ROLLS / (2 * math.pi)
    apart = steps - ROLLS * np.round(steps / ROLLS)
    likely = np.exp(-0.5 * np.square(apart / SPREAD))
    return np.asarray(likely / likely.sum(1, keepdims=True), np.float32)


def score(estimator: RollEstimator, pictures: Sequence[LabelledPicture]) -> str:
    """Return the share of photos whose most probable roll is right, with a 95 % interval over objects."""
    names = sorted({each.object_id for each in pictures})
    owner = np.array([names.index(each.object_id) for each in pictures])
    apart = []
    for picture in pictures:
        photo = read_rgb(picture.file)
        likely = int(estimator.probabilities(photo, find_object(photo)).argmax())
        apart.append(abs(math.remainder(likely * 2 * math.pi / ROLLS - (picture.roll_rad or 0.0), 2 * math.pi)))
    return f"right: {mean_interval(np.array(apart) < GOOD_ROLL, owner)} of {len(pictures)} photos"


if __name__ == "__main__":
    raise SystemExit(main())
