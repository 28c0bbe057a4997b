"""What the features of each tower say of an object: linear probes of its relief, shape, pitch and amplitude.

    python -m benchmarks.models.probes RECORDING ... --test TEST [--model shipped] [--cache FOLDER]

A ridge regression from the pooled features of a touch (all fingers), or of a photo (all views), to the labels of the
simulated objects is fitted on the RECORDINGs and scored on TEST, whose objects no model and no probe was fitted to. For
relief and shape the table has the fraction of right answers, for pitch and amplitude the correlation of the logarithms
over objects with relief. "Both": the answers for the touch and for the photo of a grasp are right. Intervals are 95 %,
over objects.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.models.recognition import interval
from retrieval.data.dataset import load_grasps
from retrieval.data.labelled_pictures import FAMILIES, SIZES, ObjectLabels, load_object_labels
from retrieval.metrics.intervals import bootstrap_interval
from retrieval.metrics.measure import object_means
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.defaults import find_model
from retrieval.training.features import Features, encode_recording

RIDGE, CLIP = 5000.0, 6.0
"""Penalty of the regression on standardised features, and the largest magnitude of these."""
MIN_RELATIVE_DEVIATION = 0.02
SIDES = ("touch", "photo")

Array = NDArray[np.float64]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="+")
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--model", default="shipped")
    parser.add_argument("--cache", type=Path, help="folder for encoded features")
    arguments = parser.parse_args(argv)
    checkpoint, folders = load_checkpoint(find_model(arguments.model)[0]), [*arguments.recording, arguments.test]
    labels = {name: each for folder in folders for name, each in load_object_labels(folder).items()}
    train, test = (
        encode_recording(
            [grasp for folder in part for grasp in load_grasps(folder)],
            checkpoint.matcher,
            checkpoint.config,
            arguments.cache,
        ).pooled(checkpoint.matcher)
        for part in (arguments.recording, [arguments.test])
    )
    fitted, known = ([labels[name] for name in part.object_ids] for part in (train, test))
    predictions = [predict(*(inputs(part, side) for part in (train, test)), fitted) for side in SIDES]
    print("\n".join(table(predictions, fitted, known, test.owner)))
    return 0


def inputs(features: Features, side: str) -> Array:
    """Return the features (G, F) of the touches or of the photos of grasps."""
    part: NDArray[np.float32] = getattr(features, side)
    return part.reshape(len(features), -1).astype(np.float64)


def predict(fitted: Array, tested: Array, labels: Sequence[ObjectLabels]) -> Array:
    """Return predictions (G, kinds and sizes) for `tested`, by a ridge regression from `fitted` with its labels."""
    mean = fitted.mean(0)
    scale = np.maximum(fitted.std(0), MIN_RELATIVE_DEVIATION * np.abs(mean)) + 1e-9
    fitted, tested = (np.clip((part - mean) / scale, -CLIP, CLIP) for part in (fitted, tested))
    sizes = np.array([label.size_targets for label in labels])
    one_hot = [
        np.array([[label.families[index] == kind for kind in kinds(labels, index)] for label in labels])
        for index in range(len(FAMILIES))
    ]
    targets = np.concatenate([*one_hot, sizes], axis=1)
    weights = np.linalg.solve(
        fitted.T @ fitted + RIDGE * np.eye(fitted.shape[1]), fitted.T @ (targets - targets.mean(0))
    )
    return np.asarray(tested @ weights + targets.mean(0))


def kinds(labels: Sequence[ObjectLabels], index: int) -> list[str]:
    """Return the names of the reliefs (index 0) or shapes (1) of objects."""
    return sorted({label.families[index] for label in labels})


def table(
    predictions: Sequence[Array],
    fitted: Sequence[ObjectLabels],
    known: Sequence[ObjectLabels],
    owner: NDArray[np.int64],
) -> list[str]:
    """Return a Markdown table.

    Args:
        predictions: (G, kinds and sizes) of the touches and of the photos.
        fitted: Labels of the grasps of the fit.
        known: Labels of the G test grasps.
        owner: (G,) object of each test grasp.
    """
    lines, start = ["| label | chance | touch | photo | both |", "|---|---|---|---|---|"], 0
    for index, family in enumerate(FAMILIES):
        names = kinds(fitted, index)
        truth = np.array([label.families[index] for label in known])
        answers = [np.array(names)[part[:, start : start + len(names)].argmax(1)] for part in predictions]
        right = np.stack([answer == truth for answer in answers], axis=1)
        means = object_means(np.column_stack([right, right.all(1)]).astype(np.float64), owner)[1]
        cells = [interval(*ends) for ends in zip(means.mean(0), *bootstrap_interval(means), strict=True)]
        chance = max(np.unique(truth, return_counts=True)[1]) / len(truth)
        lines.append(f"| {family} | {chance:.3f} | {' | '.join(cells)} |")
        start += len(names)
    has_relief = np.array([not label.is_smooth for label in known])
    sizes = np.array([label.size_targets for label in known])[has_relief]
    for column, name in enumerate(SIZES[:2]):
        each = [np.corrcoef(part[has_relief, start + column], sizes[:, column])[0, 1] for part in predictions]
        lines.append(f"| {name}, correlation | 0 | {each[0]:.3f} | {each[1]:.3f} | |")
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
