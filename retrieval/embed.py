"""Photos to rows, embeddings and halves: files are read and decoded while others are encoded.

Every thread takes a whole batch from its files to its halves and computes alone. A team of threads for each product of
the towers, as PyTorch's default is, waits for those of its members whose core is decoding a file.
"""

from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.generation import Generation
from retrieval.ahead import ahead
from retrieval.catalogue import (
    Catalogue,
    CataloguePhoto,
    PhotoBytes,
    SkippedPhoto,
    decode_photo,
    read_photo,
)
from retrieval.checkpoint import Checkpoint
from retrieval.encode import Image, batches, encode_photos, one_thread
from retrieval.errors import DatasetError, NumericalError
from retrieval.progress import Bar

BATCH = 16
READ = 32
"""Files that a thread reads at a time: what a task costs by itself is a tenth of reading and hashing a photo."""


@dataclass(frozen=True)
class _Found:
    """A photo's row, and its file where the parent does not have the photo."""

    row: dict[str, Any]
    file: PhotoBytes | None


@dataclass(frozen=True)
class _Decoded:
    """A photo's row, and its preprocessed image where the parent does not have the photo."""

    row: dict[str, Any]
    image: Image | None


@dataclass(frozen=True)
class Part:
    """Photos that follow each other, as many new ones among them as make a batch; what became of them.

    rows: of all that could be read; embeddings (F, d) and halves (F, hidden): of the new ones among them.
    """

    rows: list[dict[str, Any]]
    skipped: list[SkippedPhoto] = field(default_factory=list)
    embeddings: NDArray[np.float32] | None = None
    halves: NDArray[np.float16] | None = None
    half_error: float = 0.0


class Embedder:
    """Makes parts of a catalogue's photos, and counts what became of them.

    photos: rows so far, of which `embedded` were new to the parent, and `known` its own by id, with the same content
    or another. object_ids: of these rows. half_error: largest rounding of a stored half.
    """

    def __init__(self, checkpoint: Checkpoint, parent: Generation | None) -> None:
        self.checkpoint, self.parent = checkpoint, parent
        self.skipped: list[SkippedPhoto] = []
        self.objects: Counter[str] = Counter()
        self.photos, self.embedded, self.known, self.half_error = 0, 0, 0, 0.0
        self.renamed, self.resumed = 0, 0

    @property
    def removed(self) -> int:
        """How many of the parent's photos are no longer there."""
        return 0 if self.parent is None else self.parent.count - self.known

    def parts(self, catalogue: Catalogue, quiet: bool) -> Generator[Part, None, None]:
        """The catalogue's photos in its order. Raises DatasetError where none can be read, and NumericalError for
        halves that float16 cannot hold."""
        self.skipped += catalogue.skipped
        threads = torch.get_num_threads()
        lists = batches(catalogue.photos, READ)
        found = ahead(lambda photos: self._find(catalogue, photos), lists, threads, 2 * threads)
        with Bar("embed", len(catalogue.photos), "photos", quiet=quiet) as bar, one_thread():
            for part in ahead(self._encode, _full(chain.from_iterable(found)), threads, 2 * threads):
                self._count(part)
                bar.advance(len(part.rows) + len(part.skipped))
                if part.rows:
                    yield part
        if not self.photos:
            first = self.skipped[0]
            raise DatasetError(f"no photo in {catalogue.folder} can be read; the first: {first.path}: {first.reason}")
        if self.parent is not None and self.embedded < self.photos:  # what was taken over was rounded when it was made
            self.half_error = max(self.half_error, self.parent.manifest.about.get("half_error", 0.0))

    def _find(self, catalogue: Catalogue, photos: Sequence[CataloguePhoto]) -> list[_Found | SkippedPhoto]:
        """Read photos' files, and keep the bytes of those with which there is more to do. Called on threads."""
        items = [read_photo(catalogue, photo) for photo in photos]
        read = [item for item in items if isinstance(item, PhotoBytes)]
        known: set[str] = set()
        if self.parent is not None:
            known.update(self.parent.reusable({item.photo.photo_id: item.digest for item in read}))
        return [
            item
            if isinstance(item, SkippedPhoto)
            else _Found(_row(item), None if item.photo.photo_id in known else item)
            for item in items
        ]

    def _encode(self, found: Sequence[_Found | SkippedPhoto]) -> Part:
        """Decode and encode the new ones. Called on threads."""
        done = [self._decoded(item) for item in found]
        skipped = [item for item in done if isinstance(item, SkippedPhoto)]
        usable = [item for item in done if isinstance(item, _Decoded)]
        rows = [item.row for item in usable]
        images = {item.row["id"]: item.image for item in usable if item.image is not None}
        if not images:
            return Part(rows, skipped)
        with one_thread():
            code = encode_photos(self.checkpoint.matcher, images.values(), BATCH)
        halves = code.half.numpy()
        stored = _as_float16(halves, list(images))
        return Part(rows, skipped, code.embedding.numpy(), stored, float(np.abs(stored - halves).max()))

    def _decoded(self, item: _Found | SkippedPhoto) -> "_Decoded | SkippedPhoto":
        if isinstance(item, SkippedPhoto) or item.file is None:
            return item if isinstance(item, SkippedPhoto) else _Decoded(item.row, None)
        image = decode_photo(item.file)
        if isinstance(image, SkippedPhoto):
            return image
        return _Decoded(item.row, self.checkpoint.config.preprocessing.photo(image))

    def _count(self, part: Part) -> None:
        self.skipped += part.skipped
        self.objects.update(row["object_id"] for row in part.rows)
        self.photos += len(part.rows)
        self.embedded += 0 if part.halves is None else len(part.halves)
        self.half_error = max(self.half_error, part.half_error)
        if self.parent is not None:
            self.known += int((self.parent.rows.find([row["id"] for row in part.rows]) >= 0).sum())


def _full(found: Iterable[_Found | SkippedPhoto]) -> Iterator[list[_Found | SkippedPhoto]]:
    """Parts with a whole batch of new photos in each but the last."""
    part: list[_Found | SkippedPhoto] = []
    new = 0
    for item in found:
        part.append(item)
        new += isinstance(item, _Found) and item.file is not None
        if new == BATCH:
            yield part
            part, new = [], 0
    if part:
        yield part


def _row(item: PhotoBytes) -> dict[str, Any]:
    photo = item.photo
    return {
        "id": photo.photo_id,
        "object_id": photo.object_id,
        "path": photo.path,
        "digest": item.digest,
        "metadata": photo.metadata,
    }


def _as_float16(halves: NDArray[np.float32], names: list[str]) -> NDArray[np.float16]:
    largest = np.abs(halves).max(axis=1)
    bad = np.flatnonzero(~(largest <= np.finfo(np.float16).max))
    if len(bad):
        raise NumericalError(
            f"halves are stored as float16 and must stay within 65504; {names[bad[0]]} gives {largest[bad[0]]}; "
            "the model has diverged, train again with a lower learning rate"
        )
    return halves.astype(np.float16)
