"""Codes of photos and of reference touches: found in the cache of an index, or made.

A code is a row of arrays as the index stores it: of a photo, its embedding and its partial activation; of a touch, its
partial activation and what its gels show. Its key in the cache is made of the model and of the content of its files.

Some threads read and hash files, others decode and encode. Several batches are encoded at once, each by a single
thread. PyTorch therefore computes each matrix product on one thread. With its default of several, a product would wait
for cores that are busy decoding.
"""

import hashlib
import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from _touch_retrieval.cache import Cache, cache_key
from indexes.errors import WriteFailed
from retrieval.console.progress import Bar
from retrieval.data.catalogue import Catalogue
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.images import decode_rgb
from retrieval.data.loading import map_in_order
from retrieval.errors import ImageError, NumericalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.encode import batches, one_thread, torch_photo_encoder, touch_features
from retrieval.model.export import choose_photo_encoder
from retrieval.model.fusion_scorer import stored_layout, to_stored
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL

T = TypeVar("T")
R = TypeVar("R")
Paths = tuple[str, ...]
"""Files of one photo (one) or of one touch (one for each finger), relative to the catalogue."""

BATCH = 16
"""Photos that are encoded together."""
READ = 32
"""Items that a thread reads in one task. The overhead of a task is a tenth of the time to read and hash one photo."""
BLOCK = 1024
"""Codes that are copied from the cache to the index at once."""
MIN_PHOTOS_FOR_ONNX = 256
"""Smallest number of new photos that ONNX Runtime encodes: exporting the towers takes about a second."""
MIN_AGE_NS = 2 * 10**9
"""A file that changed less than this before the build is read again by the next one, as in git: it may change again
within one tick of the disk's clock, without another time. The coarsest clock of a common disk (FAT) ticks every two
seconds."""
SHOWS = (CONTACT, NO_CONTACT, NOT_A_GEL)
"""What the gels of a touch show, by its number in a code."""


class FileDigests:
    """Digests of the files of a catalogue that did not change since an earlier build, by path.

    Args:
        catalogue: The catalogue.
        cache: The cache of the index.

    Attributes:
        known: Digests of the files whose size and time did not change.
    """

    _KEY = "files/all"

    def __init__(self, catalogue: Catalogue, cache: Cache) -> None:
        self._cache, self._before = cache, time.time_ns() - MIN_AGE_NS
        content = cache.get(self._KEY)
        self._stored = {} if content is None else msgspec.json.decode(content, type=dict[str, tuple[int, int, str]])
        self._statuses = dict[str, tuple[int, int]]()
        for path in catalogue.paths:
            try:
                status = os.stat(f"{catalogue.folder}/{path}")
            except (OSError, ValueError):  # reading the file reports the error
                continue
            self._statuses[path] = status.st_size, status.st_mtime_ns
        self.known = {
            path: stored[2]
            for path, status in self._statuses.items()
            if (stored := self._stored.get(path)) and stored[:2] == status
        }

    def store(self, digests: Mapping[str, str]) -> None:
        """Store the digests of all files that are old enough, in place of those of the earlier build."""
        files = {
            path: (*status, digests[path])
            for path, status in self._statuses.items()
            if path in digests and status[1] < self._before
        }
        if files != self._stored:
            self._cache.add({self._KEY: msgspec.json.encode(files)})


class Encoder(NamedTuple):
    """How files become codes.

    Attributes:
        what: Plural of the items.
        layout: Type of a code.
        model: Group of the codes in the cache: a digest of model, preprocessing and layout.
        batch: Number of items that are encoded together.
        decode: Returns the model's input from the bytes of an item's files and their paths; raises ImageError.
        start: Returns, for a number of items to encode, the function that returns the codes (B,) of inputs with these
            paths; several threads call it at once.
    """

    what: str
    layout: np.dtype[Any]
    model: str
    batch: int
    decode: Callable[[Sequence[bytes], Paths], Any]
    start: Callable[[int], Callable[[Sequence[Any], Sequence[Paths]], NDArray[Any]]]

    def key(self, digests: Iterable[str]) -> str:
        """Return the key in the cache of an item whose files have these digests."""
        return f"{self.model}/{'-'.join(digests)}"


