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
from retrieval.evaluation.controls import MEASURED
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.scoring import MethodScores, summaries
from retrieval.metrics.measure import Measure
from retrieval.metrics.registry import Scored, take

FAINTEST = 0.05
"""Share of the touches that is judged apart."""


@dataclass(frozen=True, eq=False)
class Faint:
    """The faintest touches of a part of the split. change: grey levels, of the strongest of these; rows (Q,): of the
    part's touches, which these are."""

    change: float
    rows: NDArray[np.bool_]


def faint_touches(grasps: Sequence[Grasp], *, quiet: bool = True) -> Faint | None:
    """The faintest of these touches, by `change`; None where one lacks the frames from before its contact."""
    if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
        return None
    changes = []
    with Bar("compare with untouched", len(grasps), "grasps", quiet=quiet) as bar:
        for grasp in grasps:
            changes.append(change(grasp))
            bar.advance()
    strongest = float(np.sort(changes)[max(round(FAINTEST * len(changes)), 1) - 1])
    return Faint(strongest, np.array(changes) <= strongest)


def change(grasp: Grasp) -> float:
    """Mean difference of a gel image from that before the contact, grey levels; of the finger that felt more.

    Raises DatasetError where the two differ in size.
    """
    return max(map(_change, grasp.touches, grasp.backgrounds))


def _change(touch: Path, before: Path) -> float:
    pressed, untouched = read_rgb(touch), read_rgb(before)
    if pressed.shape != untouched.shape:
        raise DatasetError(
            f"{touch} and the frame before it must be of one size; got {pressed.shape} and {untouched.shape}"
        )
    return float(255 * np.abs(pressed - untouched).mean())


def score_faint(
    faint: Faint | None, queries: Queries, predictions: Mapping[str, Sequence[Predictions]], *, draws: int, seed: int
) -> dict[str, Any] | None:
    """ "faint" of results.json: measures of the faintest touches and of the others, by method."""
    if faint is None:
        return None
    parts = {"faint": faint.rows, "others": ~faint.rows}
    methods = {
        name: {
            part: summaries([_measures(MethodScores(queries, one, seed), rows) for one in by_seed], draws, seed)
            for part, rows in parts.items()
        }
        for name, by_seed in predictions.items()
    }
    return {"change": faint.change, "touches": int(faint.rows.sum()), "methods": methods}


def _measures(judged: MethodScores, rows: NDArray[np.bool_]) -> dict[str, Measure]:
    """The measures of some test touches (`rows`) with all test photos."""
    table = judged.touches("test", "test")
    part = table.select(rows, np.arange(len(table.photo_owner)))
    return take(Scored(part, part, {}, judged.pair_rule.rule, judged.seed), MEASURED) if part.askable.any() else {}
