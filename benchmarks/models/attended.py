"""Occlusion maps of real touches: which parts of a gel image decide that it resembles another touch of its object.

    python -m benchmarks.models.attended RECORDING --init WEIGHTS --out FOLDER

RECORDING holds touches of one finger with no-contact frames, and two or more sequences of each object (`retrieve import
physiclear`). A touch is compared by the cosine of its features minus those of its no-contact frame. Each square in turn
is replaced by the no-contact frame (Zeiler and Fergus, ECCV 2014); the map shows the decrease of the cosine with the
most similar other sequence of the same object. FOLDER/attended.png shows six objects that both towers find, and six
that the gel tower misses, each with the touch that was found instead.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.models.failures import show
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.images import RgbImage
from retrieval.evaluation.real.touch_to_touch import Sequences
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.config import Config, load_config
from retrieval.model.encode import touch_features
from retrieval.model.fusion import Matcher
from retrieval.training.features import encode_recording

TOUCH_PX, SQUARES, SHOWN = 192, 12, 6
"""Size of the gel images, as in preset `adapt`; squares along each side; objects in each half of the picture."""
TOWERS = {"ImageNet": "", "gel": "gel"}
"""Name of each touch tower and its `init_touch`."""


class Compared(NamedTuple):
    """The sequences of a recording as one touch tower sees them.

    Attributes:
        matcher: Matcher with the tower.
        mean: (F,) mean of the differences of features to those of the no-contact frame.
        deviation: (F,) their standard deviation.
        codes: (S, F) standardised differences of unit length.
    """

    matcher: Matcher
    mean: NDArray[np.float32]
    deviation: NDArray[np.float32]
    codes: NDArray[np.float32]

    def encode(self, touches: Sequence[RgbImage], frame: RgbImage) -> NDArray[np.float32]:
        """Return the codes (n, F) of touches with the same no-contact frame."""
        features = touch_features(self.matcher, [(image,) for image in (*touches, frame)]).numpy()
        return unit((features[:-1] - features[-1] - self.mean) / self.deviation)


def main(argv: Sequence[str] | None = None) -> int:
    """Print how many sequences each tower finds, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--init", default="imagenet", help="initial weights, as in `retrieve train`")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    sequences = Sequences.of(load_grasps(arguments.recording))
    grasps = [sequences.grasps[rows[len(rows) // 2]] for rows in sequences.rows]
    configs = {name: config_of(arguments.init, init_touch) for name, init_touch in TOWERS.items()}
    compared = {name: compare(grasps, config, arguments.out / "features") for name, config in configs.items()}
    nearest = {name: nearest_other(each.codes) for name, each in compared.items()}
    found = {name: sequences.owner[rows] == sequences.owner for name, rows in nearest.items()}
    for name, right in found.items():
        print(f"{name}: {right.sum()} of {len(right)} sequences find their object")
    shown = [*spread(np.flatnonzero(found["ImageNet"] & found["gel"])), *spread(np.flatnonzero(~found["gel"]))]
    figure = picture(grasps, sequences.owner, compared, nearest["gel"], shown, configs["gel"])
    figure.savefig(arguments.out / "attended.png", dpi=80)
    return 0


def config_of(init: str, init_touch: str) -> Config:
    """Return the configuration of a frozen touch tower."""
    config = load_config("real")
    return dataclasses.replace(
        config,
        matcher=dataclasses.replace(config.matcher, fingers=1),
        training=dataclasses.replace(config.training, init=init, init_touch=init_touch),
        preprocessing=dataclasses.replace(config.preprocessing, touch_px=TOUCH_PX),
    )


def compare(grasps: list[Grasp], config: Config, cache: Path) -> Compared:
    """Encode one touch of each sequence."""
    matcher = frozen_matcher(config).eval()
    touched = encode_recording(grasps, matcher, config, cache)
    frames = encode_recording(grasps, matcher, config, cache, touch_variant="no_contact", photo_features_from=touched)
    differences = (touched.touch - frames.touch)[:, 0]
    mean, deviation = differences.mean(0), differences.std(0) + 1e-6
    return Compared(matcher, mean, deviation, unit((differences - mean) / deviation))


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return rows of unit length."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def nearest_other(codes: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the most similar other row of each row."""
    cosines = codes @ codes.T
    np.fill_diagonal(cosines, -np.inf)
    return cosines.argmax(1)


def spread(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return at most `SHOWN` rows at even distances."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(SHOWN, len(rows))).astype(int))]


def decreases(each: Compared, touch: RgbImage, frame: RgbImage, other: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the occlusion map (SQUARES, SQUARES): the decrease of the cosine with the code `other` (F,)."""
    edges = list(pairwise(np.linspace(0, len(touch), SQUARES + 1).round().astype(int)))
    hidden = []
    for top, bottom in edges:
        for left, right in edges:
            image = touch.copy()
            image[top:bottom, left:right] = frame[top:bottom, left:right]
            hidden.append(image)
    whole, *others = each.encode([touch, *hidden], frame) @ other
    return (whole - np.array(others, np.float32)).reshape(SQUARES, SQUARES)


def picture(
    grasps: Sequence[Grasp],
    owner: NDArray[np.int64],
    compared: dict[str, Compared],
    nearest: NDArray[np.int64],
    shown: Sequence[int],
    config: Config,
) -> Figure:
    """Draw each shown touch, its map for each tower, its most similar touch of the same object, and the nearest."""
    figure = Figure(figsize=(16, 1.9 * -(-len(shown) // 2)), layout="constrained")
    axes = figure.subplots(-(-len(shown) // 2), 10, squeeze=False)
    half = -(-len(shown) // 2)
    for place, row in enumerate(shown):
        cells = axes[place % half, place // half * 5 :][:5]
        files = grasps[row].touches[0], grasps[row].backgrounds[0]
        touch, frame = map(config.preprocessing.load_touch, files)
        show(cells[0], touch, grasps[row].object_id)
        cosines = compared["gel"].codes @ compared["gel"].codes[row]
        same = np.flatnonzero((owner == owner[row]) & (np.arange(len(owner)) != row))
        other = same[cosines[same].argmax()]
        for axis, (name, each) in zip(cells[1:], compared.items(), strict=False):
            draw_map(axis, touch, decreases(each, touch, frame, each.codes[other]), name)
        for axis, title, which in zip(cells[3:], ("same object", "found first"), (other, nearest[row]), strict=True):
            about = title if owner[which] == owner[row] else f"{title}:\n{grasps[which].object_id}"
            show(axis, config.preprocessing.load_touch(grasps[which].touches[0]), about)
    for axis in axes.flat:
        axis.set_axis_off()
    return figure


def draw_map(axis: Axes, touch: RgbImage, falls: NDArray[np.float32], title: str) -> None:
    """Draw an occlusion map over a grey touch: red squares support the comparison, blue ones contradict it."""
    height, width = touch.shape[:2]
    axis.imshow(touch.mean(2), cmap="gray", vmin=0, vmax=1)
    scale = float(np.abs(falls).max()) or 1.0
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    axis.imshow(falls, cmap="bwr", vmin=-scale, vmax=scale, alpha=0.45, extent=extent, interpolation="bilinear")
    axis.set_title(title, fontsize=8)


if __name__ == "__main__":
    raise SystemExit(main())
