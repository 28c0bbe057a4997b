"""Linear probes: how well the features of each tower predict the relief, shape, pitch and amplitude of an object.

    python -m benchmarks.models.probes RECORDING ... --test TEST [--model shipped | --config FILE] [--cache FOLDER]

Ridge regressions from the pooled features of a touch (all fingers), or of a photo (all views), to the labels of the
simulated objects are fitted on the RECORDINGs and scored on TEST. With --config the towers are those with which a
training of this configuration starts. They should not have been trained on any of these objects. For relief and shape
the table has the fraction of right answers, for pitch and amplitude the correlation of the logarithms over objects with
relief. "Both": the answers for the touch and for the photo of a grasp are right. Intervals are 95 %, over objects.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import Ridge, RidgeClassifier

from benchmarks.models.recognition import interval
from retrieval.commands.options import training_config
from retrieval.data.dataset import load_grasps
from retrieval.data.labelled_pictures import FAMILIES, SIZES, ObjectLabels, load_object_labels
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.metrics.intervals import bootstrap_interval
from retrieval.metrics.measure import object_means
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.fusion import MIN_RELATIVE_DEVIATION
from retrieval.search.defaults import find_model
from retrieval.training.features import Features, encode_recording

RIDGE, CLIP = 5000.0, 6.0
"""Penalty of the regression on standardised features, and the largest magnitude of these."""

Array = NDArray[np.float64]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="+")
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--model", default="shipped")
    parser.add_argument("--config", help="configuration whose initial towers are used instead of the model's")
    parser.add_argument("--init", help="its initial weights, as in `retrieve train`")
    parser.add_argument("--cache", type=Path, help="folder for encoded features")
    arguments = parser.parse_args(argv)
    if arguments.config:
        config = training_config(arguments.config, None, init=arguments.init)
        matcher = frozen_matcher(config)
    else:
        checkpoint = load_checkpoint(find_model(arguments.model)[0])
        config, matcher = checkpoint.config, checkpoint.matcher
    folders = [*arguments.recording, arguments.test]
    labels = {name: each for folder in folders for name, each in load_object_labels(folder).items()}
    train, test = (
        encode_recording(
            [grasp for folder in part for grasp in load_grasps(folder)], matcher, config, arguments.cache
        ).pooled(matcher)
        for part in (arguments.recording, [arguments.test])
    )
    print("\n".join(table(train, test, labels)))
    return 0


def table(train: Features, test: Features, labels: Mapping[str, ObjectLabels]) -> list[str]:
    """Return a Markdown table of probes that are fitted on `train` and scored on `test`."""
    fitted, known = ([labels[name] for name in part.object_ids] for part in (train, test))
    sides = [
        standardised(*(part.reshape(len(part), -1).astype(np.float64) for part in each))
        for each in ((train.touch, test.touch), (train.photo, test.photo))
    ]
    lines = ["| label | chance | touch | photo | both |", "|---|---|---|---|---|"]
    for index, family in enumerate(FAMILIES):
        names, truth = (np.array([label.families[index] for label in part]) for part in (fitted, known))
        answers = [RidgeClassifier(RIDGE).fit(inputs, names).predict(tested) for inputs, tested in sides]
        right = np.stack([answer == truth for answer in answers], axis=1)
        means = object_means(np.column_stack([right, right.all(1)]).astype(np.float64), test.owner)[1]
        cells = [interval(*ends) for ends in zip(means.mean(0), *bootstrap_interval(means), strict=True)]
        chance = max(np.unique(truth, return_counts=True)[1]) / len(truth)
        lines.append(f"| {family} | {chance:.3f} | {' | '.join(cells)} |")
    targets, truths = (np.array([label.size_targets for label in part]) for part in (fitted, known))
    has_relief = np.array([not label.is_smooth for label in known])
    predictions = [Ridge(RIDGE).fit(inputs, targets).predict(tested)[has_relief] for inputs, tested in sides]
    for column, name in enumerate(SIZES[:2]):
        truth = truths[has_relief, column]
        touch, photo = (np.corrcoef(each[:, column], truth)[0, 1] for each in predictions)
        lines.append(f"| {name.removesuffix('_mm')}, correlation | 0 | {touch:.3f} | {photo:.3f} | |")
    return lines


def standardised(fitted: Array, tested: Array) -> tuple[Array, Array]:
    """Return both, standardised by the mean and deviation of `fitted` and clipped."""
    mean = fitted.mean(0)
    scale = np.maximum(fitted.std(0), MIN_RELATIVE_DEVIATION * np.abs(mean)) + 1e-9
    first, second = (np.clip((part - mean) / scale, -CLIP, CLIP) for part in (fitted, tested))
    return first, second


if __name__ == "__main__":
    raise SystemExit(main())
