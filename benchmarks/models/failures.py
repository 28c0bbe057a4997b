"""Errors of recognition: which objects are confused with which, and a picture of some errors.

    python -m benchmarks.models.failures RECORDING --out FOLDER [--model shipped]

RECORDING holds grasps of unseen objects of the simulated rig, which labels them. Each touch is ranked among the photos
of all objects of RECORDING, one photo of each, not taken in its own grasp. The tables give the top-1 accuracy by
property of the object, with 95 % intervals over objects, and what confused objects have in common. The picture,
FOLDER/failures.png, shows twelve errors at random: both gel images, the photo of the true object, and the photo ranked
first. Both photos are cropped as the model sees them.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.models.recognition import all_scores, summary_cell
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.images import read_rgb
from retrieval.data.labelled_pictures import ObjectLabels, load_object_labels
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.search.defaults import find_model
from retrieval.training.distil import feature_partials
from retrieval.training.features import encode_recording

SHOWN = 12
PITCHES_MM, AMPLITUDES_MM = (2.0, 4.0, 8.0), (0.2, 0.4, 0.8)
PROPERTIES: Mapping[str, Callable[[ObjectLabels], str]] = {
    "relief": lambda labels: labels.relief,
    "shape": lambda labels: labels.shape,
    "pitch": lambda labels: "none" if labels.is_smooth else between(labels.sizes[0], PITCHES_MM),
    "amplitude": lambda labels: "none" if labels.is_smooth else between(labels.sizes[1], AMPLITUDES_MM),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--model", default="shipped")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    checkpoint = load_checkpoint(find_model(arguments.model)[0])
    grasps, labels = load_grasps(arguments.recording), load_object_labels(arguments.recording)
    first = first_photos(checkpoint, grasps, arguments.out / "features")
    print("\n".join([*accuracy_table(grasps, first, labels), "", *rival_table(grasps, first, labels)]))
    wrong = np.flatnonzero([grasps[row].object_id != grasps[best].object_id for row, best in enumerate(first)])
    shown = np.random.default_rng(0).permutation(wrong)[:SHOWN]
    pairs = [(grasps[row], grasps[first[row]]) for row in shown]
    picture(checkpoint, pairs, labels).savefig(arguments.out / "failures.png", dpi=90)
    return 0


def first_photos(checkpoint: Checkpoint, grasps: Sequence[Grasp], cache: Path) -> NDArray[np.int64]:
    """Return, for each touch, the grasp whose photo is ranked first among one photo of each object."""
    features = encode_recording(grasps, checkpoint.matcher, checkpoint.config, cache)
    touches, photos = feature_partials(checkpoint.matcher, features)
    scores, owner = all_scores(checkpoint, touches, photos), features.owner
    draw = np.random.default_rng(0)
    first = np.zeros(len(grasps), dtype=np.int64)
    for row in range(len(grasps)):
        others = draw.permutation(np.delete(np.arange(len(owner)), row))
        chosen = others[np.unique(owner[others], return_index=True)[1]]  # a random photo of each object
        first[row] = chosen[np.argmax(scores[row, chosen])]
    return first


def accuracy_table(grasps: Sequence[Grasp], first: NDArray[np.int64], labels: Mapping[str, ObjectLabels]) -> list[str]:
    """Return the lines of a Markdown table: top-1 accuracy by property of the object."""
    names = sorted({grasp.object_id for grasp in grasps})
    owner = np.array([names.index(grasp.object_id) for grasp in grasps])
    right = np.array([grasp.object_id == grasps[best].object_id for grasp, best in zip(grasps, first, strict=True)])
    lines = [f"| property | value | objects | top-1 accuracy among {len(names)} |", "|---|---|---|---|"]
    for what, value_of in PROPERTIES.items():
        values = np.array([value_of(labels[grasp.object_id]) for grasp in grasps])
        for value in np.unique(values):
            rows = values == value
            measure = Measure(right[rows, None].astype(float), owner[rows], np.array([1 / len(names)]), "all objects")
            cell = summary_cell(summarise([measure], seed=0))
            lines.append(f"| {what} | {value} | {len(np.unique(owner[rows]))} | {cell} |")
    return lines


def rival_table(grasps: Sequence[Grasp], first: NDArray[np.int64], labels: Mapping[str, ObjectLabels]) -> list[str]:
    """Return the lines of a Markdown table: what the true object and the one ranked first have in common."""
    names = sorted({grasp.object_id for grasp in grasps})
    pairs = [(grasp.object_id, grasps[best].object_id) for grasp, best in zip(grasps, first, strict=True)]
    errors = [pair for pair in pairs if pair[0] != pair[1]]
    chance = [(one, other) for one, _ in pairs for other in names if other != one]
    lines = ["| the object ranked first has the same | of the errors | of all other objects |", "|---|---|---|"]
    for text, shared in (
        ("relief and shape", (True, True)),
        ("relief, another shape", (True, False)),
        ("shape, another relief", (False, True)),
        ("neither", (False, False)),
    ):
        fractions = [np.mean([in_common(labels, *pair) == shared for pair in part]) for part in (errors, chance)]
        lines.append(f"| {text} | {fractions[0]:.2f} | {fractions[1]:.2f} |")
    return lines


def in_common(labels: Mapping[str, ObjectLabels], one: str, other: str) -> tuple[bool, bool]:
    """Return whether two objects have the same relief, and the same shape."""
    first, second = labels[one], labels[other]
    return first.relief == second.relief, first.shape == second.shape


def between(value: float, limits: tuple[float, ...]) -> str:
    """Return the interval of `limits` in which a length lies."""
    place = int(np.searchsorted(limits, value))
    low, high = ([0.0, *limits][place], [*limits, np.inf][place])
    return f"{low:g} to {high:g} mm" if np.isfinite(high) else f"above {low:g} mm"


def picture(checkpoint: Checkpoint, pairs: Sequence[tuple[Grasp, Grasp]], labels: Mapping[str, ObjectLabels]) -> Figure:
    """Draw the gel images of each error, the photo of the true object, and the photo that was ranked first."""
    columns = 2
    figure = Figure(figsize=(17, 2.2 * -(-len(pairs) // columns)), layout="constrained")
    axes = figure.subplots(-(-len(pairs) // columns), columns * 4, squeeze=False)
    for place, (true, best) in enumerate(pairs):
        row = axes[place // columns, place % columns * 4 :][:4]
        crops = [first_view(checkpoint, grasp.photo) for grasp in (true, best)]
        images = [*(read_rgb(file) for file in true.touches[:2]), *crops]
        titles = ["finger a", "finger b", *(describe(labels[grasp.object_id]) for grasp in (true, best))]
        for axis, image, title in zip(row, images, titles, strict=False):
            show(axis, image, title)
    for axis in axes.flat:
        axis.set_axis_off()
    return figure


def first_view(checkpoint: Checkpoint, file: Path) -> NDArray[np.float32]:
    """Return the first view of a photo as the model sees it."""
    views = checkpoint.config.preprocessing.load_photo(file)
    return np.asarray(np.split(np.asarray(views), len(checkpoint.config.preprocessing.views), axis=1)[0])


def show(axis: Axes, image: NDArray[np.float32], title: str) -> None:
    """Draw an image with a title."""
    axis.imshow(np.clip(image, 0, 1))
    axis.set_title(title, fontsize=8)


def describe(labels: ObjectLabels) -> str:
    """Return a short description of an object."""
    pitch, amplitude, *_ = labels.sizes
    relief = "smooth" if labels.is_smooth else f"{labels.relief}, {pitch:.1f} mm, {amplitude:.2f} high"
    return f"{labels.shape}\n{relief}"


if __name__ == "__main__":
    raise SystemExit(main())
