"""Encode the reference touches of a catalogue for its index; codes of unchanged ones come from its cache."""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.store.codes import CodeCache
from indexes.store.generation import Arrays
from indexes.store.rows import Row
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
from retrieval.model.fusion_scorer import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.posterior import ScoredTouches
from retrieval.model.reference_calibration import (
    REFERENCE_PARTIALS,
    REFERENCE_ROWS,
    fit_reference_calibration,
    unit_embeddings,
)
from retrieval.model.stored_partials import StoredPartials
from retrieval.search.build.codes import code_model

Partials = NDArray[np.float16]
MIN_OBJECTS = 10
"""Smallest number of objects with two touches that calibrates references, if the model has no such calibration."""
MAX_REFERENCE_QUERIES = 600
"""Largest number of touches of the catalogue for that calibration."""
BATCH = 32
_SHOWS = (CONTACT, NO_CONTACT, NOT_A_GEL)
"""Results of the gel check, by their number in a code."""


@dataclass(frozen=True, eq=False)
class ReferenceBuild:
    """The encoded reference touches of a catalogue (R of them).

    Attributes:
        rows: Object, paths of the gel images and their digests, of each touch.
        partials: Their partial activations (R, touch_partial_width).
        touch_only: Objects without photos.
        skipped: Touches that could not be used.
        encoded: Number of touches that were encoded now.
        digests: Content digest by path, of the gel images that could be read.
        codes: Digests of the touches' codes in the cache.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    partials: Partials = field(default_factory=lambda: np.empty((0, 0), np.float16))
    touch_only: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    encoded: int = 0
    digests: dict[str, str] = field(default_factory=dict)
    codes: list[str] = field(default_factory=list)

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

    def calibrate(self, checkpoint: Checkpoint, photos: Sequence[Row], arrays: Arrays) -> dict[str, Any]:
        """Return the calibration of the references and its source, for the manifest.

        The calibration is that of the checkpoint. If it has none, it is fitted to the catalogue's own touches: the
        last touches of each object are queries, its first ones references.

        Args:
            checkpoint: The model.
            photos: The N rows of the new generation.
            arrays: Its per-row arrays (N, ...).

        Raises:
            BadInput: There are too few touches.
        """
        if checkpoint.references is not None:
            return {"by": "objects that the model was not fitted to", "calibration": checkpoint.references.to_dict()}
        names = np.array([row["object_id"] for row in self.rows])
        sample = _sample_objects(names)
        codes = unit_embeddings(self.partials[sample], checkpoint.config.matcher.cosine_columns)
        touched, owner = np.unique(names[sample], return_inverse=True)
        number_of = {name: number for number, name in enumerate(touched.tolist()) if name not in self.touch_only}
        rows = np.array([row for row, photo in enumerate(photos) if photo.object_id in number_of], dtype=np.int64)
        photo_owner = np.array([number_of[photos[row].object_id] for row in rows], dtype=np.int64)
        scorer = scorer_of(checkpoint.matcher.head)
        touch_partials, photo_partials = self.partials[sample].astype(np.float32), StoredPartials(arrays)[rows]
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
    catalogue: Catalogue, checkpoint: Checkpoint, cache: CodeCache, known: Mapping[str, str], quiet: bool
) -> ReferenceBuild:
    """Encode the touches of a catalogue whose codes the cache lacks.

    Touches that cannot be read, have another number of fingers or show no contact are left out.

    Args:
        catalogue: The catalogue.
        checkpoint: The model.
        cache: The cache of the index.
        known: Digests of unchanged files by path.
        quiet: Show no progress.

    Raises:
        BadInput: The model cannot compare touches, or there are too few touches to calibrate.
    """
    if not catalogue.touches:
        return ReferenceBuild()
    _require_fit(checkpoint)
    layout = touch_layout(checkpoint)
    model = code_model(checkpoint, layout)
    stored = cache.known(model)
    skipped, digests = list[SkippedPhoto](), dict[str, str]()
    read: list[tuple[CatalogueTouch, str]] = []
    encoded = 0
    with Bar("embed touches", len(catalogue.touches), "touches", quiet=quiet) as bar:
        for some in batches(catalogue.touches, BATCH):
            new: dict[str, list[Image]] = {}
            for touch in some:
                try:
                    images = _read(catalogue, checkpoint, touch, known, stored, digests)
                except ImageError as error:
                    skipped.append(SkippedPhoto(touch.paths[0], error.reason))
                    continue
                key = touch_code_digest(digests[path] for path in touch.paths)
                read.append((touch, key))
                if images:
                    new[key] = images
            if new:
                cache.add(model, dict(zip(new, _encode_touches(checkpoint, layout, list(new.values())), strict=True)))
                stored |= new.keys()
                encoded += len(new)
            bar.advance(len(some))
    keys = [key for _, key in read]
    records = np.frombuffer(b"".join(cache.read(model, keys)), layout)
    is_used = records["shows"] == _SHOWS.index(CONTACT)
    rows: list[dict[str, Any]] = []
    for (touch, _), shows in zip(read, records["shows"].tolist(), strict=True):
        if _SHOWS[shows] == CONTACT:
            named = {"touch": list(touch.paths), "digests": [digests[path] for path in touch.paths]}
            rows.append({"object_id": touch.object_id, **named})
        else:
            skipped.append(SkippedPhoto(touch.paths[0], f"{_SHOWS[shows]}: not usable as a reference touch"))
    photographed, counts = set(catalogue.photos.objects), Counter(row["object_id"] for row in rows)
    references = ReferenceBuild(
        rows, records["partial"][is_used], sorted(counts.keys() - photographed), skipped, encoded, digests, keys
    )
    if rows and checkpoint.references is None:  # count objects with photos, if any touched object has photos
        both = counts.keys() & photographed
        if sum(count > 1 and (name in both or not both) for name, count in counts.items()) < MIN_OBJECTS:
            raise references.too_few_error()
    return references


def touch_layout(checkpoint: Checkpoint) -> np.dtype[Any]:
    """Return the type of a touch's code in the cache: its partial activation and its gel check."""
    return np.dtype([("partial", "<f2", (checkpoint.config.matcher.touch_partial_width,)), ("shows", "u1")])


