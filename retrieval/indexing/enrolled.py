"""Touches that were enrolled in an index: their pictures and one table, for all generations.

    enrolled/touches.json                the table, replaced as a whole
    enrolled/<object>/<digest>.png       pictures: gel images and no-contact frames
    enrolled/LOCK                        locked by the writer; other writers wait

A writer flushes the pictures to the disk before the table that names them. If it is killed at any moment, the old or
the new table is complete; the next writer deletes pictures that no table names. Readers take no lock. A sharded index
has one table for all shards.
"""

import hashlib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, NamedTuple
from urllib.parse import quote

import msgspec
import numpy as np
from msgspec import Meta, Raw, Struct
from numpy.typing import NDArray

from _touch_retrieval.files import durable_file, read_regular, sync, write_atomically
from _touch_retrieval.names import lookup_key
from indexes.errors import CorruptIndex, UnsupportedFormat, WriteFailed
from indexes.store.locking import writer_lock
from retrieval.console.output import abbreviate_list
from retrieval.data.catalogue import ENROLLED
from retrieval.data.naming import MAX_EXAMPLES
from retrieval.data.opening import RANGE_MM
from retrieval.errors import BadInput
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint

FORMAT = 1
_PICTURE = re.compile(r"[0-9a-f]{20}\.[a-z]+")
_Path = Annotated[str, Meta(pattern=rf"^{ENROLLED}/[^./][^/\0]*/{_PICTURE.pattern}\Z")]
_Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class EnrolledTouch(Struct, frozen=True, omit_defaults=True):
    """One enrolled touch.

    Attributes:
        object_id: The object.
        pictures: Paths of its gel images in the folder of the index, in finger order.
        digests: SHA-256 of these files.
        codes: Partial activation without cells (pooled_width,) as float16, by `model_key`.
        opening_mm: Opening of the jaws; None if it was not measured.
        background: Paths of the no-contact frames; empty without them.
    """

    object_id: str
    pictures: tuple[_Path, ...]
    digests: tuple[_Digest, ...]
    codes: dict[str, bytes]
    opening_mm: Annotated[float, Meta(ge=RANGE_MM[0], le=RANGE_MM[1])] | None = None
    background: tuple[_Path, ...] = ()


class _Table(Struct):
    format: int
    sha256: str
    touches: Raw


def model_key(fingerprint: Mapping[str, str]) -> str:
    """Return the key of a model's codes; an index with cells and one without have the same codes."""
    return "-".join(fingerprint[part][:16] for part in ("checkpoint", "preprocessing"))


def to_code(partial: NDArray[np.float32], stored: CheckpointInfo) -> bytes:
    """Return the code of a touch from its partial activation (touch_partial_width,)."""
    return np.asarray(partial[: stored.config.matcher.pooled_width], "<f2").tobytes()


def codes_of(
    touches: Sequence[EnrolledTouch], stored: CheckpointInfo
) -> tuple[list[EnrolledTouch], NDArray[np.float16]]:
    """Return the touches that have a code of a model, and their codes (n, pooled_width)."""
    key, width = model_key(fingerprint(stored)), stored.config.matcher.pooled_width
    usable = [touch for touch in touches if len(touch.codes.get(key, b"")) == 2 * width]
    return usable, np.frombuffer(b"".join(touch.codes[key] for touch in usable), "<f2").reshape(-1, width)


