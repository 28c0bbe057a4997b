"""A generation of an index: its folder is written part by part, and opened for searching as a whole."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval import files
from _touch_retrieval.files import read_json
from indexes import load_kind
from indexes.errors import (
    AGAIN,
    CorruptIndex,
    IndexesError,
    MismatchedIndex,
    ParameterError,
    RowError,
    UnsupportedFormat,
)
from indexes.kinds.vector_index import VectorIndex, check_unit
from indexes.store.manifest import Manifest, check_files, read_manifest
from indexes.store.rows import Row, Rows, read_rows, write_rows

EMBEDDINGS, STRUCTURE = "embeddings", "vectors.faiss"

Arrays = Mapping[str, NDArray[Any]]
"""Name to per-row array (N, ...)."""


class Generation:
    """An opened generation. It stays usable, with its arrays, when a writer replaces and deletes it on the disk.

    Attributes:
        rows: The N rows in the order of their paths, parsed on access.
        embeddings: Unit vectors (N, d) float32, memory-mapped.
        arrays: Name to per-row array (N, ...), memory-mapped.
        documents: Name to JSON document or memory-mapped array.
        manifest: Content of `manifest.json`.
        index: Vector index over the embeddings.

    >>> import numpy as np
    >>> rows = [indexes.Row("mug/1.jpg", "mug", "1"), indexes.Row("tin/1.jpg", "tin", "2")]
    >>> store = indexes.IndexStore("searched")
    >>> manifest = store.write(rows, [{"embeddings": np.eye(2, dtype=np.float32)}])
    >>> generation = store.open()
    >>> scores, numbers = generation.index.search(np.float32([[0.6, 0.8]]), 1)
    >>> generation.rows[int(numbers[0, 0])].object_id, round(float(scores[0, 0]), 3)
    ('tin', 0.8)
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        rows: Rows,
        arrays: Arrays,
        documents: Mapping[str, Any],
        index: VectorIndex,
    ) -> None:
        self.folder, self.manifest, self.rows, self.documents, self.index = folder, manifest, rows, documents, index
        self.arrays, self.embeddings = dict(arrays), index.vectors

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rows)


def check_fingerprint(where: str | Path, fingerprint: Mapping[str, str], expect: Mapping[str, str]) -> None:
    """Check that a fingerprint has these values.

    Args:
        where: The index, for the message.
        fingerprint: Its fingerprint.
        expect: Required values.

    Raises:
        MismatchedIndex: A value differs.
    """
    for key, value in expect.items():
        got = fingerprint.get(key)
        if got != value:
            raise MismatchedIndex(
                f"{where}: the index was made with {key} {got and got[:12]!r}, "
                f"but {value[:12]!r} is required; "
                f"use the model that made it, or {AGAIN}"
            )


def write_contents(
    folder: Path, rows: Sequence[Row], blocks: Iterable[Arrays], documents: Mapping[str, Any]
) -> dict[str, NDArray[Any]]:
    """Write rows, arrays and documents into the empty folder of a generation, as `IndexStore.write`.

    Returns:
        The arrays by name, memory-mapped.
    """
    write_rows(folder, rows)
    arrays = _write_arrays(folder, rows, blocks)
    for document, value in documents.items():
        with files.durable_file(folder / f"{document}.{'npy' if isinstance(value, np.ndarray) else 'json'}") as file:
            if isinstance(value, np.ndarray):
                np.save(file, value)
            else:
                file.write(json.dumps(value, allow_nan=False, indent=2).encode() + b"\n")
    return arrays


def _write_arrays(folder: Path, rows: Sequence[Row], blocks: Iterable[Arrays]) -> dict[str, NDArray[Any]]:
    """Write blocks of arrays, and return the whole arrays, memory-mapped; only one block is in memory at a time."""
    done, opened = 0, dict[str, BinaryIO]()
    with ExitStack() as stack:
        for block in blocks:
            paths = [row.path for row in rows[done : done + len(block[EMBEDDINGS])]]
            check_unit(block[EMBEDDINGS], names=paths)
            for name, array in block.items():
                if len(array) != len(paths):
                    raise RowError(
                        f"array {name!r} must have one entry for each of {len(paths)} rows; got {len(array)}"
                    )
                finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
                if not finite.all():
                    row = paths[int(np.argmin(finite))]
                    raise RowError(f"array {name!r}: row {row!r} has NaN or infinity (too large for its type?)")
                if not done:
                    opened[name] = stack.enter_context(files.durable_file(folder / f"{name}.npy"))
                    header = {"descr": array.dtype.str, "fortran_order": False, "shape": (len(rows), *array.shape[1:])}
                    np.lib.format.write_array_header_1_0(opened[name], header)
                opened[name].write(np.ascontiguousarray(array).data)
            done += len(paths)
        if done != len(rows):
            raise RowError(f"every row needs an embedding; got {done} for {len(rows)} rows")
    return {name: _open_array(folder / f"{name}.npy") for name in opened}


def read_generation(folder: Path, *, verify: bool) -> Generation:
    """Open and check a generation's folder, as `IndexStore.open`."""
    manifest = read_manifest(folder)
    check_files(folder, manifest, verify=verify)
    try:
        rows, arrays = read_rows(folder), {name: _open_array(folder / f"{name}.npy") for name in manifest.arrays}
        embeddings = _open_array(folder / f"{EMBEDDINGS}.npy")
        got = ({len(rows), *map(len, arrays.values())}, rows.object_count, embeddings.shape, embeddings.dtype)
        must = ({manifest.photos}, manifest.objects, (manifest.photos, manifest.dim), np.dtype(np.float32))
        if got != must:
            raise CorruptIndex(f"{folder}: the manifest states {must}, but the files have {got}; {AGAIN}")
        documents = {
            name: _open_array(folder / f"{name}.npy")
            if f"{name}.npy" in manifest.files
            else read_json(folder / f"{name}.json")
            for name in manifest.documents
        }
        index = load_kind(manifest.kind).load(folder / STRUCTURE, embeddings, manifest.kind)
        return Generation(folder, manifest, rows, arrays, documents, index)
    except ParameterError as error:
        raise UnsupportedFormat(f"{folder}: {error}. Update the software, or {AGAIN}") from error
    except IndexesError:
        raise
    except Exception as error:  # damaged files raise various errors: OSError, ValueError, KeyError, SyntaxError
        raise CorruptIndex(f"{folder}: cannot be read ({type(error).__name__}: {error}); {AGAIN}") from error


def _open_array(path: Path) -> NDArray[Any]:
    return np.asanyarray(np.load(path, mmap_mode="r", allow_pickle=False))
