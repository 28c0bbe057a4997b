"""Real-data benchmark: measure each protocol, seed, fold and condition once, store it, then aggregate."""

import dataclasses
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from retrieval.console.interruption import resumable
from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording, Split, data_digest, folder_of
from retrieval.errors import BadInput
from retrieval.evaluation.cache import write_document
from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.queries import draw_queries
from retrieval.evaluation.real import PROTOCOLS, SCHEMA_VERSION
from retrieval.evaluation.real.conditions import (
    CONTROL_METHOD,
    CONTROLS,
    BenchmarkRow,
    Condition,
    TowerEncoder,
    missing_no_contact_reason,
)
from retrieval.evaluation.real.fold_measures import (
    FoldMeasures,
    measure_fold,
    pool_folds,
    read_fold_measures,
    write_fold_measures,
)
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts, read_recording_facts
from retrieval.evaluation.real.touch_to_touch import FROZEN, TouchToTouch, touch_to_touch_entry
from retrieval.evaluation.real.verdict import Aggregation, MeasuresBySeed, control_entry, row_entry
from retrieval.evaluation.scoring import MethodScores
from retrieval.methods import CHANCE, METHODS
from retrieval.methods.method import Method
from retrieval.model.config import Config, named_config
from retrieval.version import __version__

PRESET = "real"
DEFAULT_METHODS = ("cca_towers", "cca", "late_fusion", "chance")
DRAWS = 10_000
MAX_GRASPS = {"train": 1, "validation": 12, "test": 40}
"""Maximum number of scored grasps of one object, by part."""


