"""Arrays of zarr stores of version 2 that strangers made: read without groups, without pickle, a step at a time.

What an array says of itself is checked before zarr sees it: its type, its size, and the codec of its chunks. A filter,
or a type of Python objects, would let a store run a codec of its choice, pickle among them.
"""

import json
import math
import zipfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.importing import import_extra, safe_name

_CODECS = ("blosc", "bz2", "gzip", "lz4", "lzma", "zlib", "zstd")
_MAX_CHUNK_BYTES = 512 * 2**20
"""Bytes of a chunk, which is in memory whole."""
_MAX_ARRAY_BYTES = 64 * 2**20
"""Bytes of an array along episodes."""
_MAX_JSON_BYTES = 16 * 2**20


class ZarrStore:
    """One store, a folder or a .zip file of it."""

    def __init__(self, path: Path) -> None:
        """Raises ImporterError for a file that is no .zip."""
        self.path = path
        self.name = safe_name(path.name.removesuffix(".zip").removesuffix(".zarr"))
        self._zip = None
        try:
            self._zip = None if path.is_dir() else zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise ImporterError(f"{path} cannot be read as a zip file: {error}") from error
        if self._zip and any(file.file_size > _MAX_CHUNK_BYTES for file in self._zip.infolist()):
            raise ImporterError(f"{path} holds files of more than {_MAX_CHUNK_BYTES} bytes, which no chunk may have")
        # A .zip may hold the store itself, or the folder with it.
        tops = {name.split("/")[0] for name in self._zip.namelist()} if self._zip else set()
        self._top = f"{tops.pop()}/" if len(tops) == 1 else ""

    @cached_property
    def _names(self) -> frozenset[str]:
        if self._zip:
            files = [name.removeprefix(self._top) for name in self._zip.namelist() if name.endswith("/.zarray")]
        else:
            files = [path.relative_to(self.path).as_posix() for path in self.path.glob("*/*/.zarray")]
        return frozenset(name.removesuffix("/.zarray") for name in files)

    def names(self) -> list[str]:
        """Paths of its arrays, sorted: its groups may be implicit."""
        return sorted(self._names)

    def attributes(self) -> dict[str, Any]:
        """What the root says of itself; nothing where it says nothing."""
        try:
            return self._json(".zattrs")
        except ImporterError:
            return {}

    def texts(self, name: str) -> list[str]:
        """The distinct texts of a small array, in order; none where there is no such array."""
        if name not in self._names:
            return []
        found = self.array(name, kind="US").all().ravel().tolist()
        return list(
            dict.fromkeys(text.decode("utf-8", "replace") if isinstance(text, bytes) else text for text in found)
        )

    def array(self, name: str, *, ndim: int | None = None, kind: str) -> "ZarrArray":
        """Open an array. kind: letters of NumPy's kinds that are taken, "u1" for bytes. Raises ImporterError."""
        about = self._json(f"{name}/.zarray")
        where = f"{self.path.name}/{name}"
        try:
            shape, chunks = ([int(n) for n in about[key]] for key in ("shape", "chunks"))
            dtype = np.dtype(about["dtype"])
        except (KeyError, TypeError, ValueError) as error:
            raise ImporterError(f"{where} must say shape, chunks and dtype in its .zarray: {error}") from error
        wanted = dtype == np.uint8 if kind == "u1" else dtype.kind in kind
        if not wanted or (ndim is not None and len(shape) != ndim):
            raise ImporterError(
                f"{where} has the type {dtype} and {len(shape)} axes, which this importer does not read"
            )
        if min([*shape, *chunks], default=1) < 0 or len(shape) != len(chunks) or 0 in chunks:
            raise ImporterError(f"{where} has the shape {shape} in chunks of {chunks}, which is none")
        size = math.prod(chunks) * dtype.itemsize
        whole = math.prod(shape) * dtype.itemsize
        if size > _MAX_CHUNK_BYTES or (kind != "u1" and whole > _MAX_ARRAY_BYTES):
            raise ImporterError(f"{where} is too large: chunks of {size} bytes, {whole} in all")
        codec = about.get("compressor")
        known = codec is None or (isinstance(codec, dict) and codec.get("id") in _CODECS)
        if about.get("zarr_format") != 2 or about.get("filters") or not known:
            raise ImporterError(f"{where} must be zarr of version 2 without filters, in one of {', '.join(_CODECS)}")
        separator = "/" if about.get("dimension_separator") == "/" else "."
        first = separator.join(["{}", *["0"] * (len(shape) - 1)])
        return ZarrArray(self._open(name), where, lambda at: self._has(f"{name}/{first.format(at // chunks[0])}"))

    def _open(self, name: str) -> Any:
        zarr = import_extra("zarr", "zarr stores")
        try:
            store = zarr.storage.ZipStore(self.path, mode="r") if self._zip else str(self.path)
            return zarr.open_array(store, path=self._top + name, mode="r", zarr_format=2)
        except Exception as error:  # of zarr, numcodecs, asyncio: whatever a damaged store calls up
            raise ImporterError(f"{self.path.name}/{name} cannot be opened: {error}") from error

    def _has(self, name: str) -> bool:
        return self._top + name in self._zip.NameToInfo if self._zip else (self.path / name).is_file()

    def _json(self, name: str) -> dict[str, Any]:
        try:
            if self._zip:
                with self._zip.open(self._top + name) as file:
                    text = file.read(_MAX_JSON_BYTES)
            else:
                with open(self.path / name, "rb") as file:
                    text = file.read(_MAX_JSON_BYTES)
            found = json.loads(text)
        except Exception as error:  # zipfile lets out what zlib, bz2 and lzma raise
            raise ImporterError(f"{self.path.name}/{name} cannot be read: {error}") from error
        if not isinstance(found, dict):
            raise ImporterError(f"{self.path.name}/{name} must be a JSON object")
        return found


class ZarrArray:
    """A checked array: indexing reads what is asked for."""

    def __init__(self, array: Any, where: str, has: Callable[[int], bool]) -> None:
        self._array, self._where, self._has = array, where, has
        self.shape: tuple[int, ...] = tuple(array.shape)

    def step(self, at: int) -> NDArray[Any]:
        """What stands at one place of the first axis. Raises ImporterError where its chunk is damaged or not there,
        which zarr would take for one full of zeros.
        """
        if not self._has(at):
            raise ImporterError(f"a chunk of {self._where} is missing")
        return self._read(at)

    def all(self) -> NDArray[Any]:
        """The whole array. Raises ImporterError."""
        return self._read(...)

    def _read(self, at: Any) -> NDArray[Any]:
        try:
            return np.asarray(self._array[at])
        except Exception as error:
            raise ImporterError(f"{self._where} cannot be decoded: {type(error).__name__}") from error
