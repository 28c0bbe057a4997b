"""Experiments: fit one method in one fold, score its queries, measure them; each is stored by all its inputs."""

import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from _touch_retrieval.cache import Cache, cache_key
from retrieval.console.output import say
from retrieval.data.dataset import Split
from retrieval.errors import BadInput
from retrieval.evaluation.details import SeedDetails, describe
from retrieval.evaluation.inputs import Row, thin_grasps
from retrieval.evaluation.predictions import Predictions, predict
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.queries import Queries, draw_queries
from retrieval.evaluation.scoring import MethodScores
from retrieval.methods import METHODS
from retrieval.methods.late_fusion import LateFusion, checkpoint_path
from retrieval.methods.method import Method, MethodSettings
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import one_thread
from retrieval.model.losses import LOSSES
from retrieval.training.features import Features
from retrieval.training.loop import code_digest
from retrieval.version import __version__

MAX_CONTROL_GRASPS = 12
"""Maximum number of grasps of one object whose images are encoded again for a control of a protocol in depth."""
_FORMAT = 1  # raised if the same inputs give other outcomes


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
        predictions = predict(method, self.features, self.queries, fit_s)
        outcome = self._measure(predictions)
        cache.add({self.key: msgspec.msgpack.encode(outcome, enc_hook=_encode_array)})
        if not self.protocol.in_depth:  # the fits of all folds take gigabytes
            shutil.rmtree(self.folder, ignore_errors=True)
        return outcome

    @cached_property
    def key(self) -> str:
        """Key of the outcome: all inputs that determine it."""
        config = self.row.towers.config
        losses = [LOSSES.load(loss) for loss, weight in config.training.weights.items() if weight > 0]
        model = self.row.towers.checkpoint
        return cache_key(
            "experiments",
            {
                "format": _FORMAT,
                "protocol": self.name,
                "measures": list(self.measures),
                "shown": [self.protocol.allows_own_photos, self.protocol.is_by_sequence, self.gallery_of],
                "method": self.row.method,
                "kind": self.kind,
                "is_control": self.is_control,
                "seeds": [self.seed, self.draw_seed],
                "features": self.features.digest,
                "queries": self.queries.digest,
                "split": asdict(self.split),
                "config": config.without_paths(),
                "model": model.digest if model else None,
                "in_depth": self.protocol.in_depth,
                "software": __version__,
                **code_digest(METHODS.load(self.row.method), *losses),
            },
        )

    @cached_property
    def max_grasps(self) -> int | None:
        """Maximum number of grasps of one object; None for all."""
        return MAX_CONTROL_GRASPS if self.protocol.in_depth and self.kind in ("no_contact", "low_pass") else None

    @property
    def features(self) -> Features:
        """Features of all grasps, as the method takes them: without cells, or with them."""
        return self.row.towers.inputs(self.kind, METHODS.load(self.row.method).uses_cells, self.max_grasps)

    @cached_property
    def queries(self) -> Queries:
        """Touches and photos to score."""
        grasps = self.facts.grasps
        grasps = thin_grasps(grasps, self.max_grasps) if self.max_grasps else grasps
        return draw_queries(grasps, self.split, self.draw_seed, self.protocol.max_grasps)

    @cached_property
    def gallery_of(self) -> Mapping[str, str]:
        """The name of the gallery of each test object."""
        return self.protocol.gallery_of(self.facts, self.split)

    @property
    def measures(self) -> list[str]:
        """Names of the measures."""
        return list((self.is_control and self.protocol.control_measures) or self.protocol.measures)

    @property
    def checkpoint(self) -> Checkpoint | None:
        """The whole model that scores as it is; None if the method is fitted."""
        is_as_it_is = not self.is_control and issubclass(METHODS.load(self.row.method), LateFusion)
        return self.row.towers.checkpoint if is_as_it_is else None

    def late_fusion_checkpoint(self) -> Checkpoint:
        """Return the model that scores as it is, or the one that late fusion trained."""
        return self.checkpoint or load_checkpoint(checkpoint_path(self.folder, self.seed))

    def _fit(self) -> tuple[Method, float]:
        if not self.quiet:
            say(f"evaluate: {self.row.method}, seed {self.seed}" + (f" ({self.kind})" if self.is_control else ""))
        is_permuted = self.kind == "permuted"
        config = self.row.towers.config
        settings = MethodSettings(
            config.without_candidate_encoder() if is_permuted else config,  # there is no ranking to learn
            self.seed,
            self.folder,
            self.quiet,
            fit_on_validation=not self.protocol.in_depth,
            kind_of=self.facts.kind_of,
        )
        method = METHODS.load(self.row.method)(settings)
        if self.checkpoint is not None and isinstance(method, LateFusion):
            return type(method).of_checkpoint(self.checkpoint, settings), 0.0
        train, validation = (self.features.of_objects(part) for part in (self.split.train, self.split.validation))
        if is_permuted:
            train, validation = permute_touches(train, self.seed), permute_touches(validation, self.seed)
        start = time.perf_counter()
        with one_thread():  # heads are small; times refer to one core
            method.fit(train, validation)
        return method, time.perf_counter() - start

    def _measure(self, predictions: Predictions) -> Outcome:
        scores = MethodScores(self.queries, predictions, self.draw_seed, self.protocol.allows_own_photos)
        in_depth = self.protocol.in_depth and not self.is_control
        is_late_fusion = self.row.method == "late_fusion"
        return Outcome(
            self._measures(scores),
            predictions.best_params,
            predictions.seconds,
            describe(scores, self.features, self.late_fusion_checkpoint() if is_late_fusion else None)
            if in_depth
            else None,
        )

    def _measures(self, scores: MethodScores) -> dict[str, Measure]:
        """Return the measures of each gallery, pooled."""
        facts, objects, tables = self.facts, self.queries.objects, scores.score_tables()
        found: dict[str, list[Measure]] = {}
        for gallery in sorted(set(self.gallery_of.values())):
            mine = np.array([self.gallery_of.get(name) == gallery for name in objects])
            for name in self.measures:
                if (value := self.protocol.measures[name].compute(_of_gallery(tables, mine))) is not None:
                    found.setdefault(name, []).append(value)
        if self.protocol.main not in found and not self.protocol.in_depth:
            raise BadInput(
                f"{self.protocol.title}: a gallery has {len(tables.test.objects)} objects, too few for "
                f"{self.protocol.measures[self.protocol.main].label}. Give more of the data set."
            )
        unit_of = facts.sequence_of if self.protocol.is_by_sequence else {name: name for name in facts.names}
        units = sorted(set(unit_of.values()))
        number = {place: units.index(unit_of[name]) for place, name in enumerate(objects)}
        return {name: pooled(parts, [number] * len(parts)) for name, parts in found.items()}


def _of_gallery(tables: MethodScoreTables, mine: Any) -> MethodScoreTables:
    """Return the tables of the test objects that are marked."""
    if mine[tables.test.photo_owner].all():
        return tables
    test = _of_objects(tables.test, mine)
    sets = {size: _of_objects(table, mine) for size, table in tables.sets.items()}
    return MethodScoreTables(test, test, sets, tables.threshold, tables.seed)


def _of_objects(table: ScoreTable, mine: Any) -> ScoreTable:
    return table.select(mine[table.touch_owner], mine[table.photo_owner])


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