def photo_encoder(checkpoint: Checkpoint) -> Encoder:
    """Return the encoder of photos."""
    settings, photo_from_bytes = checkpoint.config.matcher, checkpoint.config.preprocessing.photo_from_bytes
    stored = stored_layout(settings.pooled_width, settings.partial_width)
    layout = np.dtype(
        [("embeddings", "<f4", (settings.embedding_dim,)), *((name, *how) for name, how in stored.items())]
    )

    def start(count: int) -> Callable[[Sequence[Any], Sequence[Paths]], NDArray[Any]]:
        is_long = count >= MIN_PHOTOS_FOR_ONNX
        run = choose_photo_encoder(checkpoint) if is_long else torch_photo_encoder(checkpoint.matcher)

        def encode(images: Sequence[Any], paths: Sequence[Paths]) -> NDArray[Any]:
            encoded, records = run(images), np.empty(len(images), layout)
            largest = np.abs(encoded.partials).max(axis=1)
            if len(bad := np.flatnonzero(~(largest <= np.finfo(np.float16).max))):
                raise NumericalError(
                    f"partial activations are stored as float16 and must be within 65504; {paths[bad[0]][0]} gives "
                    f"{largest[bad[0]]}: the model has diverged, train again with a lower learning rate"
                )
            records["embeddings"] = encoded.embeddings
            for name, array in to_stored(encoded.partials, settings.pooled_width).items():
                records[name] = array
            return records

        return encode

    def decode(data: Sequence[bytes], paths: Paths) -> Any:
        return photo_from_bytes(data[0], paths[0])

    return Encoder("photos", layout, _model(checkpoint, layout), BATCH, decode, start)


def touch_encoder(checkpoint: Checkpoint) -> Encoder:
    """Return the encoder of reference touches."""
    matcher, check, fingers = checkpoint.matcher, checkpoint.gel_check, checkpoint.config.matcher.fingers
    layout = np.dtype([("partial", "<f2", (checkpoint.config.matcher.touch_partial_width,)), ("shows", "u1")])

    def decode(data: Sequence[bytes], paths: Paths) -> list[Any]:
        if len(paths) != fingers:
            ends = " and ".join(f"_{letter}" for letter in "abcdefghij"[:fingers])
            reason = f"the touch has {len(paths)} gel image(s), the model takes {fingers}: names end in {ends}"
            raise ImageError(paths[0], reason)
        preprocess = checkpoint.config.preprocessing.touch
        return [preprocess(decode_rgb(content, path), None) for content, path in zip(data, paths, strict=True)]

    @torch.inference_mode()
    def encode(touches: Sequence[Any], paths: Sequence[Paths]) -> NDArray[Any]:
        features = touch_features(matcher, touches)
        readings, records = matcher.gel_readings(features), np.zeros(len(touches), layout)
        records["partial"] = matcher.touch_encoding(features).partial.cpu().numpy()
        if check is not None and readings is not None:
            records["shows"] = [SHOWS.index(shows) for shows in check.classify(readings.cpu().numpy())]
        return records

    return Encoder("touches", layout, _model(checkpoint, layout), 32, decode, lambda count: encode)


def _model(checkpoint: Checkpoint, layout: np.dtype[Any]) -> str:
    return cache_key("", fingerprint(checkpoint), str(layout))[1:17]


