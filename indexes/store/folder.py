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
    codes/                cache of the codes of photos, for all generations (`indexes.store.codes`)
    LOCK                  locked by the writer

A generation is self-contained. You can copy its folder and a CURRENT file elsewhere; the copy is a complete index.

There is one writer and any number of readers. If a writer is killed at any moment, the old or the new generation is
current and complete; the next writer deletes the unfinished files.
"""

import re
from collections.abc import Mapping, Sequence
from os import getpid
from pathlib import Path
from typing import Any

from _touch_retrieval import files
from _touch_retrieval.files import read_regular
from indexes.errors import AGAIN, CorruptIndex, NoIndex, WriteFailed
from indexes.kinds.vector_index import Floats
from indexes.store.generation import Arrays, Generation, GenerationContent, read_generation, write_generation
from indexes.store.locking import WriterLock
from indexes.store.rows import Row

GENERATION = re.compile(r"gen-(\d{6,})")
UNFINISHED_FOLDER = re.compile(r"gen-\d{6,}\.tmp-\d+")
"""Folders of killed writers: unfinished or partly deleted generations."""


class IndexStore:
    """The index in the folder `path`, which the first `write` creates.

    >>> import numpy as np
    >>> store = indexes.IndexStore("photos")
    >>> rows = [indexes.Row("mug/1.jpg", "mug", "1"), indexes.Row("tin/1.jpg", "tin", "2")]
    >>> store.write(rows, np.eye(2, dtype=np.float32), fingerprint={"checkpoint": "abc"}).name
    'gen-000001'
    >>> store.open(expect={"checkpoint": "abc"}).count
    2
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = WriterLock(self.path / "LOCK")

    def open(
        self,
        *,
        name: str | None = None,
        verify: bool = True,
        expect: Mapping[str, str] | None = None,
        threads: int | None = None,
    ) -> Generation:
        """Open and check a generation.

        Args:
            name: Its name; None for the current generation.
            verify: Compare the SHA-256 of the files; sizes are always checked.
            expect: Required values of the fingerprint.
            threads: Number of threads of a search; None for the library's own setting.

        Raises:
            NoIndex: There is no index.
            CorruptIndex: A file is missing or damaged.
            UnsupportedFormat: The index has another format.
            MismatchedIndex: The fingerprint has other values.
        """
        requested = name or self.current()
        try:
            generation = self._read(requested, verify, threads)
        except CorruptIndex:
            if name is not None or self.current() == requested:
                raise
            generation = self._read(self.current(), verify, threads)  # a writer replaced it while it was being read
        generation.require(expect or {})
        return generation

    def current(self) -> str:
        """Return the name of the current generation, from CURRENT."""
        path = self.path / "CURRENT"
        try:
            text = read_regular(path).decode("ascii", "replace").strip()
        except FileNotFoundError as error:
            raise NoIndex(f"{self.path}: there is no index here; run `retrieve build-index` first") from error
        except OSError as error:
            raise NoIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error
        if not GENERATION.fullmatch(text):
            raise CorruptIndex(f"{path}: must name a generation such as gen-000001, got {text!r}; {AGAIN}")
        return text

    def lock(self) -> WriterLock:
        """Return the writer lock.

        Within `with store.lock():` you may call `write` and do other steps. Other writers get `LockedIndex` until the
        block ends.
        """
        return self._lock

    def write(
        self,
        rows: Sequence[Row],
        embeddings: Floats,
        arrays: Arrays | None = None,
        *,
        fingerprint: Mapping[str, str] | None = None,
        keep: int = 2,
        **content: Any,
    ) -> Generation:
        """Write a new generation of arrays in memory, make it current, and return it opened.

        Args:
            rows: The N rows, sorted by path.
            embeddings: Unit vectors (N, d) float32.
            arrays: Name to per-row array (N, ...) of finite numbers.
            fingerprint: Origin of the vectors.
            keep: As for `write_content`.
            **content: Other fields of `indexes.store.generation.GenerationContent`.

        Raises:
            IndexesError: As for `write_content`.
        """
        block = {"embeddings": embeddings, **(arrays or {})}
        return self.write_content(GenerationContent(rows, [block], fingerprint or {}, **content), keep=keep)

    def write_content(self, content: GenerationContent, *, keep: int = 2) -> Generation:
        """Write a new generation, with one block in memory at a time, make it current, and return it opened.

        After `WriteFailed` the current generation is the old or the new one, and complete. After any other error the
        index is unchanged.

        Args:
            content: Its content.
            keep: Number of earlier generations that stay on the disk for readers that are opening them.

        Raises:
            RowError: A row, array or document is invalid.
            VectorError: A vector is invalid.
            ParameterError: The kind is unknown or needs more vectors.
            LockedIndex: Another writer is writing the index.
            WriteFailed: A file could not be written.
        """
        self._require_index_folder()
        try:
            with self._lock:
                self._sweep()
                name = generation_name(max(self._numbers(), default=0) + 1)
                folder = self.path / f"{name}.tmp-{getpid()}"
                try:
                    folder.mkdir()
                    write_generation(folder, name, content)
                    folder.rename(self.path / name)
                except BaseException:
                    _discard(folder)
                    raise
                self.make_current(name)
                self.discard_before(name, keep)
                # no need to verify: the digests were just computed from these files
                return self.open(name=name, verify=False, threads=content.threads)
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: writing failed ({error.strerror or error}); write again") from error

    def _require_index_folder(self) -> None:
        """Raise NoIndex for a folder without generations that has a file CURRENT: it belongs to another program."""
        path = self.path / "CURRENT"
        try:
            is_other = not self._numbers() and read_regular(path).strip()
        except (FileNotFoundError, NotADirectoryError):  # if the path is a file, locking it fails with a message
            return
        except OSError as error:
            raise NoIndex(f"{path} cannot be read ({error.strerror}); give another folder for the index") from error
        if is_other:
            raise NoIndex(f"{path} does not belong to an index and was not changed; give another folder for the index")

    def make_current(self, name: str) -> None:
        """Switch to the complete generation of that name. Raises OSError."""
        files.sync(self.path)
        files.write_atomically(self.path / "CURRENT", f"{name}\n".encode())

    def discard_before(self, name: str, keep: int = 2) -> None:
        """Delete old generations.

        Args:
            name: Name of the current generation.
            keep: Number of generations before it that stay for readers that are opening them.
        """
        for number in self._numbers():
            if number < int(name.removeprefix("gen-")) - keep:
                _discard(self.path / generation_name(number))

    def _read(self, name: str, verify: bool, threads: int | None) -> Generation:
        folder = self.path / name
        if not folder.is_dir():
            raise CorruptIndex(f"{self.path}: the generation {name} is missing; {AGAIN}")
        generation = read_generation(folder, verify=verify, threads=threads)
        if generation.name != name:
            raise CorruptIndex(f"{folder}: the manifest belongs to {generation.name}; {AGAIN}")
        return generation

    def _numbers(self) -> list[int]:
        found = (GENERATION.fullmatch(path.name) for path in self.path.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def _sweep(self) -> None:
        """Delete the unfinished files and folders of killed writers."""
        for path in self.path.glob(".CURRENT.*.tmp"):
            path.unlink()
        for path in [path for path in self.path.iterdir() if UNFINISHED_FOLDER.fullmatch(path.name)]:
            if path.is_dir() and not path.is_symlink():
                files.remove_folder(path)


def generation_name(number: int) -> str:
    """Return the name of a generation, such as gen-000007."""
    return f"gen-{number:06d}"


def _discard(folder: Path) -> None:
    """Delete a folder; if that fails, leave it to the next writer."""
    try:
        files.remove_folder(folder)
    except OSError:
        return
