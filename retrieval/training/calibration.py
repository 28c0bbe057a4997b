"""Calibrate a checkpoint on touches of objects that it was not fitted to: posterior, reference touches, verification.

`calibrate_checkpoint` is called after training; it adds the gel check, too (`retrieval.training.gel_check`).
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.data.dataset import Grasp
from retrieval.data.opening import believed
from retrieval.errors import BadInput
from retrieval.model import verification
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import default_device
from retrieval.model.fusion import Matcher
from retrieval.model.gel_check import CONTACT
from retrieval.model.opening import OpeningCalibration
from retrieval.model.posterior import MAX_GRASPS, SLOPE_BOUNDS, Posterior
from retrieval.model.references import ReferenceCalibration, reference_similarity, unit_embeddings
from retrieval.model.verification import LEVELS, QUANTILES, VerificationCalibration, supports_calibration
from retrieval.training.features import Features, FeatureSource, FrozenFeatures, features_by_image, recorded_features
from retrieval.training.gel_check import (
    FOREIGN,
    PENALTY,
    ForeignPictures,
    GelCheckFeatures,
    contact_levels,
    fit_gel_check,
    fit_gel_head,
)

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
Embeddings = NDArray[np.floating[Any]]
CATALOGUE_SIZES = (20, 1000)
"""Numbers of objects in the catalogues of a fit. The maximum is the number of validation objects minus one."""
MIN_OBJECTS = 3
"""Smallest number of objects of a fit; with two objects, every catalogue would have only one."""
MAX_REFERENCES = 3
"""Largest number of references of an object in the fit: a typical number if a user records few."""
WEIGHT_BOUNDS = (0.01, 1000.0)
"""Search range of the weight of C next to photos."""
MIN_OPENING_WIDTH = 0.005
"""Smallest width and spread of log openings: grippers state 0.1 mm. Without it, equal openings have no likely width."""
MIN_OPENING_OBJECTS = 10
"""Smallest number of objects whose openings are fitted: three give a width and a floor at their bounds."""
SEQUENCES = 8
"""Sequences of grasps of each validation object, for verification."""
MAX_CALIBRATION_GRASPS = 400
"""Largest number of grasps from each part of the split."""
MIN_GRASPS = 20
"""Number of validation grasps that the gel check needs; thresholds from fewer grasps would reject too many touches."""
_SETS = 4
_NO_EMBEDDINGS = np.zeros((0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class ScoredTouches:
    """Touches of known objects in the order of capture, and their match logits with photos, possibly none.

    Attributes:
        logits: (T, N) match logits.
        touch_owner: (T,) object of each touch.
        photo_owner: (N,) object of each photo.
        own: (T, N) whether the photo was taken in the grasp of that touch; such photos are masked for that touch.
        touch_embeddings: (T, d) embeddings, for the calibration of reference touches; d is 0 for a model whose logit
            has no cosine.
        photo_embeddings: (N, d') embeddings, for verification.
        touch_group: (T,) number of the session or sequence of each touch, in the order of capture. Then reference
            touches and queries are of different ones.
    """

    logits: NDArray[np.floating[Any]]
    touch_owner: Numbers
    photo_owner: Numbers
    own: NDArray[np.bool_]
    touch_embeddings: Embeddings = field(default_factory=lambda: _NO_EMBEDDINGS)
    photo_embeddings: Embeddings = field(default_factory=lambda: _NO_EMBEDDINGS)
    touch_group: Numbers | None = None

    @property
    def has_trials(self) -> bool:
        """Whether a posterior can be fitted: to three objects, and a touch with another photo of its object."""
        same = self.touch_owner[:, None] == self.photo_owner
        return len(np.unique(self.photo_owner)) >= MIN_OBJECTS and bool((same & ~self.own).any())

    def without_evidence(self, refused: NDArray[np.bool_]) -> "ScoredTouches":
        """Return these touches; those that the gel check refuses (T,) have the median logit with every photo."""
        logits = np.where(refused[:, None], np.median(self.logits), self.logits)
        return dataclasses.replace(self, logits=logits)

    def draw_sets(self, grasps: int, draws: int | None, rng: np.random.Generator) -> Numbers:
        """Return `draws` random sets (S, grasps) of each object that has so many touches and a photo of another grasp.

        Without `draws`, the sets are each single touch.
        """
        sets = []
        for name in np.unique(self.touch_owner):
            touches, photos = np.flatnonzero(self.touch_owner == name), self.photo_owner == name
            drawn = touches[:, None] if draws is None else [rng.permutation(touches)[:grasps] for _ in range(draws)]
            sets += [rows for rows in drawn if len(rows) == grasps and (photos & ~self.own[rows].any(0)).any()]
        return np.array(sets, dtype=np.int64).reshape(-1, grasps)


@torch.inference_mode()
def score_touches(
    matcher: Matcher,
    features: tuple[Tensor, Tensor],
    owners: tuple[Numbers, Numbers],
    own: NDArray[np.bool_],
    *,
    pooled: bool = False,
) -> ScoredTouches:
    """Score touches with photos, given their features (T, fingers * F) and (N, F') and their objects (T,) and (N,).

    `pooled`: without late interaction, as an index without cells does.
    """
    touch_partials = matcher.touch_encoding(features[0]).partial.cpu().numpy()
    photo_partials, photo_embeddings = (part.cpu().numpy() for part in matcher.photo_encoding(features[1]))
    scorer = matcher.head.scorer
    if pooled:
        photo_partials = photo_partials[:, : scorer.pooled_width]
    logits = np.stack([scorer.logits(partial[None], photo_partials) for partial in touch_partials])
    touch_embeddings = unit_embeddings(touch_partials, scorer.cosine_columns)
    return ScoredTouches(logits, *owners, own, touch_embeddings, photo_embeddings)


def score_grasps(
    matcher: Matcher, grasps: Sequence[Grasp], touches: Tensor, photos: dict[Path, Tensor], *, pooled: bool = False
) -> ScoredTouches | None:
    """Score the touches of grasps with their photos (`recorded_features`); None for too few objects or photos."""
    touch_owner = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1]
    owner_of = {grasp.photo: owner for grasp, owner in zip(grasps, touch_owner, strict=True)}
    owners = touch_owner, np.array([owner_of[photo] for photo in photos])
    own = np.array([[grasp.photo == photo for photo in photos] for grasp in grasps])
    scored = score_touches(matcher, (touches, torch.stack(list(photos.values()))), owners, own, pooled=pooled)
    return scored if scored.has_trials else None


# Posterior -------------------------------------------------------------------------------------------------


def fit_posterior(*parts: ScoredTouches, seed: int = 0) -> Posterior:
    """Fit on single touches of validation objects and, if objects have more, on sets of up to `MAX_GRASPS` grasps.

    `parts` come from one or several matchers (of folds) and share no object. If each object has one grasp, the
    dependence cannot be fitted and is 1. Raises BadInput for fewer than three objects, or if no touch has another photo
    of its object.
    """
    return fit_posterior_to_trials([trial for scored in parts for trial in identification_trials(scored, seed)])


def identification_trials(scored: ScoredTouches, seed: int) -> Iterator["IdentificationTrials"]:
    """Yield the trials of single touches, then of sets of two grasps, three and so on, while objects have enough."""
    for grasps in range(1, MAX_GRASPS + 1):
        sets = scored.draw_sets(grasps, None if grasps == 1 else _SETS, np.random.default_rng([seed, grasps]))
        if len(sets) or grasps == 1:
            yield IdentificationTrials.of(scored, sets, seed)


@dataclass(frozen=True, eq=False)
class IdentificationTrials:
    """Open-set identification trials over catalogues with the true object and without it.

    Attributes:
        grasps: Touches in a query.
        scores: (T, N) summed match logits, photos sorted by object, -inf for a masked photo.
        counts: (T, O) number of unmasked photos of each object.
        starts: (O,) first photo of each object.
        catalogues: (T, K + 1) objects, the true one first. First K columns: a catalogue with it; last K: one without.
    """

    grasps: int
    scores: Floats
    counts: Numbers
    starts: Numbers
    catalogues: tuple[Numbers, ...]

    @classmethod
    def of(cls, scored: ScoredTouches, sets: Numbers, seed: int = 0) -> "IdentificationTrials":
        """Return the trials of sets (S, G) of touches. Raises BadInput for no sets or fewer than 3 objects."""
        objects, owner = np.unique(scored.photo_owner, return_inverse=True)
        if len(objects) < MIN_OBJECTS or not len(sets):
            raise BadInput(
                "a posterior requires at least three objects, and touches that have another photo of their object; "
                f"got {len(objects)} objects and {len(sets)} such touches"
            )
        order = np.argsort(owner, kind="stable")
        starts = np.searchsorted(owner[order], np.arange(len(objects)))
        in_gallery = ~np.asarray(scored.own[sets].any(axis=1))[:, order]
        scores = np.where(in_gallery, scored.logits[:, order].astype(np.float64)[sets].sum(1), -np.inf)
        counts = np.add.reduceat(in_gallery.astype(np.int64), starts, axis=1)
        true = np.searchsorted(objects, scored.touch_owner[sets[:, 0]])
        keys = np.random.default_rng([seed, 100 + sets.shape[1]]).random(counts.shape)
        keys[np.arange(len(sets)), true] = -1
        ranked = np.argsort(keys, axis=1)
        sizes = sorted({min(size, len(objects) - 1) for size in CATALOGUE_SIZES})
        return cls(sets.shape[1], scores, counts, starts, tuple(ranked[:, : size + 1] for size in sizes))

    def log_ratios(self, posterior: Posterior) -> Floats:
        """Return the log likelihood ratios (T, O) of the objects."""
        scaled = posterior.weight(self.grasps) * self.scores
        counts = np.maximum(self.counts, 1)  # an object without photos is in no catalogue
        top = np.maximum.reduceat(scaled, self.starts, axis=1)
        base = np.where(np.isfinite(top), top, 0.0)
        owner = np.repeat(np.arange(len(self.starts)), np.diff(np.append(self.starts, scaled.shape[1])))
        sums = np.add.reduceat(np.exp(scaled - base[:, owner]), self.starts, axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(base + (np.log(sums) - np.log(counts)) + posterior.offset)

    def loss(self, posterior: Posterior, smooth: float) -> float:
        """Return the mean cross-entropy over catalogues, at even odds of "none of these".

        `smooth` is the part of the target that is spread evenly over all hypotheses.
        """
        ratios, losses = self.log_ratios(posterior), []
        for catalogue in self.catalogues:
            odds = np.take_along_axis(ratios, catalogue, 1) - math.log(catalogue.shape[1] - 1)
            for part, truth in ((odds[:, :-1], 1), (odds[:, 1:], 0)):
                logs = np.column_stack([np.zeros(len(part)), part])
                logs = logs - np.logaddexp.reduce(logs, axis=1, keepdims=True)
                losses.append(-((1 - smooth) * logs[:, truth] + smooth * logs.mean(1)).mean())
        return float(np.mean(losses))


def _mean_loss(trials: Sequence[IdentificationTrials], posterior: Posterior) -> float:
    count = sum(len(part.scores) for part in trials)
    return sum(len(part.scores) * part.loss(posterior, 1 / (count + 2)) for part in trials) / count


def fit_posterior_to_trials(trials: Sequence[IdentificationTrials]) -> Posterior:
    """Return the most likely posterior for all of these trials, each with weight 1.

    Targets are smoothed as in Platt (1999, section 2.2), so the optimum is finite even if the logits separate all
    trials. The slope stays within `SLOPE_BOUNDS`.
    """
    from scipy.optimize import minimize  # slow to import; queries do not need it

    count = sum(len(part.scores) for part in trials)
    several = any(part.grasps > 1 for part in trials)
    finite = np.concatenate([part.scores[np.isfinite(part.scores)] / part.grasps for part in trials])
    # Subtract the median from the logits. Then the best offset hardly depends on the slope, and the search finds both.
    middle, unit = float(np.median(finite)), float(np.std(finite))
    low, high = np.log(SLOPE_BOUNDS)
    start = float(np.clip(-math.log(unit) if unit > 0 else 0.0, low, high))

    def posterior_of(parameters: Floats) -> Posterior:
        slope = float(np.clip(np.exp(parameters[0]), *SLOPE_BOUNDS))
        dependence = float(parameters[2]) if several else 1.0  # single grasps do not determine it
        return Posterior(slope, float(parameters[1]) - slope * middle, dependence, count)

    searched = slice(3 if several else 2)
    bounds = [(low, high), (-1e6, 1e6), (0.0, 1.0)][searched]
    first = np.array([start, 0.0, 0.5])[searched]
    simplex = np.vstack([first, first + np.diag([-0.5 if start > 0 else 0.5, 0.5, 0.25][searched])])
    options = {"xatol": 1e-4, "fatol": 1e-9, "maxiter": 2000, "initial_simplex": simplex}
    found = minimize(
        lambda x: _mean_loss(trials, posterior_of(x)), first, method="Nelder-Mead", bounds=bounds, options=options
    )
    return posterior_of(found.x)


# Reference touches -----------------------------------------------------------------------------------------


def fit_references(*parts: ScoredTouches, seed: int = 0) -> ReferenceCalibration | None:
    """Fit on touches of objects that have at least two.

    References come from the first half of an object's touches, or from the first quarter if that suffices, at most
    `MAX_REFERENCES`. The queries are the second half, so with enough touches no query neighbours a reference. All
    trials are repeated with one reference per object, because a fit to three references is overconfident for one.

    None for fewer than three such objects, or for a model without embeddings.
    """
    many, one = (
        [found for part in parts if (found := _reference_trials(part, max_references)) is not None]
        for max_references in (MAX_REFERENCES, 1)
    )
    if not many:
        return None
    trials, weight, with_photos = [*many, *one], None, None
    pairs = [
        (photos, dataclasses.replace(photos, logits=near.logits[:, photos.photo_owner]))
        for near, photos in trials
        if photos.has_trials
    ]
    if pairs:
        weight = _weight(pairs, seed)
        sums = (dataclasses.replace(photos, logits=photos.logits + weight * near.logits) for photos, near in pairs)
        with_photos = fit_posterior(*sums, seed=seed)
    return ReferenceCalibration(
        fit_posterior(*(near for near, _ in trials), seed=seed),
        weight,
        with_photos,
        sum(len(near.photo_owner) for near, _ in many),
        sum(len(near.touch_owner) for near, _ in many),
    )


def _reference_trials(part: ScoredTouches, max_references: int) -> tuple[ScoredTouches, ScoredTouches] | None:
    """Return C of the other touches with each object, and their match logits with one photo of each, its first one.

    At most `max_references` touches of each object are references. None for too few objects, or without embeddings.
    """
    sets = _reference_sets(part.touch_owner, max_references, part.touch_group)
    if len(sets) < MIN_OBJECTS or not part.touch_embeddings.shape[1]:
        return None
    references, of_objects = zip(*sets, strict=True)
    queries, owner = np.concatenate(of_objects), np.repeat(np.arange(len(sets)), [len(some) for some in of_objects])
    cosines = part.touch_embeddings[queries] @ part.touch_embeddings[np.concatenate(references)].T
    near = reference_similarity(cosines, np.cumsum([0, *(len(some) for some in references[:-1])]))
    number = {int(part.touch_owner[mine[0]]): place for place, (mine, _) in enumerate(sets)}
    names, first = np.unique(part.photo_owner, return_index=True)
    known = first[np.isin(names, list(number))]
    photo_owner = np.array([number[int(name)] for name in part.photo_owner[known]], np.int64)
    shared = np.ix_(queries, known)
    return (
        ScoredTouches(near, owner, np.arange(len(sets)), np.zeros(near.shape, np.bool_)),
        ScoredTouches(part.logits[shared], owner, photo_owner, part.own[shared]),
    )


def _reference_sets(owner: Numbers, max_references: int, group: Numbers | None = None) -> list[tuple[Numbers, Numbers]]:
    """Return the touches that are references, and the queries, of each object with both (`fit_references`).

    With `group`, the references are from the first half of an object's groups, the queries from the others.
    """
    sets = []
    for name in np.unique(owner):
        mine = np.flatnonzero(owner == name)
        shown, rows = mine[: max(len(mine) // 4, min(MAX_REFERENCES, len(mine) // 2))], mine[len(mine) // 2 :]
        if group is not None:
            groups = np.unique(group[mine])
            is_first = np.isin(group[mine], groups[: max(1, len(groups) // 2)])
            shown, rows = mine[is_first], mine[~is_first]
        places = np.linspace(0, len(shown) - 1, min(max_references, len(shown)))  # evenly spaced
        if len(shown) and len(rows):
            sets.append((shown[places.round().astype(np.int64)], rows))
    return sets


def fit_opening(grasps: Sequence[Grasp]) -> OpeningCalibration | None:
    """Fit the evidence of openings to grasps in the order of capture, with references as in `fit_references`.

    The objects may be those that a model was fitted to. None for fewer than `MIN_OPENING_OBJECTS` objects with two
    openings, or if all openings are equal, as commanded ones are.
    """
    from scipy.optimize import minimize  # slow to import; queries do not need it

    measured = [(grasp.object_id, opening) for grasp in grasps if (opening := believed(grasp.opening_mm)) is not None]
    if not measured:
        return None
    names, openings = zip(*measured, strict=True)
    owner, logs = np.unique(names, return_inverse=True)[1], np.log(openings)
    sets = [(logs[shown], logs[rows]) for count in (MAX_REFERENCES, 1) for shown, rows in _reference_sets(owner, count)]
    if len(sets) < 2 * MIN_OPENING_OBJECTS:
        return None
    weights = 1 / np.bincount(owner)[owner]
    mean = float(np.average(logs, weights=weights))
    spread = math.sqrt(np.average((logs - mean) ** 2, weights=weights))
    if spread < MIN_OPENING_WIDTH:
        return None
    queries = np.concatenate([rows for _, rows in sets])[:, None]
    padded = [np.append(shown, np.full(MAX_REFERENCES - len(shown), np.nan)) for shown, _ in sets]
    references = np.repeat(padded, [len(rows) for _, rows in sets], axis=0)
    is_reference = np.isfinite(references)

    def calibration(parameters: Floats) -> OpeningCalibration:
        floor, width = float(parameters[0]), math.exp(parameters[1])
        return OpeningCalibration(mean, spread, width, floor, len(sets) // 2, len(queries) // 2)

    def loss(parameters: Floats) -> float:
        terms = np.where(is_reference, calibration(parameters).log_density(queries, references), -np.inf)
        return -float((np.logaddexp.reduce(terms, axis=1) - np.log(is_reference.sum(1))).mean())

    bounds = [(0.05, 0.99), (math.log(MIN_OPENING_WIDTH), 0.0)]
    return calibration(minimize(loss, np.array([0.2, -3.0]), method="Nelder-Mead", bounds=bounds).x)


def _weight(pairs: Sequence[tuple[ScoredTouches, ScoredTouches]], seed: int) -> float:
    """Return the most likely weight of C, in match logits, over identification trials with single touches.

    Each pair has the match logits of touches with photos, and C of the touches with the objects of the same photos.
    """
    from scipy.optimize import minimize_scalar  # slow to import; queries do not need it

    trials = [[next(identification_trials(scored, seed)) for scored in pair] for pair in pairs]

    def loss(log_weight: float) -> float:
        sums = [
            dataclasses.replace(photos, scores=photos.scores + math.exp(log_weight) * near.scores)
            for photos, near in trials
        ]
        return _mean_loss(sums, fit_posterior_to_trials(sums))

    bounds = [math.log(weight) for weight in WEIGHT_BOUNDS]
    return math.exp(float(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.1}).x))


# Verification ----------------------------------------------------------------------------------------------


class VerificationSequences(NamedTuple):
    """Log likelihood ratios of sequences of G grasps.

    Attributes:
        owner: (S,) object of each sequence.
        ratios: (S, G) ratios of the right object after 1, 2, ... grasps.
        impostor: (S, O - 1) largest ratio of each other object.
        similar: (S,) largest ratio of the most similar other object.
    """

    owner: NDArray[np.int64]
    ratios: Floats
    impostor: Floats
    similar: Floats


def verification_sequences(
    scored: ScoredTouches, posterior: Posterior, seed: int = 0, grasps: int = verification.MAX_GRASPS
) -> VerificationSequences | None:
    """Draw and score `SEQUENCES` sequences of each object that has `grasps` grasps and a photo of another grasp.

    The embeddings of the photos give the most similar object. Shorter sequences of a seed are the first grasps of
    longer ones. None without any such object.
    """
    sets = scored.draw_sets(grasps, SEQUENCES, np.random.default_rng([seed, 7]))
    if not len(sets):
        return None
    owner, objects = scored.touch_owner[sets[:, 0]], np.unique(scored.photo_owner)
    ratios = np.stack(
        [IdentificationTrials.of(scored, sets[:, :count], seed).log_ratios(posterior) for count in range(1, grasps + 1)]
    )
    rows, true = np.arange(len(sets)), np.searchsorted(objects, owner)
    highest = ratios.max(0)
    is_impostor = np.arange(len(objects)) != true[:, None]
    means = np.stack([scored.photo_embeddings[scored.photo_owner == name].mean(0) for name in objects])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    cosines = means @ means.T
    np.fill_diagonal(cosines, -np.inf)
    similar = cosines.argmax(1)[true]
    return VerificationSequences(
        owner,
        ratios[:, rows, true].T,
        highest[is_impostor].reshape(len(sets), -1),
        highest[rows, similar],
    )


def fit_verification(
    parts: Sequence[ScoredTouches],
    posterior: Posterior,
    seed: int = 0,
    refused: Sequence[NDArray[np.bool_]] | None = None,
) -> VerificationCalibration | None:
    """Return the calibration from validation objects, which are compared only within a part.

    `refused`: whether the gel check refuses each touch of each part. Refused touches raise the false rejects, and do
    not lower the false accepts.

    None if fewer than `MIN_OBJECTS` objects have sequences (`verification_sequences`), or if their pairs do not support
    `CARD_FAR`.
    """
    found = [each for part in parts if (each := verification_sequences(part, posterior, seed)) is not None]
    sizes = tuple(len(np.unique(each.owner)) for each in found)
    if not supports_calibration(sizes):
        return None
    impostors = np.concatenate([each.impostor.ravel() for each in found])
    genuine = found
    if refused is not None:
        checked = (part.without_evidence(touches) for part, touches in zip(parts, refused, strict=True))
        genuine = [each for part in checked if (each := verification_sequences(part, posterior, seed)) is not None]
    ratios = np.concatenate([each.ratios for each in genuine])
    return VerificationCalibration(
        sizes,
        _quantiles(impostors, 1 - np.array(LEVELS)),
        _quantiles(np.concatenate([each.similar for each in found])),
        tuple(map(_quantiles, np.maximum.accumulate(ratios, axis=1).T)),
        _quantiles(ratios[:, :-1].min(1)),
    )


def _quantiles(values: Floats, at: Sequence[float] | Floats = QUANTILES) -> tuple[float, ...]:
    return tuple(np.quantile(values, at).tolist())


# The checkpoint ----------------------------------------------------------------------------------------------


def calibrate_checkpoint(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: ForeignPictures = FOREIGN,
    max_grasps: int = MAX_CALIBRATION_GRASPS,
    quiet: bool = False,
) -> Checkpoint:
    """Return the checkpoint with calibrations and a gel check, if there are enough validation grasps.

    A posterior needs three validation objects, and a touch with a second photo of its object. At most `max_grasps`
    grasps of each part are used. `foreign` are the foreign pictures of the gel check. The checkpoint's matcher is
    reused and modified.
    """
    seed, matcher = checkpoint.config.training.seed, checkpoint.matcher
    grasps = _sample_grasps(validation, seed, max_grasps)
    if not train or not grasps:
        return checkpoint
    touches, photos = recorded_features(matcher, source, grasps, quiet=quiet)
    scored = [
        each
        for pooled in ((False, True) if matcher.config.cell_dim else (False,))
        if (each := score_grasps(matcher, grasps, touches, photos, pooled=pooled)) is not None
    ]
    checkpoint = dataclasses.replace(checkpoint, opening=fit_opening([*train, *validation]))
    checkpoint = with_gel_check(
        checkpoint,
        source,
        train,
        validation,
        foreign=foreign,
        max_grasps=max_grasps,
        quiet=quiet,
    )
    if not scored:
        return checkpoint
    refused = [refused_touches(checkpoint, touches)]
    return with_calibrations(checkpoint, scored[:1], scored[1:], seed=seed, refused=refused)


def with_calibrations(
    checkpoint: Checkpoint,
    scored: Sequence[ScoredTouches],
    pooled: Sequence[ScoredTouches],
    *,
    seed: int = 0,
    refused: Sequence[NDArray[np.bool_]] | None = None,
) -> Checkpoint:
    """Return the checkpoint with calibrations on touches of objects outside the fit, of one matcher or several.

    `pooled` are the touches without late interaction, for an index without cells; empty for a model without cells.
    `refused` is as for `fit_verification`.
    """
    posterior = fit_posterior(*scored, seed=seed)
    return dataclasses.replace(
        checkpoint,
        posterior=posterior,
        references=fit_references(*scored, seed=seed),
        verification=fit_verification(scored, posterior, seed, refused),
        pooled_posterior=fit_posterior(*pooled, seed=seed) if pooled else checkpoint.pooled_posterior,
        pooled_references=fit_references(*pooled, seed=seed) if pooled else checkpoint.pooled_references,
    )


def with_gel_check(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: ForeignPictures = FOREIGN,
    max_grasps: int = MAX_CALIBRATION_GRASPS,
    quiet: bool = False,
) -> Checkpoint:
    """Return the checkpoint with a new gel check (`calibrate_checkpoint`).

    With fewer than `MIN_GRASPS` validation grasps it has none: the check of another sensor would refuse these touches.
    """
    seed, matcher, settings = checkpoint.config.training.seed, checkpoint.matcher, checkpoint.config.preprocessing
    train, validation = (_sample_grasps(part, seed, max_grasps) for part in (train, validation))
    if len(validation) < MIN_GRASPS:
        matcher.gel_head = None
        return dataclasses.replace(checkpoint, gel_check=None)
    half = dataclasses.replace(foreign, count=foreign.count // 2)
    fitting, test = (
        GelCheckFeatures.of(
            matcher,
            settings,
            grasps,
            recorded_features(matcher, source, grasps, quiet=quiet)[0],
            pictures,
            seed + number,
        )
        for number, (grasps, pictures) in enumerate(((train, foreign), (validation, half)))
    )
    head = fit_gel_head(fitting, PENALTY * FOREIGN.count / foreign.count)
    check = fit_gel_check(head, test, contact_levels(validation), foreign.margin)
    matcher.gel_head = head.to(default_device())
    return dataclasses.replace(checkpoint, gel_check=check)


@torch.inference_mode()
def refused_touches(checkpoint: Checkpoint, touches: Tensor) -> NDArray[np.bool_]:
    """Return (T,) whether the gel check refuses touches with these features (T, fingers * F); none without a check."""
    readings = checkpoint.matcher.gel_readings(touches.to(next(checkpoint.matcher.parameters()).device))
    if checkpoint.gel_check is None or readings is None:
        return np.zeros(len(touches), np.bool_)
    return np.not_equal(checkpoint.gel_check.classify(readings.cpu().numpy()), CONTACT)


def with_sensor_calibrations(
    checkpoint: Checkpoint, grasps: Sequence[Grasp], features: Features, *, quiet: bool = False
) -> Checkpoint:
    """Return the checkpoint with a gel check and the evidence of openings, from all grasps of a recording.

    The gel check is fitted on half of the objects, with thresholds from the others. `features` are those of the grasps.
    """
    names, device = sorted({grasp.object_id for grasp in grasps}), default_device()
    halves = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    checkpoint.matcher.to(device)
    source = FrozenFeatures(checkpoint.config, features_by_image(grasps, features, device))
    return with_gel_check(dataclasses.replace(checkpoint, opening=fit_opening(grasps)), source, *halves, quiet=quiet)


def _sample_grasps(grasps: Sequence[Grasp], seed: int, count: int) -> list[Grasp]:
    """Return the first `count` grasps, object by object in random order."""
    names = sorted({grasp.object_id for grasp in grasps})
    place = dict(zip(names, np.random.default_rng([seed, 5]).permutation(len(names)).argsort(), strict=True))
    return sorted(grasps, key=lambda grasp: place[grasp.object_id])[:count]
