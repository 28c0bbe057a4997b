"""Evaluate methods and models by protocols: from recordings to results.json. Finished experiments are not repeated."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from _touch_retrieval.cache import Cache
from retrieval.console.interruption import resumable
from retrieval.data.dataset import AnyRecording, Split, finger_count, folder_of, recording_camera
from retrieval.errors import BadInput
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS
from retrieval.evaluation.experiment import ProtocolRun
from retrieval.evaluation.inputs import Row, TowerEncoder
from retrieval.evaluation.protocol import Protocol, RecordingFacts, read_recording_facts
from retrieval.evaluation.protocols.recording import with_split
from retrieval.evaluation.results import ProtocolResult, Results, Setting, write_results
from retrieval.evaluation.touch_to_touch import FROZEN, TouchToTouch, run_touch_to_touch
from retrieval.methods import METHODS
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import Method
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.config import Config, named_config
from retrieval.model.shipped import is_shipped, shipped_model
from retrieval.training.initial_weights import made_from, training_licences
from retrieval.training.trainer import Trainer
from retrieval.version import __version__

DATA_SET_METHODS, DATA_SET_SEEDS = ("cca_towers", "cca", "late_fusion", "chance"), 3
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
    seed: int | None = None,
    seeds: int | None = None,
    split: Split | None = None,
    skipped: Mapping[str, str] = MappingProxyType({}),
) -> Results:
    """Compare methods and models on unseen objects, with controls; write results.json.

    A stopped run resumes: experiments under `out` with the same inputs are reused. Equal settings give byte-identical
    results.

    Args:
        recordings: A folder, or the object that `robot.read_recording` returns; or one for each data set, by its name.
        out: Folder of the results.
        protocols: Names, or your own protocols, which are named by their titles. Default: "unseen-objects", one split
            of the recording, with which each method is described in depth.
        config: Towers, heads and split in place of those of a model: a `Config` (`Config.using` accepts your own towers
            and losses), or an argument of `load_config`. Only "unseen-objects" trains towers; other protocols use
            frozen ones. Default: none, with `protocols` "mobilenet", or "linear" if all compare touches with touches.
        preset: Name of the configuration in the report. Default: the configuration's name.
        methods: Names, or your own classes, which the report lists by class name. Default: all but "cca_towers", with
            `protocols` those of `DATA_SET_METHODS`.
        model: A checkpoint. The first row scores with it as it is; methods are fitted on its features, and late fusion
            starts from its head. Default: without `config` the shipped model for the number of fingers.
        compared: More rows by name: a checkpoint that scores as it is; or a configuration whose frozen touch tower is
            compared by touch-to-touch protocols.
        seed: Seed of every random draw. Default: that of `config`, else 0.
        seeds: Number of seeds, from `seed` on. Each repeats the training of each method; with `protocols`,
            each also draws the folds and queries again. Default: 1, with `protocols` 3.
        split: Objects of each part of "unseen-objects". Default: the split of `model`; without a model, a random one.
        skipped: Why a protocol is left out, by its name. The report states these reasons.

    Returns:
        The content of results.json.

    Raises:
        BadInput: There are both a configuration and a model, or a model was trained on test objects.
        ConfigError: A protocol or method is unknown.
        DatasetError: A recording does not fit a protocol.
        CheckpointError: A model cannot be read.
        JobInterrupted: After Ctrl-C.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny")
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))
    >>> results = retrieval.evaluate("lab", Path("report"), config=config, methods=["cca", "chance"])
    >>> rows = results.protocols["unseen-objects"].rows
    >>> list(rows)
    ['cca', 'chance']

    A protocol of your own:

    >>> from retrieval.evaluation.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("mine", "Halves", "Objects are halved by name.", halves, topn_accuracy(5))
    >>> options = {"protocols": [protocol], "methods": ["cca", "chance"], "config": "tiny", "seeds": 1}
    >>> results = retrieval.evaluate("lab", Path("halves"), **options)
    >>> list(results.protocols["halves"].rows)
    ['cca', 'chance']
    """
    selected = dict(map(_named, protocols or [UNSEEN_OBJECTS]))
    if model and config:
        raise BadInput("A model already defines towers and settings. Give either a model or a configuration.")
    if protocols and not model:
        config = config or data_set_preset(protocols)
    default_methods = DATA_SET_METHODS if protocols else [name for name in METHODS if name != "cca_towers"]
    names = [METHODS.name_of(method) for method in methods or default_methods]
    count = seeds if seeds is not None else DATA_SET_SEEDS if protocols else 1
    if count < 1:
        raise BadInput(f"An evaluation needs at least 1 seed, got {count}.")
    _require_use(selected, names, compared, split)
    if not isinstance(recordings, Mapping):
        recordings = dict.fromkeys((protocol.data_set for protocol in selected.values()), recordings)
    facts_of = {name: read_recording_facts(folder_of(recording)) for name, recording in recordings.items()}
    own: Config | Checkpoint
    if config:
        own, config_name = named_config(config, preset)
        seed = own.training.seed if seed is None else seed
        own = replace(own, training=replace(own.training, seed=seed))
    else:
        if model is None:
            (facts,) = facts_of.values()
            model = shipped_model(finger_count(facts.grasps))
        own, config_name, seed = load_checkpoint(model), "of the model", seed or 0
    training_seeds = list(range(seed, seed + count))
    others = {name: one if isinstance(one, Config) else load_checkpoint(one) for name, one in compared.items()}

    def encoder(facts: RecordingFacts, source: Config | Checkpoint) -> TowerEncoder:
        config = source if isinstance(source, Config) else source.config
        camera = recording_camera(facts.folder, facts.grasps, config.preprocessing)
        return TowerEncoder.of(facts.grasps, source, camera, seed, out)

    towers_of = {
        name: {row: encoder(facts, source) for row, source in {FROZEN: own, **others}.items()}
        for name, facts in facts_of.items()
    }
    found: dict[str, ProtocolResult] = {}
    out.mkdir(parents=True, exist_ok=True)
    with resumable(out), Cache(out / "cache.sqlite") as cache:
        for name, protocol in selected.items():
            facts, towers = facts_of[protocol.data_set], towers_of[protocol.data_set]
            first, are_trained = towers[FROZEN], False
            if name == UNSEEN_OBJECTS:
                protocol = with_split(facts, first.config.training, first.checkpoint, split)
                if are_trained := not first.config.training.freeze_towers:
                    first = encoder(facts, _trained(facts, protocol, first, out))
            if isinstance(protocol, TouchToTouch):
                found[name] = run_touch_to_touch(protocol, facts, towers, training_seeds)
                continue
            rows = []
            if model:
                rows = [Row("shipped model" if is_shipped(model) else model.name, "late_fusion", first, True)]
            rows += [
                Row(method, method, first, are_trained and issubclass(METHODS.load(method), LateFusion))
                for method in dict.fromkeys(names)
            ]
            rows += [Row(row, "late_fusion", towers[row], True) for row in others if towers[row].checkpoint]
            found[name] = ProtocolRun(name, protocol, facts, rows, training_seeds, out).measure(cache)
    setting = Setting(
        preset=config_name,
        config=(own if isinstance(own, Config) else own.config).without_paths(),
        model=own.digest if isinstance(own, Checkpoint) else None,
        compared={name: one.without_paths() if isinstance(one, Config) else one.digest for name, one in others.items()},
        seeds=training_seeds,
    )
    results = Results(setting, found, dict(skipped), __version__)
    write_results(out / "results.json", results)
    return results


def data_set_preset(protocols: Sequence[str | Protocol]) -> str:
    """Return the default preset of an evaluation by these protocols."""
    return "linear" if all(isinstance(_named(choice)[1], TouchToTouch) for choice in protocols) else "mobilenet"


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


def _trained(facts: RecordingFacts, protocol: Protocol, towers: TowerEncoder, out: Path) -> Checkpoint:
    """Train the towers on the split of the protocol, unless `out` has this model; return the checkpoint."""
    (split,) = protocol.folds(facts, towers.config.training.seed)
    grasps = [facts.grasps[row] for row in protocol.rows_to_fit(facts.grasps)]
    made = made_from(facts.folder, grasps, training_licences(facts.folder, towers.config.training))
    trainer = Trainer(towers.config, split, grasps, out / "model.safetensors", made, camera=towers.camera)
    return trainer.run_or_reuse()
