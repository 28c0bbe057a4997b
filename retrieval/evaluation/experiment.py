"""Experiments: fit one method in one fold, score its queries, measure them; each is stored by all its inputs."""

import shutil
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.registry import code_digest
from retrieval.console.output import say
from retrieval.console.progress import Bar
from retrieval.data.dataset import Split
from retrieval.errors import BadInput
from retrieval.evaluation.aggregate import Aggregation, MeasuresByName, protocol_result
from retrieval.evaluation.details import describe
from retrieval.evaluation.inputs import Row, thin_grasps
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.queries import MethodScores, draw_queries, score_queries
from retrieval.evaluation.results import Details, ProtocolResult, RowResult
from retrieval.methods import CHANCE, METHODS
from retrieval.methods.method import Method, MethodSettings
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.model.encode import one_thread
from retrieval.model.losses import LOSSES
from retrieval.training.features import Features
from retrieval.version import __version__

MAX_CONTROL_GRASPS = 12
"""Maximum number of grasps of one object whose images are encoded again for a control of a protocol in depth."""
_FORMAT = 7  # raised if the same inputs give other outcomes


@dataclass(frozen=True, eq=False)
class Outcome:
    """Measures of one experiment.

    Attributes:
        measures: Measures by name; owners are the units that intervals resample: objects, or their sequences.
        best_params: Parameters that the method selected on validation objects.
        details: Single objects and decisions; None without `Experiment.has_details`.
    """

    measures: dict[str, Measure]
    best_params: dict[str, Any]
    details: Details | None


