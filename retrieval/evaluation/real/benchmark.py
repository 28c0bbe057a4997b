"""The benchmark of real data: every protocol, seed, fold and line is measured once and kept; then all is summed up."""

import dataclasses
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording, Grasp, Split, data_digest, folder_of
from retrieval.errors import BadInput
from retrieval.evaluation.cache import cached_document, resumable, write_document
from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.low_contact import gel_change
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
    measure,
    pool_folds,
    read_fold_measures,
    write_fold_measures,
)
from retrieval.evaluation.real.protocol import PHOTO, Protocol, RecordingFacts, read_recording_facts
from retrieval.evaluation.real.reference_rows import (
    ANY_WIDTH_METHODS,
    assign_references,
    facts_with_references,
    features_with_references,
)
from retrieval.evaluation.real.touch_to_touch import TouchToTouch, touch_to_touch_entry
from retrieval.evaluation.real.verdict import Aggregation, BySeed, control_entry, reliability_entry, row_entry
from retrieval.evaluation.scoring import MethodScores
from retrieval.methods import METHODS, TRIVIAL_BASELINES
from retrieval.methods.method import Method
from retrieval.model.config import Config, named_config
from retrieval.training.features import Features
from retrieval.version import __version__

PRESET = "real"
DEFAULT_METHODS = ("cca_towers", "cca_pca", "cca", "late_fusion", "chance")
DRAWS = 10_000
MAX_GRASPS = {"train": 1, "validation": 12, "test": 40}
"""ShardResult grasps of an object, by part."""
EXAMPLES = 6


