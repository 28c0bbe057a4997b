"""Embed the photos of a catalogue. Some threads read and hash files; others decode and encode them.

Several batches are processed at once, each decoded and encoded by a single thread. PyTorch therefore computes each
matrix product on one thread. With its default of several, a product would wait for cores that are busy decoding.

The code of a photo is its embedding and its stored partial activation.
"""

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.kinds.scores import Slots
from indexes.store.generation import Generation
from indexes.store.rows import keys_of
from indexes.store.tables import Block, Layouts
from indexes.store.unfinished import UnfinishedBuild
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue, CataloguePhoto, PhotoBytes, PhotoTable, decode_photo, read_photo
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.loading import map_in_order
from retrieval.errors import NoReadablePhoto, NumericalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.encode import Image, batches, one_thread
from retrieval.model.photo_encoder import fastest_photo_encoder, torch_photo_encoder
from retrieval.model.stored_partials import PARTIALS, StoredPartials, stored_layout, to_stored
from retrieval.search.build.stat_cache import photo_row

T = TypeVar("T")
R = TypeVar("R")

BATCH = 16
READ = 32
"""Files that a thread reads in one task. The overhead of a task is a tenth of the time to read and hash one photo."""
MIN_PHOTOS_TO_TUNE = 256
"""Smallest number of new photos for which a faster encoder is tried; the trial takes as long as encoding 100 photos."""
MAX_REUSED_PER_PART = 256
"""Largest number of reused codes in one part, which limits the memory between the threads."""
EMBEDDED, RENAMED, RE_EMBEDDED, RESUMED = "embedded", "renamed", "re_embedded", "resumed"
"""Origins of a code: encoded now; from a row with the same content; a new embedding of a stored partial activation;
from an interrupted build."""


class _PhotoEncoding(NamedTuple):
    """Embedding (d,) and stored partial activation of a photo, its rounding error if new, and its origin."""

    embedding: NDArray[np.float32]
    stored: dict[str, NDArray[Any]]
    partial_error: float
    origin: str


@dataclass(slots=True)
class _Photo:
    """The row of a photo. If the parent has no row with this path and content: also the file's bytes, or a stored code.

    The stored code is of a photo with the same content.
    """

    row: dict[str, Any]
    file: PhotoBytes | None = None
    code: _PhotoEncoding | None = None


@dataclass
class BuildPart:
    """Consecutive photos of a catalogue, at most one batch of them newly encoded.

    Attributes:
        rows: Rows of the photos that could be read.
        codes: Codes of the rows that the parent lacks, in the order of `rows`.
        skipped: Photos that could not be read.
        unchanged: Numbers of unchanged rows of the parent; a part has either these or rows.
        objects: Object of each photo of the part.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    codes: list[_PhotoEncoding] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    unchanged: range = range(0)
    objects: Sequence[str] = ()

    @property
    def block(self) -> Block | range:
        """The block of rows, or the range of the parent's rows, for the index writer."""
        if self.unchanged or not self.codes:
            return self.unchanged or Block(self.rows)
        arrays = {name: np.stack([code.stored[name] for code in self.codes]) for name in self.codes[0].stored}
        return Block(self.rows, np.stack([code.embedding for code in self.codes]), arrays)


_ReadItem: TypeAlias = _Photo | SkippedPhoto
_CataloguedPhoto: TypeAlias = tuple[CataloguePhoto, int]