@dataclass(frozen=True, eq=False)
class Experiment:
    """One row with one kind of inputs, in one fold, fitted with one seed.

    Attributes:
        of: The protocol and the recording.
        row: Method and towers.
        kind: Kind of inputs (`inputs.INPUTS`).
        fold: Number of the fold.
        split: Split of the fold.
        seed: Seed of the fit.
        draw_seed: Seed of folds, queries, pairs and tests.
        is_control: Whether only the measures of controls are computed, without details.
    """

    of: "ProtocolRun"
    row: Row
    kind: str
    fold: int
    split: Split
    seed: int
    draw_seed: int
    is_control: bool = False

    def run(self, cache: Cache) -> Outcome:
        """Return the stored outcome, or fit, score, measure and store it.

        Raises:
            BadInput: The model was trained on a test object, or a gallery is too small for the main measure.
        """
        if (stored := cache.get(self.key)) is not None:
            return msgspec.msgpack.decode(stored, type=Outcome, dec_hook=_decode_array)
        protocol, model = self.of.protocol, self.row.towers.checkpoint
        trained = {*model.split.train, *model.split.validation} if model and model.split else set()
        if shared := trained & set(self.split.test):
            raise BadInput(
                f"The model of row {self.row.name} was trained on {len(shared)} test objects of {self.of.name}, such "
                f"as {min(shared)}. Give a model that was not trained on them, or a split without them in its test "
                "part."
            )
        grasps = thin_grasps(self.of.facts.grasps, self._max_grasps)
        queries = draw_queries(grasps, self.split, self.draw_seed, protocol.max_grasps, protocol.across_sessions)
        method = self._fit()
        scores = score_queries(method, self.features, queries, self.draw_seed, protocol.allows_own_photos)
        details = describe(method, scores, self.features) if self.has_details else None
        outcome = Outcome(self._measures(scores), method.best_params, details)
        cache.add({self.key: msgspec.msgpack.encode(outcome, enc_hook=_encode_array)})
        if not protocol.in_depth:  # the fits of all folds take gigabytes
            shutil.rmtree(self._folder, ignore_errors=True)
        return outcome

    @cached_property
    def key(self) -> str:
        """Key of the outcome: all inputs that determine it."""
        config, model, protocol = self.row.towers.config, self.row.towers.checkpoint, self.of.protocol
        losses = [LOSSES.load(loss) for loss, weight in config.training.weights.items() if weight > 0]
        return cache_key(
            "experiments",
            {
                "format": _FORMAT,
                "protocol": self.of.name,
                "measures": self.measures,
                "shown": [
                    protocol.allows_own_photos,
                    protocol.is_by_sequence,
                    self._gallery_of,
                    protocol.across_sessions,
                ],
                "method": self.row.method,
                "kind": self.kind,
                "is_control": self.is_control,
                "is_unfitted": self.row.is_unfitted,
                "seeds": [self.seed, self.draw_seed],
                "features": self.features.digest,
                "recording": self.of.facts.digest,
                "max_grasps": [self._max_grasps, dict(protocol.max_grasps)],
                "split": asdict(self.split),
                "config": config.without_paths(),
                "model": model.digest if model else None,
                "in_depth": [protocol.in_depth, self.has_details],
                "software": __version__,
                **code_digest(METHODS.load(self.row.method), *losses),
            },
        )

    @property
    def has_details(self) -> bool:
        """Whether single objects and decisions are described: of touches, with the first seed, in depth."""
        return self.of.protocol.in_depth and not self.is_control and self.seed == self.of.seeds[0]

    @property
    def _folder(self) -> Path:
        """Folder of fits; methods of the same towers, inputs and split have one in common."""
        return self.of.out / "fits" / self.of.name / f"{self.kind}-{self.fold}"

    @property
    def measures(self) -> list[str]:
        """Names of the measures."""
        return list((self.is_control and self.of.protocol.control_measures) or self.of.protocol.measures)

    @property
    def features(self) -> Features:
        """Features of all grasps, as the method takes them: without cells, or with them."""
        return self.row.towers.inputs(self.kind, METHODS.load(self.row.method).uses_cells, self._max_grasps)

    @property
    def _max_grasps(self) -> int | None:
        return MAX_CONTROL_GRASPS if self.of.protocol.in_depth and self.kind in ("no_contact", "low_pass") else None

    @cached_property
    def _gallery_of(self) -> dict[str, str]:
        return dict(self.of.protocol.gallery_of(self.of.facts, self.split))

    def _fit(self) -> Method:
        if Bar.is_on and Bar.is_verbose:
            name = f"{self.row.method} ({self.kind})" if self.is_control else self.row.name
            say(f"evaluate: {name}, seed {self.seed}")
        model = self.row.towers.checkpoint
        settings = MethodSettings(
            self.row.towers.config,
            self.seed,
            self._folder,
            fit_on_validation=not self.of.protocol.in_depth,
            kind_of=self.of.facts.kind_of,
            **{"model" if self.row.is_unfitted else "start": model},
        )
        rows = self.of.protocol.rows_to_fit(thin_grasps(self.of.facts.grasps, self._max_grasps))
        features = self.features.select(rows)
        parts = [features.of_objects(part) for part in (self.split.train, self.split.validation)]
        if self.kind == "permuted":
            parts = [permute_touches(part, self.seed) for part in parts]
        fitted: Method = METHODS.load(self.row.method)(settings)
        with one_thread():  # heads are small
            fitted.fit(*parts)
        return fitted

    def _measures(self, scores: MethodScores) -> dict[str, Measure]:
        """Return the measures of each gallery, pooled."""
        protocol, facts, objects = self.of.protocol, self.of.facts, scores.queries.objects
        tables, found = scores.tables("pair_accuracy" in self.measures), defaultdict(list)
        for gallery in sorted(set(self._gallery_of.values())):
            of_gallery = _of_gallery(tables, np.array([self._gallery_of.get(name) == gallery for name in objects]))
            for name in self.measures:
                if (value := protocol.measures[name].compute(of_gallery)) is not None:
                    found[name].append(value)
        if protocol.main not in found and not protocol.in_depth:
            raise BadInput(
                f"{protocol.title}: a gallery has {len(tables.test.objects)} objects, too few for "
                f"{protocol.measures[protocol.main].label}. Give more of the data set."
            )
        unit_of = facts.sequence_of if protocol.is_by_sequence else {name: name for name in facts.names}
        units = sorted(set(unit_of.values()))
        numbers = {number: units.index(unit_of[name]) for number, name in enumerate(objects)}
        return {name: pooled(parts, numbers) for name, parts in found.items()}


def _of_gallery(tables: MethodScoreTables, mine: NDArray[np.bool_]) -> MethodScoreTables:
    """Return the tables of the test objects that are marked."""
    if mine[tables.test.photo_owner].all():
        return tables

    def part(table: ScoreTable) -> ScoreTable:
        return table.select(mine[table.touch_owner], mine[table.photo_owner])

    sets = {size: part(table) for size, table in tables.sets.items()}
    return MethodScoreTables(part(tables.test), part(tables.test), sets, tables.threshold, tables.seed)


def permute_touches(features: Features, seed: int) -> Features:
    """Return the features with touches randomly assigned to grasps."""
    order = np.random.default_rng([seed, 13]).permutation(len(features))
    return replace(features, touch=features.touch[order])


