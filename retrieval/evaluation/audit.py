"""Leakage audit of a split: what the parts share, and how near the test frames come to those fitted or chosen on.

Byte-identical files are found by their digests. A copy that was encoded again or made a little brighter has other
bytes, so frames are also compared as grey thumbnails of 32 x 32 pixels, in grey levels of 255:

* the distance of two thumbnails is the root mean square of their difference. What all gel images share, the gel and
  its lamps, cancels in a difference: taking the mean gel image off first would change nothing, as it would for a
  correlation;
* every thumbnail loses its own mean first, so that a little more brightness is no difference.

Measured on 598 simulated grasps of 100 objects, 256 x 256 photos and 320 x 240 gel images: a copy through JPEG of
quality 75 and one grey level brighter lies within 0.6 of its source; frames of other objects start at 1.0 (touches)
and 5.6 (photos). Hence the threshold of 0.75. A touch that hardly differs from the untouched gel is near to every
other such touch, of whatever object: where no-contact frames were recorded, one within 3 grey levels of its own is
faint, and is not counted as close.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.check import check_split
from retrieval.dataset import Grasp, Split, finger_count
from retrieval.images import decode_rgb, read_bytes
from retrieval.progress import Bar
from retrieval.resize import resize

THUMBNAIL_PX = 32
CLOSE_GREY_LEVELS = 0.75
FAINT_GREY_LEVELS = 3.0
QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5)
_PARTS = ("train", "validation", "test")
_SHOWN = 5
_BLOCK = 1024

Thumbnails = NDArray[np.float64]
"""(n, 1024), or (1024,) for one: grey levels less the mean of each."""

_Pair = tuple[Path, Path | None]
"""A frame, and the no-contact frame of its finger where there is one."""


@dataclass(frozen=True, eq=False)
class _Frames:
    """One kind of frame ("photo", "touch a", ...) of all grasps: digests of the bytes, thumbnails (G, 1024), and
    which frames are faint (G,)."""

    kind: str
    digests: list[str]
    thumbnails: Thumbnails
    faint: NDArray[np.bool_]


def audit(grasps: Sequence[Grasp], split: Split, *, quiet: bool = False) -> dict[str, Any]:
    """Compare the parts of `split`; grasps of objects outside it are left out. Reads every photo and touch once.

    Returns JSON types:
    objects, grasps: counts by part; shared: sentences on objects and sequences that stand in two parts;
    identical: {"count": files of equal bytes in two parts, "examples": lists of "part: grasp_id kind"};
    frames: by kind {"test", "seen": counts, "to_seen", "within_object": distances at `quantiles`, or null where
    there is nothing to compare, "close": test frames nearer than `threshold` to a seen one that are not "faint",
    "faint": how many are, "nearest": the nearest pairs of the others, one of each test object}, where seen means of
    training and validation objects; quantiles, threshold, unit; clean, verdict.
    Raises ImageError for an image that cannot be read.
    """
    part_of = {name: part for part in _PARTS for name in getattr(split, part)}
    grasps = [grasp for grasp in grasps if grasp.object_id in part_of]
    parts = np.array([part_of[grasp.object_id] for grasp in grasps], dtype=str)
    kinds = list(_read_frames(grasps, quiet))
    result: dict[str, Any] = {
        **_counts(grasps, parts),
        "shared": [found.message for found in check_split(grasps, split) if found.severity == "error"],
        "identical": _identical(grasps, parts, kinds),
        "frames": {frames.kind: _nearness(frames, grasps, parts) for frames in kinds},
        "quantiles": list(QUANTILES),
        "threshold": CLOSE_GREY_LEVELS,
        "unit": f"grey levels of 255, root mean square over thumbnails of {THUMBNAIL_PX} x {THUMBNAIL_PX}",
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
    """Photos, then the touches of each finger."""
    files: dict[str, list[_Pair]] = {"photo": [(grasp.photo, None) for grasp in grasps]}
    for finger in range(finger_count(grasps) if grasps else 0):
        files[f"touch {ascii_lowercase[finger]}"] = [
            (grasp.touches[finger], grasp.backgrounds[finger] if grasp.backgrounds else None) for grasp in grasps
        ]
    total = sum(len(set(pairs)) for pairs in files.values())
    with ThreadPoolExecutor(2) as pool, Bar("audit", total, "images", quiet=quiet) as bar:
        for kind, pairs in files.items():
            seen = {}
            for pair, looked in zip(dict.fromkeys(pairs), pool.map(_look, dict.fromkeys(pairs)), strict=True):
                seen[pair] = looked
                bar.advance()
            yield _frames(kind, [seen[pair] for pair in pairs])


def _frames(kind: str, looked: Sequence[tuple[str, Thumbnails, bool]]) -> _Frames:
    thumbnails = np.array([thumbnail for _, thumbnail, _ in looked]).reshape(len(looked), THUMBNAIL_PX**2)
    return _Frames(
        kind, [digest for digest, _, _ in looked], thumbnails, np.array([faint for _, _, faint in looked], dtype=bool)
    )


def _look(pair: _Pair) -> tuple[str, Thumbnails, bool]:
    """Digest of a frame's bytes, its thumbnail (1024,), and whether it hardly differs from its no-contact frame."""
    path, untouched = pair
    data = read_bytes(path)
    thumbnail = _thumbnail(data, path)
    faint = False
    if untouched is not None:
        difference = thumbnail - _thumbnail(read_bytes(untouched), untouched)
        faint = bool(np.sqrt((difference**2).mean()) < FAINT_GREY_LEVELS)
    return sha256(data).hexdigest(), thumbnail, faint


