"""From a folder of photos to a searchable index; only photos whose content changed are embedded again."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch  # before faiss, which the index imports: both bring OpenMP
from numpy.typing import NDArray

from indexes.choice import Choice, choose_kind
from indexes.errors import CorruptIndex, MismatchedIndex, NoIndex, UnsupportedFormat
from indexes.generation import Generation
from indexes.store import IndexStore
from retrieval.catalogue import Catalogue, PhotoBytes, SkippedPhoto, list_catalogue, read_photos
from retrieval.checkpoint import Checkpoint
from retrieval.encode import Image, batches, encode_photos
from retrieval.errors import DatasetError, ImageError, NumericalError
from retrieval.progress import Bar
from retrieval.version import __version__

T = TypeVar("T")
R = TypeVar("R")
BATCH = 16
SHOWN_SKIPS = 20


@dataclass(frozen=True)
class BuildReport:
    """What a build did. half_error: largest rounding of a stored half; seconds: decoding and encoding alone."""

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
    kind: str
    reason: str
    recall: Any
    half_error: float
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    def lines(self) -> Iterator[str]:
        """The report for people."""
        rate = f", {self.embedded / self.seconds:.1f} photos per second" if self.embedded else ""
        yield (
            f"{self.index} ({self.generation}): {self.photos} photos of {self.objects} objects; "
            f"{self.embedded} embedded, {self.reused} unchanged, {self.removed} removed{rate}"
        )
        yield f"candidate search: {self.kind}. {self.reason}"
        if self.ignored:
            yield f"{len(self.ignored)} file(s) ignored, not images by name: {', '.join(self.ignored[:5])}"
        if self.skipped:
            yield f"{len(self.skipped)} photo(s) skipped:"
            yield from (f"  {item.path}: {item.reason}" for item in self.skipped[:SHOWN_SKIPS])
        if len(self.skipped) > SHOWN_SKIPS:
            yield f"  and {len(self.skipped) - SHOWN_SKIPS} more (--json lists them all)"


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
    catalogue = list_catalogue(folder)
    store = IndexStore(out)
    with store.lock():
        parent, why = _parent(store, checkpoint)
        start = time.perf_counter()
        made = _embed(catalogue, checkpoint, parent, quiet)
        seconds = time.perf_counter() - start
        choice = _choice(made, parent, kind, max_ms)
        generation = store.write(
            made.rows,
            made.embeddings,
            {"halves": made.halves},
            {"calibration": checkpoint.calibration.to_dict()} if checkpoint.calibration else {},
            fingerprint=fingerprint(checkpoint),
            about={"checkpoint": str(checkpoint.path.resolve()), "catalogue": str(folder.resolve())},
            kind=choice.kind,
            parameters=choice.parameters,
            parent=parent,
            software=__version__,
        )
    kept = {row["id"] for row in made.rows}
    return BuildReport(
        index=str(out),
        generation=generation.name,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len({row["object_id"] for row in made.rows}),
        embedded=len(made.halves),
        reused=len(made.rows) - len(made.halves),
        removed=sum(row["id"] not in kept for row in parent.rows) if parent else 0,
        skipped=made.skipped,
        ignored=list(catalogue.ignored),
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
class _Embedded:
    """Rows in catalogue order, and embeddings and halves (float16) of those that the parent does not have."""

    rows: list[dict[str, Any]]
    embeddings: NDArray[np.float32] | None
    halves: NDArray[np.float16]
    skipped: list[SkippedPhoto]
    half_error: float


def _embed(catalogue: Catalogue, checkpoint: Checkpoint, parent: Generation | None, quiet: bool) -> _Embedded:
    rows: list[dict[str, Any]] = []
    skipped = list(catalogue.skipped)
    embeddings, halves = [], []
    half_error = 0.0

    def prepare(item: PhotoBytes | SkippedPhoto) -> tuple[PhotoBytes | SkippedPhoto, Image | None]:
        return _prepare(item, checkpoint, parent)

    with Bar("embed", len(catalogue.photos), "photos", quiet=quiet) as bar:
        for part in batches(ahead(prepare, read_photos(catalogue)), BATCH):
            skipped += [item for item, _ in part if isinstance(item, SkippedPhoto)]
            rows += [_row(item) for item, _ in part if isinstance(item, PhotoBytes)]
            fresh = [(item, image) for item, image in part if image is not None]
            if fresh:
                code = encode_photos(checkpoint.matcher, [image for _, image in fresh], BATCH)
                names = [item.photo.photo_id for item, _ in fresh if isinstance(item, PhotoBytes)]
                stored = _as_float16(code.half.numpy(), names)
                half_error = max(half_error, float(np.abs(stored - code.half.numpy()).max()))
                halves.append(stored)
                embeddings.append(code.embedding.numpy())
            bar.advance(len(part))
    if not rows:
        raise DatasetError(
            f"no photo in {catalogue.folder} can be read; the first: {skipped[0].path}: {skipped[0].reason}"
        )
    hidden = checkpoint.config.matcher.hidden
    return _Embedded(
        rows=rows,
        embeddings=np.concatenate(embeddings) if embeddings else None,
        halves=np.concatenate(halves) if halves else np.empty((0, hidden), np.float16),
        skipped=skipped,
        half_error=half_error,
    )


def _prepare(
    item: PhotoBytes | SkippedPhoto, checkpoint: Checkpoint, parent: Generation | None
) -> tuple[PhotoBytes | SkippedPhoto, Image | None]:
    """The item with its preprocessed image, None where the parent has it already or it cannot be read."""
    if isinstance(item, SkippedPhoto):
        return item, None
    if parent is not None and parent.reusable({item.photo.photo_id: item.digest}):
        return item, None
    try:
        return item, checkpoint.config.preprocessing.photo(item.decode())
    except ImageError as error:
        return SkippedPhoto(item.photo.path, error.reason), None


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


def _choice(made: _Embedded, parent: Generation | None, kind: str | None, max_ms: float | None) -> Choice:
    if kind is not None:
        from indexes import load_kind

        return Choice(kind, load_kind(kind).parameters_type(), None, None, 1.0, "It was asked for.")
    parts = [] if made.embeddings is None else [made.embeddings]
    if parent is not None and len(made.rows) > len(made.halves):
        reused = parent.reusable({row["id"]: row["digest"] for row in made.rows})
        parts.append(parent.embeddings[parent.slots[list(reused.values())]])
    return choose_kind(np.concatenate(parts), max_ms, threads=torch.get_num_threads())


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