def benchmark(
    recordings: AnyRecording | Mapping[str, AnyRecording],
    out: Path,
    *,
    protocols: Sequence[str | Protocol],
    config: Config | str = PRESET,
    preset: str | None = None,
    methods: Sequence[str | type[Method]] = DEFAULT_METHODS,
    models: Mapping[str, Path] = MappingProxyType({}),
    seeds: int = 3,
    skipped: Mapping[str, str] = MappingProxyType({}),
    cache: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Evaluate methods by protocols of real data, with controls; write results.json.

    Files under `cache` that the same settings made are read, so that a stopped run goes on.

    Args:
        recordings: A folder, or what `robot.read_recording` returns; or one for each data set, by its name.
        out: Folder of the results.
        protocols: Names, or protocols of your own, which are called by their titles.
        config: Frozen towers, and heads, as an object (`Config.using` takes a tower of your own) or as `load_config`
            takes it.
        preset: What the report calls the configuration; its name where None.
        methods: Names, or classes of your own.
        models: Name to checkpoint; each is a row of its own, which is not fitted.
        seeds: How often folds are drawn and methods fitted.
        skipped: Protocol to the reason why it is left out, for the report.
        cache: Folder of features and measures; `out`/cache where None.
        quiet: No progress on stderr.

    Returns:
        The content of results.json.

    Raises:
        BadInput: No protocol can be asked, or there is neither method nor model.
        ConfigError: A protocol or method is unknown.
        DatasetError: A recording does not fit a protocol.
        CheckpointError: A model cannot be read.
        JobInterrupted: After Ctrl-C.

    >>> from pathlib import Path
    >>> from retrieval.evaluation.real.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("mine", "Halves", "Objects are halved by name.", halves, topn_accuracy(5))
    >>> asked = {"protocols": [protocol], "methods": ["cca", "chance"], "config": "tiny", "seeds": 1}
    >>> results = retrieval.benchmark("lab", Path("halves"), **asked, quiet=True)
    >>> list(results["protocols"]["halves"]["rows"])
    ['cca', 'chance']
    """
    fitted = [METHODS.name_of(method) for method in methods]
    if not (fitted or models) or seeds < 1:
        raise BadInput("give one method or model and one seed at least")
    config, called = named_config(config, preset)
    kept = cache or out / "cache"
    asked = dict(map(_named, protocols))
    if not isinstance(recordings, Mapping):
        recordings = dict.fromkeys((protocol.data_set for protocol in asked.values()), recordings)
    facts = {name: read_recording_facts(folder_of(recording)) for name, recording in recordings.items()}
    tables: dict[str, Any] = {}
    left_out = dict(skipped)
    rows: dict[str, list[BenchmarkRow]] = {}
    with resumable(kept):
        for name, protocol in asked.items():
            of = protocol.data_set
            if of not in rows:
                rows[of] = _rows(facts[of], config, fitted, models, kept / "features", quiet)
            if isinstance(protocol, TouchToTouch):
                tables[name] = touch_to_touch_entry(
                    protocol, facts[of], rows[of], list(range(seeds)), kept, DRAWS, quiet
                )
                continue
            taken = [row for row in rows[of] if protocol.entry == PHOTO or row.method in ANY_WIDTH_METHODS]
            if not taken:
                left_out[name] = (
                    f"it shows objects by touches, which of the methods only {', '.join(ANY_WIDTH_METHODS)} can take"
                )
                continue
            tables[name] = _ProtocolRun(name, protocol, facts[of], taken, list(range(seeds)), kept, quiet).entry()
    if not tables:
        raise BadInput(f"no protocol could be asked; {'; '.join(f'{name}: {why}' for name, why in left_out.items())}")
    results = {
        "schema_version": SCHEMA_VERSION,
        "software": __version__,
        "setting": {
            "preset": called,
            "config": config.without_paths(),
            "seeds": list(range(seeds)),
            "draws": DRAWS,
            "max_grasps": MAX_GRASPS,
        },
        "protocols": tables,
        "skipped": left_out,
    }
    write_document(out / "results.json", results)
    return results


def _named(choice: str | Protocol) -> tuple[str, Protocol]:
    """A protocol and its name; one of a user's own is called by its title."""
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
    """One protocol on one recording. all_facts: of the recording, also the grasps that the protocol does not ask."""

    name: str
    protocol: Protocol
    all_facts: RecordingFacts
    rows: list[BenchmarkRow]
    seeds: list[int]
    cache: Path
    quiet: bool

    @cached_property
    def _contact(self) -> dict[str, float] | None:
        """How much each grasp changes the gel image, in grey levels; None where frames before the contact are missing.
        It reads every touch, so it is kept.
        """
        grasps = self.all_facts.grasps
        if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
            return None
        digest = data_digest(grasps)
        return cached_document(self.cache / "contact" / f"{digest[:32]}.json", {"grasps": digest}, self._compare)

    def _compare(self) -> dict[str, float]:
        grasps = self.all_facts.grasps
        found = {}
        with Bar("compare with untouched", len(grasps), "grasps", quiet=self.quiet) as bar:
            for grasp in grasps:
                found[grasp.grasp_id] = gel_change(grasp)
                bar.advance()
        return found

    @cached_property
    def facts(self) -> RecordingFacts:
        """What is known of the grasps that ask: of all, or where reference touches are asked for, of those that have
        one, which then stands in place of their photo.
        """
        return self.all_facts if self.protocol.entry == PHOTO else facts_with_references(self.all_facts)

    @cached_property
    def _references(self) -> dict[str, Grasp]:
        return assign_references(self.all_facts.grasps)

    def _features(self, line: Condition) -> Features:
        features = line.features()
        if self.protocol.entry == PHOTO:
            return features
        return features_with_references(features, self._references, self.protocol.entry)

    def entry(self) -> dict[str, Any]:
        """The protocol's entry of results.json."""
        seeds = self.seeds[:1] if self.protocol.choices else self.seeds
        folds = {seed: self.protocol.folds(self.facts, seed) for seed in seeds}
        lines = self._conditions()
        found: dict[str, list[list[FoldMeasures]]] = {line.key: [] for line in lines}
        count = len(lines) * sum(map(len, folds.values()))
        with Bar(self.name, count, "fits", quiet=self.quiet) as bar:
            for seed, splits in folds.items():
                for line in lines:
                    some = []
                    for number, split in enumerate(splits):
                        some.append(self._fold_measures(line, seed, number, split))
                        bar.advance(note=line.key)
                    found[line.key].append(some)
        return {
            "title": self.protocol.title,
            "rule": self.protocol.rule,
            "published_results": list(self.protocol.published_results),
            "main": self.protocol.main,
            "labels": [[name, metric.label] for name, metric in self.protocol.measures.items()],
            "entry": self.protocol.entry,
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
            "examples": self._examples(found),
        }

    def _conditions(self) -> list[Condition]:
        lines = []
        for row in self.rows:
            lines += [
                Condition(row, kind)
                for kind in (("touch",) if row.method in TRIVIAL_BASELINES else ("touch", "low_pass"))
            ]
        first = BenchmarkRow(CONTROL_METHOD, CONTROL_METHOD, self._frozen)
        return lines + [Condition(first, kind) for kind in CONTROLS if self._missing_reason(kind) is None]

    @property
    def _frozen(self) -> TowerEncoder:
        """The towers that controls stand on."""
        return self.rows[0].towers

    def _missing_reason(self, kind: str) -> str | None:
        if kind == "background" and self.protocol.entry != PHOTO:
            return "an object is shown by touches"
        return missing_no_contact_reason(self.facts.grasps) if kind == "no_contact" else None

    def _aggregation(self, folds: Mapping[int, Sequence[Split]]) -> Aggregation:
        if not self.protocol.choices:
            return Aggregation(DRAWS, self.seeds[0])
        splits = [split for some in folds.values() for split in some]
        test = sum(len(split.test) for split in splits)
        return Aggregation(DRAWS, self.seeds[0], test / sum(len(split.train + split.validation) for split in splits))

    def _measures_by_seed(self, folds_of: Sequence[Sequence[FoldMeasures]]) -> BySeed:
        """Measures by seed, over all its folds; of a protocol of choices those of each fold."""
        if self.protocol.choices:
            return [pool_folds([one]) for folds in folds_of for one in folds]
        return [pool_folds(folds) for folds in folds_of]

    def _row(
        self, row: BenchmarkRow, found: Mapping[str, list[list[FoldMeasures]]], aggregation: Aggregation
    ) -> dict[str, Any]:
        lines = (f"{row.name}-touch", f"{row.name}-blurred", "order")
        touch, low_pass, order = (self._measures_by_seed(found.get(key, ())) for key in lines)
        model, mine = row.towers.checkpoint, found[lines[0]]
        return {
            "method": row.method,
            "model": model.digest if model else None,
            **row_entry(self.protocol, touch, low_pass, order, aggregation),
            "reliability": reliability_entry([one.confidences for folds in mine for one in folds]),
            "best_params": [[one.best_params for one in folds] for folds in mine],
        }

    def _controls(self, found: Mapping[str, list[list[FoldMeasures]]], aggregation: Aggregation) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        for kind, description in CONTROLS.items():
            taken = self._measures_by_seed(found.get(kind, ()))
            entries[kind] = control_entry(self.protocol, description, self._missing_reason(kind), taken, aggregation)
        return entries

    def _examples(self, found: Mapping[str, list[list[FoldMeasures]]]) -> dict[str, Any]:
        """The best and the worst queries of all folds, of the first seed, for the first row that looks at its input."""
        row = next((row for row in self.rows if row.method not in TRIVIAL_BASELINES), self.rows[0])
        folds = found[f"{row.name}-touch"][0]
        every = {kind: [one for fold in folds for one in fold.examples[kind]] for kind in ("best", "worst")}
        best = sorted(every["best"], key=lambda one: float(one["true_rank"]))
        worst = sorted(every["worst"], key=lambda one: -float(one["true_rank"]))
        return {"row": row.name, "best": best[:EXAMPLES], "worst": worst[:EXAMPLES]}

    # One fold ----------------------------------------------------------------------------------------

    def _fold_measures(self, line: Condition, seed: int, number: int, split: Split) -> FoldMeasures:
        """The measures of one line in one fold: those that are kept, else the line is fitted and asked, and its
        measures are kept. Scores are not kept: those of all folds fill gigabytes.
        """
        self._require_unseen(line, split)
        features, towers = self._features(line), line.row.towers
        work = self.cache / "fits" / f"{self.name}-{line.key}-{seed}-{number}"
        experiment = Experiment(
            folder=work,
            config=towers.config,
            split=split,
            features=features,
            pairs=None,
            queries=draw_queries(self.facts.grasps, split, seed, MAX_GRASPS),
            checkpoint=towers.checkpoint if line.kind in ("touch", "low_pass") else None,
            shuffled=line.kind == "permuted",
            quiet=True,
            fit_on_validation=True,
            kind_of=self.facts.kind_of,
        )
        protocol = self.protocol
        cache_key = experiment.cache_key(line.method, seed) | {
            "protocol": self.name,
            "measures": list(protocol.measures),
            "shown": [protocol.allows_own_photos, protocol.is_by_sequence, protocol.gallery_of(self.facts, split)],
            "line": line.key,
            "contact": self._contact is not None,
        }
        path = self.cache / "measures" / self.name / f"{line.key}-{seed}-{number}.safetensors"
        if (kept := read_fold_measures(path, cache_key)) is not None:
            return kept
        judged = MethodScores(experiment.queries, experiment.run(line.method, seed), seed)
        measured = measure(judged, protocol, self.facts, split, features.grasp_ids, self._contact)
        write_fold_measures(path, measured, cache_key)
        shutil.rmtree(work)
        return measured

    def _require_unseen(self, line: Condition, split: Split) -> None:
        """A model must not have been trained on the objects that it is tested with."""
        model = line.row.towers.checkpoint
        seen = {*model.split.train, *model.split.validation} if model and model.split else set()
        if shared := seen & set(split.test):
            raise BadInput(
                f"the model {line.row.name} was trained on {len(shared)} of the objects that {self.name} tests, such "
                f"as {min(shared)}; give one that has not seen them"
            )
