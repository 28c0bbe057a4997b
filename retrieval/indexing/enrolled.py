"""Touches that were enrolled in an index: their pictures and one table, for all generations.

    enrolled/touches.json             the table, replaced as a whole
    enrolled/<object>/<digest>.png    pictures: gel images and no-contact frames
    enrolled/LOCK                     locked by the writer; other writers wait

A writer flushes the pictures to the disk before the table that names them. If it is killed at any moment, the old or
the new table is complete; the next writer deletes pictures that no table names. Readers take no lock. A sharded index
has one table for all shards.
"""

import hashlib
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import msgspec
import numpy as np
from msgspec import Meta, Raw, Struct
from numpy.typing import NDArray

from _touch_retrieval.files import durable_file, read_regular, sync, write_atomically
from _touch_retrieval.names import lookup_key
from indexes.errors import CorruptIndex, WriteFailed
from indexes.store.locking import writer_lock
from retrieval.console.output import abbreviate_list
from retrieval.data.opening import RANGE_MM
from retrieval.errors import BadInput
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint

FORMAT = 1
ENROLLED = "enrolled"
"""Folder in an index with the pictures of enrolled touches."""
_PICTURE = re.compile(r"[0-9a-f]{20}\.[a-z]+")
_Path = Annotated[str, Meta(pattern=rf"^{ENROLLED}/[^./][^/\0]*/{_PICTURE.pattern}\Z")]
_Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class EnrolledTouch(Struct, frozen=True, omit_defaults=True):
    """One enrolled touch.

    Attributes:
        object_id: The object.
        pictures: Path of each gel image in the folder of the index, in finger order, with the SHA-256 of the file.
        codes: Partial activation without cells (pooled_width,) as float16, by `model_key`.
        opening_mm: Opening of the jaws; None if it was not measured.
        background: Paths of the no-contact frames; empty without them.
    """

    object_id: str
    pictures: Annotated[dict[_Path, _Digest], Meta(min_length=1)]
    codes: dict[str, bytes]
    opening_mm: Annotated[float, Meta(ge=RANGE_MM[0], le=RANGE_MM[1])] | None = None
    background: tuple[_Path, ...] = ()

    @property
    def path(self) -> str:
        """The path of its first gel image, which names the touch."""
        return next(iter(self.pictures))


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


def content_digest(data: bytes | Raw) -> str:
    """Return the SHA-256 of a file's content in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def picture_path(object_id: str, data: bytes) -> str:
    """Return the path of a picture of an object in the folder of the index; its content names it, not the folder."""
    extension = "png" if data.startswith(b"\x89PNG") else "jpg" if data.startswith(b"\xff\xd8") else "picture"
    folder = quote(object_id, safe="")[:80].replace(".", "_")
    return f"{ENROLLED}/{folder}/{content_digest(data)[:20]}.{extension}"


class EnrolledTable:
    """The enrolled touches of an index folder or of a sharded index.

    Args:
        index: Its folder.
        owns: Selects the objects of `read`; None for all.
    """

    def __init__(self, index: Path, owns: Callable[[str], bool] | None = None) -> None:
        self.index, self._owns, self.path = index, owns, index / ENROLLED / "touches.json"

    def version(self) -> tuple[int, int, int] | None:
        """Return numbers that change with the table; None without one."""
        with suppress(FileNotFoundError):
            status = self.path.stat()
            return status.st_ino, status.st_size, status.st_mtime_ns
        return None

    def read(self) -> list[EnrolledTouch]:
        """Return all touches. Raises CorruptIndex."""
        try:
            table = msgspec.json.decode(read_regular(self.path), type=_Table)
            if (table.format, table.sha256) != (FORMAT, content_digest(table.touches)):
                raise ValueError("its format is unknown or its SHA-256 differs")
            touches = msgspec.json.decode(table.touches, type=list[EnrolledTouch])
        except FileNotFoundError:
            return []
        except (OSError, ValueError, RecursionError) as error:
            raise CorruptIndex(
                f"{self.path}: the table of enrolled touches is damaged ({error}); restore it from a backup, or "
                f"rename the folder {self.path.parent} and enrol again from its pictures"
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
        table = _Table(FORMAT, content_digest(content), Raw(content))
        try:
            for path, data in (files or {}).items():
                (self.index / path).parent.mkdir(exist_ok=True)
                if (self.index / path).is_file() and (self.index / path).read_bytes() == data:
                    sync(self.index / path)  # of other touches, such as their no-contact frame: never truncate it
                    continue
                with durable_file(self.index / path) as file:
                    file.write(data)
                sync((self.index / path).parent)
            sync(self.path.parent)
            sync(self.index)
            write_atomically(self.path, msgspec.json.encode(table))
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: writing failed ({error.strerror or error}); repeat it") from error
        finally:
            with suppress(OSError):  # else the next writer deletes them
                self._delete_unused()

    def _delete_unused(self) -> None:
        """Delete pictures that no touch names, empty folders, and the unfinished tables of killed writers."""
        named = {path.casefold() for touch in self.read() for path in (*touch.pictures, *touch.background)}
        for folder, _, names in os.walk(self.path.parent):  # much faster than `Path.glob`
            for name in names:
                is_named = f"{ENROLLED}/{os.path.basename(folder)}/{name}".casefold() in named  # some disks ignore case
                if not is_named and (_PICTURE.fullmatch(name) or name.startswith(f".{self.path.name}.")):
                    os.unlink(os.path.join(folder, name))
                    with suppress(OSError):  # it has other files
                        os.rmdir(folder)

    def replace_codes(self, codes: Mapping[str, bytes], key: str, keep: Collection[str] | None = None) -> None:
        """Add codes of a model by the path of each touch; with `keep`, delete those under all other keys."""
        with self.lock() as touches:
            changed = []
            for touch in touches:
                kept = {name: code for name, code in touch.codes.items() if keep is None or name in keep}
                new = {key: codes[touch.path]} if touch.path in codes else {}
                changed.append(msgspec.structs.replace(touch, codes=kept | new))
            if changed != touches:
                self.replace(changed)


def remove_enrolled(index: str | Path, object_id: str, *, pictures: Collection[str] | None = None) -> tuple[str, int]:
    """Delete enrolled touches of an object; the photos and touches of the catalogue stay.

    Args:
        index: Folder of the index.
        object_id: The object: exactly so, or the only one with its `lookup_key`.
        pictures: SHA-256 of gel images whose touches are deleted. Default: all touches of the object.

    Returns:
        The object, and the number of its touches.

    Raises:
        BadInput: No touch of the object is enrolled.
        IndexesError: The table is damaged or cannot be written.

    >>> with retrieval.open("index") as searcher:
    ...     searcher.enrol("cup", ["a.png", "b.png"])
    Enrolment(object_id='cup', touches=1, added=1)
    >>> retrieval.remove_enrolled("index", "cup")
    ('cup', 1)
    """
    table = EnrolledTable(Path(index))
    names = sorted({touch.object_id for touch in table.read()})
    like = [name for name in names if lookup_key(name) == lookup_key(object_id)]
    if object_id not in names and len(like) != 1:
        raise BadInput(
            f"no touch of {object_id!r} is enrolled in {index}; objects with enrolled touches: "
            f"{abbreviate_list(like or names) or 'none'}"
        )
    name = object_id if object_id in names else like[0]
    with table.lock() as touches:
        kept = [
            touch
            for touch in touches
            if touch.object_id != name or (pictures is not None and set(pictures).isdisjoint(touch.pictures.values()))
        ]
        table.replace(kept)
    return name, len(touches) - len(kept)
