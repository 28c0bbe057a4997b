"""Lint of a recording: what would spoil a training, or make its result too good to be true."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.dataset import Grasp, Split, load_grasps
from retrieval.errors import DatasetError, ImageError
from retrieval.images import decode_rgb, read_bytes
from retrieval.progress import Bar
from retrieval.resize import resize

_THUMBNAIL = (6, 8)
_SHOWN = 5


@dataclass(frozen=True)
class Finding:
    """One remark. severity: "error" (do not train on this) or "warning". kind: short name for programs."""

    severity: str
    kind: str
    message: str


@dataclass(frozen=True)
class _Seen:
    """What is kept of one image: the digest of its bytes and a thumbnail (6, 8, 3), or why it cannot be read."""

    digest: str = ""
    thumbnail: NDArray[np.float32] | None = None
    broken: str = ""


def check_recording(folder: Path, split: Split | None = None, *, quiet: bool = False) -> list[Finding]:
    """Check every image of the successful grasps, and the split where one is given. Raises DatasetError where the
    recording cannot be read at all."""
    grasps = load_grasps(folder)
    files = sorted({path for grasp in grasps for path in (grasp.photo, *grasp.touches, *grasp.backgrounds)})
    seen: dict[Path, _Seen] = {}
    with ThreadPoolExecutor(2) as pool, Bar("check", len(files), "images", quiet=quiet) as bar:
        for path, image in zip(files, pool.map(_look, files), strict=True):
            seen[path] = image
            bar.advance()
    findings = [*_broken(folder, seen), *_single(grasps), *_duplicates(folder, grasps, seen)]
    findings += [*_same_images(grasps, seen), *_swapped(grasps, seen)]
    return findings + (list(check_split(grasps, split)) if split else [])


def check_split(grasps: Sequence[Grasp], split: Split) -> Iterable[Finding]:
    """Objects and sequences that stand on two sides of a split, and objects on none."""
    parts = {"train": split.train, "validation": split.validation, "test": split.test}
    part_of: dict[str, set[str]] = defaultdict(set)
    for part, objects in parts.items():
        for name in objects:
            part_of[name].add(part)
    shared = sorted(name for name, on in part_of.items() if len(on) > 1)
    if shared:
        yield Finding("error", "split-objects", f"the split shares {len(shared)} object(s): {_some(shared)}")
    sides: dict[str, set[str]] = defaultdict(set)
    for grasp in grasps:
        if grasp.sequence_id is not None:
            sides[grasp.sequence_id] |= part_of.get(grasp.object_id, set())
    leaking = sorted(name for name, on in sides.items() if len(on) > 1)
    if leaking:
        yield Finding(
            "error",
            "split-sequences",
            f"the split cuts {len(leaking)} sequence(s) in two, so that neighbouring frames are on both sides: "
            f"{_some(leaking)}",
        )
    recorded = {grasp.object_id for grasp in grasps}
    unknown = sorted(set(part_of) - recorded)
    if unknown:
        yield Finding(
            "warning", "split-unknown", f"the split names {len(unknown)} object(s) not recorded: {_some(unknown)}"
        )
    absent = sorted(recorded - set(part_of))
    if absent:
        yield Finding("warning", "split-absent", f"the split leaves out {len(absent)} object(s): {_some(absent)}")


def require_fit(split: Split, grasps: Sequence[Grasp]) -> None:
    """Raise DatasetError for a split that leaks, or whose parts have too few objects in the recording for pairs."""
    for finding in check_split(grasps, split):
        if finding.severity == "error":
            raise DatasetError(f"{finding.message}; every object and sequence must stand in one part of the split")
    for part in ("train", "validation"):
        count = len({grasp.object_id for grasp in split.select(grasps, part)})
        if count < 2 and (part == "train" or split.validation):
            raise DatasetError(
                f"pairs need at least 2 objects in the {part} part of the split; the recording has {count} of them"
            )


def _look(path: Path) -> _Seen:
    try:
        data = read_bytes(path)
        return _Seen(sha256(data).hexdigest(), resize(decode_rgb(data, path), _THUMBNAIL))
    except ImageError as error:
        return _Seen(broken=error.reason)


def _broken(folder: Path, seen: dict[Path, _Seen]) -> Iterable[Finding]:
    for path, image in seen.items():
        if image.broken:
            yield Finding("error", "broken", f"{path.relative_to(folder)}: {image.broken}")


def _single(grasps: Sequence[Grasp]) -> Iterable[Finding]:
    counts = Counter(grasp.object_id for grasp in grasps)
    single = sorted(name for name, count in counts.items() if count == 1)
    if single:
        yield Finding(
            "warning",
            "one-grasp",
            f"{len(single)} of {len(counts)} object(s) have one grasp, so photo and touch of a pair always come from "
            f"the same moment: {_some(single)}",
        )


def _duplicates(folder: Path, grasps: Sequence[Grasp], seen: dict[Path, _Seen]) -> Iterable[Finding]:
    """The same bytes under two objects."""
    holders: dict[str, dict[str, Path]] = defaultdict(dict)
    for grasp in grasps:
        for path in (grasp.photo, *grasp.touches):
            if seen[path].digest:
                holders[seen[path].digest].setdefault(grasp.object_id, path)
    for objects in holders.values():
        if len(objects) > 1:
            where = [f"{name} ({path.relative_to(folder)})" for name, path in sorted(objects.items())]
            yield Finding("error", "duplicate", f"{len(objects)} objects share one image: {_some(where)}")


def _same_images(grasps: Sequence[Grasp], seen: dict[Path, _Seen]) -> Iterable[Finding]:
    """The same bytes for the photo and a touch, or for two fingers, of one grasp."""
    kinds = {"same-modality": ("error", "photo and touch are"), "same-fingers": ("warning", "two fingers have")}
    names: dict[str, list[str]] = {kind: [] for kind in kinds}
    for grasp in grasps:
        touches = [seen[path].digest for path in grasp.touches if seen[path].digest]
        if seen[grasp.photo].digest in touches:
            names["same-modality"].append(grasp.grasp_id)
        if len(set(touches)) < len(touches):
            names["same-fingers"].append(grasp.grasp_id)
    for kind, (severity, what) in kinds.items():
        if names[kind]:
            where = f"in {len(names[kind])} of {len(grasps)} grasps: {_some(names[kind])}"
            yield Finding(severity, kind, f"{what} the same image {where}")


def _swapped(grasps: Sequence[Grasp], seen: dict[Path, _Seen]) -> Iterable[Finding]:
    """Gel images share one look (the gel's tint and lamps); photos of different objects do not.

    So thumbnails of touches lie close to their median and those of photos lie far from it. A grasp whose photo lies
    closer than its touch is suspect; when the photos of the whole recording are the tighter cloud, everything is.
    """
    usable = [grasp for grasp in grasps if all(not seen[path].broken for path in (grasp.photo, grasp.touches[0]))]
    if len(usable) < 3:
        return
    touches = np.array([seen[grasp.touches[0]].thumbnail for grasp in usable])
    photos = np.array([seen[grasp.photo].thumbnail for grasp in usable])
    if _spread(photos) < _spread(touches) / 2:
        yield Finding(
            "error",
            "swapped",
            "touches and photos look swapped throughout (the photos are the more alike); exchange the columns",
        )
        return
    look = np.median(touches, axis=0)
    closer = _distance(photos, look) < _distance(touches, look) / 2
    names = [grasp.grasp_id for grasp, suspect in zip(usable, closer, strict=True) if suspect]
    if names:
        yield Finding(
            "error", "swapped", f"touch and photo look swapped in {len(names)} of {len(usable)} grasps: {_some(names)}"
        )


def _spread(images: NDArray[np.float32]) -> float:
    return float(np.median(_distance(images, np.median(images, axis=0))))


def _distance(images: NDArray[np.float32], centre: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.sqrt(np.mean((images - centre) ** 2, axis=(1, 2, 3)))  # type: ignore[no-any-return]


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
