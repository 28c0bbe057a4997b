"""Checks for known problems of published data sets; each yields findings on its grasps.

The problems: dead frames and repeated frames; one no-contact frame for many grasps (SSVTP, VT60); test sequences among
the training sequences. TVL draws its validation rows frame by frame from its training videos, so the nearest neighbour
by raw pixels identifies the video (first noticed by the authors of RCT).
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
"""Quantiles of the distance to the nearest touch of the same object, and of another object. Neighbouring frames can be
recognised if the first quantile is below the second."""
_MIN_FRACTION, _MIN_COUNT = 0.1, 3
"""Smallest fraction and number of held-out grasps with such a neighbour in training that cause a warning."""

_Rows = NDArray[np.float32]
_Pixels = dict[str, _Rows]
"""Pixels of each grasp, by grasp_id."""
_Item = TypeVar("_Item")


def check_dead_frames(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find pictures of a single colour."""
    kinds: dict[str, Callable[[Grasp], bool]] = {
        "the photo": lambda one: records[one.photo].is_flat,
        "a touch": lambda one: any(records[path].is_flat for path in one.touches),
        "a no-contact frame": lambda one: any(records[path].is_flat for path in one.backgrounds),
    }
    for what, is_dead in kinds.items():
        names = [grasp.grasp_id for grasp in grasps if is_dead(grasp)]
        yield from findings_for("error", "dead-frame", f"{what} has a single colour (a dead frame)", names, grasps)


