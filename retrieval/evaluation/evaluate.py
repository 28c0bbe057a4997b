"""Evaluate methods and models by protocols: from recordings to results.json. Finished experiments are not repeated."""

import dataclasses
import os
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from _touch_retrieval.cache import Cache
from retrieval.console.interruption import resumable
from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording, Split, folder_of
from retrieval.errors import BadInput
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS
from retrieval.evaluation.aggregate import (
    Aggregation,
    MeasuredControl,
    MeasuredRow,
    MeasuresBySeed,
    protocol_result,
)
from retrieval.evaluation.details import combine
from retrieval.evaluation.experiment import Experiment, Outcome
from retrieval.evaluation.inputs import Row, TowerEncoder
from retrieval.evaluation.protocol import Protocol, RecordingFacts, read_recording_facts
from retrieval.evaluation.protocols.recording import with_split
from retrieval.evaluation.results import (
    FeatureCounts,
    MethodTimes,
    ProtocolResult,
    ProtocolTimes,
    Results,
    Setting,
    Timings,
    write_results,
)
from retrieval.evaluation.touch_to_touch import FROZEN, TouchToTouch, run_touch_to_touch
from retrieval.methods import CHANCE, METHODS
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import Method
from retrieval.metrics.measure import pooled
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable
from retrieval.model.config import Config, named_config
from retrieval.model.encode import one_thread, photo_features, touch_features
from retrieval.training.batches import BatchImages
from retrieval.training.licences import training_licences
from retrieval.training.train import Trainer
from retrieval.version import __version__

DATA_SET_CONFIG, DATA_SET_METHODS, DATA_SET_SEEDS = "real", ("cca_towers", "cca", "late_fusion", "chance"), 3
"""Defaults if protocols are named, which are those of real data sets."""


def evaluate(
    recordings: AnyRecording | Mapping[str | None, AnyRecording],
    out: Path,
    *,
    protocols: Sequence[str | Protocol] = (),
    config: Config | str | None = None,
    preset: str | None = None,
    methods: Sequence[str | type[Method]] = (),
    model: Path | None = None,
    compared: Mapping[str, Path | Config] = MappingProxyType({}),
    seeds: int | None = None,
    split: Split | None = None,
    skipped: Mapping[str, str] = MappingProxyType({}),
    quiet: bool = False,
) -> Results:
    """Compare methods and models on unseen objects, with controls; write results.json and timings.json.

    A stopped run resumes: experiments under `out` with the same inputs are reused. Equal settings give byte-identical
    results.

    Args:
        recordings: A folder, or the object that `robot.read_recording` returns; or one for each data set, by its name.
        out: Folder of the results.
        protocols: Names, or your own protocols, which are named by their titles. Default: "unseen-objects", one split
            of the recording, with which each method is described in depth.
        config: Towers, heads and split, if `model` does not give them: a `Config` (`Config.using` accepts your own
            towers and losses), or an argument of `load_config`. Its seed is the seed of every random draw. Default:
            "small", with `protocols` "real". Only "unseen-objects" trains towers; other protocols use frozen ones.
        preset: Name of the configuration in the report. Default: the configuration's name.
        methods: Names, or your own classes, which the report lists by class name. Default: all, with `protocols` those
            of `DATA_SET_METHODS`.
        model: A checkpoint: late fusion scores with it as it is, and other methods are fitted on its towers.
        compared: More rows by name: a checkpoint, with which late fusion scores as it is; or a configuration whose
            frozen touch tower is compared by touch-to-touch protocols.
        seeds: Number of seeds, from that of `config` on. Each repeats the training of each method; with `protocols`,
            each also draws the folds and queries again. Default: 1, with `protocols` 3.
        split: Objects of each part of "unseen-objects". Default: the split of `model`; without a model, a random one.
        skipped: Why a protocol is left out, by its name. The report states these reasons.
        quiet: No progress on stderr.

    Returns:
        The content of results.json.

    Raises:
        BadInput: There is neither method nor model, or a model was trained on test objects.
        ConfigError: A protocol or method is unknown.
        DatasetError: A recording does not fit a protocol.
        CheckpointError: A model cannot be read.
        JobInterrupted: After Ctrl-C.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny")
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))
    >>> results = retrieval.evaluate("lab", Path("report"), config=config, methods=["cca", "chance"], quiet=True)
    >>> rows = results.protocols["unseen-objects"].rows
    >>> list(rows)
    ['cca', 'chance']

    A protocol of your own:

    >>> from retrieval.evaluation.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("mine", "Halves", "Objects are halved by name.", halves, topn_accuracy(5))
    >>> options = {"protocols": [protocol], "methods": ["cca", "chance"], "config": "tiny", "seeds": 1}
    >>> results = retrieval.evaluate("lab", Path("halves"), **options, quiet=True)
    >>> list(results.protocols["halves"].rows)
    ['cca', 'chance']
    """
    config, config_name = named_config(config or (DATA_SET_CONFIG if protocols else "small"), preset)
    names = [METHODS.name_of(method) for method in methods or (DATA_SET_METHODS if protocols else METHODS)]
    count = seeds if seeds is not None else DATA_SET_SEEDS if protocols else 1
    if count < 1:
        raise BadInput(f"An evaluation needs at least 1 seed, got {count}.")
    selected = dict(map(_named, protocols or [UNSEEN_OBJECTS]))
    _require_use(selected, names, compared, split)
    if not isinstance(recordings, Mapping):
        recordings = dict.fromkeys((protocol.data_set for protocol in selected.values()), recordings)
    evaluation = _Evaluation(
        out,
        config,
        list(dict.fromkeys(names)),
        load_checkpoint(model) if model else None,
        {name: one if isinstance(one, Config) else load_checkpoint(one) for name, one in compared.items()},
        list(range(config.training.seed, config.training.seed + count)),
        quiet,
    )
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, ProtocolResult] = {}
    times: dict[str, ProtocolTimes] = {}
    data = {name: evaluation.read(folder_of(recording)) for name, recording in recordings.items()}
    with resumable(out), Cache(out / "cache.sqlite") as cache:
        for name, protocol in selected.items():
            used, recording = evaluation.prepare(name, protocol, data[protocol.data_set], split)
            if isinstance(used, TouchToTouch):
                found[name] = evaluation.touch_to_touch(used, recording)
            else:
                run = ProtocolRun(name, used, recording.facts, evaluation.rows(recording), evaluation.seeds, out, quiet)
                found[name], times[name] = run.measure(cache)
    results = Results(
        Setting(
            preset="of the model" if model else config_name,
            config=config.without_paths(),
            model=evaluation.model.digest if evaluation.model else None,
            compared={
                name: one.without_paths() if isinstance(one, Config) else one.digest
                for name, one in evaluation.compared.items()
            },
            seeds=evaluation.seeds,
        ),
        found,
        dict(skipped),
        __version__,
    )
    write_results(out / "results.json", results)
    write_results(out / "timings.json", Timings(os.cpu_count() or 1, 1, times))
    return results


