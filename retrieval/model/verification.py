"""Verification: does the hand hold the expected object? Thresholds with a stated false-accept rate.

    accept           if the largest log likelihood ratio after 1, 2, ... grasps is at least `a`
    reject           if the last one is at most `b`, or after MAX_GRASPS grasps
    another grasp    otherwise

The ratio compares "this object" with "an object that the catalogue lacks" (`retrieval.model.posterior`). This is a
sequential test between two bounds (Wald 1945), which are quantiles over sequences of grasps of validation objects. The
largest ratio over MAX_GRASPS grasps exceeds `a` for the fraction `far` of the impostors. The bound `b` causes
additional false rejects: at most a tenth of those that `a` causes, or MIN_EARLY_REJECTS if that is larger.

An impostor is a false claim: the expected object is any other object than that in the hand, or the one whose photos are
most similar to it. Both kinds are measured.
Terms follow ISO/IEC 19795-1: false-accept rate (FAR), false-reject rate (FRR), genuine, impostor.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import check_fields
from retrieval.errors import BadInput

MAX_GRASPS = 4
"""Largest number of grasps before a decision."""
MIN_OBJECTS = 20
"""Number of validation objects that a calibration needs."""
CARD_FAR = 0.2
"""False-accept rate of the model card. Every calibration supports it."""
MIN_EARLY_REJECTS = 0.005
"""The bound `b` may always reject this fraction of the genuine sequences, even if `a` rejects none of them."""
ERRORS_NEEDED = 30
"""The data support a rate if at least this many errors are expected at it (rule of 30, Doddington et al. 2000)."""
LEVELS = tuple(float(level) for level in np.round(np.geomspace(1e-5, 0.5, 95), 9))
"""False-accept rates whose thresholds are stored."""
QUANTILES = tuple(float(level) for level in np.round(np.linspace(0, 1, 201), 3))

Floats = NDArray[np.float64]
ACCEPT, REJECT, ANOTHER_GRASP = "accept", "reject", "another grasp"


@dataclass(frozen=True)
class ErrorRate:
    """An error rate on validation objects, with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class DecisionBounds:
    """The two bounds of a verification, and its error rates.

    Attributes:
        accept: Smallest log likelihood ratio that accepts.
        reject: Largest log likelihood ratio that rejects before the last grasp.
        false_accepts: The requested false-accept rate, for random impostors.
        similar_false_accepts: The false-accept rate if the expected object is the one most similar to the object in the
            hand, in a catalogue with as many objects as one group of validation objects.
        false_rejects: False-reject rate after all `MAX_GRASPS` grasps.
        accepted: Fraction of genuine sequences that reach `accept` within 1, 2, ... grasps.
    """

    accept: float
    reject: float
    false_accepts: ErrorRate
    similar_false_accepts: ErrorRate
    false_rejects: ErrorRate
    accepted: tuple[float, ...]

    def decide(self, ratios: Floats) -> str:
        """Return the decision after the log likelihood ratios (G,) of the first grasp, the first two, and so on."""
        if ratios.max() >= self.accept:
            return ACCEPT
        return REJECT if ratios[-1] <= self.reject or len(ratios) >= MAX_GRASPS else ANOTHER_GRASP


