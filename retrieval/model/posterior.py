"""P(o | touches, catalogue): the posterior of an answer, with "none of these" among the hypotheses.

    w = slope / (1 + dependence * (grasps - 1))        weight of a sum of match logits over `grasps` grasps
    l(o) = 1 / w * log mean exp(w * z)                 logit of object o; z: a photo's summed match logits
    P(o)    proportional to  (1 - p) / O * exp(w * l(o) + offset)
    P(none) proportional to  p

The catalogue has O objects. p is the prior probability that the
object in the hand is none of them; the objects have equal priors. `w * l(o) + offset` is the log of the ratio of two
likelihoods of these touches: on object o, and on an object that the catalogue lacks. The photos of an object are
equally likely views of it, so their likelihoods are averaged. If an object has one photo, l(o) is its match logit.

slope, offset and dependence maximise the likelihood of the right answer over random catalogues of validation
objects, with the true object and without it. Grasps of one object are correlated by `dependence`. At 0 they are
independent, and their logits add; at 1 more grasps add no information. n grasps count as n / (1 + dependence (n - 1))
independent ones (the design effect of cluster sampling; Kish 1965, section 5.4).

Objects that were not scored keep their part of the probability, estimated from a sample of them.

    P(o | present) = exp(w * l(o)) / sum of exp(w * l(o')) over all objects o' of the catalogue

P(o | present) is the probability of o given that the catalogue has the object. p and offset cancel out. It is computed
from the logits, never as P(o) / (1 - P(none)): that quotient is 0 / 0 if P(none) rounds to 1.

A single pair of a touch and a photo is classified as a match above the logit with w * l + offset = 0
(`Posterior.threshold`), the threshold of pair accuracy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from _touch_retrieval.documents import check_fields
from retrieval.errors import BadInput, NumericalError

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
NONE_PRIOR = 0.5
"""Default prior probability that the catalogue lacks the object."""
SLOPE_BOUNDS = (0.01, 100.0)
MAX_GRASPS = 5
"""Largest number of grasps of an object that the dependence is fitted on."""
FORMULA = (
    "P(o) ~ (1 - none_prior) / objects * exp(w * logit + offset), P(none of these) ~ none_prior, "
    "w = slope / (1 + dependence * (grasps - 1)), logit = log mean exp(w * z) / w over the photos of o, "
    "z = match logits summed over grasps"
)


@dataclass(frozen=True)
class PosteriorProbabilities:
    """Probabilities of one object in the hand; `none`, `objects` and `unscored` add up to 1.

    Attributes:
        none: Probability that the catalogue lacks it.
        objects: (J,) probability of each scored object, in the order of the logits.
        unscored: Probability that it is one of the objects that were not scored.
        objects_if_present: (J,) the same as `objects`, given that the catalogue has the object. Over all objects of
            the catalogue, scored or not, these probabilities add up to 1.
    """

    none: float
    objects: Floats
    unscored: float
    objects_if_present: Floats


@dataclass(frozen=True)
class EvidenceMass:
    """Log-sum-exp of w * logit over the objects of a catalogue or of a part of one, relative to `top`.

    Attributes:
        scored: Log of the sum of exp(w * logit - top) over the scored objects.
        unscored: The same over the other objects, estimated from a sample of them.
        objects: Number of scored and unscored objects.
        top: Largest w * logit. It is stored separately: adding it to the others would lose their last digits.
    """

    scored: float
    unscored: float
    objects: int
    top: float

    @classmethod
    def merged(cls, masses: Sequence["EvidenceMass"]) -> "EvidenceMass":
        """Return the evidence of several parts of a catalogue together: at least one part, no object in two parts."""
        top = max(mass.top for mass in masses)
        return cls(
            float(np.logaddexp.reduce([mass.scored + (mass.top - top) for mass in masses])),
            float(np.logaddexp.reduce([mass.unscored + (mass.top - top) for mass in masses])),
            sum(mass.objects for mass in masses),
            top,
        )


@dataclass(frozen=True)
class Posterior:
    """The parameters of the formula, and the number of trials (`tests`) that they were fitted on."""

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
        """Return the factor of the summed match logits of `grasps` grasps."""
        return self.slope / (1 + self.dependence * (grasps - 1))

    def log_ratio(self, logits: ArrayLike, grasps: int) -> Floats:
        """Return log likelihood ratios of objects with these logits to an object that the catalogue lacks."""
        return self.weight(grasps) * _finite(logits, "every logit") + self.offset

    def logit_of(self, log_ratio: Floats, grasps: int) -> Floats:
        """Inverse of `log_ratio`."""
        return np.asarray((log_ratio - self.offset) / self.weight(grasps))

    @property
    def threshold(self) -> float:
        """The match logit of one touch and one photo at which both hypotheses are equally likely."""
        return -self.offset / self.slope

    def object_logits(self, logits: ArrayLike, owner: Numbers, counts: Numbers, grasps: int = 1) -> Floats:
        """Return the logit (J,) of each object from the summed match logits (N,) of its scored photos.

        owner (N,) is the index of each photo's object, counts (J,) the number of photos of each object, at least 1.
        Photos that were not scored, because they are no candidates, add 0 to the mean likelihood of their object.
        Raises NumericalError for a logit that is not finite.
        """
        weight = self.weight(grasps)
        scaled = weight * _finite(logits, "every logit")
        top = np.full(len(counts), -np.inf)
        np.maximum.at(top, owner, scaled)
        total = np.bincount(owner, np.exp(scaled - top[owner]), len(counts))
        return np.asarray((top + np.log(total / counts)) / weight)  # if all photos have one logit: log 1 = 0, exactly

    def mass(self, logits: ArrayLike, grasps: int = 1, *, unscored: int = 0, sample: ArrayLike = ()) -> EvidenceMass:
        """Return the evidence mass of objects with logits (J,), J >= 1, and `unscored` others.

        sample (S,) are the logits of a random sample of the others, required if there are any. Raises NumericalError
        for a logit that is not finite.
        """
        known, drawn = _finite(logits, "every logit"), _finite(sample, "every logit of the sample")
        weighted, others = self.weight(grasps) * known, self.weight(grasps) * drawn
        top = float(max(weighted.max(), others.max() if unscored else -math.inf))
        rest = -math.inf
        if unscored:  # their number times the mean of the sample
            rest = math.log(unscored / len(drawn)) + float(np.logaddexp.reduce(others - top))
        return EvidenceMass(float(np.logaddexp.reduce(weighted - top)), rest, len(known) + unscored, top)

    def probabilities_given(
        self, logits: ArrayLike, mass: EvidenceMass, grasps: int = 1, none_prior: float = NONE_PRIOR
    ) -> PosteriorProbabilities:
        """Return the probabilities of the objects with these logits (J,). `mass` must include these objects."""
        some = _finite(logits, "every logit")
        each = math.log1p(-none_prior) - math.log(mass.objects) + self.offset
        none = math.log(none_prior) if none_prior else -math.inf
        # Logarithms relative to the largest one: exp(1000) is infinite, and a fraction with it would be NaN.
        none -= each + mass.top
        present = float(np.logaddexp(mass.unscored, mass.scored))
        whole = float(np.logaddexp(none, present))
        logs = self.weight(grasps) * some - mass.top
        posteriors, if_present = (np.exp(np.minimum(logs - total, 0.0)) for total in (whole, present))
        return PosteriorProbabilities(math.exp(none - whole), posteriors, math.exp(mass.unscored - whole), if_present)


def require_prior(none_prior: float) -> None:
    """Raise BadInput unless `none_prior` is a valid prior probability of "none of these"."""
    if not 0 <= none_prior < 1:
        raise BadInput(f'the prior of "none of these" must be at least 0 and less than 1; got {none_prior}')


def _finite(values: ArrayLike, name: str) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise NumericalError(f"{name} must be finite; got {array[~np.isfinite(array)][0]}")
    return array
