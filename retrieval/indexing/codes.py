"""Codes of photos: found in the cache of an index, or made. Some threads read and hash files, others decode and encode.

Several batches are encoded at once, each by a single thread. PyTorch therefore computes each matrix product on one
thread. With its default of several, a product would wait for cores that are busy decoding.

The code of a photo is its embedding and its stored partial activation.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.store.codes import CodeCache, FileStatus
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue, CataloguePhoto, PhotoBytes, decode_photo, read_photo
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.loading import map_in_order
from retrieval.errors import NoReadablePhoto, NumericalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.encode import Image, PhotoEncoder, batches, one_thread, torch_photo_encoder
from retrieval.model.export import choose_photo_encoder
from retrieval.model.fusion_scorer import stored_layout, to_stored

T = TypeVar("T")
R = TypeVar("R")

BATCH = 16
READ = 32
"""Files that a thread reads in one task. The overhead of a task is a tenth of the time to read and hash one photo."""
BLOCK = 1024
"""Codes that are copied from the cache to the index at once."""
MIN_PHOTOS_FOR_ONNX = 256
"""Smallest number of new photos that ONNX Runtime encodes: exporting the towers takes about a second."""
MIN_AGE_NS = 2 * 10**9
"""A file that changed less than this before the build is read again by the next one, as in git: it may change again
within one tick of the disk's clock, without another time. The coarsest clock of a common disk (FAT) ticks every two
seconds."""


class FileDigests:
    """Digests of the files of a catalogue that did not change since an earlier build, by path.

    Args:
        folder: The catalogue.
        paths: Paths of the files in it.
        cache: The cache of the index.

    Attributes:
        known: Digests of the files whose size and time did not change.
    """

    def __init__(self, folder: Path, paths: Sequence[str], cache: CodeCache) -> None:
        self.known: dict[str, str] = {}
        self._cache, self._recordable = cache, dict[str, FileStatus]()
        before = time.time_ns() - MIN_AGE_NS
        for some in batches(paths, 4 * BLOCK):
            statuses = {path: status for path in some if (status := _status(folder, path))}
            known = cache.unchanged(statuses)
            self.known |= known
            self._recordable |= {
                path: status for path, status in statuses.items() if path not in known and status.mtime_ns < before
            }

    def note(self, digests: Mapping[str, str]) -> None:
        """Store the digests of files that were read."""
        noted = self._recordable.keys() & digests.keys()
        self._cache.note_files((path, self._recordable[path], digests[path]) for path in noted)


def _status(folder: Path, path: str) -> FileStatus | None:
    try:
        status = os.stat(f"{folder}/{path}")
    except (OSError, ValueError):  # reading the file reports the error
        return None
    return FileStatus(status.st_size, status.st_mtime_ns)


def code_layout(checkpoint: Checkpoint) -> np.dtype[Any]:
    """Return the type of a photo's code in the cache: its embedding and its stored partial activation."""
    matcher = checkpoint.config.matcher
    stored = stored_layout(matcher.pooled_width, matcher.partial_width)
    return np.dtype([("embeddings", "<f4", (matcher.embedding_dim,)), *((name, *how) for name, how in stored.items())])


def code_model(checkpoint: Checkpoint, layout: np.dtype[Any]) -> str:
    """Return the key of the codes of a model with its preprocessing in this layout."""
    made_by = [fingerprint(checkpoint), str(layout)]
    return hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()[:16]


@dataclass
class PhotoCodes:
    """The codes of a catalogue's photos are in the cache.

    Attributes:
        digests: Content digest by path, of the photos that could be read and decoded.
        skipped: Photos that could not be read.
        encoded: Number of photos that were encoded now.
    """

    digests: dict[str, str] = field(default_factory=dict)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    encoded: int = 0


