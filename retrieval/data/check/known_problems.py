"""Troubles that published data sets turned out to have; each yields findings on the grasps it is given.

Dead frames and repeated ones; one frame of the untouched gel for many grasps (SSVTP, VT60); and test sequences among
the training ones: TVL's validation rows are drawn frame by frame from its training videos, so that the nearest
neighbour by raw pixels names the video, which the authors of RCT noticed.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from retrieval.data.check.findings import Finding, ImageRecords, findings_for
from retrieval.data.dataset import Grasp, Split

_MAX_QUERIES = 5000
_BLOCK = 512
_OWN_QUANTILE, _OTHER_QUANTILE = 0.75, 0.05
"""Frames of one sitting are known by their neighbours where the nearest of the own object is nearer, for three quarters
of all touches, than the nearest of another object for any but a twentieth."""
_MIN_FRACTION, _MIN_COUNT = 0.1, 3
"""Of the grasps held back, how many must have such a neighbour in training before it is said."""

_Rows = NDArray[np.float32]
_Pixels = dict[str, _Rows]
"""By grasp_id."""
_Item = TypeVar("_Item")


def check_dead_frames(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Pictures of one colour alone."""
    kinds: dict[str, Callable[[Grasp], bool]] = {
        "the photo": lambda one: records[one.photo].is_flat,
        "a touch": lambda one: any(records[path].is_flat for path in one.touches),
        "an untouched gel": lambda one: any(records[path].is_flat for path in one.backgrounds),
    }
    for what, is_dead in kinds.items():
        names = [grasp.grasp_id for grasp in grasps if is_dead(grasp)]
        yield from findings_for("error", "dead-frame", f"{what} is of one colour alone, a dead frame,", names, grasps)


