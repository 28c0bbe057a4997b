"""Reference touches of a catalogue to what an index keeps of them; one whose content did not change is not encoded
again."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.store.generation import Generation
from indexes.store.rows import keys_of
from indexes.store.tables import Tables
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue, CataloguePhoto, Photos
from retrieval.data.images import decode_rgb
from retrieval.data.touched import CatalogueTouch
from retrieval.data.walking import SkippedPhoto
from retrieval.errors import BadInput, ImageError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, batches, touch_features
from retrieval.model.fusion import judge_of
from retrieval.model.judge import CONTACT
from retrieval.model.posterior import JudgedTouches
from retrieval.model.references import FeltTouches, ReferenceWorth, fit_references, touch_codes
from retrieval.search.query.references import CODES, ROWS

Halves = NDArray[np.float16]
FEWEST = 10
"""Objects with two touches at least that can tell what references are worth, where the model does not say."""
MOST_ASKED = 600
"""Touches of the catalogue that tell it."""
BATCH = 32


@dataclass(frozen=True, eq=False)
class MadeReferences:
    """The reference touches of a catalogue (R of them), encoded.

    rows: of each touch its object, the paths of its gel images and their digests. halves (R, half). alone: objects
    without photos. skipped: what could not be used. encoded: how many were encoded now, not taken over from the parent.
    """

    rows: list[dict[str, Any]]
    halves: Halves
    alone: list[str]
    skipped: list[SkippedPhoto]
    encoded: int

    @property
    def documents(self) -> dict[str, Any]:
        """What a generation keeps of the references; empty without any."""
        return {ROWS: {"touches": self.rows, "alone": self.alone}, CODES: self.halves} if self.rows else {}

    @property
    def about(self) -> dict[str, Any]:
        """What the manifest says of the references; empty without any."""
        if not self.rows:
            return {}
        told = json.dumps([self.rows, self.alone]).encode()
        objects = len({row["object_id"] for row in self.rows})
        return {ROWS: {"touches": len(self.rows), "objects": objects, "sha256": hashlib.sha256(told).hexdigest()}}

    def shown(self, catalogue: Catalogue) -> Catalogue:
        """The catalogue, with a picture to show of each object that has no photo: the first gel image of its first
        touch."""
        first: dict[str, CatalogueTouch] = {}
        for touch in catalogue.touches:
            if touch.object_id in self.alone:
                first.setdefault(touch.object_id, touch)
        if not first:
            return catalogue
        pictures = [CataloguePhoto(touch.paths[0], touch.object_id, touch.metadata) for touch in first.values()]
        photos = sorted([*catalogue.photos, *pictures], key=lambda photo: photo.path)
        return replace(catalogue, photos=Photos.of(photos))


def make_references(
    catalogue: Catalogue, checkpoint: Checkpoint, parent: Generation | None, quiet: bool
) -> MadeReferences:
    """Encode the touches of a catalogue, but those that the parent has. Touches that cannot be read, that are of
    another number of fingers, or that feel nothing, are left out. Raises BadInput for a model that cannot compare
    touches, and where nothing says what references are worth."""
    if not catalogue.touches:
        return MadeReferences([], np.empty((0, 0), np.float16), [], [], 0)
    _require_fit(checkpoint)
    known = _known(parent)
    skipped: list[SkippedPhoto] = []
    rows: list[dict[str, Any]] = []
    halves: list[NDArray[np.float16]] = []
    encoded = 0
    with Bar("embed touches", len(catalogue.touches), "touches", quiet=quiet) as bar:
        for some in batches(catalogue.touches, BATCH):
            found = list(_read(catalogue, checkpoint, some, known, skipped))
            new = [views for _, views, half in found if half is None]
            made = iter(_encoded(checkpoint, new) if new else ())
            for row, _, half in found:
                if half is None:
                    half, shows = next(made)
                    encoded += 1
                    if shows != CONTACT:
                        skipped.append(SkippedPhoto(row["touch"][0], f"{shows}: no touch to compare with"))
                        continue
                rows.append(row)
                halves.append(half)
            bar.advance(len(some))
    photographed = set(catalogue.photos.objects)
    alone = sorted({row["object_id"] for row in rows} - photographed)
    stacked = np.stack(halves) if halves else np.empty((0, 0), np.float16)
    made_all = MadeReferences(rows, stacked, alone, skipped, encoded)
    if rows and checkpoint.references is None:
        _require_told(made_all, photographed)
    return made_all


def worth_of(references: MadeReferences, checkpoint: Checkpoint, tables: Tables) -> tuple[ReferenceWorth, str]:
    """What the references are worth, and who says so: the checkpoint, else the catalogue's own touches, each object's
    last ones asking for its first. Raises BadInput where these are too few."""
    if checkpoint.references is not None:
        return checkpoint.references, "objects that the model was not fitted to"
    names = np.array([row["object_id"] for row in references.rows])
    kept = _some_objects(names)
    codes = touch_codes(references.halves[kept], checkpoint.config.matcher.hidden)
    photographed = ~np.isin(tables.objects, keys_of(references.alone))
    asked, owner = np.unique(names[kept], return_inverse=True)
    keys = keys_of(asked.tolist())
    photos = np.flatnonzero(photographed & np.isin(tables.objects, keys))
    order = np.argsort(keys)
    photo_owner = order[np.searchsorted(keys[order], tables.objects[photos])]
    judge = judge_of(checkpoint.matcher.head)
    felt, shown = references.halves[kept].astype(np.float32), tables.arrays["halves"][photos]
    logits = np.stack([judge.logits(half[None], shown) for half in felt])
    none = np.zeros(logits.shape, np.bool_)
    found = fit_references(FeltTouches(JudgedTouches(logits, owner, photo_owner, none), codes))
    if found is None or (found.beside is None and len(set(names) - set(references.alone))):
        raise BadInput(_untold(references))
    return found, "the catalogue's own touches"


def _require_fit(checkpoint: Checkpoint) -> None:
    if not checkpoint.config.matcher.cosine or checkpoint.posterior is None:
        raise BadInput(
            "the catalogue has touches (touch_* beside photos), and this model cannot compare touches: its match logit "
            "counts no cosine, or was never calibrated; take a shipped model, one of `retrieve adapt`, or rename them"
        )
    if checkpoint.config.preprocessing.background != "none":
        raise BadInput(
            "the catalogue has touches (touch_* beside photos), and this model subtracts the untouched gel, for which "
            "a catalogue has no place; take a model with background none, or rename them"
        )


def _require_told(references: MadeReferences, photographed: set[str]) -> None:
    """Raise BadInput unless enough objects have two touches to tell what references are worth; of objects with photos
    where any touched object has one."""
    counts = Counter(row["object_id"] for row in references.rows)
    both = set(counts) & photographed
    several = [name for name, count in counts.items() if count > 1 and (name in both or not both)]
    if len(several) < FEWEST:
        raise BadInput(_untold(references))


def _untold(references: MadeReferences) -> str:
    return (
        f"nothing says what the catalogue's {len(references.rows)} reference touches are worth: the model does not, "
        f"and {FEWEST} objects with two touches each, and photos where objects have photos, would tell; touch some "
        "objects twice, or let `retrieve adapt` fit a model to a recording"
    )


def _known(parent: Generation | None) -> Mapping[tuple[str, ...], Halves]:
    """Halves of the parent's touches by the digests of their gel images."""
    if parent is None or ROWS not in parent.documents:
        return {}
    rows = parent.documents[ROWS]["touches"]
    return {tuple(row["digests"]): half for row, half in zip(rows, parent.documents[CODES], strict=True)}