def find_codes(
    catalogue: Catalogue, checkpoint: Checkpoint, cache: CodeCache, known: Mapping[str, str], quiet: bool
) -> PhotoCodes:
    """Store the codes of a catalogue's photos in the cache of the index, each content once.

    Args:
        catalogue: The catalogue.
        checkpoint: The model.
        cache: The cache of the index.
        known: Digests of unchanged files by path.
        quiet: Show no progress.

    Raises:
        NoReadablePhoto: No photo can be read.
        NumericalError: A partial activation exceeds float16.
        WriteFailed: A code could not be stored.
    """
    layout = code_layout(checkpoint)
    model, threads = code_model(checkpoint, layout), torch.get_num_threads()
    stored = cache.known(model)
    found = PhotoCodes({one.path: known[one.path] for one in catalogue.photos if known.get(one.path) in stored})
    unread = [photo for photo in catalogue.photos if photo.path not in found.digests]
    encode_images = _photo_encoder(checkpoint, len(unread))
    unusable: dict[str, str] = {}

    def new_contents() -> Generator[PhotoBytes, None, None]:
        def read_some(photos: Sequence[CataloguePhoto]) -> list[PhotoBytes | SkippedPhoto]:
            return [read_photo(catalogue, photo) for photo in photos]

        with closing(map_ahead(read_some, batches(unread, READ), threads, 2 * threads)) as parts:
            for file in (file for part in parts for file in part):
                bar.advance()
                if isinstance(file, SkippedPhoto):
                    found.skipped.append(file)
                    continue
                found.digests[file.photo.path] = file.digest
                if file.digest not in stored:
                    stored.add(file.digest)
                    yield file

    with Bar("embed", len(unread), "photos", quiet=quiet) as bar, one_thread(), closing(new_contents()) as contents:
        encode = partial(_encode, checkpoint, encode_images, layout)
        with closing(map_ahead(encode, batches(contents, BATCH), threads, 2 * threads)) as encoded:
            for codes, reasons in encoded:
                cache.add(model, codes)
                found.encoded += len(codes)
                unusable |= reasons
    for path in [path for path, digest in found.digests.items() if digest in unusable]:
        found.skipped.append(SkippedPhoto(path, unusable[found.digests.pop(path)]))
    if not found.digests:
        raise no_photo(catalogue, [*catalogue.skipped, *found.skipped])
    return found


def code_blocks(cache: CodeCache, checkpoint: Checkpoint, digests: Sequence[str]) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the codes of photos in blocks: arrays by name, such as "embeddings" (n, d)."""
    layout = code_layout(checkpoint)
    model = code_model(checkpoint, layout)
    for some in batches(digests, BLOCK):
        records = np.frombuffer(b"".join(cache.read(model, some)), layout)
        yield {name: records[name] for name in layout.names or ()}


def _photo_encoder(checkpoint: Checkpoint, photos: int) -> PhotoEncoder:
    many = photos >= MIN_PHOTOS_FOR_ONNX
    return choose_photo_encoder(checkpoint) if many else torch_photo_encoder(checkpoint.matcher)


def _encode(
    checkpoint: Checkpoint, encode_images: PhotoEncoder, layout: np.dtype[Any], files: Sequence[PhotoBytes]
) -> tuple[dict[str, bytes], dict[str, str]]:
    """Decode and encode photos on a thread; return codes, and reasons why there is none, by digest."""
    images, readable, reasons = list[Image](), list[PhotoBytes](), dict[str, str]()
    for file in files:
        image = decode_photo(file, checkpoint.config.preprocessing.photo_from_bytes)
        if isinstance(image, SkippedPhoto):
            reasons[file.digest] = image.reason
        else:
            images.append(image)
            readable.append(file)
    if not images:
        return {}, reasons
    encoded = encode_images(images)
    largest = np.abs(encoded.partial).max(axis=1)
    if len(bad := np.flatnonzero(~(largest <= np.finfo(np.float16).max))):
        raise NumericalError(
            f"partial activations are stored as float16 and must be within 65504; {readable[bad[0]].photo.path} gives "
            f"{largest[bad[0]]}: the model has diverged, train again with a lower learning rate"
        )
    records = np.empty(len(images), layout)
    records["embeddings"] = encoded.embedding
    for name, array in to_stored(encoded.partial, checkpoint.config.matcher.pooled_width).items():
        records[name] = array
    return {file.digest: record.tobytes() for file, record in zip(readable, records, strict=True)}, reasons


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


def map_ahead(function: Callable[[T], R], items: Iterable[T], threads: int, window: int) -> Generator[R, None, None]:
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
