"""Training of the network that marks the object in a photo (`retrieval.data.object_finder`).

    python -m models.object_finder PHOTOS [PHOTOS ...] --out retrieval/shipped/object-finder.onnx
    python -m models.object_finder OTHER-PHOTOS --score retrieval/shipped/object-finder.onnx

PHOTOS are folders of varied photos (`models.pictures`), with a mask of the object's pixels for each photo. `--score`
prints how well the object's box agrees with that of the mask: the mean intersection over union, and the share of
photos where it is below 0.7.
"""

import itertools
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
from retrieval.data.object_finder import INPUT_PX, FoundObject, ObjectFinder

STEPS, PHOTOS_PER_STEP, LEARNING_RATE = 2500, 24, 3e-3
WIDTHS = (16, 32, 64, 96)
"""Channels at a half, a quarter, an eighth and a sixteenth of the input's resolution."""
SMALLEST_CROP, STRETCH = 0.6, 0.15
"""Smallest side of a training crop relative to the photo; standard deviation of the logarithm of its stretch."""
GOOD_OVERLAP = 0.7
EXAMPLE = torch.zeros(1, 3, INPUT_PX, INPUT_PX)


class MaskNetwork(nn.Module):
    """A U-Net (Ronneberger et al., 2015) that marks the object.

    It maps photos (B, 3, INPUT_PX, INPUT_PX) in 0..1 to logits (B, 1, INPUT_PX / 2, INPUT_PX / 2) of the object.
    """

    def __init__(self) -> None:
        """Create random weights."""
        super().__init__()
        self.enter = nn.Sequential(convolution(3, WIDTHS[0], stride=2), convolution(WIDTHS[0], WIDTHS[0]))
        pairs = list(itertools.pairwise(WIDTHS))
        self.down = nn.ModuleList(
            nn.Sequential(convolution(fine, coarse, stride=2), convolution(coarse, coarse)) for fine, coarse in pairs
        )
        self.up = nn.ModuleList(convolution(fine + coarse, fine) for fine, coarse in pairs[::-1])
        self.leave = nn.Conv2d(WIDTHS[0], 1, 1)

    def forward(self, photos: Tensor) -> Tensor:
        """Return the logits of photos."""
        maps = [self.enter(photos - 0.5)]
        for down in self.down:
            maps.append(down(maps[-1]))
        coarse = maps.pop()
        for up in self.up:
            fine = maps.pop()
            coarse = up(torch.cat([fine, functional.interpolate(coarse, scale_factor=2.0, mode="nearest")], dim=1))
        logits: Tensor = self.leave(coarse)
        return logits


def main(argv: Sequence[str] | None = None) -> int:
    """Train and write a network, or score one."""
    return run_command(
        argv,
        __doc__,
        lambda pictures: to_onnx(train(pictures), EXAMPLE),
        lambda file, pictures: score(ObjectFinder(file), pictures),
    )


def train(pictures: Sequence[LabelledPicture], steps: int = STEPS) -> MaskNetwork:
    """Return a network that was trained on photos and their masks."""
    torch.manual_seed(0)
    rng, network = np.random.default_rng(96), MaskNetwork().to(memory_format=torch.channels_last)  # faster on a CPU
    photos = [cv2.imread(str(each.file))[..., ::-1] for each in pictures]
    masks = [cv2.imread(str(each.mask), cv2.IMREAD_GRAYSCALE) for each in pictures]

    def loss_of_step() -> Tensor:
        rows = rng.integers(len(photos), size=PHOTOS_PER_STEP)
        crops = [draw_crop(photos[row], masks[row], rng) for row in rows]
        shown, marked = (torch.from_numpy(np.stack(part)) for part in zip(*crops, strict=True))
        logits = network(shown.permute(0, 3, 1, 2))[:, 0]  # the permuted memory has the channels last
        return functional.binary_cross_entropy_with_logits(logits, marked)

    fit(network, loss_of_step, "object finder", steps, LEARNING_RATE, weight_decay=1e-4)
    return network


def draw_crop(
    photo: NDArray[np.uint8], mask: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a random crop of a square photo (INPUT_PX, INPUT_PX, 3) and of its mask, half as large, both in 0..1."""
    size, stretch = rng.uniform(SMALLEST_CROP, 1), rng.normal(0, STRETCH)
    sides = np.minimum([size * math.exp(stretch), size * math.exp(-stretch)], 1.0)
    corner = rng.uniform(0, 1, 2) * (1 - sides)
    is_mirrored = rng.random() < 0.5

    def crop(picture: NDArray[np.uint8], px: int) -> NDArray[np.float32]:
        side = len(picture)
        top, left = np.rint(corner * side).astype(int)
        height, width = np.maximum(np.rint(sides * side).astype(int), 1)
        inside = picture[top : top + height, left : left + width].astype(np.float32) / 255
        resized = cv2.resize(inside, (px, px), interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(resized[:, ::-1] if is_mirrored else resized)

    return crop(photo, INPUT_PX), crop(mask, INPUT_PX // 2)


def score(finder: ObjectFinder, pictures: Sequence[LabelledPicture]) -> str:
    """Return mean overlap and share of bad boxes, with 95 % intervals over objects, of photos with an object."""
    overlaps, owner, names = [], [], sorted({each.object_id for each in pictures})
    for picture in pictures:
        mask = cv2.imread(str(picture.mask), cv2.IMREAD_GRAYSCALE) >= 128
        if not mask.any():
            continue
        photo = read_rgb(picture.file)
        height, width = photo.shape[:2]
        down, right = np.nonzero(mask)
        scale = np.array([width, height, width, height]) / [*mask.shape[::-1], *mask.shape[::-1]]
        edges = [right.min(), down.min(), right.max() + 1, down.max() + 1] * scale
        true = FoundObject(*edges.tolist(), mask.mean() * width * height)
        overlaps.append(overlap(finder.find(photo), true))
        owner.append(names.index(picture.object_id))
    rows = {"overlap": np.array(overlaps), f"below {GOOD_OVERLAP}": np.array(overlaps) < GOOD_OVERLAP}
    means = {what: mean_interval(values, np.array(owner)) for what, values in rows.items()}
    return "\n".join(f"{what}: {mean} of {len(overlaps)} photos" for what, mean in means.items())


def overlap(one: FoundObject, other: FoundObject) -> float:
    """Return the intersection over union of two boxes."""
    width = max(min(one.right, other.right) - max(one.left, other.left), 0)
    height = max(min(one.bottom, other.bottom) - max(one.top, other.top), 0)
    areas = [(box.right - box.left) * (box.bottom - box.top) for box in (one, other)]
    return width * height / (sum(areas) - width * height)


if __name__ == "__main__":
    raise SystemExit(main())
