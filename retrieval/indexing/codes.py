"""Codes of photos and of reference touches: found in the cache of an index, or made.

A code is a row of arrays as the index stores it: of a photo, its embedding and its partial activation; of a touch, its
partial activation and what its gels show. Its key in the cache is made of the model and of the content of its files.

Several batches are read, decoded and encoded at once, each by a single thread. PyTorch therefore computes each matrix
product on one thread. With its default of several, a product would wait for cores that are busy decoding.
"""

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from _touch_retrieval.cache import Cache, cache_key
from indexes.errors import WriteFailed
from retrieval.console.progress import Bar
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.catalogue import Catalogue, SkippedPhoto
from retrieval.data.images import decode_rgb, read_bytes
from retrieval.data.loading import map_in_order
from retrieval.errors import ImageError, NumericalError, RetrievalError
from retrieval.indexing.enrolled import EnrolledTable, EnrolledTouch, codes_of, model_key, to_code
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.encode import TorchEncoder, batches, one_thread, torch_photo_encoder, touch_features
from retrieval.model.export import choose_photo_encoder
from retrieval.model.fusion_scorer import stored_layout, to_stored
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.touch_reader import Stopwatch, TouchReader
from retrieval.model.touches import parse_grasps

Paths = tuple[str, ...]
"""Files of one photo (one) or of one touch (one for each finger), relative to the catalogue."""

BATCH = 16
"""Photos or touches that are encoded together."""
MIN_PHOTOS_FOR_ONNX = 256
"""Smallest number of new photos that ONNX Runtime encodes: exporting the towers takes about a second."""
MIN_AGE_NS = 2 * 10**9
"""A file that changed less than this before the build is read again by the next one, as in git: it may change again
within one tick of the disk's clock, without another time. The coarsest clock of a common disk (FAT) ticks every two
seconds."""
SHOWS = (CONTACT, NO_CONTACT, NOT_A_GEL)
"""What the gels of a touch show, by its number in a code."""


class FileRecord(NamedTuple):
    """Size, time of the last change and SHA-256 of a file."""

    bytes: int
    changed_ns: int
    digest: str


class CatalogueFiles:
    """The files of a catalogue; those that did not change since an earlier build need not be read.

    Args:
        catalogue: The catalogue.
        cache: The cache of the index.

    Attributes:
        known: Records of the files that did not change or were read, by path.
    """

    _KEY = "files/all"

    def __init__(self, catalogue: Catalogue, cache: Cache) -> None:
        self._catalogue, self._cache, self._before = catalogue, cache, time.time_ns() - MIN_AGE_NS
        content = cache.get(self._KEY)
        self._stored = {} if content is None else msgspec.json.decode(content, type=dict[str, FileRecord])
        self.known = {
            path: record
            for path in catalogue.paths
            if (record := self._stored.get(path)) and record[:2] == self._status(path)
        }

    def digest(self, path: str) -> str:
        """Return the digest of a known file, or an empty string."""
        return self.known[path].digest if path in self.known else ""

    def read(self, path: str) -> tuple[FileRecord, bytes]:
        """Read a file, which becomes known. Raises ImageError."""
        status = self._status(path)  # before reading: if the file changes now, the next build reads it again
        content = read_bytes(self._catalogue.folder / path)
        self.known[path] = record = FileRecord(*status, hashlib.sha256(content).hexdigest())
        return record, content

    def save(self) -> None:
        """Store the records of all files that are old enough, in place of those of the earlier build."""
        settled = {path: record for path, record in self.known.items() if record.changed_ns < self._before}
        if settled != self._stored:
            self._cache.add({self._KEY: msgspec.json.encode(settled)})

    def _status(self, path: str) -> tuple[int, int]:
        try:
            status = os.stat(f"{self._catalogue.folder}/{path}")
        except (OSError, ValueError):  # reading the file reports the error
            return -1, -1
        return status.st_size, status.st_mtime_ns


class Encoder(NamedTuple):
    """How files become codes.

    Attributes:
        what: Plural of the items.
        layout: Type of a code.
        model: Group of the codes in the cache: a digest of model, preprocessing and layout.
        decode: Returns the model's input from the bytes of an item's files and their paths, and the faults of a photo;
            raises ImageError.
        start: Returns, for a number of items to encode, the function that returns the codes (B,) of inputs with these
            paths; several threads call it at once.
        variant: End of the key of an item in the cache: what its code depends on besides its files.
    """

    what: str
    layout: np.dtype[Any]
    model: str
    decode: Callable[[Sequence[bytes], Paths], tuple[Any, Sequence[str]]]
    start: Callable[[int], Callable[[Sequence[Any], Sequence[Paths]], NDArray[Any]]]
    variant: Callable[[Paths], str] = lambda paths: ""

    def key(self, paths: Paths, digests: Iterable[str]) -> str:
        """Return the key in the cache of an item whose files have these digests."""
        return f"{self.model}/{'-'.join(digests)}{self.variant(paths)}"


