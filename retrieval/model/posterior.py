"""P(object | touches, catalogue), with "none of these" among the hypotheses: the one formula of every probability.

    w = slope / (1 + dependence * (grasps - 1))        what a sum of match logits over so many grasps is worth
    l(o) = 1 / w * log mean exp(w * z)                 logit of object o: over the summed match logits z of its photos
    P(o)    proportional to  (1 - p) / O * exp(w * l(o) + offset)
    P(none) proportional to  p

O is the number of objects in the catalogue and p the prior probability that the object in the hand is none of them;
the others are taken as alike. `w * l(o) + offset` is the log of a likelihood ratio: how much likelier these touches
are of object o than of one that the catalogue lacks. A photo is one view of its object, each as likely, so their
likelihoods are averaged; an object with one photo has just its match logit.

slope, offset and dependence have the greatest likelihood of "which object was it, or none" over catalogues of
validation objects, drawn with the true object and without. Grasps of one object are alike: n of them, correlated by
`dependence` (0: independent, their logits add; 1: more grasps tell nothing new), weigh as n / (1 + dependence (n - 1))
independent ones (the design effect of cluster sampling; Kish 1965, section 5.4).

Objects that were not judged keep their share of the probability, estimated from a sample of them.

    P(o | present) = exp(w * l(o)) / sum of exp(w * l(o')) over all objects o' of the catalogue

P(o | present) is the probability of o given that the catalogue has the object. p and offset cancel out. It is computed
from the logits, never as P(o) / (1 - P(none)): that quotient is 0 / 0 where P(none) rounds to 1.

From a query to its probabilities, in four files:

    judge.py                FusionScorer.logits sums the match logits z of a photo over the grasps
    search/query/objects.py Objects.judged gives each object the logit l(o) of its photos (Posterior.object_logits)
    search/query/shard.py   FolderShard.ask chooses the photos that are scored and samples the other objects (Mass)
    posterior.py            Mass.joined adds the shards; Posterior.share gives P(o), P(none) and the verdict's rule;
                            fit_posterior fits slope, offset and dependence

Reference touches change l(o) before the third step (references.py).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from _touch_retrieval.documents import check_fields, typed
from retrieval.errors import BadInput, NumericalError

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
NONE_PRIOR = 0.5
"""That the catalogue lacks the object, where a user says nothing: as likely as not."""
SLOPE_BOUNDS = (0.01, 100.0)
MAX_GRASPS = 5
"""Grasps of an object that the dependence is fitted on; of larger sets nothing is known."""
FORMULA = (
    "P(o) ~ (1 - none_prior) / objects * exp(w * logit + offset), P(none of these) ~ none_prior, "
    "w = slope / (1 + dependence * (grasps - 1)), logit = log mean exp(w * z) / w over the photos of o, "
    "z = match logits summed over grasps"
)


@dataclass(frozen=True)
class PosteriorProbabilities:
    """What is believed of one object in the hand; `none`, `objects` and `unscored` add up to 1.

    none: that it is none of the catalogue's. objects (J,): that it is each of the judged ones, in the order given.
    unjudged: that it is one of those that were not judged. objects_if_present (J,): probabilities of the judged
    objects given that the catalogue has the object; over all its objects these add up to 1.
    """

    none: float
    objects: Floats
    unscored: float
    objects_if_present: Floats

    @property
    def is_match(self) -> bool:
        """Whether the best object is likelier than "none of these": the rule of the verdict."""
        return bool(self.objects.max() > self.none)


@dataclass(frozen=True)
class EvidenceMass:
    """What objects of a catalogue, or of a part of one, weigh together: logs of their sums of exp(w * logit - top).

    judged: of those that were judged; unjudged: of the others, as a sample of them says. objects: how many of both.
    top: the largest w * logit, told apart: in a sum with it the others' digits would be lost.
    """

    scored: float
    unscored: float
    objects: int
    top: float

    @classmethod
    def merged(cls, masses: Sequence["EvidenceMass"]) -> "EvidenceMass":
        """What several parts of a catalogue weigh together: one part at least, no object in two of them."""
        top = max(mass.top for mass in masses)
        return cls(
            float(np.logaddexp.reduce([mass.scored + (mass.top - top) for mass in masses])),
            float(np.logaddexp.reduce([mass.unscored + (mass.top - top) for mass in masses])),
            sum(mass.objects for mass in masses),
            top,
        )

    def extrapolated(self, objects: int) -> "EvidenceMass":
        """The same with so many more objects, of which nothing is known: each is taken to weigh what these do on
        average.
        """
        if not objects:
            return self
        mean = float(np.logaddexp(self.scored, self.unscored)) - math.log(self.objects)
        unscored = float(np.logaddexp(self.unscored, math.log(objects) + mean))
        return EvidenceMass(self.scored, unscored, self.objects + objects, self.top)


@dataclass(frozen=True)
class Posterior:
    """The formula's numbers, and how many catalogues they were fitted on."""

    formula: str = field(default=FORMULA, kw_only=True, repr=False)
    slope: Annotated[float, Meta(ge=SLOPE_BOUNDS[0], le=SLOPE_BOUNDS[1])] = 1.0
    offset: float = 0.0
    dependence: Annotated[float, Meta(ge=0, le=1)] = 1.0
    tests: Annotated[int, Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        check_fields(self, "posterior", BadInput)
        if self.formula != FORMULA:
            raise BadInput("posterior.formula is not the one of this version; train again, or build the index again")

    def weight(self, grasps: int) -> float:
        """What the sum of the match logits of so many grasps is multiplied by."""
        return self.slope / (1 + self.dependence * (grasps - 1))

    def log_ratio(self, logits: ArrayLike, grasps: int) -> Floats:
        """How much likelier the grasps are of objects with these logits than of one that the catalogue lacks; logs."""
        return self.weight(grasps) * _finite(logits, "every logit") + self.offset

    def logit_of(self, log_ratio: Floats, grasps: int) -> Floats:
        """Inverse of `log_ratio`."""
        return np.asarray((log_ratio - self.offset) / self.weight(grasps))

    def object_logits(self, logits: ArrayLike, owner: Numbers, counts: Numbers, grasps: int = 1) -> Floats:
        """Logit (J,) of each object from the summed match logits (N,) of its judged photos.

        owner (N,): number of each photo's object, 0 to J - 1, each with a photo at least. counts (J,): photos that
        each object has; those that were not judged count as no match at all, which the search for candidates makes
        nearly true. Raises NumericalError for a logit that is not finite.
        """
        weight = self.weight(grasps)
        scaled = weight * _finite(logits, "every logit")
        top = np.full(len(counts), -np.inf)
        np.maximum.at(top, owner, scaled)
        total = np.bincount(owner, np.exp(scaled - top[owner]), len(counts))
        return np.asarray((top + np.log(total / counts)) / weight)  # equal photos: exactly log 1, however many

    def probabilities(
        self,
        logits: ArrayLike,
        grasps: int = 1,
        *,
        none_prior: float = NONE_PRIOR,
        unscored: int = 0,
        sample: ArrayLike = (),
    ) -> PosteriorProbabilities:
        """The posterior over judged objects, those not judged, and none.

        logits (J,) of the judged objects, J >= 1 (`object_logits`). unjudged: how many objects were not judged.
        sample (S,): logits of some of these, drawn at random; needed where there are any. Raises BadInput, and
        NumericalError for a logit that is not finite.
        """
        require_prior(none_prior)
        return self.probabilities_given(
            logits, self.mass(logits, grasps, unscored=unscored, sample=sample), grasps, none_prior
        )

    def mass(self, logits: ArrayLike, grasps: int = 1, *, unscored: int = 0, sample: ArrayLike = ()) -> EvidenceMass:
        """What objects weigh, given as `probabilities` takes them; of several parts of a catalogue, `EvidenceMass.merged`."""
        scored, drawn = _finite(logits, "every logit"), _finite(sample, "every logit of the sample")
        if not len(scored) or unscored < 0 or (unscored and not len(drawn)):
            raise BadInput(
                "a posterior needs a judged object, and a sample where others were not judged; got "
                f"{len(scored)} judged, {unscored} not, and a sample of {len(drawn)}"
            )
        weighed, others = self.weight(grasps) * scored, self.weight(grasps) * drawn
        top = float(max(weighed.max(), others.max() if unscored else -math.inf))
        rest = -math.inf
        if unscored:  # so many times the mean of the sample
            rest = math.log(unscored / len(drawn)) + float(np.logaddexp.reduce(others - top))
        return EvidenceMass(float(np.logaddexp.reduce(weighed - top)), rest, len(scored) + unscored, top)

    def probabilities_given(
        self, logits: ArrayLike, mass: EvidenceMass, grasps: int = 1, none_prior: float = NONE_PRIOR
    ) -> PosteriorProbabilities:
        """What is believed of some of the objects that `mass` stands for: `objects` (J,) are those of these logits."""
        some = _finite(logits, "every logit")
        each = math.log1p(-none_prior) - math.log(mass.objects) + self.offset
        none = math.log(none_prior) if none_prior else -math.inf
        # In logarithms: exp of a logit of 1000 is infinite, and the share of the best one would be NaN. All are told
        # from the best one's.
        none -= each + mass.top
        present = float(np.logaddexp(mass.unscored, mass.scored))
        whole = float(np.logaddexp(none, present))
        logs = self.weight(grasps) * some - mass.top
        shares, if_present = (np.exp(np.minimum(logs - total, 0.0)) for total in (whole, present))
        return PosteriorProbabilities(math.exp(none - whole), shares, math.exp(mass.unscored - whole), if_present)

    def more_grasps(self, logit: float, objects: int, grasps: int, none_prior: float = NONE_PRIOR) -> int | None:
        """Estimate how many further grasps make the best object likelier than "none of these".

        The further grasps are taken to be like the g made so far: their match logits have the same mean, so that n
        grasps together have the summed logit n / g * l. The best object is likelier than none after the first n with

            slope * n / (1 + dependence * (n - 1)) * l / g + offset  >  log objects + log (p / (1 - p))

        The left side grows by the factor 1 / dependence at most, however many grasps are made. docs/answers.md says how
        often the estimate comes true.

        Args:
            logit: of the best object, l; it is not likelier than none yet.
            objects: of the catalogue.
            grasps: so far, g.
            none_prior: p, more than 0.

        Returns:
            The number of further grasps, n - g; None where none up to `MAX_GRASPS` together suffices.
        """
        needed = math.log(objects) + math.log(none_prior) - math.log1p(-none_prior) - self.offset
        for total in range(grasps + 1, MAX_GRASPS + 1):
            if self.weight(total) * total * logit / grasps > needed:
                return total - grasps
        return None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints and in `calibration.json`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "Posterior":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        return typed(data, cls, "posterior", complete=True, error=BadInput)


def require_prior(none_prior: float) -> None:
    """Raises BadInput for what is no prior probability of "none of these"."""
    if not 0 <= none_prior < 1:
        raise BadInput(f'the prior of "none of these" must be at least 0 and less than 1; got {none_prior}')


def _finite(values: ArrayLike, what: str) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise NumericalError(f"{what} must be finite; got {array[~np.isfinite(array)][0]}")
    return array


# Fitting ---------------------------------------------------------------------------------------------------

CATALOGUE_SIZES = (20, 1000)
"""Objects of the catalogues that the numbers are fitted on; at most all but one of the validation objects."""
MIN_OBJECTS = 3
"""That a posterior is fitted on: a catalogue of two has one of two without the true object beside it."""
_SETS = 4
_SEARCH = {"xatol": 1e-4, "fatol": 1e-9, "maxiter": 2000}


@dataclass(frozen=True, eq=False)
class ScoredTouches:
    """Match logits (T, N) of touches with photos; whose they are (T,), (N,); own (T, N): photos that were taken in a
    grasp of that very touch and are not shown to it.
    """

    logits: NDArray[np.floating[Any]]
    touch_owner: Numbers
    photo_owner: Numbers
    own: NDArray[np.bool_]


def fit_posterior(*parts: ScoredTouches, seed: int = 0) -> Posterior:
    """Fit on single touches of validation objects and, where an object has more, on sets of up to 5 grasps of it.

    parts: of one matcher, or of several, such as those of folds, each with objects of its own. With one grasp of each
    object only nothing is known of the dependence, and it is 1. Raises BadInput for fewer than three objects, or where
    no touch has another photo of its object.
    """
    return fit_posterior_to_trials([questions for scored in parts for questions in identification_trials(scored, seed)])


def identification_trials(scored: ScoredTouches, seed: int) -> Iterator["IdentificationTrials"]:
    """IdentificationTrials asked by single touches, and then by sets of two grasps, three and so on, as far as objects have grasps
    for them.
    """
    for grasps in range(1, MAX_GRASPS + 1):
        rng = np.random.default_rng([seed, grasps])
        sets = []  # touches of one object each, which leave that object a photo; of one grasp every touch
        for name in np.unique(scored.touch_owner):
            mine = np.flatnonzero(scored.touch_owner == name)
            draws = mine[:, None] if grasps == 1 else [rng.permutation(mine)[:grasps] for _ in range(_SETS)]
            photos = scored.photo_owner == name
            sets += [rows for rows in draws if len(rows) == grasps and (photos & ~scored.own[rows].any(0)).any()]
        if sets or grasps == 1:
            yield IdentificationTrials.of(scored, np.array(sets, dtype=np.int64).reshape(-1, grasps), seed)


@dataclass(frozen=True, eq=False)
class IdentificationTrials:
    """Which object was it, or none? Asked of catalogues with the true object and without it.

    scores (T, N): summed match logits, photos sorted by object, -inf for one that is not shown; counts (T, O): photos
    shown of each object; starts (O,): each object's first photo. catalogues: (T, K + 1) objects, the true one first;
    the first K are a catalogue with it, the last K one without.
    """

    grasps: int
    scores: Floats
    counts: Numbers
    starts: Numbers
    catalogues: tuple[Numbers, ...]

    @classmethod
    def of(cls, scored: ScoredTouches, sets: Numbers, seed: int = 0) -> "IdentificationTrials":
        """IdentificationTrials asked by sets of G touches each, `sets` (S, G). Raises BadInput where there are none, or fewer than
        three objects.
        """
        objects, owner = np.unique(scored.photo_owner, return_inverse=True)
        if len(objects) < MIN_OBJECTS or not len(sets):
            raise BadInput(
                "a posterior is fitted on three objects at least, and on touches that have another photo of theirs; "
                f"got {len(objects)} objects and {len(sets)} such touches"
            )
        order = np.argsort(owner, kind="stable")
        starts = np.searchsorted(owner[order], np.arange(len(objects)))
        shown = ~np.asarray(scored.own[sets].any(axis=1))[:, order]
        scores = np.where(shown, scored.logits[:, order].astype(np.float64)[sets].sum(1), -np.inf)
        counts = np.add.reduceat(shown.astype(np.int64), starts, axis=1)
        true = np.searchsorted(objects, scored.touch_owner[sets[:, 0]])
        keys = np.random.default_rng([seed, 100 + sets.shape[1]]).random(counts.shape)
        keys[np.arange(len(sets)), true] = -1
        ranked = np.argsort(keys, axis=1)
        sizes = sorted({min(size, len(objects) - 1) for size in CATALOGUE_SIZES})
        return cls(sets.shape[1], scores, counts, starts, tuple(ranked[:, : size + 1] for size in sizes))

    def log_ratios(self, posterior: Posterior) -> Floats:
        """(T, O) logs of the likelihood ratios of the objects."""
        scaled = posterior.weight(self.grasps) * self.scores
        shown = np.maximum(self.counts, 1)  # an object without a photo stands in no catalogue
        top = np.maximum.reduceat(scaled, self.starts, axis=1)
        base = np.where(np.isfinite(top), top, 0.0)
        owner = np.repeat(np.arange(len(self.starts)), np.diff(np.append(self.starts, scaled.shape[1])))
        sums = np.add.reduceat(np.exp(scaled - base[:, owner]), self.starts, axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(base + (np.log(sums) - np.log(shown)) + posterior.offset)

    def loss(self, posterior: Posterior, smooth: float) -> float:
        """Mean over catalogues of the cross-entropy with the truth, at even odds of "none of these".

        smooth: of the target, the share that is spread evenly over all hypotheses.
        """
        ratios, losses = self.log_ratios(posterior), []
        for catalogue in self.catalogues:
            chosen = np.take_along_axis(ratios, catalogue, 1) - math.log(catalogue.shape[1] - 1)
            for part, truth in ((chosen[:, :-1], 1), (chosen[:, 1:], 0)):
                logs = np.column_stack([np.zeros(len(part)), part])
                logs = logs - np.logaddexp.reduce(logs, axis=1, keepdims=True)
                losses.append(-((1 - smooth) * logs[:, truth] + smooth * logs.mean(1)).mean())
        return float(np.mean(losses))


def fit_posterior_to_trials(trials: Sequence[IdentificationTrials]) -> Posterior:
    """The likeliest posterior for the answers to all of these questions, each counting once.

    Targets are smoothed as Platt's are (1999, section 2.2), so that logits that never err have a finite optimum too,
    and the slope stays within `SLOPE_BOUNDS`.
    """
    from scipy.optimize import minimize  # slow to import, and no query needs it

    count = sum(len(part.scores) for part in trials)
    several = any(part.grasps > 1 for part in trials)
    finite = np.concatenate([part.scores[np.isfinite(part.scores)] / part.grasps for part in trials])
    # Told from the middle of the logits, the offset does not hang on the slope, and the search finds both.
    middle, unit = float(np.median(finite)), float(np.std(finite))
    low, high = np.log(SLOPE_BOUNDS)
    start = float(np.clip(-math.log(unit) if unit > 0 else 0.0, low, high))

    def made(parameters: Floats) -> Posterior:
        slope = float(np.clip(np.exp(parameters[0]), *SLOPE_BOUNDS))
        dependence = float(parameters[2]) if several else 1.0  # of which single grasps say nothing
        return Posterior(slope, float(parameters[1]) - slope * middle, dependence, count)

    def loss(parameters: Floats) -> float:
        posterior = made(parameters)
        return sum(len(part.scores) * part.loss(posterior, 1 / (count + 2)) for part in trials) / count

    searched = slice(3 if several else 2)
    bounds = [(low, high), (-1e6, 1e6), (0.0, 1.0)][searched]
    first = np.array([start, 0.0, 0.5])[searched]
    simplex = np.vstack([first, first + np.diag([-0.5 if start > 0 else 0.5, 0.5, 0.25][searched])])
    found = minimize(loss, first, method="Nelder-Mead", bounds=bounds, options={**_SEARCH, "initial_simplex": simplex})
    return made(found.x)