def content_digest(data: bytes) -> str:
    """Return the SHA-256 of a picture's file in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def picture_path(object_id: str, data: bytes) -> str:
    """Return the path of a picture of an object in the folder of the index."""
    name = quote(object_id, safe="")
    if len(name) > 80 or name.startswith("."):
        name = f"_{name[:40]}-{hashlib.sha256(object_id.encode()).hexdigest()[:16]}"
    kinds = {b"\x89PNG": "png", b"\xff\xd8": "jpg"}
    extension = next((kind for magic, kind in kinds.items() if data.startswith(magic)), "picture")
    return f"{ENROLLED}/{name}/{content_digest(data)[:20]}.{extension}"


class EnrolledTable:
    """The enrolled touches of an index folder or of a sharded index.

    Args:
        index: Its folder.
        owns: Selects the objects of `read`; None for all.
    """

    def __init__(self, index: Path, owns: Callable[[str], bool] | None = None) -> None:
        self.index, self._owns = index, owns
        self.path = index / ENROLLED / "touches.json"

    def version(self) -> tuple[int, int, int] | None:
        """Return numbers that change with the table; None without one."""
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CorruptIndex(f"{self.path}: cannot be read ({error.strerror})") from error
        return status.st_ino, status.st_size, status.st_mtime_ns

    def read(self) -> list[EnrolledTouch]:
        """Return all touches. Raises CorruptIndex or UnsupportedFormat."""
        try:
            table = msgspec.json.decode(read_regular(self.path), type=_Table)
            if table.format != FORMAT:
                raise UnsupportedFormat(
                    f"{self.path}: has the format {table.format}, not {FORMAT}; update the software"
                )
            if hashlib.sha256(table.touches).hexdigest() != table.sha256:
                raise ValueError("its SHA-256 differs")
            touches = msgspec.json.decode(table.touches, type=list[EnrolledTouch])
            if any(len(touch.pictures) != len(touch.digests) for touch in touches):
                raise ValueError("a picture has no digest")
        except FileNotFoundError:
            return []
        except (OSError, ValueError, RecursionError) as error:
            raise CorruptIndex(
                f"{self.path}: the table of enrolled touches is damaged ({error}); restore it from a backup, or delete "
                f"it and enrol again from the pictures in {self.path.parent}"
            ) from error
        return touches if self._owns is None else [touch for touch in touches if self._owns(touch.object_id)]

    @contextmanager
    def lock(self) -> Iterator[list[EnrolledTouch]]:
        """Yield all touches, and keep other writers out in the block; wait for them before."""
        with writer_lock(self.path.with_name("LOCK"), wait=True):
            yield self.read()

    def replace(self, touches: Sequence[EnrolledTouch], files: Mapping[str, bytes] | None = None) -> None:
        """Replace the table, which is locked; `files` are the contents of new pictures by path.

        Raises:
            WriteFailed: The disk is full or cannot be written. The table is the old or the new one.
        """
        content = msgspec.json.encode(touches)
        table = _Table(FORMAT, hashlib.sha256(content).hexdigest(), Raw(content))
        try:
            self._sweep(self.read())
            for path, data in (files or {}).items():
                (self.index / path).parent.mkdir(exist_ok=True)
                with durable_file(self.index / path) as file:
                    file.write(data)
                sync((self.index / path).parent)
            sync(self.path.parent)
            sync(self.index)
            write_atomically(self.path, msgspec.json.encode(table))
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: writing failed ({error.strerror or error}); enrol again") from error
        with suppress(OSError):  # else the next writer deletes them
            self._sweep(touches)

    def _sweep(self, touches: Sequence[EnrolledTouch]) -> None:
        """Delete pictures that no touch names, empty folders, and the unfinished tables of killed writers."""
        for path in self.path.parent.glob(f".{self.path.name}.*.tmp"):
            path.unlink()
        named = {Path(path).name for touch in touches for path in (*touch.pictures, *touch.background)}
        for folder in self.path.parent.iterdir():
            if folder.is_dir() and not folder.is_symlink():
                files = list(folder.iterdir())
                doomed = [file for file in files if file.name not in named and _PICTURE.fullmatch(file.name)]
                for file in doomed:
                    file.unlink()
                if len(doomed) == len(files):
                    folder.rmdir()

    def replace_codes(self, key: str, codes: Mapping[tuple[str, ...], bytes], keep: Collection[str] = ()) -> None:
        """Add codes under the key of a model, by the gel images' paths; with `keep`, delete those under other keys."""
        with self.lock() as touches:
            changed = []
            for touch in touches:
                own = {name: code for name, code in touch.codes.items() if not keep or name in keep}
                if touch.pictures in codes:
                    own[key] = codes[touch.pictures]
                changed.append(msgspec.structs.replace(touch, codes=own))
            if changed != touches:
                self.replace(changed)


class Removal(NamedTuple):
    """The object whose enrolled touches were deleted, and their number."""

    object_id: str
    touches: int


def remove_enrolled(index: str | Path, object_id: str, *, pictures: Collection[str] | None = None) -> Removal:
    """Delete enrolled touches of an object; the photos and touches of the catalogue stay.

    Args:
        index: Folder of the index.
        object_id: The object: exactly so, or the only one with its `lookup_key`.
        pictures: SHA-256 of gel images whose touches are deleted. Default: all touches of the object.

    Raises:
        BadInput: No touch of the object is enrolled.
        IndexesError: The table is damaged or cannot be written.

    >>> retrieval.enrol("index", "cup", ["a.png", "b.png"]).touches
    1
    >>> retrieval.remove_enrolled("index", "cup")
    Removal(object_id='cup', touches=1)
    """
    table = EnrolledTable(Path(index))
    if table.version() is None:
        raise BadInput(f"{index} has no enrolled touches; `retrieve enrol OBJECT --gelsight ...` enrols them")
    with table.lock() as touches:
        names = sorted({touch.object_id for touch in touches})
        like = [name for name in names if lookup_key(name) == lookup_key(object_id)]
        if object_id not in names and len(like) != 1:
            raise BadInput(
                f"no touch of {object_id!r} is enrolled in {index}; objects with enrolled touches: "
                f"{abbreviate_list(like or names, MAX_EXAMPLES) or 'none'}"
            )
        name = object_id if object_id in names else like[0]
        kept = [
            touch
            for touch in touches
            if touch.object_id != name or (pictures is not None and set(pictures).isdisjoint(touch.digests))
        ]
        table.replace(kept)
    return Removal(name, len(touches) - len(kept))