class Embedder:
    """Embed and count the photos of a catalogue, under the lock of the index. Call `close` afterwards.

    New codes are stored in the index folder immediately, in case the build is interrupted.

    Args:
        checkpoint: The model.
        index: Folder of the index.
        parent: The current generation, if it is of this model.
        donors: Other generations of this model, whose codes are reused for photos with the same content.
        partials: A generation whose partial activations are those of this model, but whose embeddings are not.

    Attributes:
        objects: Number of photos of each object.
        made: Number of codes by origin.
        known: Number of photos whose id the parent has.
        skipped: Photos that could not be read.
        partial_error: Largest rounding error of a stored partial activation.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        index: Path,
        parent: Generation | None,
        donors: Sequence[Generation] = (),
        partials: Generation | None = None,
    ) -> None:
        self.checkpoint, self.parent, self._partials = checkpoint, parent, partials
        config = checkpoint.config.matcher
        self._stored = stored_layout(config.pooled_width, config.partial_width)
        layouts: Layouts = {
            "embedding": (np.dtype(np.float32), (config.embedding_dim,)),
            "partial_error": (np.dtype(np.float32), ()),
            **self._stored,
        }
        self._unfinished = UnfinishedBuild(index, fingerprint(checkpoint), layouts)
        self._sources = [
            source
            for source in (parent, *donors, partials)
            if source is not None and self._stored.keys() <= source.arrays.keys()
        ]
        self.objects, self.made = Counter[str](), Counter[str]()
        self.skipped: list[SkippedPhoto] = []
        self.known, self.partial_error = 0, 0.0
        self._encode_photos, self._preprocess = (
            torch_photo_encoder(checkpoint),
            checkpoint.config.preprocessing.photo_from_bytes,
        )

    def close(self) -> None:
        """Close the file with the codes for an interrupted build."""
        self._unfinished.__exit__(None, None, None)

    def clear(self) -> None:
        """Delete the codes for an interrupted build, after a generation contains them."""
        self._unfinished.clear()

    @property
    def removed(self) -> int:
        """Number of the parent's photos that the catalogue lacks."""
        return 0 if self.parent is None else self.parent.count - self.known

    def parts(
        self, catalogue: Catalogue, known: Slots, unchanged: Iterable[slice], quiet: bool
    ) -> Generator[BuildPart, None, None]:
        """Yield the photos of the catalogue, in its order.

        Args:
            catalogue: The N photos.
            known: The parent's row of each photo whose file is not read again (N,), else -1.
            unchanged: Runs of photos whose rows are consecutive in the parent and do not change.
            quiet: Show no progress.

        Raises:
            NoReadablePhoto: No photo can be read.
            NumericalError: A partial activation exceeds float16.
        """
        self.skipped += catalogue.skipped
        threads = torch.get_num_threads()
        new = len(catalogue.photos) - (self.parent.count if self.parent else 0)
        if new >= MIN_PHOTOS_TO_TUNE and next(self.checkpoint.matcher.parameters()).device.type == "cpu":
            self._encode_photos = fastest_photo_encoder(self.checkpoint)
        found = map_ahead(
            partial(self._find, catalogue), _steps(catalogue.photos, known, unchanged), threads, 2 * threads
        )
        with Bar("embed", len(catalogue.photos), "photos", quiet=quiet) as bar, one_thread():
            for part in map_ahead(self._encode, _full_batches(found), threads, 2 * threads):
                self._count(part)
                bar.advance(len(part.objects) + len(part.skipped))
                if part.objects:
                    yield part
        if not self.objects:
            raise no_photo(catalogue, self.skipped)
        if self.made[EMBEDDED] + self.made[RESUMED] < self.objects.total():
            # Reused codes were rounded by earlier builds.
            errors = [source.manifest.about.get("partial_error", 0.0) for source in self._sources]
            self.partial_error = max(self.partial_error, *errors)

    def _find(self, catalogue: Catalogue, step: BuildPart | list[_CataloguedPhoto]) -> BuildPart | list[_ReadItem]:
        """Read files, and keep the bytes of those that must be encoded. Runs on threads."""
        if isinstance(step, BuildPart):
            return step
        items, new = list[_ReadItem](), dict[str, _Photo]()
        for photo, number in step:
            file = read_photo(catalogue, photo) if number < 0 else None
            if isinstance(file, SkippedPhoto):
                items.append(file)
            elif file is not None:
                items.append(new.setdefault(photo.path, _Photo(photo_row(photo, file.digest), file)))
            elif self.parent is not None:
                items.append(_Photo(photo_row(photo, self.parent.rows[number]["digest"])))
        if self.parent is not None:
            for path in self.parent.reusable({path: item.row["digest"] for path, item in new.items()}):
                new.pop(path).file = None
        codes = self._find_encoded([item.row["digest"] for item in new.values()])
        for item in new.values():
            item.code = codes.get(item.row["digest"])
            item.file = item.file if item.code is None else None
        return items

    def _find_encoded(self, digests: Sequence[str]) -> dict[str, _PhotoEncoding]:
        """Return the codes of these contents from generations, under any id, or from an interrupted build."""
        found: dict[str, _PhotoEncoding] = {}
        for source in self._sources:
            if not (missing := [digest for digest in digests if digest not in found]):
                break
            numbers = source.rows.by_digest.find(keys_of(missing))
            present = [digest for digest, number in zip(missing, numbers, strict=True) if number >= 0]
            rows = numbers[numbers >= 0]
            stored = {name: source.arrays[name][rows] for name in self._stored}
            is_partial_only = source is self._partials
            embeddings = self._embeddings(stored) if is_partial_only else source.embeddings[source.slots[rows]]
            for place, (digest, embedding) in enumerate(zip(present, embeddings, strict=True)):
                one = {name: array[place] for name, array in stored.items()}
                found[digest] = _PhotoEncoding(embedding, one, 0.0, RE_EMBEDDED if is_partial_only else RENAMED)
        for digest, record in self._unfinished.find(digest for digest in digests if digest not in found).items():
            found[digest] = _PhotoEncoding(
                record["embedding"],
                {name: record[name] for name in self._stored},
                float(record["partial_error"]),
                RESUMED,
            )
        return found

    @torch.inference_mode()
    def _embeddings(self, arrays: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the candidate encoder's embeddings (n, d) of stored partial activations."""
        candidate_encoder = self.checkpoint.matcher.candidate_encoder
        assert candidate_encoder is not None
        pooled = arrays[PARTIALS].astype(np.float32)
        stored = torch.from_numpy(pooled).to(next(candidate_encoder.parameters()).device)
        embeddings: NDArray[np.float32] = candidate_encoder.photo(stored).cpu().numpy()
        return embeddings

    def _encode(self, found: BuildPart | list[_ReadItem]) -> BuildPart:
        """Decode and encode the photos that have no code, each content once. Runs on threads."""
        if isinstance(found, BuildPart):
            return found
        part, photos, images = BuildPart(), list[_Photo](), list[Image]()
        rows: dict[str, dict[str, Any]] = {}
        for item in found:
            result: _ReadItem = item
            if isinstance(item, _Photo) and item.file is not None and item.row["digest"] not in rows:
                image = decode_photo(item.file, self._preprocess)
                if isinstance(image, SkippedPhoto):
                    result = image
                else:
                    images.append(image)
                    rows[item.row["digest"]] = item.row
            if isinstance(result, SkippedPhoto):
                part.skipped.append(result)
            else:
                photos.append(result)
        made = dict(zip(rows, self._encode_images(list(rows.values()), images), strict=True)) if images else {}
        part.codes = [photo.code or made[photo.row["digest"]] for photo in photos if photo.code or photo.file]
        part.rows = [photo.row for photo in photos]
        part.objects = [row["object_id"] for row in part.rows]
        return part

    def _encode_images(self, rows: Sequence[dict[str, Any]], images: Sequence[Image]) -> list[_PhotoEncoding]:
        """Encode the images of these rows, and store their codes in case the build is interrupted."""
        partials, embeddings = self._encode_photos(images)
        largest = np.abs(partials).max(axis=1)
        arrays = to_stored(partials, self.checkpoint.config.matcher.pooled_width)
        if len(bad := np.flatnonzero(~(largest <= np.finfo(np.float16).max))):
            raise NumericalError(
                f"partial activations are stored as float16 and must be within 65504; {rows[bad[0]]['id']} gives "
                f"{largest[bad[0]]}: the model has diverged, train again with a lower learning rate"
            )
        errors = np.abs(StoredPartials(arrays)[:] - partials).max(axis=1)
        self._unfinished.add(
            [row["digest"] for row in rows], {"embedding": embeddings, "partial_error": errors, **arrays}
        )
        return [
            _PhotoEncoding(embedding, {name: array[place] for name, array in arrays.items()}, error, EMBEDDED)
            for place, (embedding, error) in enumerate(zip(embeddings, errors.tolist(), strict=True))
        ]

    def _count(self, part: BuildPart) -> None:
        self.skipped += part.skipped
        self.objects.update(part.objects)
        self.made.update(code.origin for code in part.codes)
        self.partial_error = max([self.partial_error, *(code.partial_error for code in part.codes)])
        self.known += len(part.unchanged)
        if self.parent is not None and part.rows:
            self.known += int((self.parent.rows.find([row["id"] for row in part.rows]) >= 0).sum())


def no_photo(catalogue: Catalogue, skipped: list[SkippedPhoto]) -> NoReadablePhoto:
    """Return the error for a catalogue without a readable photo.

    Args:
        catalogue: The catalogue.
        skipped: Its photos that could not be read, at least one.
    """
    first = skipped[0]
    return NoReadablePhoto(
        f"no photo in {catalogue.where} can be read; the first: {first.path}: {first.reason}", skipped
    )


def map_ahead(function: Callable[[T], R], items: Iterable[T], threads: int, window: int) -> Iterator[R]:
    """Yield `map(function, items)`, computed on threads ahead of the reader.

    When the reader stops or an item fails, waiting items are dropped and running ones finish first.

    Args:
        function: Called on threads.
        items: Its arguments.
        threads: Number of threads.
        window: Largest number of items ahead of the reader.
    """
    pool = ThreadPoolExecutor(threads)
    try:
        yield from map_in_order(pool, function, items, window - 1)
    finally:
        pool.shutdown(cancel_futures=True)


def _steps(
    photos: PhotoTable, known: Slots, unchanged: Iterable[slice]
) -> Iterator[BuildPart | list[_CataloguedPhoto]]:
    """Yield parts of the parent's rows and, between them, lists of photos with their known rows."""
    done = 0
    for run in [*unchanged, slice(len(known), len(known))]:
        yield from batches(zip(photos[done : run.start], known[done : run.start].tolist(), strict=True), READ)
        if run.start < run.stop:
            first = int(known[run.start])
            yield BuildPart(unchanged=range(first, first + run.stop - run.start), objects=photos[run].objects)
        done = run.stop


def _full_batches(found: Iterable[BuildPart | list[_ReadItem]]) -> Iterator[BuildPart | list[_ReadItem]]:
    """Regroup photos into lists that each have a full batch to encode.

    A list ends earlier at the end, before unchanged rows, and after `MAX_REUSED_PER_PART` reused codes.
    """
    waiting = list[_ReadItem]()
    new = reused = 0
    for step in found:
        for item in [] if isinstance(step, BuildPart) else step:
            waiting.append(item)
            new += isinstance(item, _Photo) and item.file is not None
            reused += isinstance(item, _Photo) and item.code is not None
            if new == BATCH or reused == MAX_REUSED_PER_PART:
                yield waiting
                waiting, new, reused = [], 0, 0
        if isinstance(step, BuildPart):
            if waiting:
                yield waiting
            yield step
            waiting, new, reused = [], 0, 0
    if waiting:
        yield waiting
