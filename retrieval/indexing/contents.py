"""What an index of a catalogue contains: the rows and codes of its photos, and its reference touches."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import NDArray

from _touch_retrieval.cache import Cache
from indexes.store.rows import Row
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera, stated_camera
from retrieval.data.catalogue import Catalogue, CataloguePhoto, SkippedPhoto
from retrieval.errors import BadInput, NoReadablePhoto
from retrieval.indexing.codes import (
    SHOWS,
    CatalogueFiles,
    Encoder,
    find_codes,
    photo_encoder,
    read_codes,
    touch_encoder,
)
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.gel_check import CONTACT
from retrieval.model.references import REFERENCE_PARTIALS, REFERENCE_ROWS
from retrieval.model.towers import NO_TOWER

BLOCK = 1024
"""Codes that are copied from the cache to the index at once."""


@dataclass(frozen=True, eq=False)
class ReferenceTouches:
    """The reference touches of a catalogue.

    Attributes:
        documents: Documents of the generation: object, paths of the gel images, their digests and opening of each
            touch, and the partial activations (touches, touch_partial_width); empty without references.
        about: Entries of the manifest; empty without references.
        report: Numbers for the report; None without references.
        pictures: A gel image of each object without photos, in place of its photo.
        keys: Keys of the codes of all touches in the cache.
        skipped: Touches that could not be used.
    """

    documents: dict[str, Any] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    report: dict[str, int] | None = None
    pictures: list[CataloguePhoto] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class IndexContents:
    """The photos that could be read, and the reference touches. The codes are in the cache of the index.

    Attributes:
        rows: Rows of the photos, and of a gel image of each object without photos.
        keys: Key of the code of each row.
        encoder: Encoder of the photos.
        references: The reference touches.
        encoded: Number of photos that were encoded now.
        skipped: Photos and touches that could not be used.
        faults: Faults (`retrieval.data.photo_faults`) of the photos that were encoded now and have some, by path.
    """

    rows: list[Row]
    keys: list[str]
    encoder: Encoder
    references: ReferenceTouches
    encoded: int
    skipped: list[SkippedPhoto]
    faults: dict[str, Sequence[str]]

    def blocks(self, cache: Cache) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the codes of the rows in blocks: arrays by name, such as "embeddings" (n, d)."""
        for start in range(0, len(self.keys), BLOCK):
            records = read_codes(cache, self.encoder, self.keys[start : start + BLOCK])
            yield {name: records[name] for name in self.encoder.layout.names or ()}


def read_contents(catalogue: Catalogue, checkpoint: Checkpoint, assumed: PhotoCamera, cache: Cache) -> IndexContents:
    """Find or make the codes of a catalogue's photos, by the camera that they state or the assumed one, and touches.

    Raises:
        NoReadablePhoto: No photo can be read.
        BadInput: The catalogue has touches, and the model cannot compare them.
    """
    if checkpoint.config.matcher.photo_tower == NO_TOWER:
        reason = "the model was fitted to touches only and compares no photos"
        unused = (SkippedPhoto(photo.path, reason) for photo in catalogue.photos)
        catalogue = replace(catalogue, photos=(), skipped=(*catalogue.skipped, *unused))
    files = CatalogueFiles(catalogue, cache)
    references = _find_references(catalogue, checkpoint, files, cache)
    photos = sorted([*catalogue.photos, *references.pictures], key=lambda photo: photo.path)
    cameras = {
        photo.path: camera
        for photo in catalogue.photos
        if (camera := stated_camera(photo.metadata, assumed)) != USUAL_CAMERA
    }
    encoder, gel_images = photo_encoder(checkpoint, cameras), {picture.path for picture in references.pictures}
    codes = find_codes([(photo.path,) for photo in photos], encoder, files, cache)
    files.save()
    if not codes.keys:
        raise no_photo(catalogue, [*catalogue.skipped, *codes.skipped])
    photos = [photo for photo in photos if (photo.path,) in codes.keys]
    return IndexContents(
        [Row(photo.path, photo.object_id, files.digest(photo.path), photo.metadata) for photo in photos],
        [codes.keys[photo.path,] for photo in photos],
        encoder,
        references,
        codes.encoded,
        [*catalogue.skipped, *codes.skipped, *references.skipped],
        {path: faults for path, faults in codes.faults.items() if path not in gel_images},
    )


def no_photo(catalogue: Catalogue, skipped: Sequence[SkippedPhoto]) -> NoReadablePhoto:
    """Return the error for a catalogue whose photos were all skipped, at least one."""
    first = skipped[0]
    return NoReadablePhoto(
        f"no photo in {catalogue.where} can be read; the first: {first.path}: {first.reason}", list(skipped)
    )


def _find_references(
    catalogue: Catalogue, checkpoint: Checkpoint, files: CatalogueFiles, cache: Cache
) -> ReferenceTouches:
    """Find or make the codes of touches; those without contact or with another number of fingers are left out."""
    if not catalogue.touches:
        return ReferenceTouches()
    require_reference_calibration(checkpoint)
    encoder = touch_encoder(checkpoint)
    codes = find_codes([touch.paths for touch in catalogue.touches], encoder, files, cache)
    readable = [touch for touch in catalogue.touches if touch.paths in codes.keys]
    records = read_codes(cache, encoder, [codes.keys[touch.paths] for touch in readable])
    shown, photographed = [SHOWS[shows] for shows in records["shows"]], {photo.object_id for photo in catalogue.photos}
    pictures, skipped, rows = dict[str, CataloguePhoto](), list(codes.skipped), list[dict[str, Any]]()
    for touch, shows in zip(readable, shown, strict=True):
        if shows != CONTACT:
            skipped.append(SkippedPhoto(touch.paths[0], f"{shows}: not usable as a reference touch"))
            continue
        rows.append(
            {
                "object_id": touch.object_id,
                "touch": list(touch.paths),
                "digests": [files.digest(path) for path in touch.paths],
                "opening_mm": touch.opening_mm,
            }
        )
        if touch.object_id not in photographed:
            pictures.setdefault(touch.object_id, CataloguePhoto(touch.paths[0], touch.object_id, touch.metadata))
    if not rows:
        return ReferenceTouches(keys=list(codes.keys.values()), skipped=skipped)
    listed = {"touches": rows, "touch_only": sorted(pictures)}
    counts = {"touches": len(rows), "objects": len({row["object_id"] for row in rows})}
    digest = hashlib.sha256(json.dumps(listed).encode()).hexdigest()
    return ReferenceTouches(
        {REFERENCE_ROWS: listed, REFERENCE_PARTIALS: records["partial"][[shows == CONTACT for shows in shown]]},
        {REFERENCE_ROWS: {**counts, "sha256": digest}},
        {**counts, "touch_only": len(pictures), "encoded": codes.encoded},
        list(pictures.values()),
        list(codes.keys.values()),
        skipped,
    )


def require_reference_calibration(checkpoint: Checkpoint) -> None:
    """Raise BadInput for a model that cannot compare the touches of a catalogue with those of a query."""
    if checkpoint.references is None or checkpoint.posterior is None:
        raise BadInput(
            "the catalogue has touches (touch_* files next to photos), but this model has no calibration of reference "
            "touches. Use a shipped model, or one of `retrieve train`, or rename the files"
        )
    if checkpoint.config.preprocessing.background != "none":
        raise BadInput(
            "the catalogue has touches (touch_* files next to photos), but this model subtracts no-contact frames, "
            "which a catalogue cannot contain. Use a model with background none, or rename the files"
        )