def _named(choice: str | Protocol) -> tuple[str, Protocol]:
    """Return the name and the protocol; a user's own protocol is named by its title."""
    if isinstance(choice, Protocol):
        return re.sub(r"[^a-z0-9]+", "-", choice.title.lower()).strip("-"), choice
    name = PROTOCOLS.name_of(choice)
    return name, PROTOCOLS.load(name)


def _require_use(
    protocols: Mapping[str, Protocol],
    methods: Sequence[str],
    compared: Mapping[str, Path | Config],
    split: Split | None,
) -> None:
    """Raise BadInput for arguments that would be ignored, and for rows with equal names."""
    if split is not None and UNSEEN_OBJECTS not in protocols:
        raise BadInput(f"Only {UNSEEN_OBJECTS} takes a split, got {', '.join(protocols)}. Leave the split out.")
    if equal := set(compared) & {FROZEN, *methods}:
        raise BadInput(f"Another row is already named {min(equal)}. Give this entry of `compared` a different name.")
    has_towers = any(isinstance(one, Config) for one in compared.values())
    if has_towers and not any(isinstance(protocol, TouchToTouch) for protocol in protocols.values()):
        raise BadInput(
            f"Only touch-to-touch protocols compare towers, got {', '.join(protocols)}. Add one, such as physiclear, "
            "or compare a checkpoint."
        )