def check_frozen_frames(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches that equal their no-contact frame byte for byte (legitimate only for a grasp that missed)."""
    names = [
        grasp.grasp_id for grasp in grasps if _digests(records, grasp.touches) & _digests(records, grasp.backgrounds)
    ]
    yield from findings_for("error", "frozen-frame", "touch and no-contact frame are the same image", names, grasps)


def check_repeated_touches(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches that several grasps of one object share byte for byte."""
    users: dict[tuple[str, str], list[str]] = defaultdict(list)
    for grasp in grasps:
        for digest in sorted(_digests(records, grasp.touches)):
            users[grasp.object_id, digest].append(grasp.grasp_id)
    names = {name for group in users.values() if len(group) > 1 for name in group}
    repeated = [grasp.grasp_id for grasp in grasps if grasp.grasp_id in names]
    yield from findings_for(
        "warning", "repeated-touch", "another grasp of the object has the same touch", repeated, grasps
    )


def check_shared_backgrounds(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find no-contact frames that serve several objects."""
    users: dict[str, list[Grasp]] = defaultdict(list)
    for grasp in grasps:
        for digest in sorted(_digests(records, grasp.backgrounds)):
            users[digest].append(grasp)
    shared = [group for group in users.values() if len({grasp.object_id for grasp in group}) > 1]
    if shared:
        served = {grasp.grasp_id: grasp.object_id for group in shared for grasp in group}
        yield Finding(
            "warning",
            "one-background",
            f"{len(shared)} no-contact frame(s) serve {len(served)} of {len(grasps)} grasps, of "
            f"{len(set(served.values()))} objects: drift since such a frame was taken stays in its difference "
            "from the touch and may identify the object; compare with the controls of `retrieve evaluate`",
        )


# Test sequences in training ----------------------------------------------------------------------------------


def check_sequences_in_training(grasps: Sequence[Grasp], split: Split, records: ImageRecords) -> Iterator[Finding]:
    """Find held-out touches whose neighbouring frames are in the training part, by nearest neighbours in raw pixels.

    If the split cuts recorded sequences, count the touches whose nearest training touch is of their own sequence.
    Otherwise, count the touches that have a training touch as near as touches of one object are to each other. This
    second count is meaningful only if touches of two objects are rarely that near.
    """
    pixels = {grasp.grasp_id: _grey(records, grasp) for grasp in grasps}
    train = split.select(grasps, "train")
    trained_on = {grasp.sequence_id for grasp in train if grasp.sequence_id is not None}
    for part in ("validation", "test"):
        held_out = [grasp for grasp in split.select(grasps, part) if grasp.object_id not in split.train]
        cut = [grasp for grasp in held_out if grasp.sequence_id in trained_on]
        if cut:
            yield _sequence_leakage(part, cut, len(held_out), train, pixels)
        rest = [grasp for grasp in held_out if grasp.sequence_id not in trained_on]
        yield from _neighbour_leakage(part, rest, train, pixels)


def _sequence_leakage(part: str, cut: Sequence[Grasp], total: int, train: Sequence[Grasp], pixels: _Pixels) -> Finding:
    queries = _sample_evenly(cut)
    blocks = _distances(_rows(queries, pixels), _rows(train, pixels))
    nearest = np.concatenate([block.argmin(axis=1) for _, block in blocks])
    correct = [train[at].sequence_id == grasp.sequence_id for at, grasp in zip(nearest.tolist(), queries, strict=True)]
    sizes = Counter(grasp.sequence_id for grasp in train)
    chance = np.mean([sizes[grasp.sequence_id] for grasp in queries]) / len(train)
    return Finding(
        "error",
        "sequences-in-training",
        f"{len(cut)} of {total} {part} grasps belong to sequences that are also in training, and for "
        f"{np.mean(correct):.0%} of them the nearest training touch by raw pixels is of the same sequence (chance "
        f"{chance:.0%}): a score on them measures memorisation; keep every sequence in one part of the split",
    )


def _neighbour_leakage(
    part: str, held_out: Sequence[Grasp], train: Sequence[Grasp], pixels: _Pixels
) -> Iterator[Finding]:
    if len(held_out) < _MIN_COUNT or len(train) < 2:
        return
    known = _rows(train, pixels)
    own, other = _within(known, np.unique([grasp.object_id for grasp in train], return_inverse=True)[1])
    if not len(own) or not len(other) or np.quantile(own, _OWN_QUANTILE) >= np.quantile(other, _OTHER_QUANTILE):
        return
    limit = float(np.quantile(own, _OWN_QUANTILE))
    queries = _sample_evenly(held_out)
    near = np.concatenate([block.min(axis=1) <= limit for _, block in _distances(_rows(queries, pixels), known)])
    if near.sum() >= _MIN_COUNT and near.mean() > _MIN_FRACTION:
        yield Finding(
            "warning",
            "sequences-in-training",
            f"{near.mean():.0%} of {len(queries)} {part} touches have a training touch, of another object, that is as "
            f"near by raw pixels as touches of one object are ({np.mean(other <= limit):.0%} of the training touches "
            "have one): neighbouring frames may be on both sides of the split; give them one sequence_id and split "
            "by it",
        )


def _within(known: _Rows, objects: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances of training touches to the nearest touch of the same object, and of another object.

    Touches without such a neighbour are left out.
    """
    sample = np.array(_sample_evenly(range(len(known))), dtype=np.int64)
    own, other = [], []
    for at, block in _distances(known[sample], known):
        rows = sample[at]
        block[np.arange(len(rows)), rows] = np.inf
        same = objects[rows][:, None] == objects
        own.append(np.where(same, block, np.inf).min(axis=1))
        other.append(np.where(same, np.inf, block).min(axis=1))
    own_all, other_all = np.concatenate(own), np.concatenate(other)
    return own_all[np.isfinite(own_all)], other_all[np.isfinite(other_all)]


def _distances(queries: _Rows, known: _Rows) -> Iterator[tuple[slice, NDArray[np.float64]]]:
    """Yield blocks of queries with their distances (b, n): root mean square of grey levels."""
    squares = np.square(known, dtype=np.float64).sum(axis=1)
    for start in range(0, len(queries), _BLOCK):
        at = slice(start, min(start + _BLOCK, len(queries)))
        block = queries[at].astype(np.float64)
        squared = np.square(block).sum(axis=1)[:, None] - 2.0 * (block @ known.T) + squares
        yield at, np.sqrt(np.maximum(squared, 0.0) / known.shape[1])


def _sample_evenly(items: Sequence[_Item]) -> list[_Item]:
    """Return at most `_MAX_QUERIES` of the items, evenly spaced."""
    return list(items[:: max(-(-len(items) // _MAX_QUERIES), 1)])


def _rows(grasps: Sequence[Grasp], pixels: _Pixels) -> _Rows:
    return np.stack([pixels[grasp.grasp_id] for grasp in grasps])


def _grey(records: ImageRecords, grasp: Grasp) -> _Rows:
    """Return all fingers' thumbnails (256 values each), minus their means, so that a flickering lamp has no effect."""
    thumbnails = [records[path].thumbnail for path in grasp.touches]
    return np.concatenate([one.grey - one.grey.mean() for one in thumbnails if one is not None])


def _digests(records: ImageRecords, paths: Sequence[Path]) -> set[str]:
    return {records[path].digest for path in paths}
