"""Photos to rows, embeddings and halves: files are read and decoded while others are encoded.

Every thread takes a whole batch from its files to its halves and computes alone. A team of threads for each product of
the towers, as PyTorch's default is, waits for those of its members whose core is decoding a file.
"""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from indexes.kinds.scores import Slots
from indexes.store.generation import Generation
from indexes.store.rows import keys_of
from indexes.store.tables import Layouts
from indexes.store.unfinished import Unfinished
from retrieval.console.progress import Bar
from retrieval.data.catalogue import (
    Catalogue,
    CataloguePhoto,
    PhotoBytes,
    Photos,
    decode_photo,
    read_photo,
)
from retrieval.data.walking import SkippedPhoto
from retrieval.errors import NoPhoto, NumericalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, batches, one_thread
from retrieval.model.photo_encoder import fastest, on_torch
from retrieval.search.build.looks import Looked, row_of, runs

T = TypeVar("T")
R = TypeVar("R")

BATCH = 16
READ = 32
"""Files that a thread reads at a time: what a task costs by itself is a tenth of reading and hashing a photo."""
MANY = 256
"""New photos from which on a faster encoder is looked for, which takes as long as encoding a hundred, and machine code
that resizes is loaded."""
HELD = 256
"""Embeddings that were made before and stand in one part, at most: what waits between threads stays small."""


@dataclass(frozen=True)
class _Code:
    """An embedding (d,) and a half (half,), and the largest rounding of the half where this index has none yet.
    resumed: left by a build that was cut off; remade: the embedding is a new one of an older half; neither: the parent
    has it under another name."""

    embedding: NDArray[np.float32]
    half: NDArray[np.float16]
    half_error: float
    resumed: bool = False
    remade: bool = False


@dataclass(frozen=True)
class _Found:
    """A photo's row, and where the parent does not have the photo its file, or a code of the same content."""

    row: dict[str, Any]
    file: PhotoBytes | None = None
    code: _Code | None = None


@dataclass(frozen=True)
class _Kept:
    """Photos whose rows the parent has as they would be written, one after another."""

    photos: Photos
    rows: range


_Item: TypeAlias = _Found | SkippedPhoto | _Kept
_Listed: TypeAlias = tuple[CataloguePhoto, int]


@dataclass(frozen=True)
class Part:
    """Photos that follow each other, as many to encode among them as make a batch; what became of them.

    kept: the parent's rows of these numbers, as they are, and nothing else. rows: of all that could be read;
    embeddings (F, d) and halves (F, half): of those that the parent does not have
    under their names, of which `embedded` were encoded now, `resumed` by a build that was cut off, and `remade` have a
    new embedding of an older half.
    """

    rows: list[dict[str, Any]]
    skipped: list[SkippedPhoto] = field(default_factory=list)
    embeddings: NDArray[np.float32] | None = None
    halves: NDArray[np.float16] | None = None
    half_error: float = 0.0
    embedded: int = 0
    resumed: int = 0
    remade: int = 0
    kept: range = range(0)
    objects: Mapping[str, int] = field(default_factory=dict)
    """How many photos each object has; of `kept` alone, where no row tells."""