@dataclass(frozen=True, eq=False)
class _Recording:
    """A recording, and its encoders by the towers of the methods and of the rows that are compared."""

    folder: Path
    facts: RecordingFacts
    towers: TowerEncoder
    compared: dict[str, TowerEncoder]


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Settings of an evaluation.

    Attributes:
        out: Folder of the results.
        config: Configuration of towers and heads.
        methods: Names of the methods.
        model: The checkpoint whose towers are used.
        compared: More rows by name.
        seeds: Training seeds.
        quiet: No progress on stderr.
    """

    out: Path
    config: Config
    methods: list[str]
    model: Checkpoint | None
    compared: Mapping[str, Checkpoint | Config]
    seeds: list[int]
    quiet: bool

    def read(self, folder: Path) -> _Recording:
        """Read a recording."""
        facts = read_recording_facts(folder)
        compared = {name: self._towers(facts, one) for name, one in self.compared.items()}
        return _Recording(folder, facts, self._towers(facts, self.model or self.config), compared)

    def _towers(self, facts: RecordingFacts, source: Checkpoint | Config) -> TowerEncoder:
        features = self.out / "features"
        if isinstance(source, Config):
            return TowerEncoder.of_config(facts.grasps, source, features, self.quiet)
        return TowerEncoder.of_checkpoint(facts.grasps, source, self.config.training.iterations, features, self.quiet)

    def prepare(
        self, name: str, protocol: Protocol, recording: _Recording, split: Split | None
    ) -> tuple[Protocol, _Recording]:
        """Return the protocol with its split, and the recording with trained towers, if it has one split."""
        if name != UNSEEN_OBJECTS:
            return protocol, recording
        config = recording.towers.config
        protocol = with_split(recording.facts, self.config.training, self.model, split)
        if config.training.freeze_towers:
            return protocol, recording
        done, folder = self.out / "model.safetensors", recording.folder
        require_writable(done)
        (drawn,) = protocol.folds(recording.facts, self.seeds[0])
        trainer = Trainer(
            config,
            drawn,
            recording.facts.grasps,
            done,
            source=recording.facts.source,
            licences=training_licences(folder, config.training),
        )
        towers = self._towers(recording.facts, trainer.run_or_reuse(self.quiet))
        return protocol, dataclasses.replace(recording, towers=towers)

    def rows(self, recording: _Recording) -> list[Row]:
        """Return the rows of a table: the methods, then the compared checkpoints."""
        models = {name: towers for name, towers in recording.compared.items() if towers.checkpoint}
        return [
            *(Row(name, name, recording.towers) for name in self.methods),
            *(Row(name, "late_fusion", towers) for name, towers in models.items()),
        ]

    def touch_to_touch(self, protocol: TouchToTouch, recording: _Recording) -> ProtocolResult:
        """Run a protocol that compares towers and fits no method."""
        towers = {FROZEN: recording.towers, **recording.compared}
        folder = self.out / "common-frame"
        return run_touch_to_touch(protocol, recording.facts, towers, self.seeds, folder, self.quiet)


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
        quiet: No progress on stderr.
    """

    name: str
    protocol: Protocol
    facts: RecordingFacts
    rows: list[Row]
    seeds: list[int]
    out: Path
    quiet: bool

    def measure(self, cache: Cache) -> tuple[ProtocolResult, ProtocolTimes]:
        """Run all experiments; return measures with intervals, and times."""
        in_depth, folds = self.protocol.in_depth, self.folds
        kinds = {
            row.name: ["touch"] if in_depth or row.method == CHANCE else ["touch", "low_pass"] for row in self.rows
        }
        controls = self._controls()
        jobs = {
            **{(row.name, kind): self._experiments(row, kind) for row in self.rows for kind in kinds[row.name]},
            **{
                ("", one.kind): self._experiments(Row(one.kind, one.method, self.rows[0].towers), one.kind, True)
                for one in controls
                if one.reason is None
            },
        }
        outcomes: dict[tuple[str, str], list[list[Outcome]]] = {}
        count = sum(len(by_fold) for by_seed in jobs.values() for by_fold in by_seed)
        with Bar(self.name, count, "fits", quiet=self.quiet or in_depth) as bar:
            for job, by_seed in jobs.items():
                outcomes[job] = []
                for experiments in by_seed:
                    outcomes[job].append([])
                    for experiment in experiments:
                        outcomes[job][-1].append(experiment.run(cache))
                        bar.advance(note=" ".join(filter(None, job)))
        aggregation = Aggregation(self.seeds[0], self._ratio())
        measures = {job: self._by_seed(found) for job, found in outcomes.items()}
        rows = {
            row.name: MeasuredRow(
                row.method,
                row.towers.checkpoint.digest if row.towers.checkpoint else None,
                measures[row.name, "touch"],
                measures.get((row.name, "low_pass"), ()),
                best_params=[[one.best_params for one in by_fold] for by_fold in outcomes[row.name, "touch"]],
                details=combine(
                    [one.details for by_fold in outcomes[row.name, "touch"] for one in by_fold if one.details],
                    self.seeds[0],
                )
                if in_depth
                else None,
            )
            for row in self.rows
        }
        measured = [dataclasses.replace(one, measures=measures.get(("", one.kind), ())) for one in controls]
        first, *others = (row.name for row in self.rows)
        compared = [(first, other) for other in others]
        features = self.rows[0].towers.inputs("touch")
        counts = FeatureCounts(
            features.touch.shape[2], features.photo.shape[1], features.touch.shape[1], features.digest
        )
        result = protocol_result(
            self.protocol, self.facts, folds.values(), rows, measured, compared, aggregation, counts
        )
        return result, self._times({row.name: outcomes[row.name, "touch"] for row in self.rows})

    @cached_property
    def folds(self) -> dict[int, list[Split]]:
        """The splits of each seed that draws some."""
        is_drawn_once = self.protocol.in_depth or self.protocol.choices
        seeds = self.seeds[:1] if is_drawn_once else self.seeds
        return {seed: self.protocol.folds(self.facts, seed) for seed in seeds}

    def _controls(self) -> list[MeasuredControl]:
        """Return the controls and ceilings, without measures."""
        towers = self.rows[0].towers
        inputs = {**self.protocol.controls, **self.protocol.ceilings}
        return [MeasuredControl(kind, method, (), towers.missing_reason(kind)) for kind, method in inputs.items()]

    def _experiments(self, row: Row, kind: str, is_control: bool = False) -> list[list[Experiment]]:
        """Return the experiments of a row with one kind of inputs, by seed and fold."""

        def experiment(seed: int, draw_seed: int, number: int, split: Split) -> Experiment:
            folder = self.out / "fits" / self.name / f"{kind}-{number}"
            is_quiet = self.quiet or not self.protocol.in_depth  # a bar shows the progress
            return Experiment(
                self.name, self.protocol, self.facts, row, kind, split, seed, draw_seed, folder, is_control, is_quiet
            )

        if not self.protocol.in_depth:
            return [
                [experiment(seed, seed, number, split) for number, split in enumerate(splits)]
                for seed, splits in self.folds.items()
            ]
        method, first = METHODS.load(row.method), self.seeds[0]
        is_as_it_is = row.towers.checkpoint is not None and issubclass(method, LateFusion)
        seeds = self.seeds[:1] if is_control or is_as_it_is or not method.is_seeded else self.seeds
        return [[experiment(seed, first, 0, split) for split in self.folds[first]] for seed in seeds]

    def _ratio(self) -> float | None:
        """Return the number of test objects for each training object, for a protocol of choices."""
        if not self.protocol.choices:
            return None
        splits = [split for of_seed in self.folds.values() for split in of_seed]
        return sum(len(one.test) for one in splits) / sum(len(one.train + one.validation) for one in splits)

    def _by_seed(self, outcomes: Iterable[Sequence[Outcome]]) -> MeasuresBySeed:
        """Return the measures of each seed, over the queries of all folds; with `choices`, those of each fold."""
        groups = [[one] for folds in outcomes for one in folds] if self.protocol.choices else outcomes
        return [
            {
                name: pooled([one.measures[name] for one in folds])
                for name in folds[0].measures
                if all(name in one.measures for one in folds)
            }
            for folds in groups
        ]

    def _times(self, outcomes: Mapping[str, list[list[Outcome]]]) -> ProtocolTimes:
        found = {
            name: _method_times([one.seconds for folds in by_seed for one in folds])
            for name, by_seed in outcomes.items()
        }
        if {"late_fusion", "retrieve_rerank"} <= set(found):  # both use one training run
            fit_s = found["late_fusion"].fit_s
            found["retrieve_rerank"] = dataclasses.replace(found["retrieve_rerank"], fit_s=fit_s)
        return ProtocolTimes(*_tower_times(self.rows[0].towers), found)