def _read(
    catalogue: Catalogue,
    checkpoint: Checkpoint,
    touches: list[CatalogueTouch],
    known: Mapping[tuple[str, ...], Halves],
    skipped: list[SkippedPhoto],
) -> Iterator[tuple[dict[str, Any], list[Image], Halves | None]]:
    """For each touch its row, what the tower sees of it, and its half where that is known already. A touch that cannot
    be used is added to `skipped`."""
    fingers, see = checkpoint.config.matcher.fingers, checkpoint.config.preprocessing.touch
    for touch in touches:
        if len(touch.paths) != fingers:
            ends = " and ".join(f"_{letter}" for letter in "abcdefghij"[:fingers])
            reason = f"a touch has {len(touch.paths)} gel image(s), the model takes {fingers}: names end in {ends}"
            skipped.append(SkippedPhoto(touch.paths[0], reason))
            continue
        try:
            files = [catalogue.read(path) for path in touch.paths]
            digests = [hashlib.sha256(data).hexdigest() for data in files]
            row = {"object_id": touch.object_id, "touch": list(touch.paths), "digests": digests}
            half = known.get(tuple(digests))
            named = zip(files, touch.paths, strict=True)
            views = [] if half is not None else [see(decode_rgb(data, path), None) for data, path in named]
        except ImageError as error:
            skipped.append(SkippedPhoto(touch.paths[0], error.reason))
            continue
        yield row, views, half


@torch.inference_mode()
def _encoded(checkpoint: Checkpoint, touches: list[list[Image]]) -> Iterator[tuple[Halves, str]]:
    """Half of each touch, and what it shows."""
    matcher = checkpoint.matcher
    features = touch_features(matcher, touches)
    halves = matcher.touch_code(features).half.cpu().numpy().astype(np.float16)
    readings = matcher.gel_readings(features)
    check = checkpoint.gel_check
    shows = [CONTACT] * len(touches) if check is None or readings is None else check.judge(readings.cpu().numpy())
    yield from zip(halves, shows, strict=True)


def _some_objects(names: NDArray[np.str_]) -> NDArray[np.int64]:
    """Rows of objects with two touches at least, drawn by a seed while there is room, in their order."""
    _, owner, counts = np.unique(names, return_inverse=True, return_counts=True)
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(counts > 1))
    chosen = drawn[: max(FEWEST, int(np.searchsorted(np.cumsum(counts[drawn]), MOST_ASKED)))]
    return np.flatnonzero(np.isin(owner, chosen))
