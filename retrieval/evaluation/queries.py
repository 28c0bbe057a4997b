"""Queries of an evaluation, drawn once for all methods, and the scores of a fitted method for them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.evaluation.results import PairThreshold
from retrieval.methods.method import Method, sum_over_sets
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, SET_SIZES, MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.model.encode import one_thread
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.posterior import IdentificationTrials, fit_posterior_to_trials
from retrieval.training.calibration.scores import MIN_OBJECTS, ScoredTouches
from retrieval.training.features import Features

PARTS = ("train", "validation", "test")
SETS_OF_AN_OBJECT = 20

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Queries:
    """Touches (Q) and photos (P) to score, and sets of these touches.

    Attributes:
        touches: (Q,) rows of the features.
        photos: (P,) rows of the features; a photo file that several grasps share is listed once.
        own_photo: (Q,) column of the photo that was taken before the grasp; -1 if it is not among the photos.
        touch_owner: (Q,) object numbers.
        photo_owner: (P,) object numbers.
        objects: Names of all objects of the split, sorted; object numbers are places in it.
        part_of: The part of each object.
        sets: By number of grasps, (S, G) places in `touches`; a set has one object.
    """

    touches: Rows
    photos: Rows
    own_photo: Rows
    touch_owner: Rows
    photo_owner: Rows
    objects: tuple[str, ...]
    part_of: tuple[str, ...]
    sets: dict[int, Rows]

    def of_part(self, owner: Rows, part: str | None) -> Rows:
        """Return the places of the items whose owner is in `part`; None for all parts."""
        if part is None:
            return np.arange(len(owner))
        return np.flatnonzero(np.array(self.part_of, dtype=str)[owner] == part)


def draw_queries(
    grasps: Sequence[Grasp], split: Split, seed: int, max_grasps: Mapping[str, int], across_sessions: bool = False
) -> Queries:
    """Draw the queries: all grasps of test objects and some of the others.

    Sets of each size in `SET_SIZES` are drawn for test and validation objects, without replacement within a set, if
    `PHOTOS_PER_CANDIDATE` photos of other grasps remain. With fewer photos than its rivals the true object would rank
    first more often than 1 in K by chance, because a mean of fewer scores varies more.

    A part without an entry in `max_grasps`, the maximum number of grasps of one object, has no limit.

    With `across_sessions`, the touches of test objects are those of all sessions but the first, and all other touches
    and all photos are of the first session.

    Raises:
        DatasetError: A part has fewer than two objects.
    """
    part_of = {name: part for part in PARTS for name in getattr(split, part)}
    objects = tuple(sorted({grasp.object_id for grasp in grasps} & set(part_of)))
    parts = tuple(part_of[name] for name in objects)
    for part in PARTS:
        if (count := parts.count(part)) < 2:
            raise DatasetError(
                f"An evaluation needs at least 2 {part} objects, but the recording has {count} of the split's. Record "
                "more objects, or give your own split."
            )
    rng = np.random.default_rng([seed, 11])

    def draw(name: str, part: str, later: bool) -> Rows:
        of_session = [not across_sessions or (grasp.session != grasps[0].session) == later for grasp in grasps]
        rows = np.flatnonzero([grasp.object_id == name for grasp in grasps] & np.array(of_session))
        limit = max_grasps.get(part, len(rows))
        return rows if len(rows) <= limit else np.sort(rng.choice(rows, limit, replace=False))

    of_touches = [draw(name, part, part == "test") for name, part in zip(objects, parts, strict=True)]
    of_photos = [
        draw(name, part, False) if across_sessions and part == "test" else rows
        for name, part, rows in zip(objects, parts, of_touches, strict=True)
    ]
    touches, with_photo = np.concatenate(of_touches), np.concatenate(of_photos)
    owner, photo_owner = (np.repeat(np.arange(len(objects)), list(map(len, rows))) for rows in (of_touches, of_photos))
    column: dict[Path, int] = {}
    first = np.unique([column.setdefault(grasps[row].photo, len(column)) for row in with_photo], return_index=True)[1]
    sets = {}
    for size in SET_SIZES:
        enough = [
            np.flatnonzero(owner == place)
            for place, (touched, pictured) in enumerate(zip(of_touches, of_photos, strict=True))
            if parts[place] != "train" and len(touched) >= size
            if len(pictured) >= PHOTOS_PER_CANDIDATE + (size if pictured is touched else 0)
        ]
        drawn = [rng.choice(places, size, replace=False) for places in enough for _ in range(SETS_OF_AN_OBJECT)]
        if drawn:
            sets[size] = np.array(drawn)
    return Queries(
        touches=touches,
        photos=with_photo[first],
        own_photo=np.array([column.get(grasps[row].photo, -1) for row in touches]),
        touch_owner=owner,
        photo_owner=photo_owner[first],
        objects=objects,
        part_of=parts,
        sets=sets,
    )


# Scores ------------------------------------------------------------------------------------------------

MIN_THRESHOLD_OBJECTS = 10
"""Minimum number of validation objects of a fitted pair threshold."""


def scored_touches(table: ScoreTable) -> ScoredTouches:
    """Return a score table as posteriors and verification take it; a row counts as one touch."""
    return ScoredTouches(table.scores, table.touch_owner, table.photo_owner, table.own)


def identification_trials(table: ScoreTable, seed: int = 0) -> IdentificationTrials:
    """Return a trial for each of the rows `table.with_targets`. Raises BadInput for fewer than three objects."""
    targets = table.with_targets
    return IdentificationTrials.of(scored_touches(targets), np.arange(len(targets.touch_owner))[:, None], seed)


def fit_posterior(validation: ScoreTable, seed: int = 0) -> Posterior | None:
    """Return the posterior (`retrieval.model.posterior`) of a table's rows; None for fewer than three objects."""
    if len(validation.objects) < MIN_OBJECTS:
        return None
    return fit_posterior_to_trials([identification_trials(validation, seed)])