def _method_times(seconds: Sequence[Mapping[str, float]]) -> MethodTimes:
    """Return the median times of a row."""
    medians = {key: float(np.median([one[key] for one in seconds])) for key in seconds[0]}
    return MethodTimes(
        fit_s=medians["fit"] or None,
        encode_touch_ms=1e3 * medians["encode_touch"],
        encode_photo_ms=1e3 * medians["encode_photo"],
        score_us_per_photo=1e6 * medians["score"],
        query_ms=1e3 * medians["query"],
    )


@one_thread()
def _tower_times(towers: TowerEncoder, count: int = 4, repeats: int = 3) -> tuple[float, float]:
    """Return the median times (ms) of the towers for a touch and a photo, on one thread, without reading files."""
    grasps = towers.grasps[:count]
    images = BatchImages(towers.config.preprocessing)
    touches, photos = [images.touch(grasp) for grasp in grasps], [images.photo(grasp.photo) for grasp in grasps]
    touch_s, photo_s = [], []
    for touch, photo in zip(touches * repeats, photos * repeats, strict=True):
        start = time.perf_counter()
        touch_features(towers.matcher, [touch])
        middle = time.perf_counter()
        photo_features(towers.matcher, [photo])
        touch_s.append(middle - start)
        photo_s.append(time.perf_counter() - middle)
    return 1e3 * float(np.median(touch_s)), 1e3 * float(np.median(photo_s))
