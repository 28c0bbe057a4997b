"""Encode the reference touches of a catalogue for its index; unchanged ones are reused."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.store.generation import Generation
from indexes.store.rows import keys_of
from indexes.store.tables import Tables
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue, CataloguePhoto, PhotoTable
from retrieval.data.catalogue_touches import CatalogueTouch
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.images import decode_rgb
from retrieval.errors import BadInput, ImageError
from retrieval.model.calibration_touches import CalibrationTouches
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, batches, touch_features
from retrieval.model.fusion import scorer_of
from retrieval.model.fusion_scorer import CONTACT
from retrieval.model.posterior import ScoredTouches
from retrieval.model.reference_calibration import (
    REFERENCE_PARTIALS,
    REFERENCE_ROWS,
    fit_reference_calibration,
    unit_embeddings,
)
from retrieval.model.stored_partials import StoredPartials

Partials = NDArray[np.float16]
MIN_OBJECTS = 10
"""Smallest number of objects with two touches that calibrates references, if the model has no such calibration."""
MAX_REFERENCE_QUERIES = 600
"""Largest number of touches of the catalogue for that calibration."""
BATCH = 32


@dataclass(frozen=True, eq=False)
class ReferenceBuild:
    """The encoded reference touches of a catalogue (R of them).

    Attributes:
        rows: Object, paths of the gel images and their digests, of each touch.
        partials: Their partial activations (R, touch_partial_width).
        touch_only: Objects without photos.
        skipped: Touches that could not be used.
        encoded: Number of touches that were encoded now.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    partials: Partials = field(default_factory=lambda: np.empty((0, 0), np.float16))
    touch_only: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    encoded: int = 0

    @property
    def documents(self) -> dict[str, Any]:
        """Documents of the generation; empty without references."""
        return (
            {REFERENCE_ROWS: {"touches": self.rows, "touch_only": self.touch_only}, REFERENCE_PARTIALS: self.partials}
            if self.rows
            else {}
        )

    @property
    def about(self) -> dict[str, Any]:
        """Entries of the manifest; empty without references."""
        content = json.dumps([self.rows, self.touch_only]).encode()
        return {REFERENCE_ROWS: {**self._counts, "sha256": hashlib.sha256(content).hexdigest()}} if self.rows else {}

    @property
    def _counts(self) -> dict[str, int]:
        return {"touches": len(self.rows), "objects": len({row["object_id"] for row in self.rows})}

    def summary(self, by: str) -> dict[str, Any]:
        """Return the entry of the report; `by` is the source of the calibration."""
        return {**self._counts, "touch_only": len(self.touch_only), "encoded": self.encoded, "by": by}

    def with_gel_images(self, catalogue: Catalogue) -> Catalogue:
        """Return the catalogue with a gel image of each object without photos in place of its photo."""
        first: dict[str, CatalogueTouch] = {}
        for touch in catalogue.touches:
            if touch.object_id in self.touch_only:
                first.setdefault(touch.object_id, touch)
        if not first:
            return catalogue
        pictures = [CataloguePhoto(touch.paths[0], touch.object_id, touch.metadata) for touch in first.values()]
        photos = sorted([*catalogue.photos, *pictures], key=lambda photo: photo.path)
        return replace(catalogue, photos=PhotoTable.of(photos))

    def calibrate(self, checkpoint: Checkpoint, tables: Tables) -> dict[str, Any]:
        """Return the calibration of the references and its source, for the manifest.

        The calibration is that of the checkpoint. If it has none, it is fitted to the catalogue's own touches: the
        last touches of each object are queries, its first ones references.

        Args:
            checkpoint: The model.
            tables: Tables of the new generation.

        Raises:
            BadInput: There are too few touches.
        """
        if checkpoint.references is not None:
            return {"by": "objects that the model was not fitted to", "calibration": checkpoint.references.to_dict()}
        names = np.array([row["object_id"] for row in self.rows])
        sample = _sample_objects(names)
        codes = unit_embeddings(self.partials[sample], checkpoint.config.matcher.cosine_columns)
        photographed = ~np.isin(tables.objects, keys_of(self.touch_only))
        touched, owner = np.unique(names[sample], return_inverse=True)
        keys = keys_of(touched.tolist())
        photos = np.flatnonzero(photographed & np.isin(tables.objects, keys))
        order = np.argsort(keys)
        photo_owner = order[np.searchsorted(keys[order], tables.objects[photos])]
        scorer = scorer_of(checkpoint.matcher.head)
        touch_partials, photo_partials = self.partials[sample].astype(np.float32), StoredPartials(tables.arrays)[photos]
        logits = np.stack([scorer.logits(partial[None], photo_partials) for partial in touch_partials])
        scored = ScoredTouches(logits, owner, photo_owner, np.zeros(logits.shape, np.bool_))
        photo_codes = unit_embeddings(photo_partials, checkpoint.config.matcher.cosine_columns)
        fitted = fit_reference_calibration(CalibrationTouches(scored, codes, photo_codes))
        if fitted is None or (fitted.with_photos is None and len(set(names) - set(self.touch_only))):
            raise self.too_few_error()
        return {"by": "the catalogue's own touches", "calibration": fitted.to_dict()}

    def too_few_error(self) -> BadInput:
        """Return the error for too few touches to calibrate."""
        return BadInput(
            f"the catalogue's {len(self.rows)} reference touches cannot be calibrated: the model has no calibration "
            f"for them, and fitting one needs {MIN_OBJECTS} objects with two touches each, and with photos if objects "
            "have photos. Touch some objects twice, or fit a model to a recording with `retrieve adapt`"
        )


