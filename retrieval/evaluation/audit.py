"""Leakage audit of a split: content that two parts share, and near copies of test frames in the other parts.

Digests find byte-identical files. Shapes find frames that were re-encoded, lit differently, moved or flipped.
`retrieval.data.check.near_copies` compares the shapes and marks the test frames that have enough detail for the check.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
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

_PARTS = ("train", "validation", "test")
_MAX_EXAMPLES = 5


def audit(grasps: Sequence[Grasp], split: Split, *, quiet: bool = False) -> dict[str, Any]:
    """Compare the parts of a split. Read every photo and touch once.

    Args:
        grasps: All grasps of the recording; those of objects outside the split are ignored.
        split: The objects of each part.
        quiet: No progress on stderr.

    Returns:
        JSON types.

        * shared: sentences about objects and sequences that are in two parts.
        * identical: {"count": files with equal bytes in two parts, "examples": lists of "part: grasp_id kind"}.
        * frames: by kind ("photo", "touch a", ...) {"test", "train_validation": counts, "checked": test frames with
          enough detail to recognise a copy, "near_copies": those that have one, "examples": lists of "part: grasp_id"}.
          "train_validation" means training and validation objects together.
        * clean: whether the audit found no leakage; verdict: the result as a sentence.

    Raises:
        ImageError: An image cannot be read.
    """
    part_of = {name: part for part in _PARTS for name in getattr(split, part)}
    grasps = [grasp for grasp in grasps if grasp.object_id in part_of]
    parts = np.array([part_of[grasp.object_id] for grasp in grasps], dtype=str)
    names = [f"{part}: {grasp.grasp_id}" for part, grasp in zip(parts, grasps, strict=True)]
    objects = [grasp.object_id for grasp in grasps]
    places: dict[str, dict[str, str]] = defaultdict(dict)
    frames = {}
    for kind, thumbnails in _read_frames(grasps, quiet):
        for thumbnail, part, name in zip(thumbnails, parts.tolist(), names, strict=True):
            places[thumbnail.digest].setdefault(part, f"{name} {kind}")
        frames[kind] = _near_copies(PictureSet(thumbnails, objects), parts, names)
    identical = sorted(sorted(place.values()) for place in places.values() if len(place) > 1)
    result: dict[str, Any] = {
        "shared": [problem.message for problem in check_split(grasps, split) if problem.severity == "error"],
        "identical": {"count": len(identical), "examples": identical[:_MAX_EXAMPLES]},
        "frames": frames,
    }
    return result | _verdict(result)


def _read_frames(grasps: Sequence[Grasp], quiet: bool) -> Iterator[tuple[str, list[Thumbnail]]]:
    """Yield each kind of frame with those of all grasps: the photos, then the touches of each finger."""
    files: dict[str, list[Path]] = {"photo": [grasp.photo for grasp in grasps]}
    for finger in range(finger_count(grasps) if grasps else 0):
        files[f"touch {ascii_lowercase[finger]}"] = [grasp.touches[finger] for grasp in grasps]
    with worker_pool() as pool, Bar("audit", sum(map(len, map(set, files.values()))), "images", quiet=quiet) as bar:
        for kind, paths in files.items():
            thumbnails: dict[Path, Thumbnail] = {}
            unique = list(dict.fromkeys(paths))
            for path, thumbnail in zip(unique, pool.map(load_thumbnail, unique), strict=True):
                thumbnails[path] = thumbnail
                bar.advance()
            yield kind, [thumbnails[path] for path in paths]


def _near_copies(pictures: PictureSet, parts: NDArray[np.str_], names: Sequence[str]) -> dict[str, Any]:
    test, others = np.flatnonzero(parts == "test"), np.flatnonzero(parts != "test")
    found = pictures.nearest(test, others)
    copies = np.flatnonzero(found.copy)[:_MAX_EXAMPLES]
    return {
        "test": len(test),
        "train_validation": len(others),
        "checked": int(found.checked.sum()),
        "near_copies": int(found.copy.sum()),
        "examples": [[names[test[at]], names[found.row[at]]] for at in copies],
    }


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
    if not all(frames["test"] and frames["train_validation"] for frames in kinds.values()):
        return "near copies were not checked, as one side has no frames"
    counts = [f"{frames['checked']} of {frames['test']} ({kind})" for kind, frames in kinds.items()]
    copies = "" if any(frames["near_copies"] for frames in kinds.values()) else "; none was found"
    rest = any(frames["checked"] < frames["test"] for frames in kinds.values())
    reason = "; the other test frames have too little detail to recognise a copy" if rest else ""
    return f"checked for near copies: {', '.join(counts)} test frames{copies}{reason}"
