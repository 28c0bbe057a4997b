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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.names import lookup_key
from indexes.store.generation import Generation, check_fingerprint
from indexes.store.sharded import ShardedManifest
from retrieval.errors import BadInput
from retrieval.indexing.enrolled import EnrolledTable
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint, read_scorer
from retrieval.model.fusion_scorer import StoredPartials
from retrieval.model.posterior import EvidenceMass
from retrieval.model.touch_reader import EncodedQuery, Stopwatch
from retrieval.search.answer import NearestReference
from retrieval.search.objects import ListedPhoto, Objects, ReferenceEvidence, Rows, ScoredObjects, listed_photo

DEFAULT_CANDIDATES = 1000
MIN_COMPLETED_OBJECTS = 20
"""All photos of at least this many of the best objects are scored."""
MIN_SUM_NORM = 1e-5
"""A sum of unit embeddings with a smaller norm is only rounding error."""
Floats = NDArray[np.float32]


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
        mass: Evidence mass of all objects.
        compared_openings: Number of objects whose opening was compared with that of a grasp.
        references: Number of reference touches, and of their objects.
        timing_ms: Milliseconds by stage; of several shards, those of the slowest.
    """

    photos: int
    objects: int
    best: list[RankedObject]
    mass: EvidenceMass
    compared_openings: int
    references: tuple[int, int]
    timing_ms: Mapping[str, float]


class Page(NamedTuple):
    """Some photos, and the total number of matching photos."""

    total: int
    photos: list[ListedPhoto]


class FolderShard:
    """The photos of one generation of an index folder, opened in this process.

    Its index finds candidates, and the model's head reranks them. Threads may search at once.

    Args:
        generation: The opened generation.
        stored: Header of the checkpoint that built it.
        enrolled: The enrolled touches; None for those of the generation's index folder.

    Raises:
        MismatchedIndex: Another checkpoint built it.
        CorruptIndex: The reference touches are damaged.
    """

    def __init__(self, generation: Generation, stored: CheckpointInfo, enrolled: EnrolledTable | None = None) -> None:
        check_fingerprint(generation.folder.parent, generation.manifest.fingerprint, fingerprint(stored))
        self.generation, self.manifest, self.scorer = generation, generation.manifest, read_scorer(stored)
        self._enrolled = EnrolledTable(generation.folder.parent) if enrolled is None else enrolled
        self._catalogue = Objects(generation, stored, self.scorer.cosine_columns)
        self._snapshot: tuple[object, Objects] = None, self._catalogue
        self._has_embeddings = stored.config.has_embeddings

    @property
    def objects(self) -> Objects:
        """The objects of the generation and of the touches that are enrolled now: one snapshot for each use."""
        version, (known, objects) = self._enrolled.version(), self._snapshot
        if version != known:
            objects = self._catalogue.with_enrolled(self._enrolled.read())
            self._snapshot = version, objects
        return objects

    def search(self, query: EncodedQuery, top: int, candidates: int | None) -> ShardResult:
        """Return the best objects for the grasps of a query, and the evidence mass of all objects.

        Args:
            query: Grasps with contact of one object, at least one.
            top: Number of objects to return.
            candidates: Number of photos to rerank, raised to `top` if smaller. Default: the number that was measured
                when the index was built.

        Raises:
            NumericalError: A logit is not finite.
        """
        clock, objects = Stopwatch(), self.objects
        grasps = len(query.partials)
        with clock("candidates"):
            measured = self.manifest.about.get("candidates") or {"k": DEFAULT_CANDIDATES}
            limit = max(top, int(measured["k"]) if candidates is None else candidates)
            evidence = objects.compare_references(query.partials, query.openings_mm)
            rows = self._candidates(objects, query.embeddings, evidence, limit)
        with clock("rerank"):
            logits = self._logits(query.partials, rows)
            scored = objects.score(rows, logits, evidence, grasps)
            best = scored.numbers[scored.best(max(top, MIN_COMPLETED_OBJECTS))]
            if len(rest := objects.other_rows(best, rows)):
                rows = np.concatenate([rows, rest])
                logits = np.concatenate([logits, self._logits(query.partials, rest)])
                scored = objects.score(rows, logits, evidence, grasps)
            enrolled = objects.score_enrolled_only(evidence, grasps)
            scored = ScoredObjects(*(np.concatenate(pair) for pair in zip(scored, enrolled, strict=True)))
            mass = self._mass(objects, query.partials, scored, evidence)
        ranked = [self._ranked(objects, scored, place, query.partials) for place in scored.best(top).tolist()]
        counts = objects.reference_counts
        return ShardResult(len(rows), len(scored.numbers), ranked, mass, evidence.compared, counts, clock.finish(1))

    def _ranked(self, objects: Objects, scored: ScoredObjects, place: int, partials: Floats) -> RankedObject:
        row, nearest = int(scored.rows[place]), objects.nearest_reference(scored, place, partials)
        if row < 0 and nearest is not None:  # a gel image in place of a photo
            photo = objects.gel_images[nearest.touch[0]]
        else:
            photo = listed_photo(self.generation.rows[row])
        return RankedObject(float(scored.logits[place]), photo, nearest)

    def object_logits(self, name: str, partials: Floats) -> list[float]:
        """Return the logits (G,) of an object for the first grasp, the first two, and so on, without openings.

        All its photos and reference touches count. Raises BadInput for an object that was removed.

        Args:
            name: The object.
            partials: (G, touch_partial_width) partial activations of the grasps.
        """
        objects, logits = self.objects, list[float]()
        if (number := objects.find(name)) < 0:
            raise BadInput(f"the object {name!r} was removed from the index in the meantime")
        rows = objects.other_rows(np.array([number]), np.zeros(0, dtype=np.int64))
        for grasps in range(1, len(partials) + 1):
            some = partials[:grasps]
            evidence = objects.compare_references(some)
            if len(rows):
                scored = objects.score(rows, self._logits(some, rows), evidence, grasps)
            else:
                scored = objects.score_enrolled_only(evidence, grasps)
            logits += scored.logits[scored.numbers == number].tolist()
        return logits

    def photos(self, paths: Sequence[str]) -> list[ListedPhoto | None]:
        """Return the photo with each path, or a reference touch's gel image; None if missing."""
        rows, images, found = self.generation.rows, self.objects.gel_images, list[ListedPhoto | None]()
        for path in paths:
            # For an object without photos, the index has a gel image as a row, in place of a photo.
            image, number = images.get(path), rows.find(path)
            found.append(image if image is not None or number < 0 else listed_photo(rows[number]))
        return found

    def names_like(self, name: str) -> list[str]:
        """Return the objects that a person can mean by this name (`Rows.names_like`)."""
        return self.objects.names_like(name)

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """Return a page of the photos that contain all words in object, path or metadata, in index order.

        The gel images of objects that were only enrolled follow, by object.

        Args:
            words: Lower-case words.
            object_id: Return only photos of this object. Default: photos of all objects.
            offset: Number of photos to skip.
            limit: Largest number of photos to return.
        """
        rows, enrolled = self.generation.rows, self.objects.enrolled_pictures
        found = np.arange(len(rows))
        if object_id is not None:
            found = np.flatnonzero(rows.objects == rows.find_object(object_id))
            enrolled = [picture for picture in enrolled if picture.object_id == object_id]
        if words:
            texts, keys = self._texts, [lookup_key(word) for word in words]
            found = np.array([row for row in found if all(key in texts[row] for key in keys)], dtype=np.int64)
            enrolled = [picture for picture in enrolled if all(key in _searched(picture.object_id) for key in keys)]
        photos = [listed_photo(rows[int(row)]) for row in found[offset : offset + limit]]
        start = max(0, offset - len(found))
        return Page(len(found) + len(enrolled), photos + enrolled[start : start + limit - len(photos)])

    def counts(self) -> tuple[int, int]:
        """Return the number of objects, and of enrolled touches."""
        return self.objects.counts

    @cached_property
    def _texts(self) -> list[str]:
        """Searched text of each row: object, path and metadata in lower case."""
        return [
            _searched(" ".join(map(str, (row.object_id, row.path, *row.metadata.values()))))
            for row in self.generation.rows
        ]

    def _candidates(self, objects: Objects, embeddings: Floats, evidence: ReferenceEvidence, k: int) -> Rows:
        """Return the rows to score.

        These are the k photos nearest to all grasps together, and photos of the k objects that are most likely by
        their reference touches and openings; all rows if k covers them or there are no embeddings.
        """
        if not self._has_embeddings or k >= self.generation.count:
            return np.arange(self.generation.count)
        rows = np.sort(self.generation.index.candidates(combined_embedding(embeddings), k)[0])
        nearest = objects.nearest_by_reference(evidence, k)
        return np.union1d(rows, objects.other_rows(nearest, rows)) if len(nearest) else rows

    def _logits(self, partials: Floats, rows: Rows) -> Floats:
        """Return the match logits of the rows, summed over grasps."""
        some = None if len(rows) == self.generation.count else rows
        return self.scorer.logits(partials, StoredPartials(self.generation.arrays), some)

    def _mass(
        self, objects: Objects, partials: Floats, scored: ScoredObjects, evidence: ReferenceEvidence
    ) -> EvidenceMass:
        """Return the evidence mass of all objects, of which some are scored."""
        # A sample of unscored objects estimates their mass. Without a sample, use the lowest logit of the scored ones,
        # an upper estimate: unscored objects are expected to be worse than candidates.
        sample, unscored = scored.logits.min(keepdims=True), objects.count - len(scored.numbers)
        if unscored and len(rows := objects.sample_rows_without(scored.numbers)):
            sample = objects.score(rows, self._logits(partials, rows), evidence, len(partials)).logits
        return objects.posterior.mass(scored.logits, len(partials), unscored=unscored, sample=sample)