@dataclass(frozen=True, eq=False)
class MethodScores:
    """Scores of one fitted method.

    Attributes:
        queries: The queries.
        scores: (Q, P) of touches with photos.
        set_scores: By number of grasps, (S, P) of sets of grasps with photos.
        threshold: The checkpoint's own threshold of a match.
        seed: Seed of drawn tests and pairs.
        allows_own_photos: Whether a touch is compared with the photo of its own grasp.
    """

    queries: Queries
    scores: NDArray[np.float32]
    set_scores: dict[int, NDArray[np.float32]]
    threshold: float | None
    seed: int
    allows_own_photos: bool = False

    def touches(self, part: str | None = None, *, all_photos: bool = False) -> ScoreTable:
        """Return the scores of touches of one part of the objects with its photos or all; `part` None: of all parts."""
        singles = np.arange(len(self.queries.touches))[:, None]
        return self._table(self.scores, singles, part, None if all_photos else part)

    def _table(self, scores: NDArray[np.float32], sets: Rows, part: str | None, photo_part: str | None) -> ScoreTable:
        queries = self.queries
        owner = queries.touch_owner[sets[:, 0]]
        rows, photos = queries.of_part(owner, part), queries.of_part(queries.photo_owner, photo_part)
        own = (queries.own_photo[sets[rows]][:, :, None] == photos).any(1) & (not self.allows_own_photos)
        return ScoreTable(scores[np.ix_(rows, photos)], owner[rows], queries.photo_owner[photos], own)

    def tables(self, with_threshold: bool) -> MethodScoreTables:
        """Return the tables that metrics need; the pair threshold only if a metric uses it.

        Numbers of grasps without a set that has a target photo are left out.
        """
        sets = {
            size: self._table(self.set_scores[size], sets, "test", "test") for size, sets in self.queries.sets.items()
        }
        return MethodScoreTables(
            test=self.touches("test"),
            all_objects=self.touches("test", all_photos=True),
            sets={size: table for size, table in sets.items() if table.has_target.any()},
            threshold=self.pair_threshold.at if with_threshold else None,
            seed=self.seed,
        )

    @cached_property
    def posterior(self) -> Posterior | None:
        """The posterior of single touches, fitted on validation objects; None for too few of them."""
        return fit_posterior(self.touches("validation"), self.seed)

    @cached_property
    def pair_threshold(self) -> PairThreshold:
        """The score at which a match and no match are equally likely, of the checkpoint or of `posterior`.

        Fewer than `MIN_THRESHOLD_OBJECTS` validation objects give none, because one for so few objects is arbitrary.
        """
        if self.threshold is not None:
            return PairThreshold(self.threshold, "the checkpoint")
        count = len(self.touches("validation").with_targets.objects)
        if count >= MIN_THRESHOLD_OBJECTS and self.posterior:
            return PairThreshold(self.posterior.threshold, "validation objects")
        needs = f"a threshold of the checkpoint, or one fitted on at least {MIN_THRESHOLD_OBJECTS} validation objects"
        return PairThreshold(None, None, f"pair accuracy needs {needs}; the split has {count}")


@one_thread()
def score_queries(
    method: Method, features: Features, queries: Queries, seed: int = 0, allows_own_photos: bool = False
) -> MethodScores:
    """Score all queries with a fitted method, on one thread; `features` are those of all grasps."""
    touch_encodings = method.encode_touch(features.touch[queries.touches])
    photo_encodings = method.encode_photo(features.photo[queries.photos])
    scores = method.score(touch_encodings, photo_encodings)
    if type(method)._score_sets is Method._score_sets:  # the sum of single scores, which are computed
        sets = {size: sum_over_sets(scores, rows) for size, rows in queries.sets.items()}
    else:
        sets = {size: method.score_sets(touch_encodings, photo_encodings, rows) for size, rows in queries.sets.items()}
    threshold = method.best_params.get("pair_threshold")
    return MethodScores(queries, scores, sets, threshold, seed, allows_own_photos)