def check_frozen_frames(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Touches that are their untouched gel byte for byte; that of a grasp that missed may well be."""
    names = [
        grasp.grasp_id for grasp in grasps if _digests(records, grasp.touches) & _digests(records, grasp.backgrounds)
    ]
    yield from findings_for("error", "frozen-frame", "touch and untouched gel are the same image", names, grasps)


def check_repeated_touches(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Touches that several grasps of one object share byte for byte."""
    holders: dict[tuple[str, str], list[str]] = defaultdict(list)
    for grasp in grasps:
        for digest in sorted(_digests(records, grasp.touches)):
            holders[grasp.object_id, digest].append(grasp.grasp_id)
    names = {name for those in holders.values() if len(those) > 1 for name in those}
    again = [grasp.grasp_id for grasp in grasps if grasp.grasp_id in names]
    yield from findings_for(
        "warning", "repeated-touch", "another grasp of the object has the same touch", again, grasps
    )


def check_shared_backgrounds(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Frames of the untouched gel that serve several objects."""
    holders: dict[str, list[Grasp]] = defaultdict(list)
    for grasp in grasps:
        for digest in sorted(_digests(records, grasp.backgrounds)):
            holders[digest].append(grasp)
    shared = [those for those in holders.values() if len({grasp.object_id for grasp in those}) > 1]
    if shared:
        served = {grasp.grasp_id: grasp.object_id for those in shared for grasp in those}
        yield Finding(
            "warning",
            "one-background",
            f"{len(shared)} frame(s) of the untouched gel serve {len(served)} of {len(grasps)} grasps, of "
            f"{len(set(served.values()))} objects: what drifted since such a frame was taken stays in its difference "
            "to the touch and may name the object; compare with `retrieve evaluate`'s controls",
        )


# Test sequences in training ----------------------------------------------------------------------------------


def check_sequences_in_training(grasps: Sequence[Grasp], split: Split, records: ImageRecords) -> Iterator[Finding]:
    """Touches held back whose neighbouring frames are trained on, by their nearest neighbour in raw pixels.

    Where the split cuts recorded sequences, the share of touches whose nearest training touch is of their own sequence;
    elsewhere, the share of those that have a training touch as near as touches of one object are to each other, which
    says something only where touches of two objects hardly ever are.
    """
    pixels = {grasp.grasp_id: _grey(records, grasp) for grasp in grasps}
    train = split.select(grasps, "train")
    trained_on = {grasp.sequence_id for grasp in train if grasp.sequence_id is not None}
    for part in ("validation", "test"):
        held_back = [grasp for grasp in split.select(grasps, part) if grasp.object_id not in split.train]
        cut = [grasp for grasp in held_back if grasp.sequence_id in trained_on]
        if cut:
            yield _named_sequences(part, cut, len(held_back), train, pixels)
        rest = [grasp for grasp in held_back if grasp.sequence_id not in trained_on]
        yield from _neighbours(part, rest, train, pixels)


def _named_sequences(part: str, cut: Sequence[Grasp], total: int, train: Sequence[Grasp], pixels: _Pixels) -> Finding:
    asked = _sample_evenly(cut)
    nearest = np.concatenate([far.argmin(axis=1) for _, far in _distances(_rows(asked, pixels), _rows(train, pixels))])
    right = [train[at].sequence_id == grasp.sequence_id for at, grasp in zip(nearest.tolist(), asked, strict=True)]
    sizes = Counter(grasp.sequence_id for grasp in train)
    chance = np.mean([sizes[grasp.sequence_id] for grasp in asked]) / len(train)
    return Finding(
        "error",
        "sequences-in-training",
        f"{len(cut)} of {total} {part} grasps are of sequences that are trained on, and for {np.mean(right):.0%} of "
        f"them the nearest training touch by raw pixels names the sequence (chance {chance:.0%}): a score on them "
        "shows what is remembered; keep every sequence in one part of the split",
    )


def _neighbours(part: str, held_back: Sequence[Grasp], train: Sequence[Grasp], pixels: _Pixels) -> Iterator[Finding]:
    if len(held_back) < _MIN_COUNT or len(train) < 2:
        return
    known = _rows(train, pixels)
    own, other = _within(known, np.unique([grasp.object_id for grasp in train], return_inverse=True)[1])
    if not len(own) or not len(other) or np.quantile(own, _OWN_QUANTILE) >= np.quantile(other, _OTHER_QUANTILE):
        return
    told = float(np.quantile(own, _OWN_QUANTILE))
    asked = _sample_evenly(held_back)
    near = np.concatenate([far.min(axis=1) <= told for _, far in _distances(_rows(asked, pixels), known)])
    if near.sum() >= _MIN_COUNT and near.mean() > _MIN_FRACTION:
        yield Finding(
            "warning",
            "sequences-in-training",
            f"{near.mean():.0%} of {len(asked)} {part} touches have a training touch, of another object, that is as "
            f"near by raw pixels as touches of one object are ({np.mean(other <= told):.0%} of the training touches "
            "have one): neighbouring frames may stand on both sides; give them one sequence_id and split by it",
        )


def _within(known: _Rows, objects: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances of training touches to the nearest of their own object, and to that of another; those without are
    left out.
    """
    sample = np.array(_sample_evenly(range(len(known))), dtype=np.int64)
    own, other = [], []
    for at, far in _distances(known[sample], known):
        rows = sample[at]
        far[np.arange(len(rows)), rows] = np.inf
        alike = objects[rows][:, None] == objects
        own.append(np.where(alike, far, np.inf).min(axis=1))
        other.append(np.where(alike, np.inf, far).min(axis=1))
    own_all, other_all = np.concatenate(own), np.concatenate(other)
    return own_all[np.isfinite(own_all)], other_all[np.isfinite(other_all)]


def _distances(queries: _Rows, known: _Rows) -> Iterator[tuple[slice, NDArray[np.float64]]]:
    """A block of queries at a time and its distances (b, n): root mean square of grey levels."""
    squares = np.square(known, dtype=np.float64).sum(axis=1)
    for start in range(0, len(queries), _BLOCK):
        at = slice(start, min(start + _BLOCK, len(queries)))
        block = queries[at].astype(np.float64)
        far = np.square(block).sum(axis=1)[:, None] - 2.0 * (block @ known.T) + squares
        yield at, np.sqrt(np.maximum(far, 0.0) / known.shape[1])


def _sample_evenly(items: Sequence[_Item]) -> list[_Item]:
    """At most `_MAX_QUERIES` of them, evenly taken."""
    return list(items[:: max(-(-len(items) // _MAX_QUERIES), 1)])


def _rows(grasps: Sequence[Grasp], pixels: _Pixels) -> _Rows:
    return np.stack([pixels[grasp.grasp_id] for grasp in grasps])


def _grey(records: ImageRecords, grasp: Grasp) -> _Rows:
    """All fingers' thumbnails (256 each), less their mean: a lamp that flickers hides no neighbour."""
    thumbnails = [records[path].thumbnail for path in grasp.touches]
    return np.concatenate([one.grey - one.grey.mean() for one in thumbnails if one is not None])


def _digests(records: ImageRecords, paths: Sequence[Path]) -> set[str]:
    return {records[path].digest for path in paths}
