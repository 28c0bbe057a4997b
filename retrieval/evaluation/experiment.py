"""Experiments: fit one method in one fold, score its queries, measure them; each is stored by all its inputs."""

import shutil
import time
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.registry import code_digest
from retrieval.console.output import say
from retrieval.data.dataset import Split
from retrieval.errors import BadInput
from retrieval.evaluation.details import SeedDetails, describe
from retrieval.evaluation.inputs import Row, thin_grasps
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.queries import Queries, draw_queries
from retrieval.evaluation.scoring import MethodScores, score_queries
from retrieval.methods import METHODS
from retrieval.methods.late_fusion import LateFusion
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
_FORMAT = 2  # raised if the same inputs give other outcomes


@dataclass(frozen=True, eq=False)
class Outcome:
    """Measures of one experiment.

    Attributes:
        measures: Measures by name; owners are the units that intervals resample: objects, or their sequences.
        best_params: Parameters that the method selected on validation objects.
        seconds: Run times; no result depends on them.
        details: Single objects and decisions; None unless the protocol is in depth and the inputs are touches.
    """

    measures: dict[str, Measure]
    best_params: dict[str, Any]
    seconds: dict[str, float]
    details: SeedDetails | None


@dataclass(frozen=True, eq=False)
class Experiment:
    """One row with one kind of inputs, in one fold, fitted with one seed.

    Attributes:
        name: Name of the protocol.
        protocol: The protocol.
        facts: The recording.
        row: Method and towers.
        kind: Kind of inputs (`inputs.INPUTS`).
        split: The split of the fold.
        seed: Seed of the fit.
        draw_seed: Seed of the queries, pairs and tests.
        folder: Folder of fits; methods of the same towers, inputs and split have one in common.
        is_control: Whether the method is fitted in any case, also if the row's towers are those of a whole model.
        quiet: No progress on stderr.
    """

    name: str
    protocol: Protocol
    facts: RecordingFacts
    row: Row
    kind: str
    split: Split
    seed: int
    draw_seed: int
    folder: Path
    is_control: bool = False
    quiet: bool = True

    def run(self, cache: Cache) -> Outcome:
        """Return the stored outcome, or fit, score, measure and store it.

        Raises:
            BadInput: The model was trained on a test object, or a gallery is too small for the main measure.
        """
        if (stored := cache.get(self.key)) is not None:
            return msgspec.msgpack.decode(stored, type=Outcome, dec_hook=_decode_array)
        model = self.row.towers.checkpoint
        trained = {*model.split.train, *model.split.validation} if model and model.split else set()
        if shared := trained & set(self.split.test):
            raise BadInput(
                f"The model of row {self.row.name} was trained on {len(shared)} test objects of {self.name}, such as "
                f"{min(shared)}. Give a model that was not trained on them, or a split without them in its test part."
            )
        method, fit_s = self._fit()
        scores = score_queries(
            method,
            self.features,
            self.queries,
            fit_s=fit_s,
            seed=self.draw_seed,
            allows_own_photos=self.protocol.allows_own_photos,
        )
        details = describe(method, scores, self.features) if self.protocol.in_depth and not self.is_control else None
        outcome = Outcome(self._measures(scores), scores.best_params, scores.seconds, details)
        cache.add({self.key: msgspec.msgpack.encode(outcome, enc_hook=_encode_array)})
        if not self.protocol.in_depth:  # the fits of all folds take gigabytes
            shutil.rmtree(self.folder, ignore_errors=True)
        return outcome

    @cached_property
    def key(self) -> str:
        """Key of the outcome: all inputs that determine it."""
        config, model, protocol = self.row.towers.config, self.row.towers.checkpoint, self.protocol
        losses = [LOSSES.load(loss) for loss, weight in config.training.weights.items() if weight > 0]
        return cache_key(
            "experiments",
            {
                "format": _FORMAT,
                "protocol": self.name,
                "measures": self.measures,
                "shown": [protocol.allows_own_photos, protocol.is_by_sequence, self._gallery_of],
                "method": self.row.method,
                "kind": self.kind,
                "is_control": self.is_control,
                "seeds": [self.seed, self.draw_seed],
                "features": self.features.digest,
                "recording": self.facts.digest,
                "max_grasps": [self._max_grasps, dict(protocol.max_grasps)],
                "split": asdict(self.split),
                "config": config.without_paths(),
                "model": model.digest if model else None,
                "in_depth": protocol.in_depth,
                "software": __version__,
                **code_digest(METHODS.load(self.row.method), *losses),
            },
        )

    @property
    def measures(self) -> list[str]:
        """Names of the measures."""
        return list((self.is_control and self.protocol.control_measures) or self.protocol.measures)

    @property
    def features(self) -> Features:
        """Features of all grasps, as the method takes them: without cells, or with them."""
        return self.row.towers.inputs(self.kind, METHODS.load(self.row.method).uses_cells, self._max_grasps)

    @cached_property
    def queries(self) -> Queries:
        """Touches and photos to score."""
        grasps = self.facts.grasps
        grasps = thin_grasps(grasps, self._max_grasps) if self._max_grasps else grasps
        return draw_queries(grasps, self.split, self.draw_seed, self.protocol.max_grasps)

    @property
    def _max_grasps(self) -> int | None:
        return MAX_CONTROL_GRASPS if self.protocol.in_depth and self.kind in ("no_contact", "low_pass") else None

    @cached_property
    def _gallery_of(self) -> dict[str, str]:
        return dict(self.protocol.gallery_of(self.facts, self.split))

    def _fit(self) -> tuple[Method, float]:
        if not self.quiet:
            say(f"evaluate: {self.row.method}, seed {self.seed}" + (f" ({self.kind})" if self.is_control else ""))
        is_permuted, method = self.kind == "permuted", METHODS.load(self.row.method)
        config, checkpoint = self.row.towers.config, None if self.is_control else self.row.towers.checkpoint
        settings = MethodSettings(
            config.without_candidate_encoder() if is_permuted else config,  # there is no ranking to learn
            self.seed,
            self.folder,
            self.quiet,
            fit_on_validation=not self.protocol.in_depth,
            kind_of=self.facts.kind_of,
        )
        if checkpoint and issubclass(method, LateFusion):
            return method.of_checkpoint(checkpoint, settings), 0.0
        parts = [self.features.of_objects(part) for part in (self.split.train, self.split.validation)]
        if is_permuted:
            parts = [permute_touches(part, self.seed) for part in parts]
        fitted, start = method(settings), time.perf_counter()
        with one_thread():  # heads are small; times refer to one core
            fitted.fit(*parts)
        return fitted, time.perf_counter() - start

    def _measures(self, scores: MethodScores) -> dict[str, Measure]:
        """Return the measures of each gallery, pooled."""
        objects, tables = self.queries.objects, scores.tables("pair_accuracy" in self.measures)
        found: dict[str, list[Measure]] = {}
        for gallery in sorted(set(self._gallery_of.values())):
            of_gallery = _of_gallery(tables, np.array([self._gallery_of.get(name) == gallery for name in objects]))
            for name in self.measures:
                if (value := self.protocol.measures[name].compute(of_gallery)) is not None:
                    found.setdefault(name, []).append(value)
        if self.protocol.main not in found and not self.protocol.in_depth:
            raise BadInput(
                f"{self.protocol.title}: a gallery has {len(tables.test.objects)} objects, too few for "
                f"{self.protocol.measures[self.protocol.main].label}. Give more of the data set."
            )
        unit_of = self.facts.sequence_of if self.protocol.is_by_sequence else {name: name for name in self.facts.names}
        numbers = {unit: number for number, unit in enumerate(sorted(set(unit_of.values())))}
        number_of = {place: numbers[unit_of[name]] for place, name in enumerate(objects)}
        return {name: pooled(parts, number_of) for name, parts in found.items()}


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
    return Features(features.grasp_ids, features.object_ids, features.touch[order], features.photo)


def _encode_array(value: Any) -> Any:
    """Return an array as MessagePack types."""
    return [value.dtype.str, value.shape, value.tobytes()]


def _decode_array(kind: Any, value: Any) -> Any:
    dtype, shape, data = value
    return np.frombuffer(data, dtype).reshape(shape)
