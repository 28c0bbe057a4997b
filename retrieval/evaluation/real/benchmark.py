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
from retrieval.evaluation.cache import kept_document, resumable, write_document
from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.faint import change
from retrieval.evaluation.queries import draw_queries
from retrieval.evaluation.real import PROTOCOLS, SCHEMA_VERSION
from retrieval.evaluation.real.lines import CONTROL_METHOD, CONTROLS, Line, Row, Towers, why_not_untouched
from retrieval.evaluation.real.measuring import Measured, joined, measure, read_measured, write_measured
from retrieval.evaluation.real.protocol import PHOTO, Facts, Protocol, read_facts
from retrieval.evaluation.real.references import FITTED, referenced, references_of, shown_by_references
from retrieval.evaluation.real.touch_to_touch import TouchToTouch, touch_to_touch_entry
from retrieval.evaluation.real.verdict import BySeed, Summing, control_entry, reliability_entry, row_entry
from retrieval.evaluation.scoring import MethodScores
from retrieval.methods import KNOW_NOTHING, METHODS
from retrieval.methods.base import Method
from retrieval.model.config import Config, named_config
from retrieval.training.features import Features
from retrieval.version import __version__

PRESET = "real"
METHODS_ASKED = ("cca_towers", "cca_pca", "cca", "late_fusion", "chance")
DRAWS = 10_000
MOST = {"train": 1, "validation": 12, "test": 40}
"""Judged grasps of an object, by part."""
EXAMPLES = 6


def benchmark(
    recordings: AnyRecording | Mapping[str, AnyRecording],
    out: Path,
    *,
    protocols: Sequence[str | Protocol],
    config: Config | str = PRESET,
    preset: str | None = None,
    methods: Sequence[str | type[Method]] = METHODS_ASKED,
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
        Interrupted: After Ctrl-C.

    >>> from pathlib import Path
    >>> from retrieval.evaluation.real.protocol import first_guess, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("mine", "Halves", "Objects are halved by name.", halves, first_guess(5))
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
    facts = {name: read_facts(folder_of(recording)) for name, recording in recordings.items()}
    tables: dict[str, Any] = {}
    left_out = dict(skipped)
    rows: dict[str, list[Row]] = {}
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
            taken = [row for row in rows[of] if protocol.entry == PHOTO or row.method in FITTED]
            if not taken:
                left_out[name] = f"it shows objects by touches, which of the methods only {', '.join(FITTED)} can take"
                continue
            tables[name] = _Asked(name, protocol, facts[of], taken, list(range(seeds)), kept, quiet).entry()
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
            "judged_grasps": MOST,
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
    facts: Facts, config: Config, methods: Sequence[str], models: Mapping[str, Path], cache: Path, quiet: bool
) -> list[Row]:
    towers = Towers.of_config(facts.grasps, config, cache, quiet)
    rows = [Row(name, name, towers) for name in dict.fromkeys(methods)]
    for name, path in models.items():
        rows.append(Row(name, "late_fusion", Towers.of_model(facts.grasps, path, cache, quiet)))
    return rows


