"""Touches that hardly press the gel, judged apart: what was not felt cannot be found."""

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
"""Share of the touches that is judged apart."""


@dataclass(frozen=True, eq=False)
class LowContactTouches:
    """The faintest touches of a part of the split. change: grey levels, of the strongest of these; rows (Q,): of the
    part's touches, which these are.
    """

    gel_change: float
    rows: NDArray[np.bool_]


def find_low_contact_touches(grasps: Sequence[Grasp], *, quiet: bool = True) -> LowContactTouches | None:
    """The faintest of these touches, by `gel_change`; None where one lacks the frames from before its contact."""
    if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
        return None
    changes = []
    with Bar("compare with untouched", len(grasps), "grasps", quiet=quiet) as bar:
        for grasp in grasps:
            changes.append(gel_change(grasp))
            bar.advance()
    strongest = float(np.sort(changes)[max(round(LOW_CONTACT_FRACTION * len(changes)), 1) - 1])
    return LowContactTouches(strongest, np.array(changes) <= strongest)


def gel_change(grasp: Grasp) -> float:
    """Mean difference of a gel image from that before the contact, grey levels; of the finger that felt more.

    Raises DatasetError where the two differ in size.
    """
    return max(map(_finger_change, grasp.touches, grasp.backgrounds))


def _finger_change(touch: Path, before: Path) -> float:
    pressed, no_contact = read_rgb(touch), read_rgb(before)
    if pressed.shape != no_contact.shape:
        raise DatasetError(
            f"{touch} and the frame before it must be of one size; got {pressed.shape} and {no_contact.shape}"
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
    """ "faint" of results.json: measures of the faintest touches and of the others, by method."""
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


def _measures(judged: MethodScores, rows: NDArray[np.bool_]) -> dict[str, Measure]:
    """The measures of some test touches (`rows`) with all test photos."""
    table = judged.touches("test", "test")
    part = table.select(rows, np.arange(len(table.photo_owner)))
    return (
        compute(MethodScoreTables(part, part, {}, judged.pair_rule.rule, judged.seed), CONTROL_MEASURES)
        if part.has_target.any()
        else {}
    )