def photo_encoder(checkpoint: Checkpoint, cameras: Mapping[str, PhotoCamera] = MappingProxyType({})) -> Encoder:
    """Return the encoder of photos; `cameras` are those that are not usual, by path."""
    settings, photo_from_bytes = checkpoint.config.matcher, checkpoint.config.preprocessing.photo_from_bytes
    stored = stored_layout(settings.pooled_width, settings.partial_width)
    layout = np.dtype(
        [("embeddings", "<f4", (settings.embedding_dim,)), *((name, *how) for name, how in stored.items())]
    )

    def start(count: int) -> Callable[[Sequence[Any], Sequence[Paths]], NDArray[Any]]:
        run = (
            torch_photo_encoder(checkpoint.matcher) if count < MIN_PHOTOS_FOR_ONNX else choose_photo_encoder(checkpoint)
        )

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

    return Encoder(
        "photos",
        layout,
        _model(checkpoint, layout),
        lambda data, paths: photo_from_bytes(data[0], paths[0], cameras.get(paths[0], USUAL_CAMERA)),
        start,
        lambda paths: "-{:g}-{:g}".format(*cameras[paths[0]]) if paths[0] in cameras else "",
    )


def touch_encoder(checkpoint: Checkpoint) -> Encoder:
    """Return the encoder of reference touches."""
    matcher, check, fingers = checkpoint.matcher, checkpoint.gel_check, checkpoint.config.matcher.fingers
    layout = np.dtype([("partial", "<f2", (checkpoint.config.matcher.touch_partial_width,)), ("shows", "u1")])

    def decode(data: Sequence[bytes], paths: Paths) -> tuple[list[Any], Sequence[str]]:
        if len(paths) != fingers:
            ends = " and ".join(f"_{letter}" for letter in "abcdefghij"[:fingers])
            reason = f"the touch has {len(paths)} gel image(s), the model takes {fingers}: names end in {ends}"
            if len(paths) == 1:
                reason += "; for a sensor with one finger give --model shipped-one-finger, or a model of your own"
            raise ImageError(paths[0], reason)
        return list(map(checkpoint.config.preprocessing.touch, map(decode_rgb, data, paths))), ()

    @torch.inference_mode()
    def encode(touches: Sequence[Any], paths: Sequence[Paths]) -> NDArray[Any]:
        features = touch_features(matcher, touches)
        readings, records = matcher.gel_readings(features), np.zeros(len(touches), layout)
        records["partial"] = matcher.touch_encoding(features).partial.cpu().numpy()
        if check is not None and readings is not None:
            records["shows"] = [SHOWS.index(shows) for shows in check.classify(readings.cpu().numpy())]
        return records

    return Encoder("touches", layout, _model(checkpoint, layout), decode, lambda count: encode)


class EnrolledCodes(NamedTuple):
    """Enrolled touches of a build.

    Attributes:
        counts: Number of `touches`, of their `objects`, of touches that were `encoded` now, and of those that are
            `usable` by the model.
        skipped: Touches that could not be encoded; they stay in the table.
    """

    counts: dict[str, int]
    skipped: list[SkippedPhoto]


def encode_enrolled(
    index: Path, checkpoint: Checkpoint, cells: bool | None, previous: Mapping[str, str] | None = None
) -> EnrolledCodes | None:
    """Add codes of a model to the enrolled touches that have none, from their pictures.

    Args:
        index: Folder of the index.
        checkpoint: The model.
        cells: Whether the index has cells.
        previous: Fingerprint of the generation before. With it, codes of all but these two models are deleted: readers
            may still use the previous one.

    Returns:
        A report; None without enrolled touches.
    """
    table, codes, skipped, usable = EnrolledTable(index), dict[str, bytes](), list[SkippedPhoto](), 0
    if not (touches := table.read()):
        return None
    used = checkpoint.without_cells() if cells is False else checkpoint
    if used.references is not None and used.posterior is not None:  # else touches cannot be compared
        coded = {touch.path for touch in codes_of(touches, used)[0]}
        if missing := [touch for touch in touches if touch.path not in coded]:
            codes, skipped = _encode_pictures(index, missing, used)
        key = model_key(fingerprint(used))
        table.replace_codes(codes, key, previous and {key, model_key(previous)})
        usable = len(coded) + len(codes)
    counts = {"touches": len(touches), "objects": len({touch.object_id for touch in touches})}
    return EnrolledCodes({**counts, "encoded": len(codes), "usable": usable}, skipped)