def embed_references(
    catalogue: Catalogue, checkpoint: Checkpoint, parent: Generation | None, quiet: bool
) -> ReferenceBuild:
    """Encode the touches of a catalogue that the parent lacks.

    Touches that cannot be read, have another number of fingers or show no contact are left out.

    Args:
        catalogue: The catalogue.
        checkpoint: The model.
        parent: Generation whose encoded touches are reused; None to reuse none.
        quiet: Show no progress.

    Raises:
        BadInput: The model cannot compare touches, or there are too few touches to calibrate.
    """
    if not catalogue.touches:
        return ReferenceBuild()
    _require_fit(checkpoint)
    known: Mapping[tuple[str, ...], Partials] = {}
    if parent is not None and REFERENCE_ROWS in parent.documents:
        # An index that drops its cells has longer ones.
        before = parent.documents[REFERENCE_PARTIALS][:, : checkpoint.config.matcher.touch_partial_width]
        stored = zip(parent.documents[REFERENCE_ROWS]["touches"], before, strict=True)
        known = {tuple(row["digests"]): partial for row, partial in stored}
    skipped: list[SkippedPhoto] = []
    rows: list[dict[str, Any]] = []
    partials: list[Partials] = []
    encoded = 0
    with Bar("embed touches", len(catalogue.touches), "touches", quiet=quiet) as bar:
        for some in batches(catalogue.touches, BATCH):
            found = list(_read(catalogue, checkpoint, some, known, skipped))
            new = [views for _, views, partial in found if partial is None]
            made = iter(_encode_touches(checkpoint, new) if new else ())
            for row, _, partial in found:
                if partial is None:
                    partial, shows = next(made)
                    encoded += 1
                    if shows != CONTACT:
                        skipped.append(SkippedPhoto(row["touch"][0], f"{shows}: not usable as a reference touch"))
                        continue
                rows.append(row)
                partials.append(partial)
            bar.advance(len(some))
    photographed, counts = set(catalogue.photos.objects), Counter(row["object_id"] for row in rows)
    stacked = np.stack(partials) if partials else np.empty((0, 0), np.float16)
    references = ReferenceBuild(rows, stacked, sorted(counts.keys() - photographed), skipped, encoded)
    if rows and checkpoint.references is None:  # count objects with photos, if any touched object has photos
        both = counts.keys() & photographed
        if sum(count > 1 and (name in both or not both) for name, count in counts.items()) < MIN_OBJECTS:
            raise references.too_few_error()
    return references


def _require_fit(checkpoint: Checkpoint) -> None:
    if not checkpoint.config.matcher.cosine or checkpoint.posterior is None:
        raise BadInput(
            "the catalogue has touches (touch_* files next to photos), but this model cannot compare touches: its "
            "match logit has no cosine term, or it is not calibrated. Use a shipped model, or one of `retrieve adapt` "
            "or `retrieve train` (preset relief, with validation objects), or rename the files"
        )
    if checkpoint.config.preprocessing.background != "none":
        raise BadInput(
            "the catalogue has touches (touch_* files next to photos), but this model subtracts no-contact frames, "
            "which a catalogue cannot contain. Use a model with background none, or rename the files"
        )


def _read(
    catalogue: Catalogue,
    checkpoint: Checkpoint,
    touches: list[CatalogueTouch],
    known: Mapping[tuple[str, ...], Partials],
    skipped: list[SkippedPhoto],
) -> Iterator[tuple[dict[str, Any], list[Image], Partials | None]]:
    """Yield the row of each touch, the tower's inputs, and its partial activation if it is known.

    Touches that cannot be used are added to `skipped`.
    """
    fingers, preprocess = checkpoint.config.matcher.fingers, checkpoint.config.preprocessing.touch
    for touch in touches:
        if len(touch.paths) != fingers:
            ends = " and ".join(f"_{letter}" for letter in "abcdefghij"[:fingers])
            reason = f"the touch has {len(touch.paths)} gel image(s), the model takes {fingers}: names end in {ends}"
            skipped.append(SkippedPhoto(touch.paths[0], reason))
            continue
        try:
            files = [catalogue.read(path) for path in touch.paths]
            digests = [hashlib.sha256(data).hexdigest() for data in files]
            row = {"object_id": touch.object_id, "touch": list(touch.paths), "digests": digests}
            partial = known.get(tuple(digests))
            named = zip(files, touch.paths, strict=True)
            views = [] if partial is not None else [preprocess(decode_rgb(data, path), None) for data, path in named]
        except ImageError as error:
            skipped.append(SkippedPhoto(touch.paths[0], error.reason))
            continue
        yield row, views, partial


@torch.inference_mode()
def _encode_touches(checkpoint: Checkpoint, touches: list[list[Image]]) -> Iterator[tuple[Partials, str]]:
    """Yield the partial activation of each touch, and its gel check: contact, no contact or not a gel image."""
    matcher = checkpoint.matcher
    features = touch_features(matcher, touches)
    partials = matcher.touch_encoding(features).partial.cpu().numpy().astype(np.float16)
    readings = matcher.gel_readings(features)
    check = checkpoint.gel_check
    shows = [CONTACT] * len(touches) if check is None or readings is None else check.classify(readings.cpu().numpy())
    yield from zip(partials, shows, strict=True)


def _sample_objects(names: NDArray[np.str_]) -> NDArray[np.int64]:
    """Return rows of random objects with two or more touches, about `MAX_REFERENCE_QUERIES` at most, in their order."""
    _, owner, counts = np.unique(names, return_inverse=True, return_counts=True)
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(counts > 1))
    chosen = drawn[: max(MIN_OBJECTS, int(np.searchsorted(np.cumsum(counts[drawn]), MAX_REFERENCE_QUERIES)))]
    return np.flatnonzero(np.isin(owner, chosen))