class Embedder:
    """Makes parts of a catalogue's photos, and counts what became of them. What it encodes is kept in `unfinished`.

    looked: how the files look, and so which need not be read. donors: other generations of the same model, whose codes
    are taken for photos of the same content. halves: a generation of a model with other embeddings of the same halves
    (`retrieval.model.stored.halves_kept`).

    photos: rows so far, of which `embedded` were encoded now, `resumed` by a build that was cut off, `remade` were
    given a new embedding of an older half, `renamed` had another name in the parent, and `known` are the parent's
    own by id, with the same content or another. objects: how many rows each has. unread: how many files need not be
    read. half_error: largest rounding of a stored half.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        parent: Generation | None,
        unfinished: Unfinished,
        looked: Looked,
        donors: Sequence[Generation] = (),
        halves: Generation | None = None,
    ) -> None:
        self.checkpoint, self.parent, self.unfinished, self.looked = checkpoint, parent, unfinished, looked
        self._halves = halves
        self._holders = [holder for holder in (parent, *donors, halves) if holder is not None]
        self.skipped: list[SkippedPhoto] = []
        self.objects: Counter[str] = Counter()
        self.photos, self.embedded, self.resumed, self.remade, self.renamed, self.known, self.unread = (0,) * 7
        self.half_error = 0.0
        self._encode_photos = on_torch(checkpoint)
        self._see = checkpoint.config.preprocessing.photo_of

    @property
    def removed(self) -> int:
        """How many of the parent's photos are no longer there."""
        return 0 if self.parent is None else self.parent.count - self.known

    def parts(self, catalogue: Catalogue, quiet: bool) -> Generator[Part, None, None]:
        """The catalogue's photos in its order. Raises NoPhoto where none can be read, and NumericalError for
        halves that float16 cannot hold."""
        self.skipped += catalogue.skipped
        threads = torch.get_num_threads()
        new = len(catalogue.photos) - (self.parent.count if self.parent else 0)
        if new >= MANY:
            from retrieval.data.photo_resize import resize_photo

            self._see = partial(self._see, resize=resize_photo)
        if new >= MANY and next(self.checkpoint.matcher.parameters()).device.type == "cpu":
            self._encode_photos = fastest(self.checkpoint)
        known = self.looked.known(self.parent)
        self.unread = int((known >= 0).sum())
        found = ahead(lambda some: self._find(catalogue, some), self._lists(catalogue, known), threads, 2 * threads)
        with Bar("embed", len(catalogue.photos), "photos", quiet=quiet) as bar, one_thread():
            for part in ahead(self._encode, _full(chain.from_iterable(found)), threads, 2 * threads):
                self._count(part)
                bar.advance(len(part.kept) + len(part.rows) + len(part.skipped))
                if part.kept or part.rows:
                    yield part
        if not self.photos:
            first = self.skipped[0]
            raise NoPhoto(
                f"no photo in {catalogue.where} can be read; the first: {first.path}: {first.reason}", self.skipped
            )
        if self.embedded + self.resumed < self.photos:
            # What was taken over was rounded when it was made.
            errors = [holder.manifest.about.get("half_error", 0.0) for holder in self._holders]
            self.half_error = max(self.half_error, *errors)

    def _lists(self, catalogue: Catalogue, known: Slots) -> Iterator[_Kept | list[_Listed]]:
        """The photos in their order: long runs that stay as they are, and lists of others, each with its row in the
        parent where its file need not be read."""
        done = 0
        for run in chain(runs(catalogue.photos, known, self.parent), [slice(len(known), len(known))]):
            others = zip(catalogue.photos[done : run.start], known[done : run.start].tolist(), strict=True)
            yield from batches(others, READ)
            if run.start < run.stop:
                first = int(known[run.start])
                yield _Kept(catalogue.photos[run], range(first, first + run.stop - run.start))
            done = run.stop

    def _find(self, catalogue: Catalogue, some: "_Kept | list[_Listed]") -> list[_Item]:
        """Read photos' files, and keep the bytes of those with which there is more to do. Called on threads."""
        if isinstance(some, _Kept):
            return [some]
        items = [read_photo(catalogue, photo) if number < 0 else self._same(photo, number) for photo, number in some]
        read = [item for item in items if isinstance(item, PhotoBytes)]
        known: set[str] = set()
        if self.parent is not None:
            known.update(self.parent.reusable({item.photo.path: item.digest for item in read}))
        codes = self._made_before([item.digest for item in read if item.photo.path not in known])
        found: list[_Item] = []
        for item in items:
            if not isinstance(item, PhotoBytes):
                found.append(item)
                continue
            photo = item.photo
            code = None if photo.path in known else codes.get(item.digest)
            file = item if code is None and photo.path not in known else None
            found.append(_Found(row_of(photo, item.digest), file, code))
        return found

    def _same(self, photo: CataloguePhoto, number: int) -> _Found:
        """A photo whose file has the content of that row of the parent."""
        assert self.parent is not None
        return _Found(row_of(photo, self.parent.rows[number]["digest"]))

    def _made_before(self, digests: Sequence[str]) -> dict[str, _Code]:
        """Codes of these contents, of the parent under other names, or of a build that was cut off."""
        found: dict[str, _Code] = {}
        for holder in self._holders:
            if not (wanted := [digest for digest in digests if digest not in found]):
                break
            numbers = holder.rows.by_digest.find(keys_of(wanted))
            having = [digest for digest, number in zip(wanted, numbers, strict=True) if number >= 0]
            rows = numbers[numbers >= 0]
            halves, remade = holder.arrays["halves"][rows], holder is self._halves
            embeddings = self._embeddings(halves) if remade else holder.embeddings[holder.slots[rows]]
            codes = (_Code(*code, 0.0, remade=remade) for code in zip(embeddings, halves, strict=True))
            found.update(zip(having, codes, strict=True))
        left = self.unfinished.find(digest for digest in digests if digest not in found)
        for digest, record in left.items():
            found[digest] = _Code(record["embedding"], record["halves"], float(record["half_error"]), resumed=True)
        return found

    @torch.inference_mode()
    def _embeddings(self, halves: NDArray[np.float16]) -> NDArray[np.float32]:
        """Embeddings (n, d) that the pruner makes of stored halves (n, half)."""
        pruner = self.checkpoint.matcher.pruner
        assert pruner is not None
        read = torch.from_numpy(halves.astype(np.float32)).to(next(pruner.parameters()).device)
        made: NDArray[np.float32] = pruner.photo(read).cpu().numpy()
        return made

    def _encode(self, found: Sequence[_Item]) -> Part:
        """Decode and encode those that must be. Called on threads."""
        if isinstance(found[0], _Kept):
            return Part([], kept=found[0].rows, objects=Counter(found[0].photos.objects))
        part, new, images = Part([]), list[dict[str, Any]](), list[Image]()
        codes = dict[str, _Code]()
        for item in found:
            if not isinstance(item, _Found):
                part.skipped.extend([item] if isinstance(item, SkippedPhoto) else [])
                continue
            image = None if item.file is None else decode_photo(item.file, self._see)
            if isinstance(image, SkippedPhoto):
                part.skipped.append(image)
                continue
            part.rows.append(item.row)
            if image is not None:
                new.append(item.row)
                images.append(image)
            elif item.code is not None:
                codes[item.row["id"]] = item.code
        resumed = sum(code.resumed for code in codes.values())
        remade = sum(code.remade for code in codes.values())
        codes |= self._encoded(new, images)
        if not codes:
            return part
        ordered = [codes[row["id"]] for row in part.rows if row["id"] in codes]
        return replace(
            part,
            embeddings=np.stack([code.embedding for code in ordered]),
            halves=np.stack([code.half for code in ordered]),
            half_error=max(code.half_error for code in ordered),
            embedded=len(new),
            resumed=resumed,
            remade=remade,
        )

    def _encoded(self, rows: Sequence[dict[str, Any]], images: Sequence[Image]) -> dict[str, _Code]:
        """Encode the images of these rows, and keep what comes of it against a sudden end."""
        if not images:
            return {}
        halves, embeddings = self._encode_photos(images)
        names = [row["id"] for row in rows]
        largest = np.abs(halves).max(axis=1)
        if len(bad := np.flatnonzero(~(largest <= np.finfo(np.float16).max))):
            raise NumericalError(
                f"halves are stored as float16 and must stay within 65504; {names[bad[0]]} gives {largest[bad[0]]}; "
                "the model has diverged, train again with a lower learning rate"
            )
        stored = halves.astype(np.float16)
        errors = np.abs(stored - halves).max(axis=1)
        self.unfinished.keep(
            [row["digest"] for row in rows], {"embedding": embeddings, "halves": stored, "half_error": errors}
        )
        made = zip(embeddings, stored, errors.tolist(), strict=True)
        return {name: _Code(*of) for name, of in zip(names, made, strict=True)}

    def _count(self, part: Part) -> None:
        self.skipped += part.skipped
        self.objects.update(part.objects)
        self.objects.update(row["object_id"] for row in part.rows)
        self.photos += len(part.kept) + len(part.rows)
        self.embedded += part.embedded
        self.resumed += part.resumed
        self.remade += part.remade
        self.renamed += 0 if part.halves is None else len(part.halves) - part.embedded - part.resumed - part.remade
        self.half_error = max(self.half_error, part.half_error)
        self.known += len(part.kept)
        if self.parent is not None and part.rows:
            self.known += int((self.parent.rows.find([row["id"] for row in part.rows]) >= 0).sum())


