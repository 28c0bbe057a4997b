"""Choice of the next grasp, replayed on recorded grasps: accuracy of late fusion against the number of grasps.

After a first grasp of an object, a policy chooses each further grasp among the recorded ones:

    spread       the one whose place is farthest from those of the earlier grasps (by height: `robot.SpreadPlanner`)
    random       any
    repeated     the first grasp again
    upper_bound  the one after which the true object leads by the largest margin: it knows the answer

The catalogue has one photo of each test object; the grasp of that photo is not replayed. Objects are ranked by the sum
of the match logits.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.predictions import Predictions, scored_touches
from retrieval.evaluation.queries import Queries
from retrieval.metrics.intervals import LEVEL, summarise
from retrieval.metrics.measure import Measure
from retrieval.model.posterior import MIN_OBJECTS, ScoredTouches

GRASPS = 5
"""Grasps of a sequence."""
ACCURACY = 0.8
"""Accuracy for which the number of grasps is stated."""
CATALOGUES = 4
"""Draws of the catalogue's photos."""
DRAWS = 2000
"""Resamples of the objects."""

Rows = NDArray[np.int64]
Floats = NDArray[np.float64]
Policy = Callable[[list[int], list[int]], int]
"""Returns the next grasp, given the earlier and the remaining ones."""


class Replay(NamedTuple):
    """Replayed sequences of grasps.

    Attributes:
        owner: (S,) object of each sequence.
        ranks_first: By policy, whether this object ranks first after each grasp (S, GRASPS).
    """

    owner: Rows
    ranks_first: dict[str, NDArray[np.bool_]]


def score_next_grasp(
    queries: Queries, predictions: Sequence[Predictions], heights_mm: Sequence[float | None], seed: int
) -> dict[str, Any] | None:
    """Return "next_grasp" of results.json: accuracy by policy after 1 to `GRASPS` grasps, and grasps to `ACCURACY`.

    Args:
        queries: The queries of the evaluation.
        predictions: Scores of late fusion for each training seed.
        heights_mm: Height of the gripper in each of the queries' touches; None if it was not recorded.
        seed: Seed of the random choices.

    Returns:
        The values, averaged over training seeds. None if fewer than three test objects have more than `GRASPS` grasps
        of known height.
    """
    touches = queries.of_part(queries.touch_owner, "test")
    heights = np.array([math.nan if heights_mm[row] is None else heights_mm[row] for row in touches], dtype=np.float64)
    replayed = [replay(scored_touches(queries, scores, "test"), heights[:, None], seed) for scores in predictions]
    if not replayed or len(np.unique(replayed[0][0])) < MIN_OBJECTS:
        return None
    return compare_policies(replayed, queries.part_of.count("test"), seed)


def compare_policies(replayed: Sequence[Replay], candidates: int, seed: int) -> dict[str, Any]:
    """Return the accuracy of each policy, and its number of grasps to `ACCURACY`, with intervals over objects.

    Args:
        replayed: The same sequences with the scores of each training seed.
        candidates: Number of objects that each sequence is compared with.
        seed: Seed of the resamples.
    """
    owner, policies = replayed[0]
    chance = np.full(GRASPS, 1 / candidates)
    measures = {
        policy: [Measure(correct[policy].astype(float), owner, chance, "test objects") for _, correct in replayed]
        for policy in policies
    }
    means = {policy: np.mean([one.by_object()[1] for one in each], axis=0) for policy, each in measures.items()}
    # A resample has the same objects for all policies.
    needed = {policy: (grasps_needed(each.mean(0)), resampled_grasps(each, seed)) for policy, each in means.items()}
    found = {}
    for policy, each in measures.items():
        summary = summarise(each, seed=seed)
        (value, resampled), (random, random_resampled) = needed[policy], needed["random"]
        with np.errstate(invalid="ignore"):  # inf / inf: neither this policy nor "random" reaches the accuracy
            ratios = np.where(np.isfinite(random_resampled), resampled / random_resampled, math.inf)
        found[policy] = {
            "accuracy": [list(row) for row in zip(summary["value"], summary["low"], summary["high"], strict=True)],
            "grasps_needed": _interval(value, resampled),
            "relative_to_random": _interval(value / random if math.isfinite(random) else math.inf, ratios),
        }
    return {"candidates": candidates, "objects": len(means["random"]), "sequences": len(owner), "policies": found}


