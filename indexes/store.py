"""The index on disk: a folder of generations, of which one is current.

    CURRENT             the name of the current generation; the only file ever replaced
    gen-000007/         a generation: written beside, checked, renamed into place, never changed afterwards
      manifest.json     what it is, and size and SHA-256 of every other file; written last
      rows.jsonl        a row's own data and its slot
      embeddings.npy    (slots, d) float32, from which any kind of index is built
      vectors.faiss     the structure of the index, for kinds that have one
      NAME.npy          per-row arrays
      NAME.json         documents
    LOCK                held by the writer

One writer, many readers. A writer killed at any moment leaves the old or the new generation current, whole;
the next writer sweeps up what the killed one left.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from indexes import files, load_kind
from indexes.base import Parameters, VectorIndex
from indexes.errors import CorruptIndex, NoIndex, RowError, WriteFailed
from indexes.generation import EMBEDDINGS, ROWS, STRUCTURE, Generation, read_generation
from indexes.locking import WriterLock
from indexes.manifest import AGAIN, Counts, Manifest, sealed, write_manifest
from indexes.measure import recall_against_exact, sample_queries
from indexes.plan import Content, Plan, check_documents, gather, lay_out
from indexes.scores import Floats

GENERATION = re.compile(r"gen-(\d{6,})")
RECALL_AT = 10
RECALL_QUERIES = 100


class IndexStore:
    """The index in the folder `path`, which need not exist before the first `write`."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = WriterLock(self.path / "LOCK")

    def open(
        self, *, verify: bool = True, expect: Mapping[str, str] | None = None, threads: int | None = None
    ) -> Generation:
        """The current generation, checked whole.

        `verify` False leaves out the SHA-256 of the files (sizes are still checked). `expect` names values
        that the fingerprint must have. `threads` is the number used by searches.

        Raises `NoIndex`, `CorruptIndex`, `UnsupportedFormat`, or `MismatchedIndex` (see `indexes.errors`).
        """
        name = self.current()
        try:
            generation = self._read(name, verify, threads)
        except CorruptIndex:
            newer = self.current()
            if newer == name:
                raise
            generation = self._read(newer, verify, threads)  # a writer replaced it while it was being read
        generation.require(expect or {})
        return generation

    def current(self) -> str:
        """The name of the current generation, as CURRENT says."""
        path = self.path / "CURRENT"
        try:
            text = path.read_bytes().decode("ascii", "replace").strip()
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
        *,
        fingerprint: Mapping[str, str],
        about: Mapping[str, Any] | None = None,
        kind: str = "flat",
        parameters: Parameters | None = None,
        parent: Generation | None = None,
        software: str = "",
        seed: int = 0,
        threads: int | None = None,
        self_check: int = 256,
        keep: int = 2,
    ) -> Generation:
        """Write a new generation holding exactly `rows`, make it current, and return it opened.

        rows         JSON objects with a distinct text "id", and a "digest" of the content for later reuse
        embeddings   (F, d) float32 unit vectors; arrays: name -> (F, ...) finite numbers
        documents    name -> JSON; never taken over from the parent
        fingerprint  what made the vectors; `open(expect=...)` compares it
        about        anything else for the manifest
        parent       a generation to take rows over from: those that `parent.reusable` gives for the ids and
                     digests of `rows` keep its vectors and arrays, and F counts only the other rows, in their
                     order (embeddings may be None when F = 0). Without a parent, F is the number of rows.
        software     version that writes
        self_check   rows that must find themselves before the switch (see `Generation.self_check`)
        keep         generations before the new one that stay on disk for readers that are just opening them

        Raises `RowError`, `VectorError`, `ParameterError`, `MismatchedIndex` for bad input, `LockedIndex`
        while another writer works, `SelfRetrievalFailed`, and then the index is as it was; `WriteFailed` when
        the disk refuses, and then it is the old one or the new one, whole.
        """
        with self._lock, self._writing():
            content = gather(rows, embeddings, arrays, parent, fingerprint)
            texts = check_documents(documents or {})
            clash = sorted(set(texts) & set(content.arrays))
            if clash:
                raise RowError(f"an array and a document cannot share a name; got {', '.join(clash)}")
            check_about(fingerprint, about or {})
            chosen = load_kind(kind)
            asked = chosen.parameters_type() if parameters is None else parameters
            plan = lay_out(content, chosen, asked, seed)
            index = _index(chosen, asked, plan, content, seed, threads)
            self._sweep()
            name = self._next_name()
            manifest = Manifest(
                generation=name,
                parent=None if content.parent is None else content.parent.name,
                created=datetime.now(UTC).isoformat(timespec="seconds"),
                software=software,
                fingerprint=dict(fingerprint),
                about=dict(about or {}),
                dim=index.dim,
                metric="inner_product",
                kind=kind,
                parameters=index.settings(),
                asked=asdict(asked),
                seed=seed,
                recall=_recall(index, plan, seed),
                counts=_counts(plan, content),
                arrays=sorted(content.arrays),
                documents=sorted(texts),
                files={},
            )
            return self._publish(manifest, content, plan, index, texts, threads, self_check, keep)

    def _publish(
        self,
        manifest: Manifest,
        content: Content,
        plan: Plan,
        index: VectorIndex,
        documents: Mapping[str, Any],
        threads: int | None,
        self_check: int,
        keep: int,
    ) -> Generation:
        name = manifest.generation
        folder = self.path / f"{name}.tmp-{getpid()}"
        try:
            _write_files(folder, manifest, content, plan, index, documents)
            generation = read_generation(folder, verify=True, threads=threads)
            generation.self_check(self_check)
            folder.rename(self.path / name)
        except BaseException:
            _discard(folder)
            raise
        files.sync(self.path)
        files.replace_text(self.path / "CURRENT", f"{name}\n")
        generation.folder = self.path / name
        self._forget(keep)
        return generation

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            where = error.filename or self.path
            raise WriteFailed(f"{where}: the disk refused ({error.strerror or error}); write again") from error

    def _read(self, name: str, verify: bool, threads: int | None) -> Generation:
        folder = self.path / name
        if not folder.is_dir():
            raise CorruptIndex(f"{self.path}: CURRENT names {name}, which is missing; {AGAIN}")
        generation = read_generation(folder, verify=verify, threads=threads)
        if generation.name != name:
            raise CorruptIndex(f"{folder}: the manifest is that of {generation.name}; {AGAIN}")
        return generation

    def _numbers(self) -> list[int]:
        found = (GENERATION.fullmatch(path.name) for path in self.path.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def _next_name(self) -> str:
        return f"gen-{max(self._numbers(), default=0) + 1:06d}"

    def _sweep(self) -> None:
        """Delete what killed writers left: unfinished folders and files beside CURRENT."""
        for path in self.path.glob("*.tmp-*"):
            if path.is_dir():
                files.remove_folder(path)
            else:
                path.unlink()

    def _forget(self, keep: int) -> None:
        """Delete all generations but the newest and `keep` before it."""
        numbers = self._numbers()
        for number in numbers[: max(0, len(numbers) - 1 - keep)]:
            _discard(self.path / f"gen-{number:06d}")


def check_about(fingerprint: Mapping[str, str], about: Mapping[str, Any]) -> None:
    """The fingerprint is text, and `about` JSON; or `RowError`."""
    odd = [key for key, value in fingerprint.items() if not isinstance(key, str) or not isinstance(value, str)]
    if odd:
        raise RowError(f"the fingerprint must map text to text; {odd[0]!r} does not")
    files.check_json(dict(about), "about")


def _index(
    kind: type[VectorIndex],
    asked: Parameters,
    plan: Plan,
    content: Content,
    seed: int,
    threads: int | None,
) -> VectorIndex:
    if plan.inherited and content.parent is not None:
        index = content.parent.index.copy()
        index.threads = threads
        index.add(plan.vectors[plan.inherited :])
        return index
    return kind.build(plan.vectors, asked, seed=seed, threads=threads)


def _counts(plan: Plan, content: Content) -> Counts:
    slots = len(plan.vectors)
    built = slots
    if plan.inherited and content.parent is not None:
        built = content.parent.manifest.counts.built_slots
    return Counts(len(content.rows), slots, slots - len(set(plan.slots.tolist())), built)


def _recall(index: VectorIndex, plan: Plan, seed: int) -> dict[str, Any]:
    if index.exact:
        return {"value": 1.0, "at": RECALL_AT, "queries": 0, "how": "exact by construction"}
    queries = sample_queries(plan.vectors, RECALL_QUERIES, seed=seed)
    value = recall_against_exact(index, queries, RECALL_AT)
    return {
        "value": value,
        "at": RECALL_AT,
        "queries": RECALL_QUERIES,
        "how": "measured on moved own vectors",
    }


def _write_files(
    folder: Path,
    manifest: Manifest,
    content: Content,
    plan: Plan,
    index: VectorIndex,
    documents: Mapping[str, Any],
) -> None:
    folder.mkdir()
    pairs = zip(content.rows, plan.slots.tolist(), strict=True)
    files.write_lines(folder / ROWS, ({"slot": slot} | row for row, slot in pairs))
    files.write_array(folder / EMBEDDINGS, plan.vectors.dtype, plan.vectors.shape, [plan.vectors])
    for name, array in content.arrays.items():
        shape = (len(content.rows), *array.shape[1:])
        files.write_array(folder / f"{name}.npy", array.dtype, shape, content.array_blocks(name))
    for name, document in documents.items():
        with files.durable(folder / f"{name}.json") as handle:
            handle.write(files.encoded(document, indent=2) + b"\n")
    if index.save(folder / STRUCTURE):
        files.sync(folder / STRUCTURE)
    manifest.files.update(sealed(folder))
    write_manifest(folder, manifest)
    files.sync(folder)


def _discard(folder: Path) -> None:
    """Delete a folder that nobody needs; what cannot be deleted is left for the next writer."""
    try:
        files.remove_folder(folder)
    except OSError:
        return