def _encode_array(value: Any) -> Any:
    """Return an array as MessagePack types."""
    return [value.dtype.str, value.shape, value.tobytes()]


def _decode_array(kind: Any, value: Any) -> Any:
    dtype, shape, data = value
    return np.frombuffer(data, dtype).reshape(shape)


Job = tuple[str, str]
"""A row and a kind of inputs; the row of controls and ceilings is ""."""


@dataclass(frozen=True, eq=False)
class ProtocolRun:
    """One protocol on one recording.

    Attributes:
        name: Name of the protocol.
        protocol: The protocol.
        facts: The recording.
        rows: The rows of the table; controls use the towers of the first one.
        seeds: Seeds of folds and fits.
        out: Folder of fits.
    """

    name: str
    protocol: Protocol
    facts: RecordingFacts
    rows: list[Row]
    seeds: list[int]
    out: Path

    def measure(self, cache: Cache) -> ProtocolResult:
        """Run all experiments; return measures with intervals."""
        protocol, towers = self.protocol, self.rows[0].towers
        jobs = {(row.name, "touch"): self._experiments(row, "touch") for row in self.rows}
        if not protocol.in_depth:
            trained = [row for row in self.rows if row.method != CHANCE]
            jobs |= {(row.name, "low_pass"): self._experiments(row, "low_pass") for row in trained}
        reasons = {}
        for kind, method in {**protocol.controls, **protocol.ceilings}.items():
            if reason := towers.missing_reason(kind):
                reasons[kind] = reason
            else:
                jobs["", kind] = self._experiments(Row(kind, method, towers), kind, is_control=True)
        outcomes: dict[Job, list[list[Outcome]]] = {}
        count = sum(len(by_fold) for by_seed in jobs.values() for by_fold in by_seed)
        with Bar(f"evaluating {self.name}", count, "fits") as bar:
            for job, by_seed in jobs.items():
                outcomes[job] = [[] for _ in by_seed]
                for found, experiments in zip(outcomes[job], by_seed, strict=True):
                    for experiment in experiments:
                        found.append(experiment.run(cache))
                        bar.advance(note=" ".join(filter(None, job)))
        rows = {}
        for row in self.rows:
            of_row = outcomes[row.name, "touch"]
            rows[row.name] = RowResult(
                row.method,
                row.towers.checkpoint.digest if row.towers.checkpoint else None,
                best_params=[[one.best_params for one in by_fold] for by_fold in of_row],
                details=of_row[0][0].details,
            )
        splits = [split for of_seed in self.folds.values() for split in of_seed]
        ratio = sum(len(one.test) for one in splits) / sum(len(one.train + one.validation) for one in splits)
        return protocol_result(
            protocol,
            self.facts,
            self.folds.values(),
            rows,
            {job: self._by_name(found) for job, found in outcomes.items()},
            [(other.name, self.rows[0].name) for other in self.rows[1:]],
            Aggregation(self.seeds[0], ratio if protocol.choices else None),
            reasons,
        )

    @cached_property
    def folds(self) -> dict[int, list[Split]]:
        """The splits of each seed that draws some."""
        is_drawn_once = self.protocol.in_depth or self.protocol.choices
        seeds = self.seeds[:1] if is_drawn_once else self.seeds
        return {seed: self.protocol.folds(self.facts, seed) for seed in seeds}

    def _experiments(self, row: Row, kind: str, is_control: bool = False) -> list[list[Experiment]]:
        """Return the experiments of a row with one kind of inputs, by seed and fold."""
        seeds = {seed: seed for seed in self.folds}  # of the fit, and of the draws
        if self.protocol.in_depth:
            is_one_fit = is_control or row.is_unfitted or not METHODS.load(row.method).is_seeded
            seeds = dict.fromkeys(self.seeds[:1] if is_one_fit else self.seeds, self.seeds[0])
        return [
            [
                Experiment(self, row, kind, fold, split, seed, draw, is_control)
                for fold, split in enumerate(self.folds[draw])
            ]
            for seed, draw in seeds.items()
        ]

    def _by_name(self, outcomes: Sequence[Sequence[Outcome]]) -> MeasuresByName:
        """Return the measures of each seed, over the queries of all folds; with `choices`, those of each fold."""
        groups = [[one] for folds in outcomes for one in folds] if self.protocol.choices else outcomes
        every = [one.measures for folds in groups for one in folds]
        return {
            name: [pooled([one.measures[name] for one in folds]) for folds in groups]
            for name in every[0]
            if all(name in measures for measures in every)
        }
