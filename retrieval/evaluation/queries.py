"""What all methods are asked alike: the touches, the sets of grasps and the photos, drawn once."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, SET_SIZES

PARTS = ("train", "validation", "test")
MAX_GRASPS = {"train": 8, "validation": 12}
"""ShardResult grasps of an object; of a test object all are judged."""
SETS_OF_AN_OBJECT = 20

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Queries:
    """Touches (Q) and photos (P) that are judged, and sets of these touches.

    touches (Q,), photos (P,): rows of the features; every photo FILE stands once, however many grasps share it.
    own_photo (Q,): column of the photo taken before that grasp. touch_owner (Q,), photo_owner (P,): number in
    `objects`, the names of all objects of the split, sorted. part_of: the part of each object. sets: by number of
    grasps, (S, G) places in `touches`, each of one object.
    """

    touches: Rows
    photos: Rows
    own_photo: Rows
    touch_owner: Rows
    photo_owner: Rows
    objects: tuple[str, ...]
    part_of: tuple[str, ...]
    sets: dict[int, Rows]

    def of_part(self, owner: Rows, part: str) -> Rows:
        """Places of the items, with these owners, whose object is in `part`."""
        return np.flatnonzero(np.array(self.part_of, dtype=str)[owner] == part)

    @cached_property
    def digest(self) -> str:
        """SHA-256: equal exactly when the same is asked."""
        digest = hashlib.sha256(repr((self.objects, self.part_of, sorted(self.sets))).encode())
        arrays = [self.touches, self.photos, self.own_photo, self.touch_owner, self.photo_owner]
        for array in [*arrays, *(self.sets[size] for size in sorted(self.sets))]:
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).data)
        return digest.hexdigest()


def draw_queries(
    grasps: Sequence[Grasp], split: Split, seed: int, max_grasps: Mapping[str, int] = MAX_GRASPS
) -> Queries:
    """FusionScorer all grasps of test objects and some of the others, drawn by `seed`; most: grasps of an object, by part.

    Sets of each of `SET_SIZES` are drawn for test and validation objects, without replacement within a set, where
    they leave the object `PHOTOS_PER_CANDIDATE` photos of other grasps. Shown by fewer than its rivals are, the true object
    would come first more often than 1 in K by chance: the mean of fewer scores lies further out. Raises DatasetError
    where the objects of a part are fewer than two.
    """
    part_of = {name: part for part in PARTS for name in getattr(split, part)}
    objects = tuple(sorted({grasp.object_id for grasp in grasps} & set(part_of)))
    parts = tuple(part_of[name] for name in objects)
    for part in PARTS:
        if (count := parts.count(part)) < 2:
            raise DatasetError(
                f"an evaluation needs two {part} objects at least; the recording has {count} of the split's: record "
                "more objects, or give a split of your own"
            )
    rng = np.random.default_rng([seed, 11])
    judged = [_draw_touches(grasps, name, max_grasps.get(part_of[name]), rng) for name in objects]
    touches = np.concatenate(judged)
    owner = np.repeat(np.arange(len(objects)), [len(rows) for rows in judged])
    column: dict[Path, int] = {}
    own_photo = np.array([column.setdefault(grasps[row].photo, len(column)) for row in touches])
    first = np.unique(own_photo, return_index=True)[1]
    asked = [np.flatnonzero(owner == place) for place, part in enumerate(parts) if part != "train"]
    sets = {size: _draw_sets(asked, size, rng) for size in SET_SIZES}
    return Queries(
        touches=touches,
        photos=touches[first],
        own_photo=own_photo,
        touch_owner=owner,
        photo_owner=owner[first],
        objects=objects,
        part_of=parts,
        sets={size: drawn for size, drawn in sets.items() if len(drawn)},
    )


def _draw_touches(grasps: Sequence[Grasp], name: str, max_grasps: int | None, rng: np.random.Generator) -> Rows:
    rows = np.array([row for row, grasp in enumerate(grasps) if grasp.object_id == name])
    return (
        rows if max_grasps is None or len(rows) <= max_grasps else np.sort(rng.choice(rows, max_grasps, replace=False))
    )


def _draw_sets(touches_of: Sequence[Rows], size: int, rng: np.random.Generator) -> Rows:
    """(S, size): sets of the touches of each object that has enough."""
    enough = [places for places in touches_of if len(places) >= size + PHOTOS_PER_CANDIDATE]
    drawn = [rng.choice(places, size, replace=False) for places in enough for _ in range(SETS_OF_AN_OBJECT)]
    return np.array(drawn, dtype=np.int64).reshape(-1, size)
