"""Reference touches: catalogue entries that are touches, without or with photos.

An object's touches are split in the order of capture: the first quarter are references, the last half are queries. The
touches between them are left out, so that no query is next to a reference. A catalogue entry is a reference touch,
without or with the photo of its grasp. With photos, `cca_towers` weights both by validation accuracy. Without photos,
reference touches are matched like photos, and training needs no photo.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from retrieval.data.dataset import Grasp
from retrieval.errors import DatasetError
from retrieval.evaluation.real.protocol import BOTH, RecordingFacts

if TYPE_CHECKING:
    from retrieval.training.features import Features

MAX_QUERIES = 30
"""Maximum number of queries of one object, evenly spaced; more slow down the fits and add little information."""
ANY_WIDTH_METHODS = ("cca_towers", "cca", "chance")
"""Methods that accept entries of any width; the others have heads for photos."""


def assign_references(grasps: Sequence[Grasp]) -> dict[str, Grasp]:
    """Assign to each query a reference touch, its catalogue entry; the references of an object are used cyclically.

    Args:
        grasps: All grasps, in the order of capture.

    Returns:
        Grasp id of the query -> reference.

    Raises:
        DatasetError: An object has fewer than four touches.
    """
    by_object: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(grasp)
    found: dict[str, Grasp] = {}
    for name, own in by_object.items():
        if len(own) < 4:
            raise DatasetError(f"Reference touches need at least 4 touches of each object, but {name} has {len(own)}.")
        references, queries = own[: len(own) // 4], own[len(own) // 2 :]
        places = np.linspace(0, len(queries) - 1, min(MAX_QUERIES, len(queries))).round().astype(int)
        for turn, place in enumerate(places):
            found[queries[place].grasp_id] = references[turn % len(references)]
    return found


def replace_photos_by_references(grasps: Sequence[Grasp]) -> list[Grasp]:
    """Return the queries, each with the gel image of its reference in place of its photo.

    The gel image (of the first finger) identifies the catalogue entry, also in a report.
    """
    references = assign_references(grasps)
    return [
        dataclasses.replace(grasp, photo=references[grasp.grasp_id].touches[0])
        for grasp in grasps
        if grasp.grasp_id in references
    ]


def facts_with_references(facts: RecordingFacts) -> RecordingFacts:
    """Return the recording with only the grasps of `replace_photos_by_references`."""
    return dataclasses.replace(facts, grasps=replace_photos_by_references(facts.grasps))


def features_with_references(features: "Features", references: Mapping[str, Grasp], entry: str) -> "Features":
    """Return the features of the queries with reference features in place of photo features.

    Args:
        features: Features of all grasps. A control that replaces touches also replaces the references.
        references: Grasp id of each query -> its reference.
        entry: With "both" the features of the reference's photo precede those of its touch.
    """
    row_of = {grasp_id: row for row, grasp_id in enumerate(features.grasp_ids)}
    queries = features.select(np.array([row_of[name] for name in references], np.int64))
    rows = np.array([row_of[one.grasp_id] for one in references.values()], np.int64)
    entries = features.touch[rows].reshape(len(rows), -1)
    if entry == BOTH:
        entries = np.concatenate([features.photo[rows], entries], axis=1)
    return dataclasses.replace(queries, photo=entries)