def benchmark(
    recordings: AnyRecording | Mapping[str, AnyRecording],
    out: Path,
    *,
    protocols: Sequence[str | Protocol],
    config: Config | str = PRESET,
    preset: str | None = None,
    methods: Sequence[str | type[Method]] = DEFAULT_METHODS,
    models: Mapping[str, Path] = MappingProxyType({}),
    towers: Mapping[str, Config] = MappingProxyType({}),
    seeds: int = 3,
    skipped: Mapping[str, str] = MappingProxyType({}),
    cache: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Evaluate methods by protocols of real data, with controls; write results.json.

    A stopped run resumes: files under `cache` from the same settings are reused.

    Args:
        recordings: A folder, or the object that `robot.read_recording` returns; or one for each data set, by its name.
        out: Folder of the results.
        protocols: Names, or your own protocols, which are named by their titles.
        config: Frozen towers and heads: a `Config` (`Config.using` accepts your own tower), or an argument of
            `load_config`.
        preset: Name of the configuration in the report. Default: the configuration's name.
        methods: Names, or your own classes.
        models: Checkpoints by name. Each is a separate row and is not fitted.
        towers: Configurations by name. The frozen touch tower of each is a separate row of touch-to-touch protocols.
        seeds: Number of seeds. Each seed draws the folds again and fits the methods again.
        skipped: Why a protocol is left out, by its name. The report states these reasons.
        cache: Folder of features and measures. Default: `out`/cache.
        quiet: No progress on stderr.

    Returns:
        The content of results.json.

    Raises:
        BadInput: No protocol can run, or there is neither method nor model.
        ConfigError: A protocol or method is unknown.
        DatasetError: A recording does not fit a protocol.
        CheckpointError: A model cannot be read.
        JobInterrupted: After Ctrl-C.

    >>> from pathlib import Path
    >>> from retrieval.evaluation.real.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("mine", "Halves", "Objects are halved by name.", halves, topn_accuracy(5))
    >>> options = {"protocols": [protocol], "methods": ["cca", "chance"], "config": "tiny", "seeds": 1}
    >>> results = retrieval.benchmark("lab", Path("halves"), **options, quiet=True)
    >>> list(results["protocols"]["halves"]["rows"])
    ['cca', 'chance']
    """
    names = [METHODS.name_of(method) for method in methods]
    if not (names or models) or seeds < 1:
        raise BadInput(
            f"A benchmark needs at least 1 method or model and 1 seed, got {len(names) + len(models)} and {seeds}."
        )
    config, preset_name = named_config(config, preset)
    cache = cache or out / "cache"
    selected = dict(map(_named, protocols))
    if equal := set(towers) & {FROZEN, *models}:
        raise BadInput(f"Another row is already named {min(equal)}. Give this entry of `towers` a different name.")
    if towers and not any(isinstance(protocol, TouchToTouch) for protocol in selected.values()):
        raise BadInput(
            f"Only touch-to-touch protocols compare towers, got {', '.join(selected)}. Add one, such as physiclear."
        )
    if not isinstance(recordings, Mapping):
        recordings = dict.fromkeys((protocol.data_set for protocol in selected.values()), recordings)
    facts = {name: read_recording_facts(folder_of(recording)) for name, recording in recordings.items()}
    tables: dict[str, Any] = {}
    left_out = dict(skipped)
    rows: dict[str, list[BenchmarkRow]] = {}
    with resumable(cache):
        for name, protocol in selected.items():
            data_set = protocol.data_set
            if data_set not in rows:
                rows[data_set] = _rows(facts[data_set], config, names, models, cache / "features", quiet)
            if isinstance(protocol, TouchToTouch):
                compared = {row.name if row.towers.checkpoint else FROZEN: row.towers for row in rows[data_set]}
                for row_name, each in towers.items():
                    compared[row_name] = TowerEncoder.of_config(facts[data_set].grasps, each, cache / "features", quiet)
                tables[name] = touch_to_touch_entry(
                    protocol, facts[data_set], compared, list(range(seeds)), cache, DRAWS, quiet
                )
                continue
            tables[name] = _ProtocolRun(
                name, protocol, facts[data_set], rows[data_set], list(range(seeds)), cache, quiet
            ).entry()
    if not tables:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise BadInput(f"No protocol can run. {reasons}")
    results = {
        "schema_version": SCHEMA_VERSION,
        "software": __version__,
        "setting": {
            "preset": preset_name,
            "config": config.without_paths(),
            "seeds": list(range(seeds)),
            "draws": DRAWS,
            "max_grasps": MAX_GRASPS,
            "towers": {name: each.without_paths() for name, each in towers.items()},
        },
        "protocols": tables,
        "skipped": left_out,
    }
    write_document(out / "results.json", results)
    return results


def _named(choice: str | Protocol) -> tuple[str, Protocol]:
    """Return the name and the protocol; a user's own protocol is named by its title."""
    if isinstance(choice, Protocol):
        return re.sub(r"[^a-z0-9]+", "-", choice.title.lower()).strip("-"), choice
    name = PROTOCOLS.name_of(choice)
    return name, PROTOCOLS.load(name)


def _rows(
    facts: RecordingFacts, config: Config, methods: Sequence[str], models: Mapping[str, Path], cache: Path, quiet: bool
) -> list[BenchmarkRow]:
    towers = TowerEncoder.of_config(facts.grasps, config, cache, quiet)
    rows = [BenchmarkRow(name, name, towers) for name in dict.fromkeys(methods)]
    for name, path in models.items():
        rows.append(BenchmarkRow(name, "late_fusion", TowerEncoder.of_model(facts.grasps, path, cache, quiet)))
    return rows


@dataclass(frozen=True, eq=False)
class _ProtocolRun:
    """One protocol on one recording.

    Attributes:
        name: Name of the protocol.
        protocol: The protocol.
        facts: The recording.
        rows: The rows of the table.
        seeds: Seeds of folds and fits.
        cache: Folder of features and measures.
        quiet: No progress on stderr.
    """

    name: str
    protocol: Protocol
    facts: RecordingFacts
    rows: list[BenchmarkRow]
    seeds: list[int]
    cache: Path
    quiet: bool

    def entry(self) -> dict[str, Any]:
        """Return the protocol's entry of results.json."""
        seeds = self.seeds[:1] if self.protocol.choices else self.seeds
        folds = {seed: self.protocol.folds(self.facts, seed) for seed in seeds}
        conditions = self._conditions()
        found: dict[str, list[list[FoldMeasures]]] = {condition.key: [] for condition in conditions}
        count = len(conditions) * sum(map(len, folds.values()))
        with Bar(self.name, count, "fits", quiet=self.quiet) as bar:
            for seed, splits in folds.items():
                for condition in conditions:
                    measured = []
                    for number, split in enumerate(splits):
                        measured.append(self._fold_measures(condition, seed, number, split))
                        bar.advance(note=condition.key)
                    found[condition.key].append(measured)
        return {
            "title": self.protocol.title,
            "rule": self.protocol.rule,
            "published_results": list(self.protocol.published_results),
            "main": self.protocol.main,
            "labels": [[name, metric.label] for name, metric in self.protocol.measures.items()],
            "unit": "choice" if self.protocol.choices else "sequence" if self.protocol.is_by_sequence else "object",
            "recording": {
                "data_set": self.protocol.data_set,
                "source": self.facts.source,
                "digest": data_digest(self.facts.grasps),
                "objects": len(self.facts.names),
                "grasps": len(self.facts.grasps),
            },
            "folds": [[dataclasses.asdict(split) for split in splits] for splits in folds.values()],
            "rows": {row.name: self._row(row, found, self._aggregation(folds)) for row in self.rows},
            "controls": self._controls(found, self._aggregation(folds)),
        }

    def _conditions(self) -> list[Condition]:
        conditions = []
        for row in self.rows:
            conditions += [
                Condition(row, kind) for kind in (("touch",) if row.method == CHANCE else ("touch", "low_pass"))
            ]
        control = BenchmarkRow(CONTROL_METHOD, CONTROL_METHOD, self._frozen)
        return conditions + [Condition(control, kind) for kind in CONTROLS if self._missing_reason(kind) is None]

    @property
    def _frozen(self) -> TowerEncoder:
        """The towers of the controls."""
        return self.rows[0].towers

    def _missing_reason(self, kind: str) -> str | None:
        return missing_no_contact_reason(self.facts.grasps) if kind == "no_contact" else None

    def _aggregation(self, folds: Mapping[int, Sequence[Split]]) -> Aggregation:
        if not self.protocol.choices:
            return Aggregation(DRAWS, self.seeds[0])
        splits = [split for of_seed in folds.values() for split in of_seed]
        test = sum(len(split.test) for split in splits)
        return Aggregation(DRAWS, self.seeds[0], test / sum(len(split.train + split.validation) for split in splits))

    def _measures_by_seed(self, folds_of: Sequence[Sequence[FoldMeasures]]) -> MeasuresBySeed:
        """Return the measures of each seed over all folds; with `choices`, those of each fold."""
        if self.protocol.choices:
            return [pool_folds([one]) for folds in folds_of for one in folds]
        return [pool_folds(folds) for folds in folds_of]

    def _row(
        self, row: BenchmarkRow, found: Mapping[str, list[list[FoldMeasures]]], aggregation: Aggregation
    ) -> dict[str, Any]:
        keys = (f"{row.name}-touch", f"{row.name}-low_pass", "order")
        touch, low_pass, order = (self._measures_by_seed(found.get(key, ())) for key in keys)
        model, mine = row.towers.checkpoint, found[keys[0]]
        return {
            "method": row.method,
            "model": model.digest if model else None,
            **row_entry(self.protocol, touch, low_pass, order, aggregation),
            "best_params": [[one.best_params for one in folds] for folds in mine],
        }

    def _controls(self, found: Mapping[str, list[list[FoldMeasures]]], aggregation: Aggregation) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        for kind, description in CONTROLS.items():
            by_seed = self._measures_by_seed(found.get(kind, ()))
            entries[kind] = control_entry(self.protocol, description, self._missing_reason(kind), by_seed, aggregation)
        return entries

    # One fold ----------------------------------------------------------------------------------------

    def _fold_measures(self, condition: Condition, seed: int, number: int, split: Split) -> FoldMeasures:
        """Return the stored measures of one condition in one fold, or fit, score and store them.

        Scores are not stored: those of all folds take gigabytes.
        """
        self._require_unseen(condition, split)
        features, towers = condition.features(), condition.row.towers
        work = self.cache / "fits" / f"{self.name}-{condition.key}-{seed}-{number}"
        experiment = Experiment(
            folder=work,
            config=towers.config,
            split=split,
            features=features,
            queries=draw_queries(self.facts.grasps, split, seed, MAX_GRASPS),
            checkpoint=towers.checkpoint if condition.kind in ("touch", "low_pass") else None,
            shuffled=condition.kind == "permuted",
            quiet=True,
            fit_on_validation=True,
            kind_of=self.facts.kind_of,
        )
        protocol = self.protocol
        cache_key = experiment.cache_key(condition.method, seed) | {
            "protocol": self.name,
            "measures": list(protocol.measures),
            "shown": [protocol.allows_own_photos, protocol.is_by_sequence, protocol.gallery_of(self.facts, split)],
            "line": condition.key,
        }
        path = self.cache / "measures" / self.name / f"{condition.key}-{seed}-{number}.safetensors"
        if (stored := read_fold_measures(path, cache_key)) is not None:
            return stored
        method_scores = MethodScores(experiment.queries, experiment.run(condition.method, seed), seed)
        measured = measure_fold(method_scores, protocol, self.facts, split)
        write_fold_measures(path, measured, cache_key)
        shutil.rmtree(work)
        return measured

    def _require_unseen(self, condition: Condition, split: Split) -> None:
        """Raise BadInput if the model was trained on a test object."""
        model = condition.row.towers.checkpoint
        trained = {*model.split.train, *model.split.validation} if model and model.split else set()
        if shared := trained & set(split.test):
            raise BadInput(
                f"Model {condition.row.name} was trained on {len(shared)} test objects of {self.name}, such as "
                f"{min(shared)}. Give a model that was not trained on them."
            )
