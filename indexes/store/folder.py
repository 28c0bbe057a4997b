"""The index on disk: a folder of generations, one of them current.

    CURRENT               name of the current generation, the only file that is replaced
    gen-000007/           a generation: written under a temporary name, renamed; immutable afterwards
      manifest.json       its description, and size and SHA-256 of every other file; written last
      rows.jsonl          rows as lines of JSON
      rows.npy            for each row: end of its line, number of its object, first row with the same content
      embeddings.npy      (rows, d) float32, from which any kind of index is built
      NAME.npy            per-row arrays, and documents that are arrays
      vectors.faiss       structure of the index, for kinds that have one
      NAME.json           documents
    codes/                cache of the codes of photos, for all generations (`_touch_retrieval.cache`)
    LOCK                  locked by the writer

A generation is self-contained. You can copy its folder and a CURRENT file elsewhere; the copy is a complete index.

There is one writer and any number of readers. If a writer is killed at any moment, the old or the new generation is
current and complete; the next writer deletes the unfinished files.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from typing import Any

from _touch_retrieval import files
from _touch_retrieval.files import read_regular
from indexes import load_kind
from indexes.errors import AGAIN, CorruptIndex, NoIndex, WriteFailed
from indexes.kinds.measure import measured_recall
from indexes.kinds.vector_index import Floats, VectorIndex
from indexes.store.generation import EMBEDDINGS, STRUCTURE, Arrays, Generation, read_generation, write_contents
from indexes.store.locking import writer_lock
from indexes.store.manifest import FORMAT, FileChecksum, Manifest, encode_document
from indexes.store.manifest import NAME as MANIFEST
from indexes.store.rows import Row

GENERATION = re.compile(r"gen-(\d{6,})")
UNFINISHED_FOLDER = re.compile(r"gen-\d{6,}\.tmp-\d+")
"""Folders of killed writers: unfinished or partly deleted generations."""


class IndexStore:
    """The index in the folder `path`, which the first `write` creates.

    >>> import numpy as np
    >>> store = indexes.IndexStore("photos")
    >>> rows = [indexes.Row("mug/1.jpg", "mug", "1"), indexes.Row("tin/1.jpg", "tin", "2")]
    >>> blocks = [{"embeddings": np.eye(2, dtype=np.float32)}]
    >>> store.write(rows, blocks, fingerprint={"checkpoint": "abc"}).generation
    'gen-000001'
    >>> store.open().count
    2
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self._is_locked = Path(path), False

    def open(self, *, name: str | None = None, verify: bool = True) -> Generation:
        """Open and check a generation.

        Args:
            name: Its name; None for the current generation.
            verify: Compare the SHA-256 of the files; sizes are always checked.

        Raises:
            NoIndex: There is no index.
            CorruptIndex: A file is missing or damaged.
            UnsupportedFormat: The index has another format.
        """
        requested = name or self.current()
        try:
            return read_generation(self.path / requested, verify=verify)
        except CorruptIndex:
            if name is not None or self.current() == requested:
                raise
            # A writer replaced it while it was being read.
            return read_generation(self.path / self.current(), verify=verify)

    def current(self) -> str:
        """Return the name of the current generation, from CURRENT."""
        path = self.path / "CURRENT"
        try:
            text = read_regular(path).decode("ascii", "replace").strip()
        except OSError as error:
            raise NoIndex(
                f"{self.path}: there is no index here; run `retrieve build-index` first ({path.name}: {error.strerror})"
            ) from error
        if not GENERATION.fullmatch(text):
            raise CorruptIndex(f"{path}: must name a generation such as gen-000001, got {text!r}; {AGAIN}")
        return text

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the writer lock in the block: other writers get `LockedIndex`. `write` takes it if it is not held."""
        if self._is_locked:
            yield
            return
        with writer_lock(self.path / "LOCK"):
            self._is_locked = True
            try:
                yield
            finally:
                self._is_locked = False

    def write(
        self,
        rows: Sequence[Row],
        blocks: Iterable[Arrays],
        *,
        kind: str = "flat",
        documents: Mapping[str, Any] | None = None,
        queries: Floats | None = None,
        measure: Callable[[VectorIndex, Arrays], Mapping[str, Any]] | None = None,
        fingerprint: Mapping[str, str] | None = None,
        about: Mapping[str, Any] | None = None,
        software: str = "",
    ) -> Manifest:
        """Write a new generation, make it current, and return its manifest.

        After `WriteFailed` the current generation is the old or the new one, and complete. After any other error the
        index is unchanged.

        Args:
            rows: The N rows, sorted by path.
            blocks: Arrays of consecutive rows by name, (n, ...) of finite numbers; "embeddings" are unit vectors (n, d)
                float32. One block is in memory at a time.
            kind: Name of the kind of index.
            documents: Name to JSON document or array.
            queries: Unit vectors (Q, d) to measure recall with; None to draw them near the embeddings.
            measure: Returns further entries of `about` from the written index and arrays.
            fingerprint: Digests of what made the vectors (`check_fingerprint`).
            about: Further entries of the manifest.
            software: Version of the writing software.

        Raises:
            RowError: A row, array or document is invalid.
            VectorError: A vector is invalid.
            ParameterError: The kind is unknown or needs more vectors.
            LockedIndex: Another writer is writing the index.
            WriteFailed: A file could not be written.
        """
        documents = documents or {}
        with self.lock(), self._draft() as (folder, name):
            arrays = write_contents(folder, rows, blocks, documents)
            index = load_kind(kind).build(arrays[EMBEDDINGS], kind)
            if index.save(folder / STRUCTURE):
                files.sync(folder / STRUCTURE)
            manifest = Manifest(
                generation=name,
                created=datetime.now(UTC).isoformat(timespec="seconds"),
                software=software,
                fingerprint=dict(fingerprint or {}),
                about={**(about or {}), **(measure(index, arrays) if measure else {})},
                dim=index.dim,
                kind=index.kind,
                recall=measured_recall(index, queries),
                photos=len(rows),
                objects=len({row.object_id for row in rows}),
                arrays=sorted(arrays.keys() - {EMBEDDINGS}),
                documents=sorted(documents),
                files={
                    path.name: FileChecksum(path.stat().st_size, files.file_digest(path))
                    for path in sorted(folder.iterdir())
                },
            )
            with files.durable_file(folder / MANIFEST) as file:
                file.write(encode_document(manifest, FORMAT))
            files.sync(folder)
        return manifest

    @contextmanager
    def _draft(self) -> Iterator[tuple[Path, str]]:
        """Yield a temporary folder and the name of the next generation; make it current when the block ends."""
        try:
            numbers = self._numbers()
            if not numbers and (self.path / "CURRENT").exists():
                raise NoIndex(f"{self.path / 'CURRENT'} does not belong to an index; give another folder for the index")
            self._sweep()
            name = f"gen-{max(numbers, default=0) + 1:06d}"
            folder = self.path / f"{name}.tmp-{getpid()}"
            try:
                folder.mkdir()
                yield folder, name
                folder.rename(self.path / name)
            except BaseException:
                with suppress(OSError):  # else the next writer deletes it
                    files.remove_folder(folder)
                raise
            files.sync(self.path)
            files.write_atomically(self.path / "CURRENT", f"{name}\n".encode())
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: writing failed ({error.strerror or error}); write again") from error

    def discard_before(self, name: str) -> None:
        """Delete old generations, except the two before `name`, which readers may be opening."""
        for number in self._numbers():
            if number < int(name.removeprefix("gen-")) - 2:
                with suppress(OSError):  # else the next writer deletes it
                    files.remove_folder(self.path / f"gen-{number:06d}")

    def _numbers(self) -> list[int]:
        return sorted(int(match[1]) for path in self.path.iterdir() if (match := GENERATION.fullmatch(path.name)))

    def _sweep(self) -> None:
        """Delete the unfinished files and folders of killed writers."""
        for path in self.path.glob(".CURRENT.*.tmp"):
            path.unlink()
        for path in list(self.path.iterdir()):
            if UNFINISHED_FOLDER.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                files.remove_folder(path)