def touch_code_digest(digests: Iterable[str]) -> str:
    """Return the digest of a touch's code in the cache from those of its gel images."""
    return hashlib.sha256("".join(digests).encode()).hexdigest()


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
    touch: CatalogueTouch,
    known: Mapping[str, str],
    stored: Collection[str],
    digests: dict[str, str],
) -> list[Image]:
    """Add the digests of a touch's gel images, and return the tower's inputs; none if its code is stored.

    Raises:
        ImageError: A gel image cannot be read, or the touch has another number of fingers than the model.
    """
    fingers, preprocess = checkpoint.config.matcher.fingers, checkpoint.config.preprocessing.touch
    if len(touch.paths) != fingers:
        ends = " and ".join(f"_{letter}" for letter in "abcdefghij"[:fingers])
        reason = f"the touch has {len(touch.paths)} gel image(s), the model takes {fingers}: names end in {ends}"
        raise ImageError(touch.paths[0], reason)
    noted = {path: known[path] for path in touch.paths if path in known}
    if len(noted) == fingers and touch_code_digest(noted.values()) in stored:
        digests |= noted
        return []
    files = [catalogue.read(path) for path in touch.paths]
    own = {path: hashlib.sha256(data).hexdigest() for path, data in zip(touch.paths, files, strict=True)}
    images: list[Image] = []
    if touch_code_digest(own.values()) not in stored:
        images = [preprocess(decode_rgb(data, path), None) for data, path in zip(files, touch.paths, strict=True)]
    digests |= own
    return images


@torch.inference_mode()
def _encode_touches(checkpoint: Checkpoint, layout: np.dtype[Any], touches: list[list[Image]]) -> list[bytes]:
    """Return the codes of touches: partial activation and gel check."""
    matcher = checkpoint.matcher
    features = touch_features(matcher, touches)
    readings, check = matcher.gel_readings(features), checkpoint.gel_check
    records = np.zeros(len(touches), layout)
    records["partial"] = matcher.touch_encoding(features).partial.cpu().numpy()
    if check is not None and readings is not None:
        records["shows"] = [_SHOWS.index(shows) for shows in check.classify(readings.cpu().numpy())]
    return [record.tobytes() for record in records]


def _sample_objects(names: NDArray[np.str_]) -> NDArray[np.int64]:
    """Return rows of random objects with two or more touches, about `MAX_REFERENCE_QUERIES` at most, in their order."""
    _, owner, counts = np.unique(names, return_inverse=True, return_counts=True)
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(counts > 1))
    chosen = drawn[: max(MIN_OBJECTS, int(np.searchsorted(np.cumsum(counts[drawn]), MAX_REFERENCE_QUERIES)))]
    return np.flatnonzero(np.isin(owner, chosen))
