"""Check a recording for problems that spoil training or make its results too good.

An ERROR is certain, or so far from the rest of the recording that nothing else explains it: do not train. A WARNING
concerns appearance, or something missing: inspect the recording. A NOTE reports what could not be checked.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path

import numpy as np

from retrieval.console.output import abbreviate_list
from retrieval.console.progress import Bar
from retrieval.data.check import appearance_checks, drift, known_problems
from retrieval.data.check.colour_layout import COLOUR_LAYOUT, check_colour_layout
from retrieval.data.check.findings import Finding, ImageRecord, ImageRecords, findings_for
from retrieval.data.check.near_copies import thumbnail
from retrieval.data.dataset import Attempt, Grasp, Split, load_all_attempts, require_accepted
from retrieval.data.images import decode_rgb, read_bytes
from retrieval.data.resize import resize
from retrieval.errors import DatasetError, ImageError

_SMALL, _PHOTO = (6, 8), (64, 64)
_FLAT = 3.5 / 255
"""Range of the samples of a single colour after JPEG compression, at most."""

_Check = Callable[[Sequence[Grasp], ImageRecords], Iterable[Finding]]


def check_recording(folder: Path, split: Split | None = None) -> list[Finding]:
    """Check every photo and gel image of a recording, including rejected grasps, and optionally the split.

    Depth pictures are not opened, since no training uses them. Each check skips the grasps that earlier findings name.

    Args:
        folder: Folder of the recording.
        split: The split to check, if any.

    Returns:
        The findings, notes last.

    Raises:
        DatasetError: The recording cannot be read, or contains no accepted grasp.

    >>> from pathlib import Path
    >>> {finding.severity for finding in retrieval.check_recording(Path("lab"))} <= {"note", "warning", "error"}
    True
    """
    attempts = load_all_attempts(folder)
    accepted = require_accepted(folder, attempts)
    records = _read_pictures(attempts)
    grasps = [attempt.grasp for attempt in attempts]
    findings = [
        Finding("error", "broken", f"{path.relative_to(folder)}: {image.error}")
        for path, image in records.items()
        if image.error
    ]
    counts = Counter(grasp.object_id for grasp in accepted)
    if single := sorted(name for name, count in counts.items() if count == 1):
        text = (
            f"{len(single)} of {len(counts)} object(s) have only one grasp, so photo and touch of a pair always come "
            f"from the same moment: {abbreviate_list(single)}"
        )
        findings.append(Finding("warning", "one-grasp", text))
    findings += _duplicates(folder, grasps, records)
    readable = [one.grasp for one in attempts if all(not records[path].error for path in _pictures(one))]
    trained_on = {grasp.grasp_id for grasp in accepted}
    of_all: tuple[_Check, ...] = (
        _same_images,
        known_problems.check_dead_frames,
        appearance_checks.check_swapped_modalities,
        check_colour_layout,  # before check_fingers, which takes exchanged channels of one finger for another finger
        appearance_checks.check_fingers,
        appearance_checks.check_moments,
    )
    of_accepted: tuple[_Check, ...] = (
        known_problems.check_frozen_frames,
        known_problems.check_shared_backgrounds,
        known_problems.check_repeated_touches,
        appearance_checks.check_own_photo,
        appearance_checks.check_exchanged_photos,
    )

    def unnamed(besides: str = "") -> list[Grasp]:
        named = {name for finding in findings if finding.kind != besides for name in finding.grasps}
        return [grasp for grasp in readable if grasp.grasp_id not in named]

    for check in of_all + of_accepted:
        findings += check([one for one in unnamed() if check in of_all or one.grasp_id in trained_on], records)
    place_of = {grasp.grasp_id: place for place, grasp in enumerate(_in_order_of_capture(attempts))}
    # A recording without photos has the touch in place of the photo; its no-contact frames are checked all the same.
    touched = [one for one in unnamed(besides="same-modality") if one.grasp_id in trained_on]
    findings += drift.check_light(sorted(touched, key=lambda grasp: place_of[grasp.grasp_id]), records)
    # A mirrored image may be a near copy, too.
    remaining = [one for one in unnamed(besides=COLOUR_LAYOUT) if one.grasp_id in trained_on]
    findings += appearance_checks.check_near_copies(remaining, records, accepted)
    if split:
        findings += check_split(accepted, split)
        readable_accepted = [grasp for grasp in readable if grasp.grasp_id in trained_on]
        findings += known_problems.check_sequences_in_training(readable_accepted, split, records)
    return sorted(findings, key=lambda finding: finding.severity == "note")


def check_gel_layout(folder: Path) -> list[Finding]:
    """Return the findings of `check_colour_layout`; only the gel images are read.

    Args:
        folder: Folder of the recording.

    Raises:
        DatasetError: The recording cannot be read.
    """
    attempts = load_all_attempts(folder)
    gels = {one.grasp.grasp_id: (*one.grasp.touches, *one.grasp.backgrounds) for one in attempts}
    records = _read(sorted({path for paths in gels.values() for path in paths}), set(), set())
    grasps = [one.grasp for one in attempts if not any(records[path].error for path in gels[one.grasp.grasp_id])]
    return list(check_colour_layout(grasps, records))


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


# Files -----------------------------------------------------------------------------------------------------


def _pictures(attempt: Attempt) -> tuple[Path, ...]:
    grasp = attempt.grasp
    return (grasp.photo, *grasp.touches, *grasp.backgrounds, *attempt.after)


def _in_order_of_capture(attempts: Sequence[Attempt]) -> list[Grasp]:
    """Return the grasps by their times if all are recorded, else in the order of the lines."""
    if all(attempt.time_s is not None for attempt in attempts):
        attempts = sorted(attempts, key=lambda attempt: attempt.time_s or 0.0)
    return [attempt.grasp for attempt in attempts]


def _read_pictures(attempts: Sequence[Attempt]) -> ImageRecords:
    files = sorted({path for attempt in attempts for path in _pictures(attempt)})
    photos = {attempt.grasp.photo for attempt in attempts}
    copied = {path for one in attempts if one.accepted for path in (one.grasp.photo, *one.grasp.touches)}
    return _read(files, photos, copied)


def _read(files: Sequence[Path], photos: AbstractSet[Path], copied: AbstractSet[Path]) -> ImageRecords:
    """Read pictures; those of `photos` are also stored as photos, those of `copied` also as thumbnails."""

    def read(path: Path) -> ImageRecord:
        try:
            data = read_bytes(path)
            image = decode_rgb(data, path)
        except ImageError as error:
            return ImageRecord(error=error.reason)
        return ImageRecord(
            sha256(data).hexdigest(),
            bool(np.ptp(image, axis=(0, 1)).max() <= _FLAT),
            resize(image, _SMALL),
            resize(image, _PHOTO) if path in photos else None,
            thumbnail(data, image) if path in copied else None,
        )

    records: ImageRecords = {}
    with ThreadPoolExecutor(2) as pool, Bar("check", len(files), "images") as bar:
        for path, record in zip(files, pool.map(read, files), strict=True):
            records[path] = record
            bar.advance()
    return records


def _duplicates(folder: Path, grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find files of two objects with the same bytes."""
    users: dict[str, dict[str, Path]] = defaultdict(dict)
    for grasp in grasps:
        for path in (grasp.photo, *grasp.touches):
            if records[path].digest:
                users[records[path].digest].setdefault(grasp.object_id, path)
    for objects in users.values():
        if len(objects) > 1:
            where = [f"{name} ({path.relative_to(folder)})" for name, path in sorted(objects.items())]
            yield Finding("error", "duplicate", f"{len(objects)} objects share one image: {abbreviate_list(where)}")


def _same_images(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find grasps with the same bytes for the photo and a touch, or for two fingers."""
    kinds = {"same-modality": ("error", "photo and touch are"), "same-fingers": ("warning", "two fingers have")}
    names: dict[str, list[str]] = {kind: [] for kind in kinds}
    for grasp in grasps:
        touches = [records[path].digest for path in grasp.touches]
        if records[grasp.photo].digest in touches:
            names["same-modality"].append(grasp.grasp_id)
        if len(set(touches)) < len(touches):
            names["same-fingers"].append(grasp.grasp_id)
    for kind, (severity, what) in kinds.items():
        yield from findings_for(severity, kind, f"{what} the same image", names[kind], grasps)
