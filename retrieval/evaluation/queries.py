"""Queries of an evaluation: touches, sets of grasps and photos, drawn once for all methods."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, SET_SIZES

PARTS = ("train", "validation", "test")
SETS_OF_AN_OBJECT = 20

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Queries:
    """Touches (Q) and photos (P) to score, and sets of these touches.

    Attributes:
        touches: (Q,) rows of the features.
        photos: (P,) rows of the features; a photo file that several grasps share is listed once.
        own_photo: (Q,) column of the photo that was taken before the grasp.
        touch_owner: (Q,) object numbers.
        photo_owner: (P,) object numbers.
        objects: Names of all objects of the split, sorted; object numbers are places in it.
        part_of: The part of each object.
        sets: By number of grasps, (S, G) places in `touches`; a set has one object.
    """

    touches: Rows
    photos: Rows
    own_photo: Rows
    touch_owner: Rows
    photo_owner: Rows
    objects: tuple[str, ...]
    part_of: tuple[str, ...]
    sets: dict[int, Rows]

    def of_part(self, owner: Rows, part: str | None) -> Rows:
        """Return the places of the items whose owner is in `part`; None for all parts."""
        if part is None:
            return np.arange(len(owner))
        return np.flatnonzero(np.array(self.part_of, dtype=str)[owner] == part)


def draw_queries(grasps: Sequence[Grasp], split: Split, seed: int, max_grasps: Mapping[str, int]) -> Queries:
    """Draw the queries: all grasps of test objects and some of the others.

    Sets of each size in `SET_SIZES` are drawn for test and validation objects, without replacement within a set, if
    `PHOTOS_PER_CANDIDATE` photos of other grasps remain. With fewer photos than its rivals the true object would rank
    first more often than 1 in K by chance, because a mean of fewer scores varies more.

    Args:
        grasps: All grasps of the recording.
        split: The objects of each part.
        seed: Seed of the draw.
        max_grasps: Maximum number of grasps of one object, by part; a part without an entry has no limit.

    Raises:
        DatasetError: A part has fewer than two objects.
    """
    part_of = {name: part for part in PARTS for name in getattr(split, part)}
    objects = tuple(sorted({grasp.object_id for grasp in grasps} & set(part_of)))
    parts = tuple(part_of[name] for name in objects)
    for part in PARTS:
        if (count := parts.count(part)) < 2:
            raise DatasetError(
                f"An evaluation needs at least 2 {part} objects, but the recording has {count} of the split's. Record "
                "more objects, or give your own split."
            )
    rng = np.random.default_rng([seed, 11])
    drawn_rows = [_draw_touches(grasps, name, max_grasps.get(part_of[name]), rng) for name in objects]
    touches = np.concatenate(drawn_rows)
    owner = np.repeat(np.arange(len(objects)), [len(rows) for rows in drawn_rows])
    column: dict[Path, int] = {}
    own_photo = np.array([column.setdefault(grasps[row].photo, len(column)) for row in touches])
    first = np.unique(own_photo, return_index=True)[1]
    touches_of = [np.flatnonzero(owner == place) for place, part in enumerate(parts) if part != "train"]
    sets = {size: _draw_sets(touches_of, size, rng) for size in SET_SIZES}
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
    if max_grasps is None or len(rows) <= max_grasps:
        return rows
    return np.sort(rng.choice(rows, max_grasps, replace=False))


def _draw_sets(touches_of: Sequence[Rows], size: int, rng: np.random.Generator) -> Rows:
    """Return sets (S, size) of the touches of each object that has enough."""
    enough = [places for places in touches_of if len(places) >= size + PHOTOS_PER_CANDIDATE]
    drawn = [rng.choice(places, size, replace=False) for places in enough for _ in range(SETS_OF_AN_OBJECT)]
    return np.array(drawn, dtype=np.int64).reshape(-1, size)
