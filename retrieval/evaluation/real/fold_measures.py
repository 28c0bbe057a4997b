"""From the predictions of one fold to its measures: the galleries of the protocol, then one measure of all of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.data.dataset import Split
from retrieval.errors import BadInput
from retrieval.evaluation.cache import CacheKey, read_cached, write_cached
from retrieval.evaluation.calibrate import KWayTest, draw_k_way_tests, pair_rule, top1_confidences
from retrieval.evaluation.example_grasps import ExampleGrasps
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts
from retrieval.evaluation.scoring import MethodScores
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.model.posterior import Posterior

QUARTILES = 4


@dataclass(frozen=True, eq=False)
class FoldMeasures:
    """What came out of one fold: measures by name, whose owners are numbers in `ResamplingUnits`; chosen: what the method chose;
    examples: best and worst queries. stated: by what was searched ("gallery", or "all" test objects where galleries are
    several), (Q, 2): the probability of each first guess, where a posterior states one, and the share that is right.
    """

    measures: Mapping[str, Measure]
    best_params: Mapping[str, Any]
    examples: Mapping[str, Any]
    confidences: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class ResamplingUnits:
    """What intervals resample: objects, or their sequences. number_of: object_id -> number in `names`."""

    names: tuple[str, ...]
    number_of: Mapping[str, int]

    @classmethod
    def of(cls, facts: RecordingFacts, protocol: Protocol) -> "ResamplingUnits":
        """Those of a recording under a protocol."""
        unit_of = facts.sequence_of if protocol.is_by_sequence else {name: name for name in facts.names}
        names = tuple(sorted(set(unit_of.values())))
        return cls(names, {name: names.index(unit) for name, unit in unit_of.items()})


def quartile_name(measure: str, quartile: int) -> str:
    """The name of a measure of one quartile of contact, 1 to `QUARTILES`."""
    return f"{measure}_contact{quartile}"


def contact_quartiles(contact: NDArray[np.float64], owner: NDArray[np.int64]) -> NDArray[np.int64]:
    """(Q,) quartile of each touch, 1 (weakest contact) to 4, within its object; equals in the order given.

    contact (Q,): how much a touch changes the gel image; owner (Q,): the object of each. Quartiles are of each object,
    so that all hold the same objects.
    """
    found = np.empty(len(contact), np.int64)
    for name in np.unique(owner):
        rows = np.flatnonzero(owner == name)
        found[rows[np.argsort(contact[rows], kind="stable")]] = 1 + np.arange(len(rows)) * QUARTILES // len(rows)
    return found


def measure(
    judged: MethodScores,
    protocol: Protocol,
    facts: RecordingFacts,
    split: Split,
    grasp_ids: Sequence[str],
    contact: Mapping[str, float] | None = None,
) -> FoldMeasures:
    """The measures of one fold by one method; of its main measure also those of each quartile of contact, where
    `contact` says how much each grasp changes the gel image. Raises BadInput where its main measure cannot be taken.
    """
    objects, units = judged.queries.objects, ResamplingUnits.of(facts, protocol)

    def shown(table: ScoreTable) -> ScoreTable:
        return table.with_own() if protocol.allows_own_photos else table

    validation = shown(judged.touches("validation", "validation"))
    rule = pair_rule(judged.predictions.best_params, validation, seed=judged.seed).rule
    whole = shown(judged.touches("test", "test"))
    sets = {size: shown(table) for size, table in judged.sets("test").items()}
    gallery_of = protocol.gallery_of(facts, split)
    found: dict[str, list[Measure]] = {}
    shown_ids = judged.ids(grasp_ids, "test")
    queries: dict[str, list[Any]] = {"best": [], "worst": []}
    confidences: dict[str, list[NDArray[np.float64]]] = {}
    posterior = judged.predictions.best_params.get("posterior")
    levels = np.array([contact[name] for name in shown_ids[0]]) if contact else None
    for one in sorted(set(gallery_of.values())):
        mine = np.array([gallery_of.get(name) == one for name in objects])
        gallery = _of(whole, mine)
        ids = (
            list(compress(*pair))
            for pair in zip(shown_ids, (mine[whole.touch_owner], mine[whole.photo_owner]), strict=True)
        )
        for kind, some in ExampleGrasps(gallery, objects, *ids).examples(one_of_each=True).items():
            queries[kind] += some
        scored = MethodScoreTables(
            gallery, gallery, {size: _of(one, mine) for size, one in sets.items()}, rule, judged.seed
        )
        for name, metric in protocol.measures.items():
            if (taken := metric.compute(scored)) is not None:
                found.setdefault(name, []).append(taken)
        if levels is not None:
            quartiles = contact_quartiles(levels[mine[whole.touch_owner]], gallery.touch_owner)
            for quartile in np.unique(quartiles):  # objects of fewer touches leave some out
                part = dataclasses.replace(
                    scored, test=gallery.select(quartiles == quartile, np.arange(len(gallery.photo_owner)))
                )
                if (taken := protocol.measures[protocol.main].compute(part)) is not None:
                    found.setdefault(quartile_name(protocol.main, quartile), []).append(taken)
        if posterior:
            confidences.setdefault("gallery", []).append(_top1_confidences(gallery, posterior, judged.seed))
    if posterior and protocol.galleries:
        confidences["all"] = [_top1_confidences(whole, posterior, judged.seed)]
    if protocol.main not in found:
        raise BadInput(
            f"{protocol.title}: a gallery holds {len(whole.objects)} objects, too few for "
            f"{protocol.measures[protocol.main].label}; give more of the data set"
        )
    number = {place: units.number_of[name] for place, name in enumerate(objects)}
    return FoldMeasures(
        {name: pooled(parts, [number] * len(parts)) for name, parts in found.items()},
        judged.predictions.best_params,
        queries,
        {name: np.concatenate(parts) for name, parts in confidences.items()},
    )


def _top1_confidences(gallery: ScoreTable, posterior: Mapping[str, Any], seed: int) -> NDArray[np.float64]:
    """(Q, 2) of first guesses among the objects of a gallery, each shown by one photo."""
    fitted = Posterior.from_dict(posterior)
    return top1_confidences(draw_k_way_tests(gallery, KWayTest(len(gallery.objects)), seed, fitted), fitted)


def _of(table: ScoreTable, mine: Any) -> ScoreTable:
    """The rows and columns of the objects that are marked; the table itself where all are."""
    rows, columns = mine[table.touch_owner], mine[table.photo_owner]
    return table if rows.all() and columns.all() else table.select(rows, columns)


# Kept on disk ----------------------------------------------------------------------------------------


def write_fold_measures(path: Path, measured: FoldMeasures, cache_key: CacheKey) -> None:
    """Keep the measures of a fold."""
    tensors = {f"stated/{name}": torch.from_numpy(part) for name, part in measured.confidences.items()} | {
        f"{name}/{part}": torch.from_numpy(np.ascontiguousarray(getattr(found, part)))
        for name, found in measured.measures.items()
        for part in ("values", "owner", "chance")
    }
    galleries = {name: found.gallery for name, found in measured.measures.items()}
    about = {"galleries": galleries, "best_params": dict(measured.best_params), "examples": dict(measured.examples)}
    write_cached(path, cache_key, tensors, about)


def read_fold_measures(path: Path, cache_key: CacheKey) -> FoldMeasures | None:
    """Return what `write_fold_measures` kept; None where it is missing, damaged, or made by something else."""
    if (kept := read_cached(path, cache_key)) is None:
        return None
    tensors, header = kept
    measures = {
        name: Measure(
            values=tensors[f"{name}/values"].numpy(),
            owner=tensors[f"{name}/owner"].numpy(),
            chance=tensors[f"{name}/chance"].numpy(),
            gallery=gallery,
        )
        for name, gallery in header["galleries"].items()
    }
    confidences = {
        name.removeprefix("stated/"): tensor.numpy() for name, tensor in tensors.items() if name.startswith("stated/")
    }
    return FoldMeasures(measures, header["best_params"], header["examples"], confidences)


def pool_folds(folds: Sequence[FoldMeasures]) -> dict[str, Measure]:
    """The measures of all folds of one seed, over all their queries; those that every fold has."""
    names = [name for name in folds[0].measures if all(name in each.measures for each in folds)]
    return {name: pooled([each.measures[name] for each in folds]) for name in names}
