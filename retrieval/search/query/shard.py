"""What can be searched: the photos of an index folder, or of several that are one catalogue together.

Whoever asks has the codes of touches and gets the best objects, and what all others weigh: an answer is made of that
alone, however many photos there are. No photo's half, no list of candidates and no other object's logit leaves a shard.

An object's photos all lie in one shard, so that its logit is known there. Merged, the best of all shards are the best
of the catalogue, and the sums of their likelihoods are its sum.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from threading import Lock
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from indexes.store.generation import Generation
from indexes.store.rows import key_of
from retrieval.errors import BadInput
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.posterior import EvidenceMass, Posterior
from retrieval.model.reference_calibration import REFERENCE_ROWS
from retrieval.model.touches import Stopwatch
from retrieval.search.query.answer import NearestReference
from retrieval.search.query.objects import ListedPhoto, Objects, ScoredObjects, listed_photo
from retrieval.search.query.reference_touches import Nearness, References

DEFAULT_CANDIDATES = 1000
MIN_COMPLETED_OBJECTS = 20
"""Objects, at least, of which every photo is judged."""
MIN_SUM_NORM = 1e-5
"""Length of a sum of unit embeddings that is rounding alone."""
Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class ShardQuery(NamedTuple):
    """Grasps of one object that felt something: embeddings (G, embedding_dim) and halves (G, half), G > 0."""

    embeddings: Floats
    partials: Floats


class RankedObject(NamedTuple):
    """An object with its logit, the photo that shows it best, and its nearest reference touch where it has any."""

    logit: float
    photo: ListedPhoto
    reference: NearestReference | None = None


@dataclass(frozen=True)
class ShardResult:
    """What a shard says of one object in the hand.

    photos, objects: how many were judged. best: at most as many objects as asked for, the best first, equals by name.
    mass: what all objects weigh; None where the model was never calibrated. searched: photos that could have been
    candidates, which are all where every shard answered. timing_ms: by stage.
    """

    photos: int
    objects: int
    best: list[RankedObject]
    mass: EvidenceMass | None
    searched: int
    timing_ms: Mapping[str, float]


@dataclass(frozen=True)
class IndexInfo:
    """What is known of a shard without asking it.

    name: of the generation, or of the whole cluster's. kind: of the candidate search. photos, objects: how many.
    fingerprint: what made its codes. about: what its manifest says besides, the catalogue and the checkpoint among it.
    calibration: the posterior as the index has it, None without one. shards: index folders.
    """

    name: str
    kind: str
    photos: int
    objects: int
    fingerprint: Mapping[str, str]
    about: Mapping[str, Any]
    calibration: Any | None
    shards: int = 1


class Page(NamedTuple):
    """Some rows of so many that there are in all."""

    total: int
    rows: list[dict[str, Any]]


class Shard(Protocol):
    """What a searcher searches. Any number of threads may ask at once."""

    @property
    def info(self) -> IndexInfo:
        """What is known without asking."""

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """The best `top` objects for these grasps, and what all weigh.

        candidates: photos that the full classifier judges, in each index folder, `top` at least; None: as many as
        measured there. Raises NumericalError.
        """

    def rows(self, ids: Sequence[str]) -> list[dict[str, Any] | None]:
        """The rows of these photos, and of gel images of reference touches, which have `touch`; None for one that is
        not there.
        """

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """Photos in whose object, path and metadata all these words stand, in small letters, and of that object alone
        where one is named; at most `limit` of them, from the one at `offset`.
        """


class FolderShard:
    """The photos of one generation of an index folder, opened in this process: candidates by its index, judged by the
    model's head. Threads may ask it at once; they wait for each other only where words are looked for in all rows.

    judge: the layers of the head that take halves. has_embeddings: whether the model's embeddings were trained;
    without, every photo is judged. Objects with reference touches are judged by these, too. Raises CorruptIndex.
    """

    def __init__(self, generation: Generation, scorer: FusionScorer, has_embeddings: bool) -> None:
        self.generation, self.scorer, self.has_embeddings = generation, scorer, has_embeddings
        self.objects = Objects(generation)
        has_references = REFERENCE_ROWS in generation.documents
        self.references = References(generation, self.objects, len(scorer.out)) if has_references else None
        self._lock = Lock()

    @property
    def info(self) -> IndexInfo:
        """What is known without asking."""
        manifest = self.generation.manifest
        return IndexInfo(
            manifest.generation,
            manifest.kind,
            self.generation.count,
            self.objects.count,
            manifest.fingerprint,
            manifest.about,
            self.generation.documents.get("calibration"),
        )

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """As `Shard.search`. Candidates are some photos of an object: of the best objects the others are judged too."""
        clock = Stopwatch()
        with clock("candidates"):
            limit = self.limit(top, candidates)
            near = None if self.references is None else self.references.near(query.partials)
            rows = self._candidates(query.embeddings, near, limit)
        with clock("rerank"):
            objects, photos = self._score_objects(query.partials, rows, top, posterior or Posterior(), near)
            mass = None if posterior is None else self._mass(query.partials, objects, posterior, near)
        best = [
            self._ranked_object(objects, place, query.partials) for place in self.objects.best(objects, top).tolist()
        ]
        return ShardResult(photos, len(objects.numbers), best, mass, self.generation.count, clock.finish(1))

    def rows(self, ids: Sequence[str]) -> list[dict[str, Any] | None]:
        """As `Shard.rows`."""
        numbers = self.generation.rows.find(ids).tolist()
        found = [None if number < 0 else self.generation.rows[number] for number in numbers]
        if self.references is None:
            return found
        images = map(self.references.image, ids)
        # An object without photos is shown by a gel image, which has a row of both kinds.
        return [row if image is None else {**image, **(row or {})} for row, image in zip(found, images, strict=True)]

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """As `Shard.page`."""
        if object_id is None and not words:
            return Page(self.generation.count, self.generation.rows[offset : offset + limit])
        found = np.arange(self.generation.count)
        if object_id is not None:
            found = found[self.generation.rows.keys("object_id") == key_of(object_id)]
        if words:
            with self._lock:
                texts = self._texts
            found = np.array([row for row in found if all(word in texts[row] for word in words)], dtype=np.int64)
        return Page(len(found), [self.generation.rows[int(row)] for row in found[offset : offset + limit]])

    @cached_property
    def _texts(self) -> list[str]:
        """What each row is found by: object, path and metadata, without capitals."""
        found = []
        for row in self.generation.rows:
            values = [row.get("object_id"), row.get("path"), *(row.get("metadata") or {}).values()]
            found.append(" ".join(str(value) for value in values).casefold())
        return found

    def limit(self, top: int, candidates: int | None) -> int:
        """Photos that are judged: as many as asked for, else as measured on the index, else 1000."""
        measured = self.generation.manifest.about.get("candidates") or {"k": DEFAULT_CANDIDATES}
        return max(top, int(measured["k"]) if candidates is None else candidates)

    def _candidates(self, embeddings: Floats, near: Nearness | None, k: int) -> Rows:
        """Rows to score: the k nearest to all grasps together, and the photos of the k objects whose reference touches
        are nearest; all rows where that would leave nothing out.
        """
        if not self.has_embeddings or k >= self.generation.count:
            return np.arange(self.generation.count)
        rows = np.sort(self.generation.candidates(combined_embedding(embeddings), k)[0])
        if self.references is None or near is None or len(rows) == self.generation.count:
            return rows
        return np.union1d(rows, self.objects.remaining_rows(self.references.nearest_objects(near, k), rows))

    def _ranked_object(self, objects: ScoredObjects, place: int, partials: Floats) -> RankedObject:
        photo, logit = listed_photo(self.generation.rows[int(objects.rows[place])]), float(objects.logits[place])
        if self.references is None or objects.photo_logits is None:
            return RankedObject(logit, photo)
        number, photo_logits = int(objects.numbers[place]), float(objects.photo_logits[place])
        return RankedObject(logit, photo, self.references.nearest(number, partials, logit, photo_logits))

    def _objects_of(
        self, rows: Rows, logits: Floats, meaning: Posterior, grasps: int, near: Nearness | None
    ) -> ScoredObjects:
        """Objects by their photos at these rows, and by their reference touches."""
        objects = self.objects.judged(rows, logits, meaning, grasps)
        if self.references is None or near is None:
            return objects
        with_photos = self.references.calibration.with_photos  # the posterior of photos next to references
        both = None if with_photos is None else self.objects.judged(rows, logits, with_photos, grasps)
        return self.references.combine(objects, both, near, meaning, grasps)

    def _score_objects(
        self, partials: Floats, rows: Rows, top: int, meaning: Posterior, near: Nearness | None
    ) -> tuple[ScoredObjects, int]:
        """Objects by their judged photos, and how many photos these are."""
        logits = self._logits(partials, rows)
        objects = self._objects_of(rows, logits, meaning, len(partials), near)
        if len(rows) == self.generation.count:
            return objects, len(rows)
        best = objects.numbers[self.objects.best(objects, max(top, MIN_COMPLETED_OBJECTS))]
        rest = self.objects.remaining_rows(best, rows)
        if not len(rest):
            return objects, len(rows)
        rows = np.concatenate([rows, rest])
        logits = self.objects.align_duplicates(rows, np.concatenate([logits, self._logits(partials, rest)]))
        return self._objects_of(rows, logits, meaning, len(partials), near), len(rows)

    def _mass(
        self, partials: Floats, objects: ScoredObjects, posterior: Posterior, near: Nearness | None
    ) -> EvidenceMass:
        unscored = self.objects.count - len(objects.numbers)
        # Without a sample of them, these are taken to be like the least of the judged ones, which candidates are not
        # expected to be.
        sample = objects.logits.min(keepdims=True)
        if unscored and len(drawn := self.objects.sample_rows_without(objects.numbers)):
            sample = self._objects_of(drawn, self._logits(partials, drawn), posterior, len(partials), near).logits
        return posterior.mass(objects.logits, len(partials), unscored=unscored, sample=sample)

    def _logits(self, partials: Floats, rows: Rows) -> Floats:
        """Match logits of the rows, summed over grasps."""
        every = len(rows) == self.generation.count
        logits = self.scorer.logits(partials, self.generation.arrays["partials"], None if every else rows)
        return self.objects.align_duplicates(rows, logits)


def combined_embedding(embeddings: Floats) -> Floats:
    """One embedding (1, d) of unit length that stands for several grasps (G, d): its cosines order photos as the sums
    of the grasps' cosines do.

    Match logits of grasps add, and so do the cosines that foretell them. Where the embeddings cancel out, no photo is
    nearer than another, and the first grasp's stands for all.
    """
    total = embeddings.sum(0, keepdims=True, dtype=np.float64)
    length = float(np.linalg.norm(total))
    return embeddings[:1] if length < MIN_SUM_NORM else (total / length).astype(np.float32)


class Shards:
    """Several shards of this process as one: asked one after another, their answers merged as those of shards on other
    machines are. described: what is known of all of them together.
    """

    def __init__(self, shards: Sequence[Shard], info: IndexInfo) -> None:
        self.shards, self.info = list(shards), info

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """As `Shard.search`."""
        return merge_results([shard.search(query, top, candidates, posterior) for shard in self.shards], top)

    def rows(self, ids: Sequence[str]) -> list[dict[str, Any] | None]:
        """As `Shard.rows`."""
        return merge_rows([shard.rows(ids) for shard in self.shards])

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """As `Shard.page`; the photos of one shard after those of the other."""
        return merge_pages([partial(shard.page, words, object_id) for shard in self.shards], offset, limit)


def merge_results(answers: Sequence[ShardResult], top: int) -> ShardResult:
    """One answer of those of several shards, one at least."""
    if not answers:
        raise BadInput("there is no answer to merge; a cluster needs a shard at least")
    best = sorted((one for answer in answers for one in answer.best), key=lambda one: (-one.logit, one.photo.object_id))
    masses = [answer.mass for answer in answers if answer.mass is not None]
    stages = dict.fromkeys(stage for answer in answers for stage in answer.timing_ms)
    return ShardResult(
        sum(answer.photos for answer in answers),
        sum(answer.objects for answer in answers),
        best[:top],
        EvidenceMass.merged(masses) if masses else None,
        sum(answer.searched for answer in answers),
        {stage: max(answer.timing_ms.get(stage, 0.0) for answer in answers) for stage in stages},
    )


def merge_pages(pages: Sequence[Callable[[int, int], Page]], offset: int, limit: int) -> Page:
    """The page of all shards together; each of `pages` gives that of one shard for an offset and a limit."""
    total, rows = 0, list[dict[str, Any]]()
    for page in pages:
        found = page(max(0, offset - total), limit - len(rows))
        total += found.total
        rows += found.rows
    return Page(total, rows)


def merge_rows(found: Sequence[Sequence[dict[str, Any] | None]]) -> list[dict[str, Any] | None]:
    """The row of each photo, from whichever shard has it: `found` holds what every shard says of the same photos, None
    where it has none.
    """
    return [next((row for row in rows if row is not None), None) for rows in zip(*found, strict=True)]
