"""Checks of a recording by the appearance of its pictures; each yields findings on its grasps.

The checks for exchanged pictures compare a minority with the majority of the recording. Exchanges of two fingers with
similar gels, of a no-contact frame with a touch of little contact, and of similar photos cannot be found; notes report
these cases (the second one only if it concerns most touches). If all photos of two objects were exchanged, this cannot
be found either, and no note reports it.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from string import ascii_lowercase

import numpy as np

from retrieval.console.output import abbreviate_list
from retrieval.data.check.appearance_statistics import (
    SmallImages,
    distance,
    exchanged_photos,
    swapped_fingers,
    swapped_moments,
)
from retrieval.data.check.findings import Finding, ImageRecords, findings_for
from retrieval.data.check.near_copies import PictureSet, Thumbnail, is_copy
from retrieval.data.dataset import Grasp

COMPARED_COPIES = "compared-copies"
"""Kind of the finding that reports how many pictures were compared for near copies."""
_MIN_GRASPS = 4


def check_swapped_modalities(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find photos and touches that look exchanged.

    Gel images look alike (the gel's tint and lamps); photos of different objects do not. So small pictures of touches
    lie close to their median, and photos lie far from it. A grasp is suspect if its photo lies at less than half
    the distance of its touch. The whole recording is suspect if its photos are twice as alike as its touches.
    """
    if len(grasps) < 3:
        return
    touches, photos = (
        _small(records, [one.touches[0] for one in grasps]),
        _small(records, [one.photo for one in grasps]),
    )
    spread = [float(np.median(distance(images, np.median(images, axis=0)))) for images in (photos, touches)]
    if spread[0] < spread[1] / 2:
        yield Finding(
            "error",
            "swapped",
            "touches and photos look swapped throughout (the photos resemble each other more than the touches do, "
            "usually it is the reverse); exchange the columns",
            tuple(grasp.grasp_id for grasp in grasps),
        )
        return
    centre = np.median(touches, axis=0)
    closer = distance(photos, centre) < distance(touches, centre) / 2
    names = [grasp.grasp_id for grasp, suspect in zip(grasps, closer, strict=True) if suspect]
    whole = {one.sequence_id for one in grasps} - {one.sequence_id for one in grasps if one.grasp_id not in set(names)}
    where = f", throughout the sequence(s) {abbreviate_list(sorted(filter(None, whole)))}," if whole - {None} else ""
    yield from findings_for("error", "swapped", f"touch and photo look swapped{where}", names, grasps)


