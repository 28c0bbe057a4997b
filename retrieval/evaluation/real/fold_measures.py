"""Measures of one fold: score each gallery of the protocol, then pool the galleries."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from retrieval.data.dataset import Split
from retrieval.errors import BadInput
from retrieval.evaluation.cache import CacheKey, read_cached, write_cached
from retrieval.evaluation.calibrate import pair_threshold
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts
from retrieval.evaluation.scoring import MethodScores
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable


@dataclass(frozen=True, eq=False)
class FoldMeasures:
    """Results of one fold.

    Attributes:
        measures: Measures by name; owners are the units that intervals resample: objects, or their sequences.
        best_params: Parameters that the method selected.
    """

    measures: Mapping[str, Measure]
    best_params: Mapping[str, Any]


def measure_fold(
    method_scores: MethodScores,
    protocol: Protocol,
    facts: RecordingFacts,
    split: Split,
) -> FoldMeasures:
    """Measure one method in one fold.

    Args:
        method_scores: The scores of the method.
        protocol: The protocol.
        facts: The recording.
        split: The split of the fold.

    Raises:
        BadInput: The gallery is too small for the main measure.
    """
    objects = method_scores.queries.objects
    unit_of = facts.sequence_of if protocol.is_by_sequence else {name: name for name in facts.names}
    units = sorted(set(unit_of.values()))

    def allowed(table: ScoreTable) -> ScoreTable:
        return table.with_own() if protocol.allows_own_photos else table

    validation = allowed(method_scores.touches("validation", "validation"))
    threshold = pair_threshold(method_scores.predictions.best_params, validation, seed=method_scores.seed).at
    whole = allowed(method_scores.touches("test", "test"))
    sets = {size: allowed(table) for size, table in method_scores.sets("test").items()}
    gallery_of = protocol.gallery_of(facts, split)
    found: dict[str, list[Measure]] = {}
    for one in sorted(set(gallery_of.values())):
        mine = np.array([gallery_of.get(name) == one for name in objects])
        gallery = _of(whole, mine)
        tables = MethodScoreTables(
            gallery, gallery, {size: _of(one, mine) for size, one in sets.items()}, threshold, method_scores.seed
        )
        for name, metric in protocol.measures.items():
            if (value := metric.compute(tables)) is not None:
                found.setdefault(name, []).append(value)
    if protocol.main not in found:
        raise BadInput(
            f"{protocol.title}: a gallery has {len(whole.objects)} objects, too few for "
            f"{protocol.measures[protocol.main].label}. Give more of the data set."
        )
    number = {place: units.index(unit_of[name]) for place, name in enumerate(objects)}
    return FoldMeasures(
        {name: pooled(parts, [number] * len(parts)) for name, parts in found.items()},
        method_scores.predictions.best_params,
    )


def _of(table: ScoreTable, mine: Any) -> ScoreTable:
    """Return the rows and columns of the marked objects; the table itself if all are marked."""
    rows, columns = mine[table.touch_owner], mine[table.photo_owner]
    return table if rows.all() and columns.all() else table.select(rows, columns)


# Stored files ---------------------------------------------------------------------------------------


def write_fold_measures(path: Path, measured: FoldMeasures, cache_key: CacheKey) -> None:
    """Write the measures of a fold to a cache file."""
    tensors = {
        f"{name}/{part}": torch.from_numpy(np.ascontiguousarray(getattr(found, part)))
        for name, found in measured.measures.items()
        for part in ("values", "owner", "chance")
    }
    galleries = {name: found.gallery for name, found in measured.measures.items()}
    about = {"galleries": galleries, "best_params": dict(measured.best_params)}
    write_cached(path, cache_key, tensors, about)


def read_fold_measures(path: Path, cache_key: CacheKey) -> FoldMeasures | None:
    """Return the measures in a cache file; None if it is missing, damaged, or has another key."""
    if (stored := read_cached(path, cache_key)) is None:
        return None
    tensors, header = stored
    measures = {
        name: Measure(
            values=tensors[f"{name}/values"].numpy(),
            owner=tensors[f"{name}/owner"].numpy(),
            chance=tensors[f"{name}/chance"].numpy(),
            gallery=gallery,
        )
        for name, gallery in header["galleries"].items()
    }
    return FoldMeasures(measures, header["best_params"])


def pool_folds(folds: Sequence[FoldMeasures]) -> dict[str, Measure]:
    """Return the measures of one seed over the queries of all folds, for measures that every fold has."""
    names = [name for name in folds[0].measures if all(name in each.measures for each in folds)]
    return {name: pooled([each.measures[name] for each in folds]) for name in names}
