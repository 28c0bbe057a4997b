"""`retrieve evaluate`: compare methods on unseen objects, of a recording or by protocols of real data sets."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retrieval.commands.import_ import run_importer
from retrieval.commands.options import (
    COUNT,
    SEED,
    Init,
    Json,
    OptionValues,
    ReportOut,
    SplitFile,
    read_split,
    resolve_model,
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


def evaluate(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA",
            help="recording; with --protocol of a data set a folder with vt60/, billets/, ..., or with recordings",
            show_default=False,
        ),
    ],
    *,
    out: ReportOut,
    protocol: Annotated[
        str | None,
        typer.Option(
            help="touch-to-touch of a recording, or protocols of real data, separated by commas: "
            f"{', '.join(name for name in PROTOCOLS if name != UNSEEN_OBJECTS)}; {ALL}: each data set there is "
            "(default: unseen objects of the recording)"
        ),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help=f"methods to compare, separated by commas: {', '.join(METHODS)} (default: all but cca_towers; with "
            "--protocol cca_towers, cca, late_fusion, chance)"
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            help="fit on the towers of a preset or TOML file, not a model's (default with --protocol: mobilenet, or "
            "linear if only touches are compared)"
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help=f"checkpoint to evaluate, a file or {' or '.join(SHIPPED_NAMES)}; methods are fitted on its features "
            "(default: the shipped one for the recording's fingers)"
        ),
    ] = None,
    compare: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse,
            metavar="NAME=CHOICE...",
            help="more rows: a checkpoint that scores as it is, or, with touch to touch, a preset or TOML file of a "
            "touch tower",
        ),
    ] = None,
    init: Init = None,
    seeds: Annotated[
        int | None, typer.Option(parser=COUNT, help="training runs per method (default: 1; with --protocol 3)")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(parser=SEED, help="seed of split, queries and first training (default: 0, or that of --config)"),
    ] = None,
    split: SplitFile = None,
    json: Json = False,
) -> None:
    """Compare methods on unseen objects, with controls, and write a report. Resumes a stopped run."""
    import msgspec

    from retrieval.evaluation.evaluate import data_set_preset
    from retrieval.evaluation.evaluate import evaluate as run
    from retrieval.report.evaluation import print_results, write_report

    if model and (config or init):
        raise BadInput("--model already defines towers and settings; give either --model or --config and --init")
    if init and not (config or protocol):
        raise BadInput("--init needs --config, which has the towers that it initialises, such as --config mobilenet")
    protocols, recordings, skipped = (
        _data_sets(protocol, data, out / "recordings") if protocol else ([], {None: data}, {})
    )
    preset = config or (data_set_preset(protocols) if protocol and not model else None)
    results = run(
        recordings,
        out,
        protocols=protocols,
        config=training_config(preset, None, init=init) if preset else None,
        preset=Path(preset).stem if preset else None,
        methods=methods.split(",") if methods else (),
        model=resolve_model(model) if model else None,
        compared=dict(_compared(word, init) for word in compare or ()),
        seed=seed,
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

    Args:
        protocol: Names of protocols.
        data: Folder with data sets, with recordings of them, or a recording itself.
        imported: Folder for the recordings of data sets that must be imported first.

    Raises:
        BadInput: There is no data of any protocol.
    """
    from retrieval.data.dataset import recording_source
    from robot.importers import data_set_of

    if not data.is_dir():
        raise BadInput(f"{data} must be a folder that contains data sets, such as vt60/ or billets/")
    requested = list(dict.fromkeys(protocol.split(",")))
    if protocol == ALL:
        requested = [name for name in PROTOCOLS.names() if PROTOCOLS.resolve(name).data_set]
    elif UNSEEN_OBJECTS in requested:
        raise BadInput(f"{UNSEEN_OBJECTS} is for one recording; leave --protocol out, and give the recording")
    folders = [path for path in (data, *sorted(data.iterdir())) if (path / "recording.json").is_file()]
    recorded = {recording_source(folder): folder for folder in reversed(folders)}
    recordings: dict[str | None, Path] = {}
    skipped: dict[str, str] = {}
    for name in requested:
        data_set = PROTOCOLS.resolve(name).data_set
        if data_set is None:
            recordings[None] = data
            continue
        about = data_set_of(data_set)
        if about.source in recorded:
            recordings[data_set] = recorded[about.source]
        elif (data / data_set).is_dir():
            if data_set not in recordings:
                recordings[data_set] = run_importer(data_set, data / data_set, imported / data_set).folder
        else:
            skipped[name] = (
                f"no folder {data_set}/ with {about.expects.replace('`', '')} and no recording of it was found"
            )
            say(f"{name} is skipped: {skipped[name]}")
    if not recordings:
        raise BadInput(
            f"{data} must contain data of at least one protocol; {'; '.join(dict.fromkeys(skipped.values()))}"
        )
    return [name for name in requested if name not in skipped], recordings, skipped


def _compared(word: str, init: str | None) -> "tuple[str, Path | Config]":
    """Return the name of NAME=CHOICE, and the file of a checkpoint or the configuration of a touch tower."""
    name, _, choice = word.partition("=")
    if not choice or not name or "/" in name:
        raise BadInput(f"--compare must have the form NAME=CHOICE, got {word!r}")
    if choice in SHIPPED_NAMES:
        return name, shipped_model(SHIPPED_NAMES[choice])
    return name, Path(choice) if choice.endswith(".safetensors") else training_config(choice, None, init=init)