@dataclass(frozen=True)
class VerificationCalibration:
    """Log likelihood ratios of sequences of grasps of validation objects.

    Attributes:
        group_sizes: Number of validation objects in each group. Objects of two groups were not compared.
        impostors: Quantiles (1 - `LEVELS`) of the largest ratio of a random impostor.
        similar: Quantiles (`QUANTILES`) of the largest ratio of the most similar impostor.
        genuine: For 1 to `MAX_GRASPS` grasps, quantiles of the largest ratio of genuine sequences so far.
        lowest: Quantiles of the lowest ratio of genuine sequences before the last grasp.
    """

    group_sizes: tuple[Annotated[int, Meta(ge=1)], ...]
    impostors: tuple[float, ...]
    similar: tuple[float, ...]
    genuine: tuple[tuple[float, ...], ...]
    lowest: tuple[float, ...]

    def __post_init__(self) -> None:
        check_fields(self, "verification", BadInput)
        sizes = [len(self.impostors), *map(len, (self.similar, self.lowest, *self.genuine)), len(self.genuine)]
        expected = [len(LEVELS), *[len(QUANTILES)] * (2 + len(self.genuine)), MAX_GRASPS]
        if sizes != expected:
            raise BadInput(f"verification must have {expected} numbers, got {sizes}")
        if not supports_calibration(self.group_sizes):
            raise BadInput(
                f"verification must have at least {MIN_OBJECTS} objects, got groups of {list(self.group_sizes)}"
            )

    @property
    def objects(self) -> int:
        """Number of validation objects."""
        return sum(self.group_sizes)

    @property
    def pairs(self) -> int:
        """Number of pairs of different validation objects that were compared."""
        return _pairs(self.group_sizes)

    def bounds(self, far: float) -> DecisionBounds:
        """Return the bounds at a false-accept rate.

        Raises:
            BadInput: The rate is not between 0 and 0.5, or too small for the number of validation objects.
        """
        if not (isinstance(far, int | float) and 0 < far <= LEVELS[-1]):
            raise BadInput(f"the false-accept rate must be above 0 and at most {LEVELS[-1]:g}, got {far}")
        if self.pairs < ERRORS_NEEDED / far:
            needed = objects_needed(far, len(self.group_sizes))
            supported = ERRORS_NEEDED / self.pairs
            step = 10.0 ** (math.floor(math.log10(supported)) - 1)
            raise BadInput(
                f"a false-accept rate of {far:g} needs {needed:,} validation objects; the model has {self.objects}, "
                f"enough for {math.ceil(supported / step) * step:.2g}: give a larger rate, or fit the model "
                "with more such objects"
            )
        accept = float(np.interp(math.log(far), np.log(LEVELS), self.impostors))
        rejects = _fraction_below(accept, self.genuine[-1])
        early = max(MIN_EARLY_REJECTS, rejects / 10)
        reject = min(float(np.interp(early, QUANTILES, self.lowest)), accept)
        return DecisionBounds(
            accept,
            reject,
            error_rate(far, self.pairs),
            error_rate(1 - _fraction_below(accept, self.similar), self.objects),
            error_rate(min(1.0, rejects + early), self.objects),
            tuple(1 - _fraction_below(accept, quantiles) for quantiles in self.genuine),
        )


def supports_calibration(group_sizes: tuple[int, ...]) -> bool:
    """Whether groups of this many validation objects have enough pairs for `CARD_FAR`."""
    return sum(group_sizes) >= MIN_OBJECTS and _pairs(group_sizes) >= ERRORS_NEEDED / CARD_FAR


def _pairs(group_sizes: tuple[int, ...]) -> int:
    return sum(size * (size - 1) // 2 for size in group_sizes)


def _fraction_below(value: float, quantiles: tuple[float, ...]) -> float:
    """Return the fraction of a distribution that lies below a value."""
    return float(np.interp(value, quantiles, QUANTILES, left=0.0, right=1.0))


def objects_needed(far: float, groups: int = 1) -> int:
    """Return how many validation objects in `groups` groups this false-accept rate needs.

    `ERRORS_NEEDED` errors must be expected among all pairs of objects that share a group.
    """
    return math.ceil((groups + math.sqrt(groups**2 + 8 * groups * ERRORS_NEEDED / far)) / 2)


def error_rate(value: float, trials: int) -> ErrorRate:
    """Return a rate with its interval for this number of independent trials (Clopper and Pearson 1934)."""
    from retrieval.metrics.intervals import binomial_interval  # imports scipy, which queries do not need

    return ErrorRate(value, *binomial_interval(value * trials, trials))