def _thumbnail(data: bytes, path: Path) -> Thumbnails:
    grey = 255.0 * resize(decode_rgb(data, path), (THUMBNAIL_PX, THUMBNAIL_PX)).mean(axis=2, dtype=np.float64).ravel()
    return np.asarray(grey - grey.mean())


def _identical(grasps: Sequence[Grasp], parts: NDArray[np.str_], kinds: Iterable[_Frames]) -> dict[str, Any]:
    """Files of equal bytes in more than one part, photos and touches of all fingers together."""
    places: dict[str, dict[str, str]] = defaultdict(dict)
    for frames in kinds:
        for digest, grasp, part in zip(frames.digests, grasps, parts, strict=True):
            places[digest].setdefault(str(part), f"{part}: {grasp.grasp_id} {frames.kind}")
    across = [sorted(place.values()) for place in places.values() if len(place) > 1]
    return {"count": len(across), "examples": sorted(across)[:_SHOWN]}


# Nearness --------------------------------------------------------------------------------------------


def _nearness(frames: _Frames, grasps: Sequence[Grasp], parts: NDArray[np.str_]) -> dict[str, Any]:
    test, seen = (np.flatnonzero(side).tolist() for side in (parts == "test", parts != "test"))
    rows, distances = nearest(frames.thumbnails[test], frames.thumbnails[seen])
    owners = [grasps[row].object_id for row in test]
    faint = frames.faint[test]
    return {
        "test": len(test),
        "seen": len(seen),
        "to_seen": _quantiles(distances),
        "within_object": _quantiles(_within_object(frames.thumbnails, grasps, test)),
        "close": int(((distances < CLOSE_GREY_LEVELS) & ~faint).sum()),
        "faint": int(faint.sum()),
        "nearest": [
            {
                "test": grasps[test[at]].grasp_id,
                "seen": grasps[seen[rows[at]]].grasp_id,
                "distance": round(float(distances[at]), 4),
            }
            for at in _first_of_each([at for at in np.argsort(distances, kind="stable") if not faint[at]], owners)
            if len(seen)
        ],
    }


def _first_of_each(order: Sequence[int], owners: Sequence[str]) -> list[int]:
    """The first places of an order, one of each owner: the frames of one object mostly have one neighbour."""
    first: dict[str, int] = {}
    for at in order:
        first.setdefault(owners[at], int(at))
    return list(first.values())[:_SHOWN]


def nearest(queries: Thumbnails, frames: Thumbnails) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Row of the nearest frame to each query, and the root mean square of their difference; inf where frames is empty.

    queries (q, d), frames (n, d). Neighbours are sought by |a|^2 - 2ab + |b|^2, in float64 and in blocks; that loses
    digits exactly where a copy lies near, so the distance itself is computed anew from the difference.
    """
    if not len(frames):
        return np.zeros(len(queries), dtype=np.int64), np.full(len(queries), np.inf)
    squares = (frames**2).sum(axis=1)
    blocks = [squares - 2 * queries[at : at + _BLOCK] @ frames.T for at in range(0, len(queries), _BLOCK)]
    rows = np.concatenate([block.argmin(axis=1) for block in blocks] or [np.zeros(0, dtype=np.int64)])
    return rows, np.sqrt(((queries - frames[rows]) ** 2).mean(axis=1))


def _within_object(thumbnails: Thumbnails, grasps: Sequence[Grasp], test: Sequence[int]) -> NDArray[np.float64]:
    """Distance from each test frame to the nearest other frame of its own object, objects with one frame left out."""
    by_object: dict[str, list[int]] = defaultdict(list)
    for row in test:
        by_object[grasps[row].object_id].append(row)
    found = [np.zeros(0)]
    for own in by_object.values():
        for row in own:
            others = [other for other in own if other != row]
            if others:
                found.append(nearest(thumbnails[[row]], thumbnails[others])[1])
    return np.concatenate(found)


def _quantiles(distances: NDArray[np.float64]) -> list[float] | None:
    finite = distances[np.isfinite(distances)]
    return [round(float(value), 4) for value in np.quantile(finite, QUANTILES)] if len(finite) else None


def _verdict(result: dict[str, Any]) -> dict[str, Any]:
    found = list(result["shared"])
    if count := result["identical"]["count"]:
        found.append(f"{count} file(s) stand byte for byte in two parts")
    for kind, frames in result["frames"].items():
        if frames["close"]:
            found.append(
                f"{frames['close']} of {frames['test']} test frames ({kind}) lie within "
                f"{CLOSE_GREY_LEVELS} grey levels of a frame of a training or validation object"
            )
    if found:
        return {"clean": False, "verdict": "Leakage is possible: " + "; ".join(found) + "."}
    return {"clean": True, "verdict": _all_clear(result["frames"])}


def _all_clear(kinds: dict[str, Any]) -> str:
    start = "No object, sequence or file stands in two parts"
    gaps = [f"{kind} {frames['to_seen'][0]:.2f}" for kind, frames in kinds.items() if frames["to_seen"]]
    if not gaps:
        return f"{start}; there are no frames of both sides to compare."
    return (
        f"{start}, and no test frame lies within {CLOSE_GREY_LEVELS} grey levels of a frame of a training or "
        f"validation object (nearest: {', '.join(gaps)})."
    )
