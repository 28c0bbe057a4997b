"""The reference touches of a catalogue, as an index stores them."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.cache import Cache
from retrieval.data.catalogue import Catalogue, CataloguePhoto, CatalogueTouch
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.errors import BadInput
from retrieval.indexing.codes import SHOWS, Codes, find_codes, read_codes, touch_encoder
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.gel_check import CONTACT
from retrieval.model.references import REFERENCE_CALIBRATION, REFERENCE_PARTIALS, REFERENCE_ROWS


@dataclass(frozen=True, eq=False)
class ReferenceTouches:
    """The reference touches of a catalogue (R of them) with their codes.

    Attributes:
        codes: Their codes, of all touches that could be read.
        rows: Object, paths of the gel images and their digests, of each touch.
        partials: Their partial activations (R, touch_partial_width).
        touch_only: Objects without photos.
        skipped: Touches that could not be used.
    """

    codes: Codes = field(default_factory=Codes)
    rows: list[dict[str, Any]] = field(default_factory=list)
    partials: NDArray[np.float16] = field(default_factory=lambda: np.empty((0, 0), np.float16))
    touch_only: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)

    @property
    def documents(self) -> dict[str, Any]:
        """Documents of the generation; empty without references."""
        listed = {"touches": self.rows, "touch_only": self.touch_only}
        return {REFERENCE_ROWS: listed, REFERENCE_PARTIALS: self.partials} if self.rows else {}

    @property
    def counts(self) -> dict[str, int]:
        """Number of touches and of their objects."""
        return {"touches": len(self.rows), "objects": len({row["object_id"] for row in self.rows})}

    def about(self, checkpoint: Checkpoint) -> dict[str, Any]:
        """Return the entries of the manifest; empty without references."""
        if not self.rows or checkpoint.references is None:
            return {}
        digest = hashlib.sha256(json.dumps([self.rows, self.touch_only]).encode()).hexdigest()
        calibration = {"calibration": checkpoint.references.to_dict()}
        return {REFERENCE_ROWS: {**self.counts, "sha256": digest}, REFERENCE_CALIBRATION: calibration}


def find_references(
    catalogue: Catalogue, checkpoint: Checkpoint, cache: Cache, known: Mapping[str, str], quiet: bool
) -> tuple[ReferenceTouches, Catalogue]:
    """Find or make the codes of a catalogue's touches.

    Touches that cannot be read, have another number of fingers or show no contact are left out.

    Args:
        catalogue: The catalogue.
        checkpoint: The model.
        cache: The cache of the index.
        known: Digests of unchanged files by path.
        quiet: Show no progress.

    Returns:
        The touches, and the catalogue with a gel image of each object without photos in place of its photo.

    Raises:
        BadInput: The model cannot compare touches.
    """
    if not catalogue.touches:
        return ReferenceTouches(), catalogue
    require_reference_calibration(checkpoint)
    encoder = touch_encoder(checkpoint)
    codes = find_codes(catalogue, [touch.paths for touch in catalogue.touches], encoder, cache, known, quiet)
    usable = [touch for touch in catalogue.touches if touch.paths in codes.keys]
    records = read_codes(cache, encoder, [codes.keys[touch.paths] for touch in usable])
    shown = [SHOWS[shows] for shows in records["shows"].tolist()]
    skipped, rows, objects = (
        list(codes.skipped),
        list[dict[str, Any]](),
        {photo.object_id for photo in catalogue.photos},
    )
    first: dict[str, CatalogueTouch] = {}
    for touch, shows in zip(usable, shown, strict=True):
        if shows != CONTACT:
            skipped.append(SkippedPhoto(touch.paths[0], f"{shows}: not usable as a reference touch"))
            continue
        digests = [codes.digests[path] for path in touch.paths]
        rows.append({"object_id": touch.object_id, "touch": list(touch.paths), "digests": digests})
        if touch.object_id not in objects:
            first.setdefault(touch.object_id, touch)
    partials = records["partial"][[shows == CONTACT for shows in shown]]
    if first:
        pictures = [CataloguePhoto(touch.paths[0], touch.object_id, touch.metadata) for touch in first.values()]
        photos = sorted([*catalogue.photos, *pictures], key=lambda photo: photo.path)
        catalogue = replace(catalogue, photos=tuple(photos))
    return ReferenceTouches(codes, rows, partials, sorted(first), skipped), catalogue


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