@dataclass
class Codes:
    """The codes of some photos or touches are in the cache.

    Attributes:
        keys: Key of the code of each item that could be read and decoded.
        digests: Content digest of its files.
        skipped: Items that could not be read.
        encoded: Number of items that were encoded now.
    """

    keys: dict[Paths, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    encoded: int = 0


class _File(NamedTuple):
    """An item that was read: its paths, the digests and the bytes of its files."""

    paths: Paths
    digests: list[str]
    data: list[bytes]


def find_codes(
    catalogue: Catalogue, items: Sequence[Paths], encoder: Encoder, cache: Cache, known: Mapping[str, str], quiet: bool
) -> Codes:
    """Store the codes of photos or touches in the cache of the index, each content once.

    Args:
        catalogue: The catalogue.
        items: Files of each photo or touch.
        encoder: Makes the codes.
        cache: The cache of the index.
        known: Digests of unchanged files by path.
        quiet: Show no progress.

    Raises:
        NumericalError: A partial activation exceeds float16.
    """
    stored, found, threads = cache.keys(encoder.model), Codes(), torch.get_num_threads()
    unread = []
    for paths in items:
        digests = [known.get(path, "") for path in paths]
        key = encoder.key(digests)
        if key in stored:
            found.keys[paths] = key
            found.digests.update(zip(paths, digests, strict=True))
        else:
            unread.append(paths)
    if not unread:
        return found
    encode, unusable = encoder.start(len(unread)), dict[str, str]()

    def read_some(some: Sequence[Paths]) -> list[_File | SkippedPhoto]:
        return [_read(catalogue, paths) for paths in some]

    def encode_some(files: Sequence[_File]) -> tuple[dict[str, bytes], dict[str, str]]:
        """Return the codes of some files, and reasons why there is none, by key."""
        inputs, readable, reasons = [], list[_File](), dict[str, str]()
        for file in files:
            try:
                inputs.append(encoder.decode(file.data, file.paths))
                readable.append(file)
            except ImageError as error:
                reasons[encoder.key(file.digests)] = error.reason
        codes = encode(inputs, [file.paths for file in readable]) if inputs else ()
        return {encoder.key(file.digests): code.tobytes() for file, code in zip(readable, codes, strict=True)}, reasons

    def new_contents() -> Generator[_File]:
        with closing(map_ahead(read_some, batches(unread, READ), threads, 2 * threads)) as parts:
            for file in (file for part in parts for file in part):
                bar.advance()
                if isinstance(file, SkippedPhoto):
                    found.skipped.append(file)
                    continue
                found.keys[file.paths] = key = encoder.key(file.digests)
                found.digests.update(zip(file.paths, file.digests, strict=True))
                if key not in stored:
                    stored.add(key)
                    yield file

    with (
        Bar("embed", len(unread), encoder.what, quiet=quiet) as bar,
        one_thread(),
        closing(new_contents()) as contents,
        closing(map_ahead(encode_some, batches(contents, encoder.batch), threads, 2 * threads)) as encoded,
    ):
        for codes, reasons in encoded:
            cache.add(codes)
            found.encoded += len(codes)
            unusable |= reasons
    for paths in [paths for paths, key in found.keys.items() if key in unusable]:
        found.skipped.append(SkippedPhoto(paths[0], unusable[found.keys.pop(paths)]))
    return found


def read_codes(cache: Cache, encoder: Encoder, keys: Sequence[str]) -> NDArray[Any]:
    """Return codes (n,) from the cache. Raises WriteFailed if one was damaged since it was stored."""
    codes = cache.get_all(keys)
    if not codes.keys() >= set(keys):
        raise WriteFailed(f"{cache.path}: a code was damaged and is deleted; build again")
    return np.frombuffer(b"".join(codes[key] for key in keys), encoder.layout)


def code_blocks(cache: Cache, encoder: Encoder, keys: Sequence[str]) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the codes of photos in blocks: arrays by name, such as "embeddings" (n, d)."""
    for some in batches(keys, BLOCK):
        records = read_codes(cache, encoder, some)
        yield {name: records[name] for name in encoder.layout.names or ()}


def _read(catalogue: Catalogue, paths: Paths) -> _File | SkippedPhoto:
    try:
        data = [catalogue.read(path) for path in paths]
    except ImageError as error:
        return SkippedPhoto(paths[0], error.reason)
    return _File(paths, [hashlib.sha256(content).hexdigest() for content in data], data)


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
