"""Check a recording for problems that spoil training or make its results too good.

An ERROR is certain, or so far from the rest of the recording that nothing else explains it: do not train. A WARNING
concerns appearance, or something missing: inspect the recording. A NOTE reports what could not be checked.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from retrieval.console.output import abbreviate_list
from retrieval.data.check import appearance
from retrieval.data.check.drift import check_drift, check_sessions
from retrieval.data.check.opening import check_openings
from retrieval.data.check.pictures import Finding, ImageRecords, findings_for, read_pictures
from retrieval.data.check.split import check_split
from retrieval.data.dataset import Grasp, Split, load_all_grasps, require_accepted


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
    grasps = load_all_grasps(folder)
    accepted = require_accepted(folder, grasps)
    records, broken = read_pictures({path for grasp in grasps for path in _pictures(grasp)})
    findings = [Finding("error", "broken", f"{path.relative_to(folder)}: {reason}") for path, reason in broken.items()]
    findings += _single_grasps(accepted)
    if any(grasp.photos for grasp in accepted):
        without = [grasp.grasp_id for grasp in accepted if not grasp.photos]
        findings += findings_for("error", "no-photo", "no photo, unlike in the others,", without, accepted)
    findings += _duplicates(folder, grasps, records)
    readable = [grasp for grasp in grasps if not broken.keys() & set(_pictures(grasp))]

    def unnamed(grasps: Sequence[Grasp]) -> list[Grasp]:
        named = {name for finding in findings for name in finding.grasps}
        return [grasp for grasp in grasps if grasp.grasp_id not in named]

    findings += _same_or_flat_images(readable, records)
    # Exchanged channels of one finger look like another finger, so they are checked before the fingers.
    for check in (
        appearance.check_swapped_modalities,
        appearance.check_colour_layout,
        appearance.check_fingers,
        appearance.check_moments,
    ):
        findings += check(unnamed(readable), records)
    used = [grasp for grasp in readable if grasp.accepted]
    findings += _shared_backgrounds(unnamed(used), records)
    findings += _repeated_touches(unnamed(used), records)
    if all(grasp.time_s is not None for grasp in used):
        used.sort(key=lambda grasp: grasp.time_s or 0.0)
    findings += check_drift(unnamed(used), records)
    findings += check_sessions(accepted)
    findings += check_openings(accepted)
    if split:
        findings += check_split(accepted, split)
    return sorted(findings, key=lambda finding: finding.severity == "note")


def check_gel_layout(folder: Path) -> list[Finding]:
    """Return the findings of `check_colour_layout`; only the gel images are read. Raises DatasetError."""
    grasps = load_all_grasps(folder)
    gels = {grasp.grasp_id: {*grasp.touches, *grasp.backgrounds} for grasp in grasps}
    records, broken = read_pictures(set().union(*gels.values()))
    readable = [grasp for grasp in grasps if not broken.keys() & gels[grasp.grasp_id]]
    return list(appearance.check_colour_layout(readable, records))


def _pictures(grasp: Grasp) -> tuple[Path, ...]:
    return (*grasp.photos, *grasp.touches, *grasp.backgrounds, *grasp.after)


def _single_grasps(grasps: Sequence[Grasp]) -> Iterator[Finding]:
    counts = Counter(grasp.object_id for grasp in grasps)
    if single := sorted(name for name, count in counts.items() if count == 1):
        effect = "photo and touch of a pair always come from the same moment"
        if not any(grasp.photos for grasp in grasps):
            effect = "no other touch of them can be recognised"
        text = f"{len(single)} of {len(counts)} object(s) have only one grasp, so {effect}: {abbreviate_list(single)}"
        yield Finding("warning", "one-grasp", text)


def _duplicates(folder: Path, grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find files of two objects with the same bytes."""
    users: dict[str, dict[str, Path]] = defaultdict(dict)
    for grasp in grasps:
        for path in filter(records.get, (*grasp.photos, *grasp.touches)):
            users[records[path].digest].setdefault(grasp.object_id, path)
    for objects in users.values():
        if len(objects) > 1:
            where = [f"{name} ({path.relative_to(folder)})" for name, path in sorted(objects.items())]
            yield Finding("error", "duplicate", f"{len(objects)} objects share one image: {abbreviate_list(where)}")


def _same_or_flat_images(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find grasps with the same bytes for two of their images, or with an image of a single colour."""
    names: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for grasp in grasps:
        photos, touches = [records[path] for path in grasp.photos], [records[path] for path in grasp.touches]
        backgrounds = [records[path] for path in grasp.backgrounds]
        digests = {touch.digest for touch in touches}
        is_touch = any(photo.digest in digests for photo in photos)
        # A grasp that missed may leave the gel untouched.
        is_frozen = grasp.accepted and digests & {frame.digest for frame in backgrounds}
        for is_faulty, severity, kind, text in (
            (is_touch, "error", "same-modality", "photo and touch are the same image"),
            (len(digests) < len(touches), "warning", "same-fingers", "two fingers have the same image"),
            (is_frozen, "error", "frozen-frame", "touch and no-contact frame are the same image"),
            (any(photo.is_flat for photo in photos), "error", "dead-frame", "the photo has a single colour"),
            (any(touch.is_flat for touch in touches), "error", "dead-frame", "a touch has a single colour"),
            (
                any(frame.is_flat for frame in backgrounds),
                "error",
                "dead-frame",
                "a no-contact frame has a single colour",
            ),
        ):
            if is_faulty:
                names[severity, kind, text].append(grasp.grasp_id)
    for finding, grasp_ids in names.items():
        yield from findings_for(*finding, grasp_ids, grasps)


def _repeated_touches(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches that several grasps of one object share byte for byte."""
    keys = {grasp.grasp_id: {(grasp.object_id, records[path].digest) for path in grasp.touches} for grasp in grasps}
    counts = Counter(key for of_grasp in keys.values() for key in of_grasp)
    names = [name for name, of_grasp in keys.items() if any(counts[key] > 1 for key in of_grasp)]
    yield from findings_for(
        "warning", "repeated-touch", "another grasp of the object has the same touch", names, grasps
    )


def _shared_backgrounds(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find no-contact frames that serve several objects."""
    users: dict[str, dict[str, str]] = defaultdict(dict)
    for grasp in grasps:
        for path in grasp.backgrounds:
            users[records[path].digest][grasp.grasp_id] = grasp.object_id
    shared = [objects for objects in users.values() if len(set(objects.values())) > 1]
    if shared:
        served = {name: owner for objects in shared for name, owner in objects.items()}
        yield Finding(
            "warning",
            "one-background",
            f"{len(shared)} no-contact frame(s) serve {len(served)} of {len(grasps)} grasps, of "
            f"{len(set(served.values()))} objects: drift since such a frame was taken stays in its difference "
            "from the touch and may identify the object; compare with the controls of `retrieve evaluate`",
        )
