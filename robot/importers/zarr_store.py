"""Arrays of untrusted zarr stores, version 2: read without groups, without pickle, one step at a time.

The metadata of an array is checked before zarr reads it: its type, its size, and the codec of its chunks. A filter, or
a type of Python objects, would let a store run a codec of its choice, including pickle.
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
"""Maximum bytes of a chunk, which is read into memory as a whole."""
_MAX_ARRAY_BYTES = 64 * 2**20
"""Maximum bytes of an array with one entry per episode."""
_MAX_JSON_BYTES = 16 * 2**20


class ZarrStore:
    """One store: a folder, or a .zip file of it."""

    def __init__(self, path: Path) -> None:
        """Open the store.

        Args:
            path: Folder or .zip file.

        Raises:
            ImporterError: The file is not a .zip file, or a file in it is too large.
        """
        self.path = path
        self.name = safe_name(path.name.removesuffix(".zip").removesuffix(".zarr"))
        self._zip = None
        try:
            self._zip = None if path.is_dir() else zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise ImporterError(f"{path} cannot be read as a zip file: {error}") from error
        if self._zip and any(file.file_size > _MAX_CHUNK_BYTES for file in self._zip.infolist()):
            raise ImporterError(f"{path} contains files of more than {_MAX_CHUNK_BYTES} bytes, the maximum of a chunk")
        # A .zip file can contain the store itself, or the folder of the store.
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
        """Return the paths of its arrays, sorted. Its groups can be implicit."""
        return sorted(self._names)

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the root; empty if there are none."""
        try:
            return self._json(".zattrs")
        except ImporterError:
            return {}

    def texts(self, name: str) -> list[str]:
        """Return the distinct texts of a small array, in order; none if the array is missing."""
        if name not in self._names:
            return []
        values = self.array(name, kind="US").all().ravel().tolist()
        return list(
            dict.fromkeys(text.decode("utf-8", "replace") if isinstance(text, bytes) else text for text in values)
        )

    def array(self, name: str, *, ndim: int | None = None, kind: str) -> "ZarrArray":
        """Open an array after checks of its metadata.

        Args:
            name: Path of the array in the store.
            ndim: Required number of axes; None for any.
            kind: Accepted letters of NumPy's kinds; "u1" for bytes.

        Raises:
            ImporterError: The array is damaged, too large or of another type.
        """
        metadata = self._json(f"{name}/.zarray")
        label = f"{self.path.name}/{name}"
        try:
            shape, chunks = ([int(size) for size in metadata[key]] for key in ("shape", "chunks"))
            dtype = np.dtype(metadata["dtype"])
        except (KeyError, TypeError, ValueError) as error:
            raise ImporterError(f"{label} must define shape, chunks and dtype in its .zarray: {error}") from error
        is_accepted = dtype == np.uint8 if kind == "u1" else dtype.kind in kind
        if not is_accepted or (ndim is not None and len(shape) != ndim):
            raise ImporterError(f"{label} has type {dtype} and {len(shape)} axes, which this importer does not read")
        if min([*shape, *chunks], default=1) < 0 or len(shape) != len(chunks) or 0 in chunks:
            raise ImporterError(f"{label} has the invalid shape {shape} in chunks of {chunks}")
        size = math.prod(chunks) * dtype.itemsize
        total = math.prod(shape) * dtype.itemsize
        if size > _MAX_CHUNK_BYTES or (kind != "u1" and total > _MAX_ARRAY_BYTES):
            raise ImporterError(f"{label} is too large: chunks of {size} bytes, {total} in total")
        codec = metadata.get("compressor")
        is_known = codec is None or (isinstance(codec, dict) and codec.get("id") in _CODECS)
        if metadata.get("zarr_format") != 2 or metadata.get("filters") or not is_known:
            raise ImporterError(
                f"{label} must be zarr version 2 without filters, with one of these codecs: {', '.join(_CODECS)}"
            )
        separator = "/" if metadata.get("dimension_separator") == "/" else "."
        first = separator.join(["{}", *["0"] * (len(shape) - 1)])
        return ZarrArray(self._open(name), label, lambda index: self._has(f"{name}/{first.format(index // chunks[0])}"))

    def _open(self, name: str) -> Any:
        zarr = import_extra("zarr", "zarr stores")
        try:
            store = zarr.storage.ZipStore(self.path, mode="r") if self._zip else str(self.path)
            return zarr.open_array(store, path=self._top + name, mode="r", zarr_format=2)
        except Exception as error:  # zarr, numcodecs and asyncio raise many types for damaged stores
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
        except Exception as error:  # zipfile passes on errors of zlib, bz2 and lzma
            raise ImporterError(f"{self.path.name}/{name} cannot be read: {error}") from error
        if not isinstance(found, dict):
            raise ImporterError(f"{self.path.name}/{name} must be a JSON object")
        return found


class ZarrArray:
    """A checked array, read in parts."""

    def __init__(self, array: Any, label: str, has: Callable[[int], bool]) -> None:
        self._array, self._label, self._has = array, label, has
        self.shape: tuple[int, ...] = tuple(array.shape)

    def step(self, index: int) -> NDArray[Any]:
        """Return the values at one index of the first axis.

        Raises:
            ImporterError: The chunk is damaged or missing; zarr would return zeros for a missing one.
        """
        if not self._has(index):
            raise ImporterError(f"a chunk of {self._label} is missing")
        return self._read(index)

    def all(self) -> NDArray[Any]:
        """Return the whole array.

        Raises:
            ImporterError: A chunk is damaged.
        """
        return self._read(...)

    def _read(self, index: Any) -> NDArray[Any]:
        try:
            return np.asarray(self._array[index])
        except Exception as error:
            raise ImporterError(f"{self._label} cannot be decoded: {type(error).__name__}") from error
