"""Doubts about a recording by what its pictures look like; each yields findings on the grasps it is given.

A minority is judged against the rest. What cannot be told is a note: no look at the pictures tells two fingers apart
whose gels are alike, before from during where nothing was touched, and two objects whose photos were exchanged
throughout.
"""

from collections import Counter
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
    nearest_grasp_accuracy,
    swapped_fingers,
    swapped_moments,
)
from retrieval.data.check.findings import Finding, ImageRecords, findings_for
from retrieval.data.check.near_copies import PictureSet, Thumbnail, is_copy
from retrieval.data.dataset import Grasp

COMPARED_COPIES = "compared-copies"
"""The finding that says in how many pictures near copies were looked for."""
_MIN_GRASPS = 4
_MAX_BY_LIGHT, _MAX_BY_TOUCH = 0.35, 0.6
"""How far from chance to always may light alone name the object: by frames without contact, and by the mean colour of
touches, which names it a little by what was felt (0.2 to 0.35 of the way on simulated recordings)."""


def swapped(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Gel images share one look (the gel's tint and lamps); photos of different objects do not.

    So small pictures of touches lie close to their median and those of photos lie far from it. A grasp whose photo lies
    closer than its touch is suspect; when the photos of the whole recording are the tighter cloud, everything is.
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
            "touches and photos look swapped throughout (the photos are the more alike); exchange the columns",
            tuple(grasp.grasp_id for grasp in grasps),
        )
        return
    look = np.median(touches, axis=0)
    closer = distance(photos, look) < distance(touches, look) / 2
    names = [grasp.grasp_id for grasp, suspect in zip(grasps, closer, strict=True) if suspect]
    whole = {one.sequence_id for one in grasps} - {one.sequence_id for one in grasps if one.grasp_id not in set(names)}
    where = f", throughout the sequence(s) {abbreviate_list(sorted(filter(None, whole)))}," if whole - {None} else ""
    yield from findings_for("error", "swapped", f"touch and photo look swapped{where}", names, grasps)


def fingers(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Frames of two fingers, before and during the grasp, that look exchanged."""
    both = [grasp for grasp in grasps if len(grasp.backgrounds) == len(grasp.touches)]
    for moment, those in (("touch", grasps), ("untouched gel", both)):
        if len(those) < _MIN_GRASPS:
            continue
        fingers = range(min(len(grasp.touches) for grasp in those))
        frames = [_small(records, [_of(grasp, moment)[finger] for grasp in those]) for finger in fingers]
        for a, b in combinations(fingers, 2):
            which = f"{ascii_lowercase[a]} and {ascii_lowercase[b]}"
            found = swapped_fingers(frames[a], frames[b])
            if found is None:
                text = f"fingers {which} look too much alike to find swapped ones ({moment})"
                yield Finding("note", "unchecked-fingers", text)
                continue
            names = [those[row].grasp_id for row in found]
            yield from findings_for(
                "error", "swapped-fingers", f"fingers {which} look swapped ({moment})", names, those
            )


def moments(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Touches and frames of the untouched gel that look exchanged."""
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
                f"touches of finger {ascii_lowercase[finger]} look swapped throughout with the untouched gel (its "
                "frames are the less alike); exchange the columns",
                tuple(grasp.grasp_id for grasp in both),
            )
            return
        suspects |= {both[row].grasp_id for row in found.swapped}
        if 2 * found.low_contact > len(both):
            text = (
                f"{found.low_contact} of {len(both)} touches of finger {ascii_lowercase[finger]} hardly differ from the "
                "untouched gel: whether these two are swapped cannot be told"
            )
            yield Finding("note", "unchecked-moments", text)
    names = [grasp.grasp_id for grasp in both if grasp.grasp_id in suspects]
    yield from findings_for("error", "swapped-moments", "touch and untouched gel look swapped", names, both)


def light(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Lamps or gels that changed from object to object, so that light names the object."""
    objects = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1] if grasps else np.zeros(0, int)
    repeated = Counter(objects.tolist())
    if len(repeated) < 2 or max(repeated.values()) < 2:
        yield Finding(
            "note", "unchecked-light", "light that names the object cannot be looked for: no object came twice"
        )
        return
    has_before = all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps)
    # A frame that serves many grasps says once what the light was like.
    has_before = has_before and len({records[one.backgrounds[0]].digest for one in grasps}) > len(grasps) / 2
    fingers = range(min(len(grasp.touches) for grasp in grasps))
    for moment, allowed in (("before", _MAX_BY_LIGHT), ("touch", _MAX_BY_TOUCH)):
        if moment == "before" and not has_before:
            yield Finding(
                "note",
                "unchecked-light",
                "without a frame of the untouched gel of its own for every grasp, light that names the object is found "
                "only where it is strong",
            )
            continue
        frames = [_small(records, [_of(grasp, moment)[finger] for grasp in grasps]) for finger in fingers]
        values = np.stack(frames, axis=1)
        found = nearest_grasp_accuracy(values if moment == "before" else values.mean(axis=(2, 3)), objects)
        if found.exceeds_chance(allowed):
            what = "the untouched gel" if moment == "before" else "the mean colour of the touch"
            yield Finding(
                "warning",
                "light",
                f"{what} alone names the object in {found.accuracy:.0%} of {found.grasps} grasps (chance "
                f"{found.chance:.0%}): light or gel changed from object to object, and a model can learn that instead "
                "of touch; mix the objects while recording, and compare with `retrieve evaluate`'s controls",
            )
            return


def check_exchanged_photos(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Photos of two objects that look exchanged."""
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
            f"the photos of {len(found.pairs)} pair(s) of grasps look exchanged between two objects: {abbreviate_list(where)}",
            tuple(grasps[row].grasp_id for row in rows),
        )
    if found.distinguishable_pairs < found.all:
        yield Finding(
            "note",
            "unchecked-photos",
            f"photos exchanged between two objects can be noticed for {found.distinguishable_pairs} of {found.all} pairs of "
            "objects; the others look too much alike, or have fewer than 4 photos",
        )


# Copies ----------------------------------------------------------------------------------------------------


def check_own_photo(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Touches that are their own photo, encoded or sized in another way."""
    names = [
        grasp.grasp_id
        for grasp in grasps
        if any(is_copy(_thumbnail(records, touch), _thumbnail(records, grasp.photo)) for touch in grasp.touches)
    ]
    yield from findings_for("error", "same-modality", "a touch shows its own photo", names, grasps)


def copies(grasps: Sequence[Grasp], records: ImageRecords, accepted: Sequence[Grasp]) -> Iterator[Finding]:
    """Near copies of pictures of another object, and in how many of those of all accepted grasps they were looked for.

    Of touches a warning only: smooth things pressed in the same way look so without being copies. (68 pairs of 4,991
    touches of VT60, boxes, mugs and bowls; none of those looked at was a copy.)
    """
    counts, low_contact, left_out = [], 0, 0
    for kind, every in _by_kind(accepted).items():
        one_each = [(grasp, path) for path, grasp in _by_kind(grasps).get(kind, {}).items()]
        pictures = PictureSet(
            [_thumbnail(records, path) for _, path in one_each], [one.object_id for one, _ in one_each]
        )
        rows = np.arange(len(one_each))
        found = pictures.nearest(rows, rows)
        pairs: dict[tuple[int, ...], str] = {}
        for row in np.flatnonzero(found.copy).tolist():
            (grasp, path), (other, near) = one_each[row], one_each[found.row[row]]
            if records[path].digest != records[near].digest:
                pairs[tuple(sorted((row, int(found.row[row]))))] = f"{grasp.grasp_id} and {other.grasp_id}"
        if pairs:
            text = f"{len(pairs)} pair(s) of images ({kind}) of two objects are near copies of each other"
            severity, or_else = ("error", "") if kind == "photo" else ("warning", ", or of things that feel alike")
            yield Finding(severity, "near-copy", f"{text}{or_else}: {abbreviate_list(list(pairs.values()))}")
        counts.append(f"{found.checked.sum()} of {len(every)} images ({kind})")
        low_contact += int((~found.checked).sum())
        left_out += len(every) - len(one_each)
    why = [f"{low_contact} show too little to tell a copy by (a light contact, or a look that many share)"] * bool(
        low_contact
    )
    why += [f"{left_out} are of grasps that are named above"] * bool(left_out)
    yield Finding("note", COMPARED_COPIES, f"near copies were looked for in {'; '.join([', '.join(counts), *why])}")


def _by_kind(grasps: Sequence[Grasp]) -> dict[str, dict[Path, Grasp]]:
    """Photos, and touches of each finger: a grasp of each file, which several may share."""
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
    found = records[path].thumbnail
    assert found is not None  # made of every photo and touch of the accepted grasps
    return found