def _searched(text: str) -> str:
    """Return a text as it is searched."""
    return lookup_key(text.casefold())


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
        manifest: Manifest of all of them together.
        shards: The shards.
    """

    def __init__(self, manifest: ShardedManifest, shards: Sequence[Any]) -> None:
        self.manifest, self.shards = manifest, list(shards)

    def call(self, shards: Sequence[Any], method: str, *arguments: Any) -> list[Any]:
        """Return the results of a method of `FolderShard` for some shards."""
        return [getattr(shard, method)(*arguments) for shard in shards]

    def search(self, query: EncodedQuery, top: int, candidates: int | None) -> ShardResult:
        """As `FolderShard.search`; each shard reranks `candidates` photos."""
        results: list[ShardResult] = self.call(self.shards, "search", query, top, candidates)
        best = [ranked for result in results for ranked in result.best]
        return ShardResult(
            sum(result.photos for result in results),
            sum(result.objects for result in results),
            sorted(best, key=lambda ranked: (-ranked.logit, ranked.photo.object_id))[:top],
            EvidenceMass.merged([result.mass for result in results]),
            sum(result.compared_openings for result in results),
            (sum(result.references[0] for result in results), sum(result.references[1] for result in results)),
            {stage: max(result.timing_ms[stage] for result in results) for stage in results[0].timing_ms},
        )

    def photos(self, paths: Sequence[str]) -> list[ListedPhoto | None]:
        """As `FolderShard.photos`."""
        of_shards = self.call(self.shards, "photos", list(paths))
        return [next(filter(None, photos), None) for photos in zip(*of_shards, strict=True)]

    def counts(self) -> tuple[int, int]:
        """As `FolderShard.counts`."""
        objects, enrolled = zip(*self.call(self.shards, "counts"), strict=True)
        return sum(objects), sum(enrolled)

    def names_like(self, name: str) -> list[str]:
        """As `FolderShard.names_like`."""
        names = [like for names in self.call(self.shards, "names_like", name) for like in names]
        return [name] if name in names else names

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """As `FolderShard.page`, in the order of the shards."""
        total, photos = 0, list[ListedPhoto]()
        for shard in self.shards:
            start, rest = max(0, offset - total), limit - len(photos)
            (page,) = self.call([shard], "page", list(words), object_id, start, rest)
            total += page.total
            photos += page.photos
        return Page(total, photos)


def resolve_object(shard: FolderShard | Shards, name: str) -> str:
    """Return the object that a person names: exactly so, or the only one with its `lookup_key`; else `name`."""
    names = shard.names_like(name)
    return names[0] if len(names) == 1 else name
