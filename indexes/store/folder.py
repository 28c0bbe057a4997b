"""The index on disk: a folder of generations, of which one is current.

    CURRENT               the name of the current generation; the only file ever replaced
    gen-000007/           a generation: written beside, checked, renamed into place, never changed afterwards
      manifest.json       what it is, and size and SHA-256 of every other file; written last
      rows.jsonl          rows as lines of JSON
      table.npy           slot, bytes and keys of each of those lines (see `indexes.store.rows`)
      NAME.npy            per-row arrays
      embeddings.npy      (slots, d) float32, from which any kind of index is built
      vectors.faiss       the structure of the index, for kinds that have one
      NAME.json           documents; NAME.npy those that are arrays, of no row
    LOCK                  held by the writer
    files.stat            the stat cache of the files behind the rows, of no generation (`indexes.store.stat_cache`)
    folders.stat          and of their folders
    unfinished.sqlite     what a build had embedded when it was cut off, of no generation (`indexes.store.unfinished`)

A generation is written whole and stands alone: its folder and a CURRENT are an index, wherever they are copied to. One
made from a parent copies what it keeps of the parent's rows: a million photos (1 GB) in 2 to 7 seconds.

One writer, many readers. A writer killed at any moment leaves the old or the new generation current, whole;
the next writer sweeps up what the killed one left.
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
"""What killed writers leave: unfinished and half-deleted generations."""


class IndexStore:
    """The index in the folder `path`, which need not exist before the first `write`.

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
        """The current generation, or the one of that `name`, checked whole.

        `verify` False leaves out the SHA-256 of the files (sizes are still checked). `expect` names values
        that the fingerprint must have. `threads` is the number used by searches.

        Raises `NoIndex`, `CorruptIndex`, `UnsupportedFormat`, or `MismatchedIndex` (see `indexes.errors`).
        """
        wanted = name or self.current()
        try:
            generation = self._read(wanted, verify, threads)
        except CorruptIndex:
            if name is not None or self.current() == wanted:
                raise
            generation = self._read(self.current(), verify, threads)  # a writer replaced it while it was being read
        generation.require(expect or {})
        return generation

    def current(self) -> str:
        """The name of the current generation, as CURRENT says."""
        path = self.path / "CURRENT"
        try:
            text = read_regular(path).decode("ascii", "replace").strip()
        except FileNotFoundError as error:
            raise NoIndex(f"{self.path}: there is no index here; run `retrieve build-index` first") from error
        except OSError as error:
            raise NoIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error
        if not GENERATION.fullmatch(text):
            raise CorruptIndex(f"{path}: must name a generation such as gen-000001, holds {text!r}; {AGAIN}")
        return text

    def lock(self) -> WriterLock:
        """`with store.lock():` keeps other writers out over several steps, `write` among them."""
        return self._lock

    def write(
        self,
        rows: Sequence[Mapping[str, Any]],
        embeddings: Floats | None,
        arrays: Mapping[str, NDArray[Any]] | None = None,
        documents: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> Generation:
        """Write a new generation holding exactly `rows`, make it current, and return it opened.

        rows         JSON objects with a distinct text "id", and a "digest" of the content for later reuse
        embeddings   (F, d) float32 unit vectors; arrays: name -> (F, ...) finite numbers
        documents    name -> JSON, or an array that is of no row; never taken over from the parent
        settings     those of `write_blocks`. Rows that `parent.reusable` gives for their ids and digests keep its
                     vectors and arrays, and F counts only the other rows, in their order (embeddings may be None
                     when F = 0). Without a parent, F is the number of rows.
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
        """As `write`, from blocks of rows that are put on the disk as they come: memory holds one of them. A range is
        of the parent's rows, which are taken over as they are, unparsed.

        fingerprint  what made the vectors; `open(expect=...)` compares it
        about        anything else for the manifest
        parent       a generation to take rows over from, as `Block` says
        software     version that writes
        settle       chooses kind, parameters and more of `about` instead, once all rows are on the disk
        queries      (Q, d) unit vectors to measure recall with; None draws them near the index's own
        self_check   rows that must find themselves before the switch: of new ones so many, of those that the parent
                     had in the same structure a sixteenth of it (see `Generation.self_check`)
        keep         generations before the new one that stay on disk for readers that are just opening them

        Raises `RowError`, `VectorError`, `ParameterError`, `MismatchedIndex` for bad input, `LockedIndex`
        while another writer works, `SelfRetrievalFailed`, and then the index is as it was; `WriteFailed` when
        the disk refuses, and then it is the old one or the new one, whole.
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
            raise WriteFailed(f"{where}: the disk refused ({error.strerror or error}); write again") from error

    def _require_index_folder(self) -> None:
        """A file called CURRENT in a folder without a generation is not of an index, and would be replaced."""
        path = self.path / "CURRENT"
        try:
            if not self._numbers() and read_regular(path).strip():
                raise NoIndex(f"{path} is not of an index, and is left as it is; give another folder for the index")
        except (FileNotFoundError, NotADirectoryError):  # where a file lies in its place, the lock says so
            return
        except OSError as error:
            raise NoIndex(f"{path} cannot be read ({error.strerror}); give another folder for the index") from error

    def _publish(
        self, name: str, blocks: Iterable[Block | range], job: WriteJob, self_check: int, keep: int
    ) -> Generation:
        folder = self.path / f"{name}.tmp-{getpid()}"
        try:
            folder.mkdir()
            kept = write_generation(folder, name, blocks, job)
            generation = read_generation(folder, verify=False, threads=job.threads)  # the digests were just taken
            generation.self_check(self_check, since=kept)
            folder.rename(self.path / name)
        except BaseException:
            _discard(folder)
            raise
        self.make_current(name)
        generation.folder = self.path / name
        self.discard_before(name, keep)
        return generation

    def make_current(self, name: str) -> None:
        """Switch to a whole generation that lies there under that name. Raises OSError."""
        files.sync(self.path)
        files.write_atomically(self.path / "CURRENT", f"{name}\n".encode())

    def discard_before(self, name: str, keep: int = 2) -> None:
        """Delete the generations before the one of that name, but for `keep` of them that readers may just open."""
        for number in self._numbers():
            if number < int(name.removeprefix("gen-")) - keep:
                _discard(self.path / generation_name(number))

    def _read(self, name: str, verify: bool, threads: int | None) -> Generation:
        folder = self.path / name
        if not folder.is_dir():
            raise CorruptIndex(f"{self.path}: the generation {name} is missing; {AGAIN}")
        generation = read_generation(folder, verify=verify, threads=threads)
        if generation.name != name:
            raise CorruptIndex(f"{folder}: the manifest is that of {generation.name}; {AGAIN}")
        return generation

    def _numbers(self) -> list[int]:
        found = (GENERATION.fullmatch(path.name) for path in self.path.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def _sweep(self) -> None:
        """Delete what killed writers left, and nothing else."""
        for path in [path for path in self.path.iterdir() if UNFINISHED_FOLDER.fullmatch(path.name)]:
            if path.is_dir() and not path.is_symlink():
                files.remove_folder(path)


def generation_name(number: int) -> str:
    """The name of a generation, such as gen-000007."""
    return f"gen-{number:06d}"


def _discard(folder: Path) -> None:
    """Delete a folder that nobody needs; what cannot be deleted is left for the next writer."""
    try:
        files.remove_folder(folder)
    except OSError:
        return
