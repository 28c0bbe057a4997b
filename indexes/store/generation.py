"""A generation of an index: its folder is written as a whole, and opened for searching."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

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
from indexes.kinds.measure import query_ms, recall_against_exact, sample_queries
from indexes.kinds.vector_index import NORM_TOLERANCE, Floats, RowNumbers, VectorIndex, check_unit, row_norms
from indexes.store.manifest import Manifest, check_files, file_checksums, read_manifest, write_manifest
from indexes.store.rows import TABLE, TEXT, Row, Rows, read_rows, write_rows

EMBEDDINGS, STRUCTURE = "embeddings", "vectors.faiss"
RECALL_AT, RECALL_QUERIES = 10, 100
TIMED_QUERIES = 20

Arrays = Mapping[str, NDArray[Any]]
"""Name to per-row array (N, ...)."""


@dataclass(frozen=True)
class GenerationContent:
    """What a generation contains.

    Attributes:
        rows: The N rows, sorted by path.
        blocks: Arrays of consecutive rows by name, (n, ...) each; "embeddings" are unit vectors (n, d) float32.
        fingerprint: Origin of the vectors, compared by `IndexStore.open(expect=...)`.
        kind: Name of the kind of index.
        documents: Name to JSON document or array.
        about: Further entries of the manifest.
        measure: Returns more such entries, from the index and its arrays, when they are on the disk.
        queries: Unit vectors (Q, d) to measure recall with; None to draw them near the vectors of the index.
        software: Version of the writing software.
        threads: Number of threads; None for the library's own setting.
    """

    rows: Sequence[Row]
    blocks: Iterable[Arrays]
    fingerprint: Mapping[str, str]
    kind: str = "flat"
    documents: Mapping[str, Any] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)
    measure: Callable[[VectorIndex, Arrays], Mapping[str, Any]] | None = None
    queries: Floats | None = None
    software: str = ""
    threads: int | None = None


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

    def search(self, queries: Floats, k: int) -> tuple[Floats, RowNumbers]:
        """Return scores and rows of the best k rows for each query, as `VectorIndex.search`."""
        return self.index.search(queries, k)


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


def write_generation(folder: Path, name: str, content: GenerationContent) -> None:
    """Write a generation into an empty folder, the manifest last.

    Args:
        folder: The folder.
        name: Name of the generation.
        content: Its content.

    Raises:
        RowError: A row, array or document is invalid.
        VectorError: A vector is invalid.
        ParameterError: The kind needs more vectors.
    """
    write_rows(folder, content.rows)
    arrays = _write_arrays(folder, content)
    for document, value in content.documents.items():
        is_array = isinstance(value, np.ndarray)
        with files.durable_file(folder / f"{document}.{'npy' if is_array else 'json'}") as file:
            if is_array:
                np.save(file, value)
            else:
                file.write(files.encoded(value, indent=2) + b"\n")
    vectors = arrays.pop(EMBEDDINGS)
    index = load_kind(content.kind).build(vectors, content.kind, threads=content.threads)
    if index.save(folder / STRUCTURE):
        files.sync(folder / STRUCTURE)
    about = {**content.about, **(content.measure(index, arrays) if content.measure else {})}
    manifest = Manifest(
        generation=name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=content.software,
        fingerprint=dict(content.fingerprint),
        about=about,
        dim=index.dim,
        kind=content.kind,
        recall=_recall(index, content.queries),
        photos=len(content.rows),
        objects=len({row.object_id for row in content.rows}),
        arrays=sorted(arrays),
        documents=sorted(content.documents),
        files=file_checksums(folder),
    )
    write_manifest(folder, manifest)
    files.sync(folder)


def _write_arrays(folder: Path, content: GenerationContent) -> dict[str, NDArray[Any]]:
    """Write the blocks to `.npy` files, with one block in memory at a time, and return the arrays, memory-mapped."""
    count, names = len(content.rows), list[str]()
    with ExitStack() as stack:
        done, opened = 0, {}
        for block in content.blocks:
            _check_block(block, content.rows[done : done + len(block[EMBEDDINGS])])
            for name, array in block.items():
                if not done:
                    opened[name] = stack.enter_context(files.durable_file(folder / f"{name}.npy"))
                    header = {"descr": array.dtype.str, "fortran_order": False, "shape": (count, *array.shape[1:])}
                    np.lib.format.write_array_header_1_0(opened[name], header)
                opened[name].write(np.ascontiguousarray(array).data)
            names, done = list(opened), done + len(block[EMBEDDINGS])
        if done != count:
            raise RowError(f"every row needs an embedding; got {done} for {count} rows")
    return {name: _open_array(folder / f"{name}.npy") for name in names}


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


def _recall(index: VectorIndex, queries: Floats | None) -> dict[str, Any]:
    """Return recall and time of a kind next to those of exact search."""
    if index.exact:
        return {"value": 1.0, "at": RECALL_AT, "queries": 0, "how": "exact by construction"}
    how = "measured on displaced vectors of the index" if queries is None else "measured on the given queries"
    if queries is None:
        queries = sample_queries(index.vectors, RECALL_QUERIES)
    exact = load_kind("flat").build(index.vectors, "flat", threads=index.threads)
    times = {"ms": query_ms(index, queries[:TIMED_QUERIES]), "exact_ms": query_ms(exact, queries[:TIMED_QUERIES])}
    value = recall_against_exact(index, queries, RECALL_AT)
    return {"value": value, "at": RECALL_AT, "queries": len(queries), "how": how, **times}


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
