"""Leakage audit of a split: content that two parts share, and near copies of test frames in the other parts.

Digests find byte-identical files. Shapes find frames that were re-encoded, lit differently, moved or flipped.
`retrieval.data.check.near_copies` compares the shapes and marks the test frames that have enough detail for the check.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.console.progress import Bar
from retrieval.data.check.near_copies import PictureSet, Thumbnail, load_thumbnail
from retrieval.data.check.split import check_split
from retrieval.data.dataset import Grasp, Split, finger_count
from retrieval.data.loading import worker_pool

QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5)
UNIT = "1 minus the correlation of shapes (0: a copy; about 1: unrelated images)"
_PARTS = ("train", "validation", "test")
_MAX_EXAMPLES = 5


@dataclass(frozen=True, eq=False)
class _Frames:
    """One kind of frame ("photo", "touch a", ...) of all grasps, in the order of the grasps."""

    kind: str
    digests: list[str]
    pictures: PictureSet


def audit(grasps: Sequence[Grasp], split: Split, *, quiet: bool = False) -> dict[str, Any]:
    """Compare the parts of a split. Read every photo and touch once.

    Args:
        grasps: All grasps of the recording; those of objects outside the split are ignored.
        split: The objects of each part.
        quiet: No progress on stderr.

    Returns:
        JSON types.

        * objects, grasps: counts by part.
        * shared: sentences about objects and sequences that are in two parts.
        * identical: {"count": files with equal bytes in two parts, "examples": lists of "part: grasp_id kind"}.
        * frames: by kind {"test", "train_validation": counts, "to_train_validation", "within_object": distances at
          `quantiles`, null if there is no pair to compare, "checked": test frames with enough detail to recognise a
          copy, "near_copies": checked frames that have one, "nearest": the nearest pairs of checked frames, one for
          each test object}. "train_validation" means training and validation objects together.
        * quantiles, unit: definition of the distances.
        * clean: whether the audit found no leakage; verdict: the result as a sentence.

    Raises:
        ImageError: An image cannot be read.
    """
    part_of = {name: part for part in _PARTS for name in getattr(split, part)}
    grasps = [grasp for grasp in grasps if grasp.object_id in part_of]
    parts = np.array([part_of[grasp.object_id] for grasp in grasps], dtype=str)
    kinds = list(_read_frames(grasps, quiet))
    result: dict[str, Any] = {
        **_counts(grasps, parts),
        "shared": [problem.message for problem in check_split(grasps, split) if problem.severity == "error"],
        "identical": _identical(grasps, parts, kinds),
        "frames": {frames.kind: _frame_distances(frames, grasps, parts) for frames in kinds},
        "quantiles": list(QUANTILES),
        "unit": UNIT,
    }
    return result | _verdict(result)


def _counts(grasps: Sequence[Grasp], parts: NDArray[np.str_]) -> dict[str, Any]:
    owners = {
        part: {grasp.object_id for grasp, own in zip(grasps, parts, strict=True) if own == part} for part in _PARTS
    }
    return {
        "objects": {part: len(owners[part]) for part in _PARTS},
        "grasps": {part: int((parts == part).sum()) for part in _PARTS},
    }


# Frames ----------------------------------------------------------------------------------------------


def _read_frames(grasps: Sequence[Grasp], quiet: bool) -> Iterable[_Frames]:
    """Yield the photos, then the touches of each finger."""
    files: dict[str, list[Path]] = {"photo": [grasp.photo for grasp in grasps]}
    for finger in range(finger_count(grasps) if grasps else 0):
        files[f"touch {ascii_lowercase[finger]}"] = [grasp.touches[finger] for grasp in grasps]
    objects = [grasp.object_id for grasp in grasps]
    with (
        worker_pool() as pool,
        Bar("audit", sum(map(len, map(set, files.values()))), "images", quiet=quiet) as bar,
    ):
        for kind, paths in files.items():
            thumbnails: dict[Path, Thumbnail] = {}
            unique = list(dict.fromkeys(paths))
            for path, thumbnail in zip(unique, pool.map(load_thumbnail, unique), strict=True):
                thumbnails[path] = thumbnail
                bar.advance()
            frames = [thumbnails[path] for path in paths]
            yield _Frames(kind, [frame.digest for frame in frames], PictureSet(frames, objects))


def _identical(grasps: Sequence[Grasp], parts: NDArray[np.str_], kinds: Iterable[_Frames]) -> dict[str, Any]:
    """Return the files with equal bytes in more than one part, photos and touches of all fingers together."""
    places: dict[str, dict[str, str]] = defaultdict(dict)
    for frames in kinds:
        for digest, grasp, part in zip(frames.digests, grasps, parts, strict=True):
            places[digest].setdefault(str(part), f"{part}: {grasp.grasp_id} {frames.kind}")
    across = [sorted(place.values()) for place in places.values() if len(place) > 1]
    return {"count": len(across), "examples": sorted(across)[:_MAX_EXAMPLES]}


# Distances -------------------------------------------------------------------------------------------


def _frame_distances(frames: _Frames, grasps: Sequence[Grasp], parts: NDArray[np.str_]) -> dict[str, Any]:
    test, others = np.flatnonzero(parts == "test"), np.flatnonzero(parts != "test")
    found = frames.pictures.nearest(test, others)
    owners = [grasps[row].object_id for row in test.tolist()]
    checked = [int(at) for at in np.argsort(found.distance, kind="stable") if found.checked[at]]
    return {
        "test": len(test),
        "train_validation": len(others),
        "to_train_validation": _quantiles(found.distance),
        "within_object": _quantiles(frames.pictures.within_object_distances(test)),
        "checked": int(found.checked.sum()),
        "near_copies": int(found.copy.sum()),
        "nearest": [
            {
                "test": grasps[test[at]].grasp_id,
                "train_validation": grasps[int(found.row[at])].grasp_id,
                "distance": round(float(found.distance[at]), 4),
            }
            for at in _first_of_each(checked, owners)
        ],
    }


def _first_of_each(order: Sequence[int], owners: Sequence[str]) -> list[int]:
    """Return the first place of each owner in an order: the frames of one object mostly share one neighbour."""
    first: dict[str, int] = {}
    for at in order:
        first.setdefault(owners[at], int(at))
    return list(first.values())[:_MAX_EXAMPLES]


def _quantiles(distances: NDArray[np.float64]) -> list[float] | None:
    finite = distances[np.isfinite(distances)]
    return [round(float(value), 4) for value in np.quantile(finite, QUANTILES)] if len(finite) else None


def _verdict(result: dict[str, Any]) -> dict[str, Any]:
    problems = list(result["shared"])
    if count := result["identical"]["count"]:
        problems.append(f"{count} file(s) are byte-identical in two parts")
    for kind, frames in result["frames"].items():
        if frames["near_copies"]:
            problems.append(
                f"{frames['near_copies']} of {frames['test']} test frames ({kind}) are near copies of a frame of a "
                "training or validation object"
            )
    clean = "No object, sequence or file is in two parts"
    start = f"Leakage is possible: {'; '.join(problems)}" if problems else clean
    return {"clean": not problems, "verdict": f"{start}; {_describe_checked(result['frames'])}."}


def _describe_checked(kinds: dict[str, Any]) -> str:
    """Describe how many test frames were checked for near copies."""
    compared = {kind: frames for kind, frames in kinds.items() if frames["to_train_validation"]}
    if not compared:
        return "near copies were not checked, as one side has no frames"
    counts = [f"{frames['checked']} of {frames['test']} ({kind})" for kind, frames in compared.items()]
    copies = "" if any(frames["near_copies"] for frames in compared.values()) else "; none was found"
    rest = any(frames["checked"] < frames["test"] for frames in compared.values())
    reason = "; the other test frames have too little detail to recognise a copy" if rest else ""
    return f"checked for near copies: {', '.join(counts)} test frames{copies}{reason}"
