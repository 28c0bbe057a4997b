"""Reference touches: a catalogue whose objects are shown by touches, alone or beside photos.

An object's touches are taken in the order of capture: its first quarter are references, its last half asks, what lies
between is left out, so that no query is the neighbour of a reference. A catalogue's entry is a reference touch, or that
touch with its grasp's photo. With photos `cca_towers` weighs both by what validation objects say; alone they are
matched with touches as photos otherwise are, so that no photo is needed to learn from.
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
"""Queries of an object, evenly spaced: more of them cost fits time and say little."""
ANY_WIDTH_METHODS = ("cca_towers", "cca_pca", "cca", "plsca", "chance", "constant")
"""Methods that take an entry of any width; the others are heads for photos."""


def assign_references(grasps: Sequence[Grasp]) -> dict[str, Grasp]:
    """Grasp id of each query -> the reference that is its entry in the catalogue; references are dealt in turn. Raises
    DatasetError for an object of fewer than four touches.
    """
    by_object: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(grasp)
    found: dict[str, Grasp] = {}
    for name, own in by_object.items():
        if len(own) < 4:
            raise DatasetError(
                f"reference touches and queries of one object need four touches of it; {name} has {len(own)}"
            )
        references, asking = own[: len(own) // 4], own[len(own) // 2 :]
        places = np.linspace(0, len(asking) - 1, min(MAX_QUERIES, len(asking))).round().astype(int)
        for turn, place in enumerate(places):
            found[asking[place].grasp_id] = references[turn % len(references)]
    return found


def replace_photos_by_references(grasps: Sequence[Grasp]) -> list[Grasp]:
    """The queries, each with the gel image of its reference (the first finger's) in place of its photo: what tells the
    entries of the catalogue apart, and what a report shows of them.
    """
    references = assign_references(grasps)
    return [
        dataclasses.replace(grasp, photo=references[grasp.grasp_id].touches[0])
        for grasp in grasps
        if grasp.grasp_id in references
    ]


def facts_with_references(facts: RecordingFacts) -> RecordingFacts:
    """The recording with such grasps alone."""
    return dataclasses.replace(facts, grasps=replace_photos_by_references(facts.grasps))


def features_with_references(features: "Features", references: Mapping[str, Grasp], entry: str) -> "Features":
    """Features of the queries, with those of their references in place of those of photos; where `entry` is "both",
    after those of the reference's photo. Whatever stands for touches stands for references, too.
    """
    row_of = {grasp_id: row for row, grasp_id in enumerate(features.grasp_ids)}
    asked = features.select(np.array([row_of[name] for name in references], np.int64))
    there = np.array([row_of[one.grasp_id] for one in references.values()], np.int64)
    shown = features.touch[there].reshape(len(there), -1)
    if entry == BOTH:
        shown = np.concatenate([features.photo[there], shown], axis=1)
    return dataclasses.replace(asked, photo=shown)
