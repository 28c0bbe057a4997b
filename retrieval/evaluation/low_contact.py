"""Separate measures of low-contact touches, which hardly press the gel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.data.images import read_rgb
from retrieval.errors import DatasetError
from retrieval.evaluation.controls import CONTROL_MEASURES
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.scoring import MethodScores, summaries
from retrieval.metrics.measure import Measure
from retrieval.metrics.registry import MethodScoreTables, compute

LOW_CONTACT_FRACTION = 0.05
"""Fraction of the touches, those with the smallest gel change, that are called low-contact."""


@dataclass(frozen=True, eq=False)
class LowContactTouches:
    """The low-contact touches of one part of the split.

    Attributes:
        gel_change: Largest gel change among these touches, grey levels.
        rows: (Q,) whether each touch of the part is one of them.
    """

    gel_change: float
    rows: NDArray[np.bool_]


def find_low_contact_touches(grasps: Sequence[Grasp], *, quiet: bool = True) -> LowContactTouches | None:
    """Return the touches with the smallest `gel_change`; None if a grasp lacks no-contact frames.

    Args:
        grasps: The grasps of one part.
        quiet: No progress on stderr.
    """
    if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
        return None
    changes = []
    with Bar("compare with no-contact frames", len(grasps), "grasps", quiet=quiet) as bar:
        for grasp in grasps:
            changes.append(gel_change(grasp))
            bar.advance()
    strongest = float(np.sort(changes)[max(round(LOW_CONTACT_FRACTION * len(changes)), 1) - 1])
    return LowContactTouches(strongest, np.array(changes) <= strongest)


def gel_change(grasp: Grasp) -> float:
    """Return the mean absolute difference between gel image and no-contact frame, grey levels.

    Args:
        grasp: A grasp with no-contact frames; of two fingers, the larger change is returned.

    Raises:
        DatasetError: The two images differ in size.
    """
    return max(map(_finger_change, grasp.touches, grasp.backgrounds))


def _finger_change(touch: Path, before: Path) -> float:
    pressed, no_contact = read_rgb(touch), read_rgb(before)
    if pressed.shape != no_contact.shape:
        raise DatasetError(
            f"{touch} and its no-contact frame must have the same size, got {pressed.shape} and {no_contact.shape}."
        )
    return float(255 * np.abs(pressed - no_contact).mean())


def score_low_contact(
    low_contact: LowContactTouches | None,
    queries: Queries,
    predictions: Mapping[str, Sequence[Predictions]],
    *,
    draws: int,
    seed: int,
) -> dict[str, Any] | None:
    """Return "low_contact" of results.json: measures of low-contact and other touches, by method.

    Args:
        low_contact: The low-contact test touches; None if there are none, and then the result is None.
        queries: The queries of the evaluation.
        predictions: Predictions of each training seed, by method.
        draws: Resamples of an interval.
        seed: Seed of the resamples.
    """
    if low_contact is None:
        return None
    parts = {"low_contact": low_contact.rows, "others": ~low_contact.rows}
    methods = {
        name: {
            part: summaries([_measures(MethodScores(queries, one, seed), rows) for one in by_seed], draws, seed)
            for part, rows in parts.items()
        }
        for name, by_seed in predictions.items()
    }
    return {"change": low_contact.gel_change, "touches": int(low_contact.rows.sum()), "methods": methods}


def _measures(method_scores: MethodScores, rows: NDArray[np.bool_]) -> dict[str, Measure]:
    """Return the measures of some test touches (`rows`) with all test photos."""
    table = method_scores.touches("test", "test")
    part = table.select(rows, np.arange(len(table.photo_owner)))
    if not part.has_target.any():
        return {}
    tables = MethodScoreTables(part, part, {}, method_scores.pair_rule.rule, method_scores.seed)
    return compute(tables, CONTROL_MEASURES)