def _encode_pictures(
    index: Path, touches: Sequence[EnrolledTouch], checkpoint: Checkpoint
) -> tuple[dict[str, bytes], list[SkippedPhoto]]:
    """Return the codes of enrolled touches by path, and the touches that could not be encoded."""
    reader, codes, skipped = TouchReader(checkpoint.config, TorchEncoder(checkpoint.matcher)), {}, list[SkippedPhoto]()
    takes_frames = checkpoint.config.preprocessing.background != "none"
    for touch in touches:
        try:
            frames = [str(index / path) for path in touch.background] if takes_frames else []
            files = [read_bytes(index / path, digest) for path, digest in touch.pictures.items()]
            grasps, no_contact = parse_grasps(files, reader.fingers), reader.no_contact_frames(frames or None)
            codes[touch.path] = to_code(reader.encode(grasps, no_contact, Stopwatch()).partials[0], checkpoint)
        except RetrievalError as error:
            skipped.append(SkippedPhoto(touch.path, f"enrolled for {touch.object_id}: {error}"))
    return codes, skipped


def _model(checkpoint: Checkpoint, layout: np.dtype[Any]) -> str:
    return cache_key("", fingerprint(checkpoint), str(layout))[1:17]


@dataclass
class Codes:
    """The codes of some photos or touches, which are in the cache.

    Attributes:
        keys: Key of the code of each item that could be read and decoded.
        skipped: Items that could not.
        encoded: Number of items that were encoded now.
        faults: Faults of the photos among them that have some, by path.
    """

    keys: dict[Paths, str] = field(default_factory=dict)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    encoded: int = 0
    faults: dict[str, Sequence[str]] = field(default_factory=dict)


def find_codes(items: Sequence[Paths], encoder: Encoder, files: CatalogueFiles, cache: Cache) -> Codes:
    """Store the codes of photos or touches in the cache of the index, each content once.

    Raises:
        NumericalError: A partial activation exceeds float16.
    """
    found, taken = Codes(), dict[str, Paths | None].fromkeys(cache.keys(encoder.model))
    known = {paths: encoder.key(paths, map(files.digest, paths)) for paths in items}
    found.keys = {paths: key for paths, key in known.items() if key in taken}
    unread = [paths for paths in items if paths not in found.keys]
    if not unread:
        return found
    encode, unusable = encoder.start(len(unread)), dict[str, str]()

    def process(some: Sequence[Paths]) -> dict[str, bytes]:
        """Read items, and return the codes of new contents."""
        inputs, new = list[Any](), dict[str, Paths]()
        for paths in some:
            try:
                records, contents = zip(*map(files.read, paths), strict=True)
            except ImageError as error:
                found.skipped.append(SkippedPhoto(paths[0], error.reason))
                continue
            found.keys[paths] = key = encoder.key(paths, (record.digest for record in records))
            if taken.setdefault(key, paths) is paths:  # no other thread encodes this content
                try:
                    prepared, faults = encoder.decode(contents, paths)
                    inputs.append(prepared)
                    new[key] = paths
                    if faults:
                        found.faults[paths[0]] = faults
                except ImageError as error:
                    unusable[key] = error.reason
        codes = encode(inputs, list(new.values())) if new else ()
        return {key: code.tobytes() for key, code in zip(new, codes, strict=True)}

    with (
        Bar("embedding", len(unread), encoder.what) as bar,
        ThreadPoolExecutor(threads := torch.get_num_threads()) as pool,
        one_thread(),
    ):
        try:
            for codes in map_in_order(pool, process, batches(unread, BATCH), 2 * threads):
                cache.add(codes)
                found.encoded += len(codes)
                bar.advance(min(BATCH, len(unread) - bar.done))
        finally:
            pool.shutdown(cancel_futures=True)
    for paths in [paths for paths, key in found.keys.items() if key in unusable]:
        found.skipped.append(SkippedPhoto(paths[0], unusable[found.keys.pop(paths)]))
    found.skipped.sort(key=lambda item: item.path)
    return found


def read_codes(cache: Cache, encoder: Encoder, keys: Sequence[str]) -> NDArray[Any]:
    """Return codes (n,) from the cache. Raises WriteFailed if one was damaged since it was stored."""
    codes = cache.get_all(keys)
    if not codes.keys() >= set(keys):
        raise WriteFailed(f"{cache.path}: a code was damaged and is deleted; build again")
    return np.frombuffer(b"".join(codes[key] for key in keys), encoder.layout)
