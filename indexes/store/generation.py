"""A generation of an index: its folder is written part by part, and opened for searching as a whole."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
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
from indexes.kinds.measure import measured_recall
from indexes.kinds.vector_index import NORM_TOLERANCE, Floats, VectorIndex, check_unit, row_norms
from indexes.store.manifest import Manifest, check_files, file_checksums, read_manifest, write_manifest
from indexes.store.rows import TABLE, TEXT, Row, Rows, read_rows, write_rows

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
    >>> generation = indexes.IndexStore("searched").write(rows, np.eye(2, dtype=np.float32))
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
    def name(self) -> str:
        """The generation's name, such as gen-000007."""
        return self.manifest.generation

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def fingerprint(self) -> dict[str, str]:
        """Origin of the vectors: digests of the checkpoint and the preprocessing."""
        return self.manifest.fingerprint

    def require(self, expect: Mapping[str, str]) -> None:
        """Check that the fingerprint has these values. Raises `MismatchedIndex` with the first difference."""
        check_fingerprint(self.folder.parent, self.fingerprint, expect)


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


class Draft:
    """A generation while it is written, each part once: rows, arrays, documents, index, and at last the manifest.

    `IndexStore.draft` makes it. Only one block of arrays is in memory at a time.

    Attributes:
        folder: Its temporary folder.
        name: Name of the generation.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self._rows: Sequence[Row] = ()
        self._arrays: list[str] = []
        self._documents: list[str] = []
        self._index: VectorIndex | None = None
        self._recall: dict[str, Any] = {}

    def write_rows(self, rows: Sequence[Row]) -> None:
        """Write the N rows, sorted by path. Raises RowError if a row is invalid, or there is none."""
        write_rows(self.folder, rows)
        self._rows = rows

    def write_arrays(self, blocks: Iterable[Arrays]) -> dict[str, NDArray[Any]]:
        """Write arrays of consecutive rows, and return the whole arrays (N, ...), memory-mapped.

        Args:
            blocks: Arrays (n, ...) by name; "embeddings" are unit vectors (n, d) float32.

        Raises:
            RowError: An array has not one entry for each row, or one that is not finite.
            VectorError: A vector is invalid.
        """
        count, done, opened = len(self._rows), 0, dict[str, BinaryIO]()
        with ExitStack() as stack:
            for block in blocks:
                _check_block(block, self._rows[done : done + len(block[EMBEDDINGS])])
                for name, array in block.items():
                    if not done:
                        opened[name] = stack.enter_context(files.durable_file(self.folder / f"{name}.npy"))
                        header = {"descr": array.dtype.str, "fortran_order": False, "shape": (count, *array.shape[1:])}
                        np.lib.format.write_array_header_1_0(opened[name], header)
                    opened[name].write(np.ascontiguousarray(array).data)
                done += len(block[EMBEDDINGS])
            if done != count:
                raise RowError(f"every row needs an embedding; got {done} for {count} rows")
        self._arrays = [name for name in opened if name != EMBEDDINGS]
        return {name: _open_array(self.folder / f"{name}.npy") for name in opened}

    def write_documents(self, documents: Mapping[str, Any]) -> None:
        """Write JSON documents and arrays by name."""
        for name, value in documents.items():
            is_array = isinstance(value, np.ndarray)
            with files.durable_file(self.folder / f"{name}.{'npy' if is_array else 'json'}") as file:
                if is_array:
                    np.save(file, value)
                else:
                    file.write(json.dumps(value, allow_nan=False, indent=2).encode() + b"\n")
        self._documents = sorted(documents)

    def build_index(
        self, embeddings: Floats, kind: str, *, queries: Floats | None = None, threads: int | None = None
    ) -> VectorIndex:
        """Build and write the index over the embeddings (N, d), and measure its recall.

        Args:
            embeddings: The embeddings that `write_arrays` returned.
            kind: Name of the kind.
            queries: Unit vectors (Q, d) to measure recall with; None to draw them near the embeddings.
            threads: Number of threads; None for the library's own setting.

        Raises:
            ParameterError: The kind is unknown or needs more vectors.
        """
        index = load_kind(kind).build(embeddings, kind, threads=threads)
        if index.save(self.folder / STRUCTURE):
            files.sync(self.folder / STRUCTURE)
        self._index, self._recall = index, measured_recall(index, queries)
        return index

    def finish(
        self,
        *,
        fingerprint: Mapping[str, str] | None = None,
        about: Mapping[str, Any] | None = None,
        software: str = "",
    ) -> Manifest:
        """Write the manifest, and return it.

        Args:
            fingerprint: Origin of the vectors, compared by `IndexStore.open(expect=...)`.
            about: Further entries of the manifest.
            software: Version of the writing software.
        """
        assert self._index is not None, "build_index comes before finish"
        manifest = Manifest(
            generation=self.name,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            software=software,
            fingerprint=dict(fingerprint or {}),
            about=dict(about or {}),
            dim=self._index.dim,
            kind=self._index.kind,
            recall=self._recall,
            photos=len(self._rows),
            objects=len({row.object_id for row in self._rows}),
            arrays=sorted(self._arrays),
            documents=self._documents,
            files=file_checksums(self.folder),
        )
        write_manifest(self.folder, manifest)
        files.sync(self.folder)
        return manifest


def _check_block(block: Arrays, rows: Sequence[Row]) -> None:
    paths = [row.path for row in rows]
    check_unit(block[EMBEDDINGS], names=paths)
    for name, array in block.items():
        if len(array) != len(rows):
            raise RowError(f"array {name!r} must have one entry for each of {len(rows)} rows; got {len(array)}")
        finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        if not finite.all():
            row = paths[int(np.argmin(finite))]
            raise RowError(f"array {name!r}: row {row!r} has NaN or infinity (too large for its type?)")


def read_generation(folder: Path, *, verify: bool, threads: int | None = None) -> Generation:
    """Open and check a generation's folder, as `IndexStore.open`.

    Args:
        folder: The folder.
        verify: Compare the SHA-256 of the files.
        threads: Number of threads of a search; None for the library's own setting.
    """
    manifest = read_manifest(folder)
    tables = {TEXT, TABLE, *(f"{name}.npy" for name in (EMBEDDINGS, *manifest.arrays))}
    if missing := sorted(tables - manifest.files.keys()):
        raise CorruptIndex(f"{folder}: the manifest must list {missing[0]}, but does not; {AGAIN}")
    check_files(folder, manifest, verify=verify)
    try:
        rows, embeddings = read_rows(folder), _open_array(folder / f"{EMBEDDINGS}.npy")
        arrays = {name: _open_array(folder / f"{name}.npy") for name in manifest.arrays}
        documents = {name: _document(folder, name, manifest) for name in manifest.documents}
        got = (
            len(rows),
            rows.object_count,
            *embeddings.shape,
            embeddings.dtype,
            *{len(one) for one in arrays.values()},
        )
        must = (
            manifest.photos,
            manifest.objects,
            manifest.photos,
            manifest.dim,
            np.float32,
            *[len(rows)] * bool(arrays),
        )
        if got != must:
            raise CorruptIndex(f"{folder}: the manifest states {must}, but the files have {got}; {AGAIN}")
        if verify and not (np.abs(row_norms(embeddings) - 1.0) <= NORM_TOLERANCE).all():
            raise CorruptIndex(f"{folder}: every vector must be finite and have norm 1, but one is not; {AGAIN}")
        index = load_kind(manifest.kind).load(folder / STRUCTURE, embeddings, manifest.kind, threads=threads)
        return Generation(folder, manifest, rows, arrays, documents, index)
    except ParameterError as error:
        raise UnsupportedFormat(f"{folder}: {error}. Update the software, or {AGAIN}") from error
    except IndexesError:
        raise
    except Exception as error:  # damaged files raise various errors: OSError, ValueError, KeyError, SyntaxError
        raise CorruptIndex(f"{folder}: cannot be read ({type(error).__name__}: {error}); {AGAIN}") from error


def _document(folder: Path, name: str, manifest: Manifest) -> Any:
    return (
        _open_array(folder / f"{name}.npy") if f"{name}.npy" in manifest.files else read_json(folder / f"{name}.json")
    )


def _open_array(path: Path) -> NDArray[Any]:
    array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array
