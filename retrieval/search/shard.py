"""Shards: the photos of one index folder, or of several that together form one catalogue.

A shard receives encoded touches. It returns its best objects, and the sums of the likelihoods of all its objects
(`EvidenceMass`). The size of the result does not depend on the number of photos: partial activations of photos,
candidates and logits of other objects stay in the shard.

All photos of an object are in one shard, which therefore computes the object's logit. The best objects of all shards
include the best of the catalogue, and the sums of the shards add up to the sums of the catalogue.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from indexes.store.generation import Generation
from indexes.store.manifest import Manifest
from indexes.store.sharded import ShardedManifest
from retrieval.model.fusion_scorer import FusionScorer, StoredPartials
from retrieval.model.posterior import EvidenceMass, Posterior
from retrieval.model.references import REFERENCE_ROWS
from retrieval.model.touch_reader import Stopwatch
from retrieval.search.answer import NearestReference
from retrieval.search.objects import ListedPhoto, Objects, ScoredObjects, listed_photo
from retrieval.search.references import References, Similarities

DEFAULT_CANDIDATES = 1000
MIN_COMPLETED_OBJECTS = 20
"""All photos of at least this many of the best objects are scored."""
MIN_SUM_NORM = 1e-5
"""A sum of unit embeddings with a smaller norm is only rounding error."""
Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class ShardQuery(NamedTuple):
    """Grasps with contact of one object: embeddings (G, embedding_dim), partials (G, touch_partial_width); G > 0."""

    embeddings: Floats
    partials: Floats


class RankedObject(NamedTuple):
    """An object with its logit, its best photo, and its nearest reference touch if it has any."""

    logit: float
    photo: ListedPhoto
    reference: NearestReference | None = None


@dataclass(frozen=True)
class ShardResult:
    """The result of a shard for one object in the hand.

    Attributes:
        photos: Number of scored photos.
        objects: Number of scored objects.
        best: The best objects, ordered by (-logit, name), at most the requested number.
        mass: Evidence mass of all objects; None if the model is not calibrated.
        timing_ms: Milliseconds by stage; of several shards, those of the slowest.
    """

    photos: int
    objects: int
    best: list[RankedObject]
    mass: EvidenceMass | None
    timing_ms: Mapping[str, float]


@dataclass(frozen=True)
class IndexInfo:
    """Information about an index or a shard, available without a search.

    Attributes:
        name: Name of the generation.
        kind: Kind of index of candidate search.
        photos: Number of photos.
        objects: Number of objects.
        about: Further manifest entries, such as the catalogue and the checkpoint.
        calibration: The posterior as stored in the index; None without one.
        shards: Number of index folders.
    """

    name: str
    kind: str
    photos: int
    objects: int
    about: Mapping[str, Any]
    calibration: Any | None
    shards: int = 1

    @classmethod
    def of(cls, manifest: Manifest | ShardedManifest, calibration: Any | None, shards: int = 1) -> Self:
        """Return the information in a manifest."""
        return cls(
            manifest.generation, manifest.kind, manifest.photos, manifest.objects, manifest.about, calibration, shards
        )


class Page(NamedTuple):
    """Some photos, and the total number of matching photos."""

    total: int
    photos: list[ListedPhoto]


class FolderShard:
    """The photos of one generation of an index folder, opened in this process.

    Its index finds candidates, and the model's head reranks them. Reference touches contribute to the logits of their
    objects. Threads may search at once. Only `page` with words may block: the first call reads the text of all rows,
    and other calls wait for it.

    Args:
        generation: The opened generation.
        scorer: Layers of the head that take partial activations.
        has_embeddings: Whether the model has trained embeddings; without them every photo is scored.

    Raises:
        CorruptIndex: The reference touches are damaged.
    """

    def __init__(self, generation: Generation, scorer: FusionScorer, has_embeddings: bool) -> None:
        self.generation, self.scorer, self.has_embeddings = generation, scorer, has_embeddings
        self.objects = Objects(generation)
        has_references = REFERENCE_ROWS in generation.documents
        self.references = References(generation, self.objects, scorer.cosine_columns) if has_references else None
        self._lock = Lock()
        self.info = IndexInfo.of(generation.manifest, generation.documents.get("calibration"))

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """Return the best objects for the grasps of a query, and the evidence mass of all objects.

        Remaining photos of the best objects are scored too.

        Args:
            query: The grasps.
            top: Number of objects to return.
            candidates: Number of photos to rerank, raised to `top` if smaller. Default: the number that was measured
                when the index was built.
            posterior: Converts logits to probabilities; None if the model is not calibrated.

        Raises:
            NumericalError: A logit is not finite.
        """
        clock = Stopwatch()
        with clock("candidates"):
            measured = self.generation.manifest.about.get("candidates") or {"k": DEFAULT_CANDIDATES}
            limit = max(top, int(measured["k"]) if candidates is None else candidates)
            similarities = None if self.references is None else self.references.similarities_to_objects(query.partials)
            rows = self._candidates(query.embeddings, similarities, limit)
        with clock("rerank"):
            objects, photos = self._score_objects(query.partials, rows, top, posterior or Posterior(), similarities)
            mass = None if posterior is None else self._mass(query.partials, objects, posterior, similarities)
        best = [
            self._ranked_object(objects, place, query.partials) for place in self.objects.best(objects, top).tolist()
        ]
        return ShardResult(photos, len(objects.numbers), best, mass, clock.finish(1))

    def object_logit(self, number: int, partials: Floats, posterior: Posterior) -> float:
        """Return the logit of an object for grasps, by all its photos and reference touches.

        Args:
            number: Number of the object (`Rows.find_object`).
            partials: (G, touch_partial_width) partial activations of the grasps.
            posterior: The posterior of the model.
        """
        rows = self.objects.remaining_rows(np.array([number]), np.zeros(0, dtype=np.int64))
        similarities = None if self.references is None else self.references.similarities_to_objects(partials)
        scored = self._objects_of(rows, self._logits(partials, rows), posterior, len(partials), similarities)
        return float(scored.logits[0])

    def photos(self, paths: Sequence[str]) -> list[ListedPhoto | None]:
        """Return the photo with each path, or a reference touch's gel image; None if missing."""
        return [self._photo(path) for path in paths]

    def _photo(self, path: str) -> ListedPhoto | None:
        # For an object without photos, the index has a gel image as a row, in place of a photo.
        if self.references is not None and (image := self.references.image(path)) is not None:
            return image
        number = self.generation.rows.find(path)
        return None if number < 0 else listed_photo(self.generation.rows[number])

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """Return a page of the photos that contain all words in object, path or metadata.

        Args:
            words: Lower-case words.
            object_id: Return only photos of this object. Default: photos of all objects.
            offset: Number of photos to skip.
            limit: Largest number of photos to return.
        """
        rows = self.generation.rows
        found = np.arange(len(rows))
        if object_id is not None:
            found = np.flatnonzero(rows.objects == rows.find_object(object_id))
        if words:
            with self._lock:
                texts = self._texts
            found = np.array([row for row in found if all(word in texts[row] for word in words)], dtype=np.int64)
        return Page(len(found), [listed_photo(rows[int(row)]) for row in found[offset : offset + limit]])

    @cached_property
    def _texts(self) -> list[str]:
        """Searched text of each row: object, path and metadata in lower case."""
        return [
            " ".join(map(str, (row.object_id, row.path, *row.metadata.values()))).casefold()
            for row in self.generation.rows
        ]

    def _candidates(self, embeddings: Floats, similarities: Similarities | None, k: int) -> Rows:
        """Return the rows to score.

        These are the k photos nearest to all grasps together, and photos of the k objects with the nearest reference
        touches; all rows if k covers them or there are no embeddings.
        """
        if not self.has_embeddings or k >= self.generation.count:
            return np.arange(self.generation.count)
        rows = np.sort(self.generation.index.candidates(combined_embedding(embeddings), k)[0])
        if self.references is None or similarities is None or len(rows) == self.generation.count:
            return rows
        return np.union1d(rows, self.objects.remaining_rows(self.references.nearest_objects(similarities, k), rows))

    def _ranked_object(self, objects: ScoredObjects, place: int, partials: Floats) -> RankedObject:
        photo, logit = listed_photo(self.generation.rows[int(objects.rows[place])]), float(objects.logits[place])
        if self.references is None or objects.photo_logits is None:
            return RankedObject(logit, photo)
        number, photo_logits = int(objects.numbers[place]), float(objects.photo_logits[place])
        return RankedObject(logit, photo, self.references.nearest(number, partials, logit, photo_logits))

    def _objects_of(
        self, rows: Rows, logits: Floats, posterior: Posterior, grasps: int, similarities: Similarities | None
    ) -> ScoredObjects:
        """Return the objects of these photos, scored by photos and reference touches."""
        objects = self.objects.aggregate(rows, logits, posterior, grasps)
        if self.references is None or similarities is None:
            return objects
        # Objects with both photos and reference touches have a posterior of their own.
        with_photos = self.references.calibration.with_photos
        both = None if with_photos is None else self.objects.aggregate(rows, logits, with_photos, grasps)
        return self.references.combine(objects, both, similarities, posterior, grasps)

    def _score_objects(
        self, partials: Floats, rows: Rows, top: int, posterior: Posterior, similarities: Similarities | None
    ) -> tuple[ScoredObjects, int]:
        """Return the scored objects, and the number of scored photos."""
        logits = self._logits(partials, rows)
        objects = self._objects_of(rows, logits, posterior, len(partials), similarities)
        if len(rows) == self.generation.count:
            return objects, len(rows)
        best = objects.numbers[self.objects.best(objects, max(top, MIN_COMPLETED_OBJECTS))]
        rest = self.objects.remaining_rows(best, rows)
        if not len(rest):
            return objects, len(rows)
        rows = np.concatenate([rows, rest])
        logits = self.objects.align_duplicates(rows, np.concatenate([logits, self._logits(partials, rest)]))
        return self._objects_of(rows, logits, posterior, len(partials), similarities), len(rows)

    def _mass(
        self, partials: Floats, objects: ScoredObjects, posterior: Posterior, similarities: Similarities | None
    ) -> EvidenceMass:
        unscored = self.objects.count - len(objects.numbers)
        # A sample of unscored objects estimates their mass. Without a sample, use the lowest logit of the scored ones,
        # an upper estimate: unscored objects are expected to be worse than candidates.
        sample = objects.logits.min(keepdims=True)
        if unscored and len(rows := self.objects.sample_rows_without(objects.numbers)):
            sample = self._objects_of(rows, self._logits(partials, rows), posterior, len(partials), similarities).logits
        return posterior.mass(objects.logits, len(partials), unscored=unscored, sample=sample)

    def _logits(self, partials: Floats, rows: Rows) -> Floats:
        """Return the match logits of the rows, summed over grasps."""
        every = len(rows) == self.generation.count
        logits = self.scorer.logits(partials, StoredPartials(self.generation.arrays), None if every else rows)
        return self.objects.align_duplicates(rows, logits)


