"""The index on disk: a folder of generations, one of them current.

    CURRENT               name of the current generation; apart from caches, the only file that is replaced
    gen-000007/           a generation: written under a temporary name, checked, renamed; immutable afterwards
      manifest.json       its description, and size and SHA-256 of every other file; written last
      rows.jsonl          rows as lines of JSON
      table.npy           for each line: slot (row of embeddings.npy), end, keys (`indexes.store.rows`)
      NAME.npy            per-row arrays, and documents that are arrays
      embeddings.npy      (slots, d) float32, from which any kind of index is built
      vectors.faiss       structure of the index, for kinds that have one
      NAME.json           documents
    LOCK                  locked by the writer
    files.stat            stat cache of the files of the rows, for all generations (`indexes.store.stat_cache`)
    folders.stat          stat cache of their folders, for all generations
    unfinished.sqlite     codes of an interrupted build, for all generations (`indexes.store.unfinished`)

A generation is self-contained. You can copy its folder and a CURRENT file elsewhere; the copy is a complete index. A
generation with a parent copies the rows that it reuses: a million photos (1 GB) in 2 to 7 seconds.

There is one writer and any number of readers. If a writer is killed at any moment, the old or the new generation is
current and complete; the next writer deletes the unfinished files.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from os import getpid
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from _touch_retrieval import files
from _touch_retrieval.files import read_regular
from indexes import load_kind
from indexes.errors import AGAIN, CorruptIndex, NoIndex, ParameterError, RowError, WriteFailed
from indexes.kinds.scores import Floats
from indexes.kinds.vector_index import MAX_COUNT, Parameters, check_seed, check_threads, is_whole
from indexes.store.generation import Generation, read_generation
from indexes.store.locking import WriterLock
from indexes.store.rows import json_of
from indexes.store.tables import Block, check_documents
from indexes.store.writing import KindChooser, WriteJob, write_generation

GENERATION = re.compile(r"gen-(\d{6,})")
UNFINISHED_FOLDER = re.compile(r"gen-\d{6,}\.tmp-\d+")
"""Folders of killed writers: unfinished or partly deleted generations."""


class IndexStore:
    """The index in the folder `path`, which the first `write` creates.

    >>> import numpy as np
    >>> store = indexes.IndexStore("photos")
    >>> rows = [{"id": "mug/1.jpg", "object_id": "mug"}, {"id": "tin/1.jpg", "object_id": "tin"}]
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
        rows: Sequence[Mapping[str, Any]],
        embeddings: Floats | None,
        arrays: Mapping[str, NDArray[Any]] | None = None,
        documents: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> Generation:
        """Write a new generation with exactly these rows, make it current, and return it opened.

        Rows that `parent.reusable` finds by their ids and digests reuse the parent's vectors and arrays. Pass
        `embeddings` and `arrays` only for the F rows that are not reused, in the order of `rows`. Without a parent,
        these are all rows.

        Args:
            rows: JSON objects with a distinct text "id", and a "digest" of the content for later reuse.
            embeddings: Unit vectors (F, d) float32; None if F = 0.
            arrays: Name to per-row array (F, ...) of finite numbers.
            documents: Name to JSON document or array; documents are never copied from the parent.
            **settings: As for `write_blocks`.
        """
        return self.write_blocks([Block(rows, embeddings, arrays or {})], documents, **settings)

    def write_blocks(
        self,
        blocks: Iterable[Block | range],
        documents: Mapping[str, Any] | None = None,
        *,
        fingerprint: Mapping[str, str],
        about: Mapping[str, Any] | None = None,
        kind: str = "flat",
        parameters: Parameters | None = None,
        parent: Generation | None = None,
        software: str = "",
        seed: int = 0,
        threads: int | None = None,
        choose_kind: KindChooser | None = None,
        queries: Floats | None = None,
        self_check: int = 256,
        keep: int = 2,
    ) -> Generation:
        """Write a new generation from blocks of rows, with one block in memory at a time, and make it current.

        After `WriteFailed` the current generation is the old or the new one, and complete. After any other error the
        index is unchanged.

        Args:
            blocks: Blocks of rows; a range selects rows of the parent, which are copied without parsing.
            documents: As for `write`.
            fingerprint: Origin of the vectors, compared by `open(expect=...)`.
            about: Further entries of the manifest.
            kind: Name of the kind of index.
            parameters: Its parameters; None for the defaults.
            parent: Generation whose rows may be reused (`Block`).
            software: Version of the writing software.
            seed: Seed of all random choices.
            threads: Number of threads; None for the library's own setting.
            choose_kind: Chooses kind, parameters and further entries of `about` when all rows are on the disk.
            queries: Unit vectors (Q, d) to measure recall with; None to draw them near the vectors of the index.
            self_check: Number of new rows that must be found by their own vectors before the switch. If the
                parent's structure is reused, a sixteenth of this number of its rows is also checked
                (`Generation.self_check`).
            keep: Number of earlier generations that stay on the disk for readers that are opening them.

        Raises:
            RowError: A row, array or document is invalid.
            VectorError: A vector is invalid.
            ParameterError: A setting is invalid.
            MismatchedIndex: The parent has another fingerprint.
            LockedIndex: Another writer is writing the index.
            SelfRetrievalFailed: A row is not found by its own vector.
            WriteFailed: A file could not be written.
        """
        job = WriteJob(
            documents=check_documents(documents or {}),
            fingerprint=dict(fingerprint),
            about=dict(about or {}),
            kind=load_kind(kind),
            requested=load_kind(kind).check_parameters(parameters),
            parent=parent,
            software=software,
            seed=check_seed(seed),
            threads=check_threads(threads),
            choose_kind=choose_kind,
            queries=queries,
        )
        json_of(job.about, "about")
        if odd := [key for key, value in fingerprint.items() if not isinstance(key, str) or not isinstance(value, str)]:
            raise RowError(f"the fingerprint must map text to text; {odd[0]!r} does not")
        for what, number in (("self_check", self_check), ("keep", keep)):
            if not is_whole(number, 0, MAX_COUNT):
                raise ParameterError(f"{what} must be a whole number of at least 0; got {number!r}")
        self._require_index_folder()
        try:
            with self._lock:
                self._sweep()
                name = generation_name(max(self._numbers(), default=0) + 1)
                return self._publish(name, blocks, job, self_check, keep)
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: writing failed ({error.strerror or error}); write again") from error

    def _require_index_folder(self) -> None:
        """Raise NoIndex for a folder without generations that has a file CURRENT: it belongs to another program."""
        path = self.path / "CURRENT"
        try:
            if not self._numbers() and read_regular(path).strip():
                raise NoIndex(
                    f"{path} does not belong to an index and was not changed; give another folder for the index"
                )
        except (FileNotFoundError, NotADirectoryError):  # if the path is a file, locking it fails with a message
            return
        except OSError as error:
            raise NoIndex(f"{path} cannot be read ({error.strerror}); give another folder for the index") from error

    def _publish(
        self, name: str, blocks: Iterable[Block | range], job: WriteJob, self_check: int, keep: int
    ) -> Generation:
        folder = self.path / f"{name}.tmp-{getpid()}"
        try:
            folder.mkdir()
            inherited = write_generation(folder, name, blocks, job)
            # no need to verify: the digests were just computed from these files
            generation = read_generation(folder, verify=False, threads=job.threads)
            generation.self_check(self_check, since=inherited)
            folder.rename(self.path / name)
        except BaseException:
            _discard(folder)
            raise
        self.make_current(name)
        generation.folder = self.path / name
        self.discard_before(name, keep)
        return generation

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
        """Delete the unfinished folders of killed writers."""
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