def replay(scored: ScoredTouches, places: Floats, seed: int) -> Replay:
    """Replay sequences of grasps that start with each usable touch.

    Args:
        scored: Match logits of the touches with the photos.
        places: (T, d) coordinates of each touch; touches with nan are not replayed.
        seed: Seed of the random choices.
    """
    rng = np.random.default_rng([seed, 21])
    objects = np.unique(scored.photo_owner)
    owners: list[int] = []
    correct: dict[str, list[NDArray[np.bool_]]] = {}
    for _ in range(CATALOGUES):
        catalogue = np.array([rng.choice(np.flatnonzero(scored.photo_owner == name)) for name in objects])
        logits = scored.logits[:, catalogue].astype(np.float64)
        for column, name in enumerate(objects):
            usable = (scored.touch_owner == name) & ~scored.own[:, catalogue[column]] & np.isfinite(places).all(1)
            rows = np.flatnonzero(usable).tolist()
            if len(rows) < GRASPS:
                continue
            policies = _policies(logits, column, places, rng)
            for first in rows:
                owners.append(int(name))
                for policy, choose in policies.items():
                    order = [first]
                    while len(order) < GRASPS:
                        order.append(choose(order, [row for row in rows if row not in order]))
                    ranked_first = logits[order].cumsum(axis=0).argmax(axis=1)
                    correct.setdefault(policy, []).append(ranked_first == column)
    return Replay(np.array(owners, dtype=np.int64), {policy: np.array(each) for policy, each in correct.items()})


def _policies(logits: Floats, true: int, places: Floats, rng: np.random.Generator) -> dict[str, Policy]:
    """Return the policies for one object, by name."""

    def lead(rows: list[int]) -> float:
        total = logits[rows].sum(axis=0)
        return float(total[true] - np.delete(total, true).max())

    def distance(row: int, earlier: list[int]) -> float:
        return float(np.linalg.norm(places[earlier] - places[row], axis=1).min())

    return {
        "spread": lambda earlier, left: max(left, key=lambda row: distance(row, earlier)),
        "random": lambda _, left: int(rng.choice(left)),
        "repeated": lambda earlier, _: earlier[0],
        "upper_bound": lambda earlier, left: max(left, key=lambda row: lead([*earlier, row])),
    }


def grasps_needed(accuracy: Floats, level: float = ACCURACY) -> float:
    """Return the number of grasps to an accuracy, interpolated between whole numbers; infinite if it is not reached.

    Args:
        accuracy: (n,) accuracy after 1 to n grasps.
        level: The required accuracy.
    """
    reached = np.flatnonzero(accuracy >= level)
    if not len(reached):
        return math.inf
    after = int(reached[0])
    if after == 0:
        return 1.0
    before = accuracy[after - 1]
    return float(after + (level - before) / (accuracy[after] - before))


def resampled_grasps(means: Floats, seed: int) -> Floats:
    """Return `grasps_needed` (DRAWS,) for resamples of the objects. All policies use the same resamples.

    Args:
        means: (R, GRASPS) accuracy of each object.
        seed: Seed of the resamples.
    """
    count = len(means)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=DRAWS)
    return np.array([grasps_needed(accuracy) for accuracy in drawn @ means / count])


def _interval(value: float, resampled: Floats) -> dict[str, float | None]:
    """Return a number of grasps, or a ratio of two, with its interval; None where `ACCURACY` is not reached."""
    low, high = np.quantile(resampled, ((1 - LEVEL) / 2, (1 + LEVEL) / 2), method="nearest")
    return {
        name: float(number) if math.isfinite(number) else None
        for name, number in (("value", value), ("low", low), ("high", high))
    }