def combined_embedding(embeddings: Floats) -> Floats:
    """Return one unit embedding (1, d) whose cosines order photos like the sums of cosines of several grasps (G, d).

    Match logits of grasps add up, and so do the cosines that approximate them. If the embeddings cancel out, no photo
    is nearer than another, and the result is the first grasp's embedding.
    """
    total = embeddings.sum(0, keepdims=True, dtype=np.float64)
    length = float(np.linalg.norm(total))
    return embeddings[:1] if length < MIN_SUM_NORM else (total / length).astype(np.float32)


class Shards:
    """The shards of a sharded index as one shard: each call goes to the shards, and their results are merged.

    This class calls shards of this process, one after another; a subclass may call others.

    Args:
        info: Information about all of them together.
        shards: The shards.
    """

    def __init__(self, info: IndexInfo, shards: Sequence[Any]) -> None:
        self.info, self.shards = info, list(shards)

    def call(self, shards: Sequence[Any], method: str, *arguments: Any) -> list[Any]:
        """Return the results of a method of `FolderShard` for some shards."""
        return [getattr(shard, method)(*arguments) for shard in shards]

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """As `FolderShard.search`; each shard reranks `candidates` photos."""
        return merge_results(self.call(self.shards, "search", query, top, candidates, posterior), top)

    def photos(self, paths: Sequence[str]) -> list[ListedPhoto | None]:
        """As `FolderShard.photos`."""
        found = self.call(self.shards, "photos", list(paths))
        return [next((photo for photo in photos if photo is not None), None) for photos in zip(*found, strict=True)]

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """As `FolderShard.page`, in the order of the shards."""
        total, photos = 0, list[ListedPhoto]()
        for shard in self.shards:
            start, rest = max(0, offset - total), limit - len(photos)
            (found,) = self.call([shard], "page", list(words), object_id, start, rest)
            total += found.total
            photos += found.photos
        return Page(total, photos)


def merge_results(results: Sequence[ShardResult], top: int) -> ShardResult:
    """Merge the results of several shards.

    Args:
        results: Results of at least one shard.
        top: Number of objects to return.
    """
    best = sorted((one for result in results for one in result.best), key=lambda one: (-one.logit, one.photo.object_id))
    masses = [result.mass for result in results if result.mass is not None]
    stages = dict.fromkeys(stage for result in results for stage in result.timing_ms)
    return ShardResult(
        sum(result.photos for result in results),
        sum(result.objects for result in results),
        best[:top],
        EvidenceMass.merged(masses) if masses else None,
        {stage: max(result.timing_ms.get(stage, 0.0) for result in results) for stage in stages},
    )
