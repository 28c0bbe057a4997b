"""From a folder of photos to a searchable index; only photos whose content changed are embedded again."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch  # before faiss, which the index imports: both bring OpenMP
from numpy.typing import NDArray

from indexes import load_kind
from indexes.choice import Choice, choose_kind
from indexes.errors import CorruptIndex, MismatchedIndex, NoIndex, UnsupportedFormat
from indexes.generation import Generation
from indexes.store import IndexStore
from retrieval.catalogue import Catalogue, PhotoBytes, SkippedPhoto, decode_photo, list_catalogue, read_photos
from retrieval.checkpoint import Checkpoint
from retrieval.encode import Image, batches, encode_photos
from retrieval.errors import BadInput, DatasetError, NumericalError
from retrieval.progress import Bar
from retrieval.version import __version__

T = TypeVar("T")
R = TypeVar("R")
BATCH = 16
SHOWN = 20


@dataclass(frozen=True)
class BuildReport:
    """What a build did.

    skipped: photos that could not be read; ignored: files that are no photos by name; notes: remarks on metadata.
    half_error: largest rounding of a stored half, which the manifest keeps too. seconds: decoding and encoding alone.
    """

    index: str
    generation: str
    model: str
    photos: int
    objects: int
    embedded: int
    reused: int
    removed: int
    skipped: list[SkippedPhoto]
    ignored: list[str]
    notes: list[str]
    kind: str
    reason: str
    recall: Any
    half_error: float
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    def _measured(self) -> str:
        if not self.recall["queries"]:
            return ""  # exact by construction
        return f" Recall@{self.recall['at']} against exact search: {self.recall['value']:.3f}, measured on this index."

    def lines(self) -> Iterator[str]:
        """The report for people."""
        rate = f", {self.embedded / self.seconds:.1f} photos per second" if self.embedded else ""
        yield (
            f"{self.index} ({self.generation}): {self.photos} photos of {self.objects} objects; "
            f"{self.embedded} embedded, {self.reused} unchanged, {self.removed} removed{rate}"
        )
        yield f"candidate search: {self.kind}. {self.reason}{self._measured()}"
        yield f"halves are stored as float16, each within {self.half_error:.2g} of the float32 one"
        if self.ignored:
            yield f"{len(self.ignored)} file(s) ignored, not images by name: {', '.join(self.ignored[:5])}"
        yield from _some("remark(s)", self.notes)
        yield from _some("photo(s) skipped", [f"{item.path}: {item.reason}" for item in self.skipped])


def _some(what: str, items: Sequence[str]) -> Iterator[str]:
    if items:
        yield f"{len(items)} {what}:"
        yield from (f"  {item}" for item in items[:SHOWN])
    if len(items) > SHOWN:
        yield f"  and {len(items) - SHOWN} more (--json lists them all)"


def fingerprint(checkpoint: Checkpoint) -> dict[str, str]:
    """What must be the same for an index to be searched with a checkpoint."""
    return {"checkpoint": checkpoint.digest, "preprocessing": checkpoint.config.preprocessing.digest()}


def build_index(
    folder: Path,
    checkpoint: Checkpoint,
    out: Path,
    *,
    kind: str | None = None,
    max_ms: float | None = None,
    quiet: bool = False,
) -> BuildReport:
    """Write the next generation of the index `out` over the catalogue `folder`, or the first one.

    kind: of the candidate index; where None, exact search unless its measured time exceeds `max_ms`. Photos that
    cannot be read are skipped and reported. Raises DatasetError where none can be, and the errors of
    `indexes.store.IndexStore.write`, which leave the index as it was.
    """
    _check_kind(kind, max_ms)
    catalogue = list_catalogue(folder)
    store = IndexStore(out)
    with store.lock():
        parent, why = _parent(store, checkpoint)
        start = time.perf_counter()
        made = _embed(catalogue, checkpoint, parent, quiet)
        seconds = time.perf_counter() - start
        choice = _choice(made, kind, max_ms)
        generation = store.write(
            made.rows,
            made.embeddings,
            {"halves": made.halves},
            {"calibration": checkpoint.calibration.to_dict()} if checkpoint.calibration else {},
            fingerprint=fingerprint(checkpoint),
            about={
                "checkpoint": str(checkpoint.path.resolve()),
                "catalogue": str(folder.resolve()),
                "half_error": made.half_error,
            },
            kind=choice.kind,
            parameters=choice.parameters,
            parent=parent,
            software=__version__,
        )
    kept, inside = {row["id"] for row in made.rows}, out.resolve()
    return BuildReport(
        index=str(out),
        generation=generation.name,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len({row["object_id"] for row in made.rows}),
        embedded=made.count,
        reused=len(made.rows) - made.count,
        removed=sum(row["id"] not in kept for row in parent.rows) if parent else 0,
        skipped=made.skipped,
        ignored=[name for name in catalogue.ignored if not (folder / name).resolve().is_relative_to(inside)],
        notes=list(catalogue.notes),
        kind=choice.kind,
        reason=" ".join(filter(None, (why, choice.reason))),
        recall=generation.manifest.recall,
        half_error=made.half_error,
        seconds=seconds,
    )


def _parent(store: IndexStore, checkpoint: Checkpoint) -> tuple[Generation | None, str]:
    """The generation to take unchanged photos over from, and why not where there is one that cannot serve."""
    try:
        return store.open(expect=fingerprint(checkpoint)), ""
    except NoIndex:
        return None, ""
    except MismatchedIndex:
        return None, "The model or its preprocessing changed, so every photo was embedded again."
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, f"The index there was not usable, so every photo was embedded again ({error})."


@dataclass(frozen=True)
class _Prepared:
    """A row of the new generation, and its preprocessed image where the parent does not have the photo."""

    row: dict[str, Any]
    image: Image | None


class _Embedded:
    """Rows in catalogue order, and embeddings and halves (float16) of those that the parent does not have."""

    def __init__(self, checkpoint: Checkpoint, parent: Generation | None) -> None:
        self.checkpoint, self.parent = checkpoint, parent
        self.rows: list[dict[str, Any]] = []
        self.skipped: list[SkippedPhoto] = []
        self.half_error = 0.0
        self._embeddings = [np.empty((0, checkpoint.config.matcher.embedding_dim), np.float32)]
        self._halves = [np.empty((0, checkpoint.config.matcher.hidden), np.float16)]

    @property
    def embeddings(self) -> NDArray[np.float32]:
        """(embedded photos, embedding_dim)."""
        return np.concatenate(self._embeddings)

    @property
    def halves(self) -> NDArray[np.float16]:
        """(embedded photos, hidden)."""
        return np.concatenate(self._halves)

    @property
    def count(self) -> int:
        """How many photos were embedded."""
        return sum(map(len, self._halves))

    def prepare(self, item: PhotoBytes | SkippedPhoto) -> _Prepared | SkippedPhoto:
        """What is to be done with a photo. Called on threads, ahead of `add`; keeps none of the file's bytes."""
        if isinstance(item, SkippedPhoto):
            return item
        row = _row(item)
        if self.parent is not None and self.parent.reusable({row["id"]: item.digest}):
            return _Prepared(row, None)
        image = decode_photo(item)
        if isinstance(image, SkippedPhoto):
            return image
        return _Prepared(row, self.checkpoint.config.preprocessing.photo(image))

    def add(self, part: Sequence[_Prepared | SkippedPhoto]) -> None:
        """Take the next photos, one batch for the tower."""
        usable = [item for item in part if isinstance(item, _Prepared)]
        self.rows += [item.row for item in usable]
        self.skipped += [item for item in part if isinstance(item, SkippedPhoto)]
        fresh = {item.row["id"]: item.image for item in usable if item.image is not None}
        if fresh:
            code = encode_photos(self.checkpoint.matcher, fresh.values(), BATCH)
            halves = code.half.numpy()
            stored = _as_float16(halves, list(fresh))
            self.half_error = max(self.half_error, float(np.abs(stored - halves).max()))
            self._halves.append(stored)
            self._embeddings.append(code.embedding.numpy())