@dataclass(frozen=True, eq=False)
class _Asked:
    """One protocol on one recording. all_facts: of the recording, also the grasps that the protocol does not ask."""

    name: str
    protocol: Protocol
    all_facts: Facts
    rows: list[Row]
    seeds: list[int]
    cache: Path
    quiet: bool

    @cached_property
    def _contact(self) -> dict[str, float] | None:
        """How much each grasp changes the gel image, in grey levels; None where frames before the contact are missing.
        It reads every touch, so it is kept."""
        grasps = self.all_facts.grasps
        if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
            return None
        digest = data_digest(grasps)
        return kept_document(self.cache / "contact" / f"{digest[:32]}.json", {"grasps": digest}, self._compare)

    def _compare(self) -> dict[str, float]:
        grasps = self.all_facts.grasps
        found = {}
        with Bar("compare with untouched", len(grasps), "grasps", quiet=self.quiet) as bar:
            for grasp in grasps:
                found[grasp.grasp_id] = change(grasp)
                bar.advance()
        return found

    @cached_property
    def facts(self) -> Facts:
        """What is known of the grasps that ask: of all, or where reference touches are asked for, of those that have
        one, which then stands in place of their photo."""
        return self.all_facts if self.protocol.entry == PHOTO else referenced(self.all_facts)

    @cached_property
    def _references(self) -> dict[str, Grasp]:
        return references_of(self.all_facts.grasps)

    def _features(self, line: Line) -> Features:
        features = line.features()
        if self.protocol.entry == PHOTO:
            return features
        return shown_by_references(features, self._references, self.protocol.entry)

    def entry(self) -> dict[str, Any]:
        """The protocol's entry of results.json."""
        seeds = self.seeds[:1] if self.protocol.choices else self.seeds
        folds = {seed: self.protocol.folds(self.facts, seed) for seed in seeds}
        lines = self._lines()
        found: dict[str, list[list[Measured]]] = {line.key: [] for line in lines}
        count = len(lines) * sum(map(len, folds.values()))
        with Bar(self.name, count, "fits", quiet=self.quiet) as bar:
            for seed, splits in folds.items():
                for line in lines:
                    some = []
                    for number, split in enumerate(splits):
                        some.append(self._measured(line, seed, number, split))
                        bar.advance(note=line.key)
                    found[line.key].append(some)
        return {
            "title": self.protocol.title,
            "rule": self.protocol.rule,
            "anchors": list(self.protocol.anchors),
            "main": self.protocol.main,
            "labels": [[name, metric.label] for name, metric in self.protocol.measures.items()],
            "entry": self.protocol.entry,
            "unit": "choice" if self.protocol.choices else "sequence" if self.protocol.by_sequence else "object",
            "recording": {
                "data_set": self.protocol.data_set,
                "source": self.facts.source,
                "digest": data_digest(self.facts.grasps),
                "objects": len(self.facts.names),
                "grasps": len(self.facts.grasps),
            },
            "folds": [[dataclasses.asdict(split) for split in splits] for splits in folds.values()],
            "rows": {row.name: self._row(row, found, self._summing(folds)) for row in self.rows},
            "controls": self._controls(found, self._summing(folds)),
            "examples": self._examples(found),
        }

    def _lines(self) -> list[Line]:
        lines = []
        for row in self.rows:
            lines += [Line(row, kind) for kind in (("touch",) if row.method in KNOW_NOTHING else ("touch", "blurred"))]
        first = Row(CONTROL_METHOD, CONTROL_METHOD, self._frozen)
        return lines + [Line(first, kind) for kind in CONTROLS if self._why_not(kind) is None]

    @property
    def _frozen(self) -> Towers:
        """The towers that controls stand on."""
        return self.rows[0].towers

    def _why_not(self, kind: str) -> str | None:
        if kind == "background" and self.protocol.entry != PHOTO:
            return "an object is shown by touches"
        return why_not_untouched(self.facts.grasps) if kind == "untouched" else None

    def _summing(self, folds: Mapping[int, Sequence[Split]]) -> Summing:
        if not self.protocol.choices:
            return Summing(DRAWS, self.seeds[0])
        splits = [split for some in folds.values() for split in some]
        test = sum(len(split.test) for split in splits)
        return Summing(DRAWS, self.seeds[0], test / sum(len(split.train + split.validation) for split in splits))

    def _taken(self, folds_of: Sequence[Sequence[Measured]]) -> BySeed:
        """Measures by seed, over all its folds; of a protocol of choices those of each fold."""
        if self.protocol.choices:
            return [joined([one]) for folds in folds_of for one in folds]
        return [joined(folds) for folds in folds_of]

    def _row(self, row: Row, found: Mapping[str, list[list[Measured]]], summing: Summing) -> dict[str, Any]:
        lines = (f"{row.name}-touch", f"{row.name}-blurred", "order")
        touch, blurred, order = (self._taken(found.get(key, ())) for key in lines)
        model, mine = row.towers.checkpoint, found[lines[0]]
        return {
            "method": row.method,
            "model": model.digest if model else None,
            **row_entry(self.protocol, touch, blurred, order, summing),
            "reliability": reliability_entry([one.stated for folds in mine for one in folds]),
            "chosen": [[one.chosen for one in folds] for folds in mine],
        }

    def _controls(self, found: Mapping[str, list[list[Measured]]], summing: Summing) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        for kind, what in CONTROLS.items():
            taken = self._taken(found.get(kind, ()))
            entries[kind] = control_entry(self.protocol, what, self._why_not(kind), taken, summing)
        return entries

    def _examples(self, found: Mapping[str, list[list[Measured]]]) -> dict[str, Any]:
        """The best and the worst queries of all folds, of the first seed, for the first row that looks at its input."""
        row = next((row for row in self.rows if row.method not in KNOW_NOTHING), self.rows[0])
        folds = found[f"{row.name}-touch"][0]
        every = {kind: [one for fold in folds for one in fold.examples[kind]] for kind in ("best", "worst")}
        best = sorted(every["best"], key=lambda one: float(one["true_rank"]))
        worst = sorted(every["worst"], key=lambda one: -float(one["true_rank"]))
        return {"row": row.name, "best": best[:EXAMPLES], "worst": worst[:EXAMPLES]}

    # One fold ----------------------------------------------------------------------------------------

    def _measured(self, line: Line, seed: int, number: int, split: Split) -> Measured:
        """The measures of one line in one fold: those that are kept, else the line is fitted and asked, and its
        measures are kept. Scores are not kept: those of all folds fill gigabytes."""
        self._require_unseen(line, split)
        features, towers = self._features(line), line.row.towers
        work = self.cache / "fits" / f"{self.name}-{line.key}-{seed}-{number}"
        experiment = Experiment(
            folder=work,
            config=towers.config,
            split=split,
            features=features,
            pairs=None,
            queries=draw_queries(self.facts.grasps, split, seed, MOST),
            checkpoint=towers.checkpoint if line.kind in ("touch", "blurred") else None,
            shuffled=line.kind == "dealt",
            quiet=True,
            all_teach=True,
            kind_of=self.facts.kind_of,
        )
        protocol = self.protocol
        made_by = experiment.made_by(line.method, seed) | {
            "protocol": self.name,
            "measures": list(protocol.measures),
            "shown": [protocol.own_photos, protocol.by_sequence, protocol.gallery_of(self.facts, split)],
            "line": line.key,
            "contact": self._contact is not None,
        }
        path = self.cache / "measures" / self.name / f"{line.key}-{seed}-{number}.safetensors"
        if (kept := read_measured(path, made_by)) is not None:
            return kept
        judged = MethodScores(experiment.queries, experiment.run(line.method, seed), seed)
        measured = measure(judged, protocol, self.facts, split, features.grasp_ids, self._contact)
        write_measured(path, measured, made_by)
        shutil.rmtree(work)
        return measured

    def _require_unseen(self, line: Line, split: Split) -> None:
        """A model must not have been trained on the objects that it is tested with."""
        model = line.row.towers.checkpoint
        seen = {*model.split.train, *model.split.validation} if model and model.split else set()
        if shared := seen & set(split.test):
            raise BadInput(
                f"the model {line.row.name} was trained on {len(shared)} of the objects that {self.name} tests, such "
                f"as {min(shared)}; give one that has not seen them"
            )
