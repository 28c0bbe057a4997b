"""Checks of a split: objects, sequences or neighbouring frames in two of its parts."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from retrieval.console.output import abbreviate_list
from retrieval.data.check.pictures import Finding, ImageRecords, thumbnails
from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError

_MAX_QUERIES = 5000
_BLOCK = 512
_OWN_QUANTILE, _OTHER_QUANTILE = 0.75, 0.05
"""Quantiles of the distance to the nearest touch of the same object, and of another object. Neighbouring frames can be
recognised if the first quantile is below the second."""
_MIN_FRACTION, _MIN_COUNT = 0.1, 3
"""Smallest fraction and number of held-out grasps with such a neighbour in training that cause a warning."""


def check_split(grasps: Sequence[Grasp], split: Split) -> Iterable[Finding]:
    """Yield findings about objects and sequences in two parts of a split, and objects in none."""
    parts = {"train": split.train, "validation": split.validation, "test": split.test}
    part_of: dict[str, set[str]] = defaultdict(set)
    for part, objects in parts.items():
        for name in objects:
            part_of[name].add(part)
    if shared := sorted(name for name, on in part_of.items() if len(on) > 1):
        yield Finding("error", "split-objects", f"the split shares {len(shared)} object(s): {abbreviate_list(shared)}")
    sides: dict[str, set[str]] = defaultdict(set)
    for grasp in grasps:
        if grasp.sequence_id is not None:
            sides[grasp.sequence_id] |= part_of.get(grasp.object_id, set())
    if leaking := sorted(name for name, on in sides.items() if len(on) > 1):
        text = f"the split cuts {len(leaking)} sequence(s) in two, so that neighbouring frames are on both sides"
        yield Finding("error", "split-sequences", f"{text}: {abbreviate_list(leaking)}")
    recorded = {grasp.object_id for grasp in grasps}
    if unknown := sorted(set(part_of) - recorded):
        text = f"the split names {len(unknown)} object(s) not recorded: {abbreviate_list(unknown)}"
        yield Finding("warning", "split-unknown", text)
    if absent := sorted(recorded - set(part_of)):
        yield Finding(
            "warning", "split-absent", f"the split leaves out {len(absent)} object(s): {abbreviate_list(absent)}"
        )


def require_fit(split: Split, grasps: Sequence[Grasp]) -> None:
    """Check that a split fits a recording.

    Raises:
        DatasetError: Parts of the split share an object or a sequence, or a part has fewer than two objects in the
            recording.
    """
    for finding in check_split(grasps, split):
        if finding.severity == "error":
            raise DatasetError(f"{finding.message}; every object and sequence must be in one part of the split")
    for part in ("train", "validation"):
        count = len({grasp.object_id for grasp in split.select(grasps, part)})
        if count < 2 and (part == "train" or split.validation):
            raise DatasetError(
                f"pairs need at least 2 objects in the {part} part of the split; the recording has {count} of them"
            )


def check_neighbours(grasps: Sequence[Grasp], split: Split, records: ImageRecords) -> Iterator[Finding]:
    """Find held-out touches that have a training touch as near, by raw pixels, as touches of one object are.

    Such touches are probably neighbouring frames of one video. (TVL draws its validation rows frame by frame from its
    training videos; the authors of RCT noticed it.) This can be seen only where touches of two objects are rarely that
    near.
    """
    train = split.select(grasps, "train")
    if len(train) < 2:
        return
    own, other = _nearest(train, train, records)
    own, other = own[np.isfinite(own)], other[np.isfinite(other)]
    if not len(own) or not len(other) or np.quantile(own, _OWN_QUANTILE) >= np.quantile(other, _OTHER_QUANTILE):
        return
    limit = float(np.quantile(own, _OWN_QUANTILE))
    for part in ("validation", "test"):
        held_out = [grasp for grasp in split.select(grasps, part) if grasp.object_id not in split.train]
        near = _nearest(held_out, train, records)[1] <= limit
        if near.sum() >= _MIN_COUNT and near.mean() > _MIN_FRACTION:
            yield Finding(
                "warning",
                "sequences-in-training",
                f"{near.mean():.0%} of {len(near)} {part} touches have a training touch, of another object, that is as "
                f"near by raw pixels as touches of one object are ({np.mean(other <= limit):.0%} of the training "
                "touches have one): neighbouring frames may be on both sides of the split; give them one sequence_id "
                "and split by it",
            )


def _nearest(
    queries: Sequence[Grasp], train: Sequence[Grasp], records: ImageRecords
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distances (q,) to the nearest training touch of the same object, and of another object.

    At most `_MAX_QUERIES` queries, evenly spaced, are compared. A distance is the root mean square of grey levels, and
    infinite where there is no such touch.
    """
    queries = queries[:: max(-(-len(queries) // _MAX_QUERIES), 1)]
    known = _greys(train, records)
    objects, names = (np.array([getattr(one, key) for one in train]) for key in ("object_id", "grasp_id"))
    squares = np.square(known).sum(axis=1)
    own, other = [np.zeros(0)], [np.zeros(0)]
    for start in range(0, len(queries), _BLOCK):
        block = queries[start : start + _BLOCK]
        greys = _greys(block, records)
        squared = np.square(greys).sum(axis=1)[:, None] - 2.0 * (greys @ known.T) + squares
        distances = np.sqrt(np.maximum(squared, 0.0) / known.shape[1])
        distances[np.array([one.grasp_id for one in block])[:, None] == names] = np.inf
        same = np.array([one.object_id for one in block])[:, None] == objects
        own.append(np.where(same, distances, np.inf).min(axis=1))
        other.append(np.where(same, np.inf, distances).min(axis=1))
    return np.concatenate(own), np.concatenate(other)


def _greys(grasps: Sequence[Grasp], records: ImageRecords) -> NDArray[np.float64]:
    """Return all fingers' thumbnails (n, 256 fingers), minus their means, so that a flickering lamp has no effect."""
    greys = np.array([[one.grey for one in thumbnails(records, grasp.touches)] for grasp in grasps], np.float64)
    greys -= greys.mean(axis=2, keepdims=True)
    return greys.reshape(len(grasps), -1)
