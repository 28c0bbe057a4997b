"""`retrieve evaluate`: compare methods on unseen objects, of a recording or by protocols of real data sets."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.import_ import run_importer
from retrieval.commands.options import (
    COUNT,
    DEFAULT_PRESET,
    SEED,
    Init,
    Iterations,
    Json,
    OptionValues,
    ReportOut,
    SplitFile,
    read_split,
    training_config,
)
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS
from retrieval.methods import METHODS
from retrieval.model.shipped import SHIPPED_NAMES, shipped_model

if TYPE_CHECKING:
    from retrieval.model.config import Config

ALL = "all"
DATA_SET_PRESET = "real"
METHODS_OF_PRESETS = {"adapt": ("cca_towers", "chance")}
"""Default methods of presets that fit only some of the methods."""


def evaluate(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA",
            help="recording; with --protocol a folder with vt60/, billets/, ..., or with recordings of them",
            show_default=False,
        ),
    ],
    *,
    out: ReportOut,
    protocol: Annotated[
        str | None,
        typer.Option(
            help="protocols of real data, separated by commas: "
            f"{', '.join(name for name in PROTOCOLS if name != UNSEEN_OBJECTS)}; {ALL}: each that has data "
            "(default: unseen objects of the recording)"
        ),
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help=f"methods to compare, separated by commas: {', '.join(METHODS)} (default: all)")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help=f"a preset, such as tiny, small, mobilenet or relief, or a TOML file (default: {DEFAULT_PRESET}; with "
            f"--protocol {DATA_SET_PRESET})"
        ),
    ] = None,
    model: Annotated[Path | None, typer.Option(help="checkpoint to evaluate, instead of fitting one")] = None,
    compare: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse,
            metavar="NAME=CHOICE...",
            help="more rows: a checkpoint that scores as it is, or, with touch to touch (physiclear), a preset or TOML "
            "file of a touch tower",
        ),
    ] = None,
    init: Init = None,
    iterations: Iterations = None,
    seeds: Annotated[
        int | None, typer.Option(parser=COUNT, help="training runs per method (default: 1; with --protocol 3)")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(parser=SEED, help="seed of split, queries and first training (default: that of the preset)"),
    ] = None,
    split: SplitFile = None,
    json: Json = False,
) -> None:
    """Compare methods on unseen objects, with controls, and write a report. Resumes a stopped run."""
    import msgspec

    from retrieval.evaluation.evaluate import evaluate as run
    from retrieval.report.evaluation import print_results, write_report

    if model and (preset or init):
        raise BadInput("--model already defines towers and settings; give either --model or --preset and --init")
    preset = preset or (DATA_SET_PRESET if protocol else DEFAULT_PRESET)
    recordings: Mapping[str | None, Path] = {None: data}
    skipped: dict[str, str] = {}
    names: list[str] = []
    if protocol:
        names, recordings, skipped = _data_sets(protocol, data, out / "recordings")
    results = run(
        recordings,
        out,
        protocols=names,
        config=training_config(preset, iterations, init=init, seed=seed),
        preset=Path(preset).stem,
        methods=methods.split(",") if methods else METHODS_OF_PRESETS.get(preset, ()),
        model=model,
        compared={name: _compared(choice, init) for name, choice in map(_named, compare or ())},
        seeds=seeds,
        split=read_split(split),
        skipped=skipped,
    )
    text, page, *_ = write_report(out)
    say(f"report: {text}, {page}")
    if json:
        print_json(msgspec.to_builtins(results))
    else:
        print_results(results)


def _data_sets(protocol: str, data: Path, imported: Path) -> tuple[list[str], dict[str | None, Path], dict[str, str]]:
    """Return the protocols to run, the recording of each data set, and the reason for each skipped protocol.

    Raises:
        BadInput: There is no data of any protocol.
    """
    requested = list(dict.fromkeys(protocol.split(",")))
    if protocol == ALL:
        requested = [name for name in PROTOCOLS.names() if PROTOCOLS.resolve(name).data_set]
    data_set_of: dict[str, Any] = {name: PROTOCOLS.resolve(name).data_set for name in requested}
    if None in data_set_of.values():
        raise BadInput(f"{UNSEEN_OBJECTS} is for one recording; leave --protocol out, and give the recording")
    recordings, missing = _recordings(data, data_set_of.values(), imported)
    skipped = {name: missing[data_set] for name, data_set in data_set_of.items() if data_set in missing}
    if len(skipped) == len(requested):
        reasons = "; ".join(dict.fromkeys(missing.values()))
        raise BadInput(f"{data} must contain data of at least one protocol; {reasons}")
    for name, reason in skipped.items():
        say(f"{name} is skipped: {reason}")
    return [name for name in requested if name not in skipped], recordings, skipped


def _recordings(data: Path, names: Iterable[str], imported: Path) -> tuple[dict[str | None, Path], dict[str, str]]:
    """Return the recording of each data set, and the reason for each missing one.

    Args:
        data: Folder with data sets, with recordings of them, or a recording itself.
        names: Data sets.
        imported: Folder for the recordings of data sets that must be imported first.

    Raises:
        BadInput: `data` is not a folder.
    """
    from retrieval.data.dataset import recording_source
    from robot.importers import data_set_of

    if not data.is_dir():
        raise BadInput(f"{data} must be a folder that contains data sets, such as vt60/ or billets/")
    folders = [path for path in (data, *sorted(data.iterdir())) if (path / "recording.json").is_file()]
    recorded = {recording_source(folder): folder for folder in reversed(folders)}
    found: dict[str | None, Path] = {}
    missing: dict[str, str] = {}
    for name in dict.fromkeys(names):
        about = data_set_of(name)
        if about.source in recorded:
            found[name] = recorded[about.source]
        elif (data / name).is_dir():
            found[name] = run_importer(name, data / name, imported / name).folder
        else:
            missing[name] = f"no folder {name}/ with {about.expects.replace('`', '')} and no recording of it was found"
    return found, missing


def _named(word: str) -> tuple[str, str]:
    """Return the name and the choice of NAME=CHOICE."""
    name, equals, choice = word.partition("=")
    if not equals or not name or "/" in name:
        raise BadInput(f"--compare must have the form NAME=CHOICE, got {word!r}")
    return name, choice


def _compared(choice: str, init: str | None) -> "Path | Config":
    """Return the file of a checkpoint, or the configuration of a touch tower."""
    if choice in SHIPPED_NAMES:
        return shipped_model(SHIPPED_NAMES[choice])
    return Path(choice) if choice.endswith(".safetensors") else training_config(choice, None, init=init)