def _embed(catalogue: Catalogue, checkpoint: Checkpoint, parent: Generation | None, quiet: bool) -> _Embedded:
    made = _Embedded(checkpoint, parent)
    made.skipped += catalogue.skipped
    with Bar("embed", len(catalogue.photos), "photos", quiet=quiet) as bar:
        for part in batches(ahead(made.prepare, read_photos(catalogue)), BATCH):
            made.add(part)
            bar.advance(len(part))
    if not made.rows:
        first = made.skipped[0]
        raise DatasetError(f"no photo in {catalogue.folder} can be read; the first: {first.path}: {first.reason}")
    if parent is not None and made.count < len(made.rows):  # what was taken over was rounded when it was made
        made.half_error = max(made.half_error, parent.manifest.about.get("half_error", 0.0))
    return made


def _row(item: PhotoBytes) -> dict[str, Any]:
    photo = item.photo
    return {
        "id": photo.photo_id,
        "object_id": photo.object_id,
        "path": photo.path,
        "digest": item.digest,
        "metadata": photo.metadata,
    }


def _as_float16(halves: NDArray[np.float32], names: list[str]) -> NDArray[np.float16]:
    largest = np.abs(halves).max(axis=1)
    bad = np.flatnonzero(~(largest <= np.finfo(np.float16).max))
    if len(bad):
        raise NumericalError(
            f"halves are stored as float16 and must stay within 65504; {names[bad[0]]} gives {largest[bad[0]]}; "
            "the model has diverged, train again with a lower learning rate"
        )
    return halves.astype(np.float16)


def _check_kind(kind: str | None, max_ms: float | None) -> None:
    """Refuse what could not be built, before the photos are embedded."""
    if kind is not None:
        load_kind(kind)
    if max_ms is not None and not max_ms > 0:
        raise BadInput(f"the longest candidate search must be above 0 ms; got {max_ms}")


def _choice(made: _Embedded, kind: str | None, max_ms: float | None) -> Choice:
    if kind is not None:
        return Choice(kind, load_kind(kind).parameters_type(), None, None, 1.0, "It was asked for.")
    vectors = made.embeddings  # without a budget nothing is measured, on these or others
    if max_ms is not None and made.parent is not None:
        reused = made.parent.reusable({row["id"]: row["digest"] for row in made.rows})
        vectors = np.concatenate([vectors, made.parent.embeddings[made.parent.slots[list(reused.values())]]])
    return choose_kind(vectors, max_ms, threads=torch.get_num_threads())


def ahead(function: Callable[[T], R], items: Iterable[T], threads: int = 2, window: int = 4 * BATCH) -> Iterator[R]:
    """`map(function, items)` on threads, in order, never more than `window` items ahead of the reader."""
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= window:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
