"""Encode the reference touches of a catalogue for its index; codes of unchanged ones come from its cache."""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.store.codes import CodeCache
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue, CataloguePhoto
from retrieval.data.catalogue_touches import CatalogueTouch
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.images import decode_rgb
from retrieval.errors import BadInput, ImageError
from retrieval.indexing.codes import code_model
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, batches, touch_features
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.references import REFERENCE_PARTIALS, REFERENCE_ROWS

Partials = NDArray[np.float16]
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

    @property
    def summary(self) -> dict[str, Any] | None:
        """The entry of the report; None without references."""
        return {**self._counts, "touch_only": len(self.touch_only), "encoded": self.encoded} if self.rows else None

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
        return replace(catalogue, photos=tuple(photos))


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
        BadInput: The model cannot compare touches.
    """
    if not catalogue.touches:
        return ReferenceBuild()
    require_reference_calibration(checkpoint)
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
    photographed, counts = {photo.object_id for photo in catalogue.photos}, Counter(row["object_id"] for row in rows)
    return ReferenceBuild(
        rows, records["partial"][is_used], sorted(counts.keys() - photographed), skipped, encoded, digests, keys
    )


def touch_layout(checkpoint: Checkpoint) -> np.dtype[Any]:
    """Return the type of a touch's code in the cache: its partial activation and its gel check."""
    return np.dtype([("partial", "<f2", (checkpoint.config.matcher.touch_partial_width,)), ("shows", "u1")])


def touch_code_digest(digests: Iterable[str]) -> str:
    """Return the digest of a touch's code in the cache from those of its gel images."""
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def require_reference_calibration(checkpoint: Checkpoint) -> None:
    """Raise BadInput for a model that cannot compare the touches of a catalogue with those of a query."""
    if checkpoint.references is None or checkpoint.posterior is None:
        raise BadInput(
            "the catalogue has touches (touch_* files next to photos), but this model has no calibration of reference "
            "touches. Use a shipped model, or one of `retrieve adapt` or `retrieve train` (preset relief, with enough "
            "validation objects), or rename the files"
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