def ahead(function: Callable[[T], R], items: Iterable[T], threads: int, window: int) -> Iterator[R]:
    """`map(function, items)` on threads, in order, never more than `window` items ahead of the reader.

    What waits is given up when the reader stops or an item fails; what runs is waited for.
    """
    waiting: deque[Future[R]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= window:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def layouts(checkpoint: Checkpoint) -> Layouts:
    """What `Unfinished` keeps of a photo for this checkpoint."""
    config = checkpoint.config.matcher
    return {
        "embedding": (np.dtype(np.float32), (config.embedding_dim,)),
        "halves": (np.dtype(np.float16), (config.half,)),
        "half_error": (np.dtype(np.float32), ()),
    }


def _full(found: Iterable[_Item]) -> Iterator[list[_Item]]:
    """Parts with a whole batch of photos to encode in each but the last, and but those before a run that is kept."""
    part: list[_Item] = []
    new, held = 0, 0
    for item in found:
        if isinstance(item, _Kept):
            if part:
                yield part
            yield [item]
            part, new, held = [], 0, 0
            continue
        part.append(item)
        new += isinstance(item, _Found) and item.file is not None
        held += isinstance(item, _Found) and item.code is not None
        if new == BATCH or held == HELD:
            yield part
            part, new, held = [], 0, 0
    if part:
        yield part
