"""Information of an answer and of the next grasp, in bits.

    gained     sum of P log2(P / P0): the Kullback-Leibler divergence of the posterior P from the prior P0
    remaining  sum of -P log2 P: the entropy of the posterior
    possible   log2(objects / (1 - none_prior)): the gain if one object becomes certain
    next grasp remaining * (1 - exp(w(n) - w(n + 1))),  w(n) = n / (1 + dependence * (n - 1))

w(n) is the number of independent grasps that are equivalent to n grasps of one object. Model: each independent grasp
reduces the remaining bits to 1/e; docs/service.md compares this estimate with measured grasps.

An answer may list only some of the objects. The others are assumed to have equal probabilities.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from retrieval.model.posterior import Posterior


@dataclass(frozen=True)
class Information:
    """Information of an answer to n grasps.

    Attributes:
        gained_bits: Gained information; all values are defined above.
        remaining_bits: Entropy of the posterior.
        possible_bits: Gain if one object becomes certain.
        next_grasp_bits: Expected gain of one more grasp.
        next_effective_grasps: w(n + 1).
    """

    gained_bits: float
    remaining_bits: float
    possible_bits: float
    next_grasp_bits: float
    next_effective_grasps: float


def information(
    posterior: Posterior, grasps: int, none: float, listed: Sequence[float], *, objects: int, none_prior: float
) -> Information:
    """Return the information of an answer.

    Args:
        posterior: The formula of the probabilities.
        grasps: Number of grasps that were scored, n.
        none: Probability of "none of these".
        listed: Probabilities of the listed objects.
        objects: Number of objects of the catalogue, at least as many as are listed.
        none_prior: Prior probability of "none of these".
    """
    unlisted = objects - len(listed)
    prior = (1 - none_prior) / objects
    # (posterior, prior) of each hypothesis, and the number of objects that have equal parts of these probabilities.
    hypotheses = [(none, none_prior, 1), *((probability, prior, 1) for probability in listed)]
    hypotheses.append((unlisted_probability(none, listed), unlisted * prior, unlisted))
    hypotheses = [(now, before, count) for now, before, count in hypotheses if now > 0 and before > 0]
    gained = math.fsum(now * math.log2(now / before) for now, before, _ in hypotheses)
    remaining = math.fsum(-now * math.log2(now / count) for now, _, count in hypotheses)
    return Information(
        max(0.0, gained),
        max(0.0, remaining),
        math.log2(objects / (1 - none_prior)),
        next_grasp_bits(posterior, grasps, max(0.0, remaining)),
        effective_grasps(posterior, grasps + 1),
    )


def unlisted_probability(none: float, listed: Sequence[float]) -> float:
    """Return the probability of all objects that an answer does not list."""
    return max(0.0, 1 - math.fsum((none, *listed)))


def effective_grasps(posterior: Posterior, grasps: int) -> float:
    """Return the number of independent grasps that are equivalent to `grasps` grasps of one object, w(n)."""
    return grasps * posterior.weight(grasps) / posterior.slope


def next_grasp_bits(posterior: Posterior, grasps: int, remaining_bits: float) -> float:
    """Return the expected gain in bits of one more grasp, after `grasps` grasps that leave `remaining_bits`."""
    gain = effective_grasps(posterior, grasps + 1) - effective_grasps(posterior, grasps)
    return remaining_bits * -math.expm1(-gain)