def check_fingers(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find grasps whose two fingers look exchanged, in the touches or in the no-contact frames."""
    with_frames = [grasp for grasp in grasps if len(grasp.backgrounds) == len(grasp.touches)]
    for moment, selected in (("touch", grasps), ("no-contact frame", with_frames)):
        if len(selected) < _MIN_GRASPS:
            continue
        fingers = range(min(len(grasp.touches) for grasp in selected))
        frames = [_small(records, [_of(grasp, moment)[finger] for grasp in selected]) for finger in fingers]
        for a, b in combinations(fingers, 2):
            which = f"{ascii_lowercase[a]} and {ascii_lowercase[b]}"
            found = swapped_fingers(frames[a], frames[b])
            if found is None:
                text = f"fingers {which} look too similar to find swaps ({moment})"
                yield Finding("note", "unchecked-fingers", text)
                continue
            names = [selected[row].grasp_id for row in found]
            yield from findings_for(
                "error", "swapped-fingers", f"fingers {which} look swapped ({moment})", names, selected
            )


def check_moments(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches and no-contact frames that look exchanged.

    The moment of a frame is "before" (before contact: a no-contact frame) or "touch" (during contact).
    """
    both = [grasp for grasp in grasps if grasp.backgrounds and len(grasp.backgrounds) == len(grasp.touches)]
    if len(both) < _MIN_GRASPS:
        return
    suspects: set[str] = set()
    for finger in range(min(len(grasp.touches) for grasp in both)):
        before, during = (_small(records, [_of(one, moment)[finger] for one in both]) for moment in ("before", "touch"))
        found = swapped_moments(before, during)
        if found.all_swapped:
            yield Finding(
                "error",
                "swapped-moments",
                f"touches of finger {ascii_lowercase[finger]} look swapped throughout with the no-contact frames (the "
                "no-contact frames differ from each other more than the touches do, usually it is the reverse); "
                "exchange the columns",
                tuple(grasp.grasp_id for grasp in both),
            )
            return
        suspects |= {both[row].grasp_id for row in found.swapped}
        if 2 * found.low_contact > len(both):
            text = (
                f"{found.low_contact} of {len(both)} touches of finger {ascii_lowercase[finger]} hardly differ from "
                "the no-contact frame: swaps of the two cannot be found"
            )
            yield Finding("note", "unchecked-moments", text)
    names = [grasp.grasp_id for grasp in both if grasp.grasp_id in suspects]
    yield from findings_for("error", "swapped-moments", "touch and no-contact frame look swapped", names, both)


def check_exchanged_photos(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find photos of two objects that look exchanged."""
    photos = np.array([records[grasp.photo].photo for grasp in grasps], dtype=np.float32)
    names, objects = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)
    if len(names) < 2:
        return
    found = exchanged_photos(photos, objects)
    if found.pairs:
        rows = dict.fromkeys(row for pair in found.pairs for row in pair)
        where = [f"{grasps[one].grasp_id} with {grasps[other].grasp_id}" for one, other in found.pairs]
        yield Finding(
            "warning",
            "exchanged-photos",
            f"the photos of {len(found.pairs)} pair(s) of grasps look exchanged between two objects: "
            f"{abbreviate_list(where)}",
            tuple(grasps[row].grasp_id for row in rows),
        )
    if found.distinguishable_pairs < found.all:
        yield Finding(
            "note",
            "unchecked-photos",
            f"photos exchanged between two objects can be found for {found.distinguishable_pairs} of {found.all} "
            "pairs of objects; the others look too similar, or have fewer than 4 photos",
        )


# Copies ----------------------------------------------------------------------------------------------------


def check_own_photo(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches whose picture is the photo of the same grasp, in any encoding or size."""
    names = [
        grasp.grasp_id
        for grasp in grasps
        if any(is_copy(_thumbnail(records, touch), _thumbnail(records, grasp.photo)) for touch in grasp.touches)
    ]
    yield from findings_for("error", "same-modality", "a touch shows its own photo", names, grasps)


def check_near_copies(grasps: Sequence[Grasp], records: ImageRecords, accepted: Sequence[Grasp]) -> Iterator[Finding]:
    """Find near copies of pictures of another object, and count the pictures that were compared.

    A near copy of a touch is only a warning: smooth objects that are pressed in the same way look alike. (68 pairs
    among 4,991 touches of boxes, mugs and bowls in VT60; no inspected pair was a copy.)
    """
    counts, low_contact, left_out = [], 0, 0
    for kind, every in _by_kind(accepted).items():
        items = [(grasp, path) for path, grasp in _by_kind(grasps).get(kind, {}).items()]
        pictures = PictureSet([_thumbnail(records, path) for _, path in items], [one.object_id for one, _ in items])
        rows = np.arange(len(items))
        found = pictures.nearest(rows, rows)
        pairs: dict[tuple[int, ...], str] = {}
        for row in np.flatnonzero(found.copy).tolist():
            (grasp, path), (other, near) = items[row], items[found.row[row]]
            if records[path].digest != records[near].digest:
                pairs[tuple(sorted((row, int(found.row[row]))))] = f"{grasp.grasp_id} and {other.grasp_id}"
        if pairs:
            text = f"{len(pairs)} pair(s) of images ({kind}) of two objects are near copies of each other"
            severity, or_else = (
                ("error", "") if kind == "photo" else ("warning", ", or the touches of these objects are similar")
            )
            yield Finding(severity, "near-copy", f"{text}{or_else}: {abbreviate_list(list(pairs.values()))}")
        counts.append(f"{found.checked.sum()} of {len(every)} images ({kind})")
        low_contact += int((~found.checked).sum())
        left_out += len(every) - len(items)
    reasons = []
    if low_contact:
        reasons.append(
            f"{low_contact} show too little to recognise a copy (little contact, or too many similar pictures)"
        )
    if left_out:
        reasons.append(f"{left_out} belong to grasps that are named above")
    yield Finding(
        "note", COMPARED_COPIES, f"near copies were searched for in {'; '.join([', '.join(counts), *reasons])}"
    )


def _by_kind(grasps: Sequence[Grasp]) -> dict[str, dict[Path, Grasp]]:
    """Return, for photos and for the touches of each finger, one grasp for each picture file."""
    kinds = {"photo": {grasp.photo: grasp for grasp in grasps}}
    for finger in range(min((len(grasp.touches) for grasp in grasps), default=0)):
        kinds[f"touch {ascii_lowercase[finger]}"] = {grasp.touches[finger]: grasp for grasp in grasps}
    return kinds


# Helpers ---------------------------------------------------------------------------------------------------


def _of(grasp: Grasp, moment: str) -> tuple[Path, ...]:
    return grasp.touches if moment == "touch" else grasp.backgrounds


def _small(records: ImageRecords, paths: Sequence[Path]) -> SmallImages:
    return np.array([records[path].small for path in paths], dtype=np.float32)


def _thumbnail(records: ImageRecords, path: Path) -> Thumbnail:
    result = records[path].thumbnail
    assert result is not None  # every photo and touch of the accepted grasps has one
    return result
