"""`retrieve benchmark`: accuracy of the matcher on public real data, by protocols with controls."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.import_ import run_importer
from retrieval.commands.options import (
    COUNT,
    Command,
    Init,
    Iterations,
    Json,
    OptionValues,
    ReportOut,
    training_config,
)
from retrieval.console.interruption import resumable
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput
from retrieval.evaluation.real import PROTOCOLS
from retrieval.model.shipped import SHIPPED_NAMES, shipped_model

HELP = "Measure methods on public data sets of real touches, with controls."
PRESET = "real"
METHODS = "cca_towers,cca,late_fusion,chance"
PRESET_METHODS = {"adapt": "cca_towers,chance"}
"""Default methods of presets that fit only some of the methods."""

app = typer.Typer(name="benchmark", help=HELP, short_help=HELP, subcommand_metavar="DATA_KIND [ARGS]...")


@app.callback()
def _group() -> None:
    """Make `benchmark` a group: typer would otherwise drop the name of its only command."""


@app.command(cls=Command)
def real(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="folder with vt60/, billets/, ..., or with recordings of them", show_default=False
        ),
    ],
    *,
    out: ReportOut,
    protocols: Annotated[
        str | None,
        typer.Option(help=f"protocols to run, separated by commas: {', '.join(PROTOCOLS)} (default: all with data)"),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help=f"methods to fit, separated by commas (default: {METHODS}; for preset adapt {PRESET_METHODS['adapt']})"
        ),
    ] = None,
    preset: Annotated[str, typer.Option(help="configuration of towers and heads: a preset or a TOML file")] = PRESET,
    init: Init = None,
    iterations: Iterations = None,
    model: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse, metavar="NAME=FILE...", help="checkpoints to score without fitting, one row each"
        ),
    ] = None,
    towers: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse,
            metavar="NAME=CONFIG...",
            help="more touch towers for touch to touch (physiclear), one row each: a preset or a TOML file, such as "
            "adapt=adapt",
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(parser=COUNT, help="repetitions: each draws new folds and fits the methods again")
    ] = 3,
    cache: Annotated[
        Path | None, typer.Option(help="folder for recordings, features and measurements (default: OUT/cache)")
    ] = None,
    json: Json = False,
) -> None:
    """Run the real-data protocols, with controls, and write a report. Resumes a stopped run."""
    from retrieval.evaluation.real.benchmark import benchmark
    from retrieval.report.real import print_verdicts, write_report

    requested = list(dict.fromkeys(protocols.split(","))) if protocols else PROTOCOLS.names()
    data_set_of = {name: PROTOCOLS.resolve(name).data_set for name in requested}
    config = training_config(preset, iterations, init=init)
    cache = cache or out / "cache"
    with resumable(cache):
        recordings, missing = _recordings(data, data_set_of.values(), cache / "recordings")
        skipped = {name: missing[data_set] for name, data_set in data_set_of.items() if data_set in missing}
        if protocols or len(skipped) < len(requested):
            for name, reason in skipped.items():
                say(f"{name} is skipped: {reason}")
        if len(skipped) == len(requested):
            raise BadInput(
                f"{data} must contain data of at least one protocol; {'; '.join(dict.fromkeys(missing.values()))}"
            )
        results = benchmark(
            recordings,
            out,
            config=config,
            preset=Path(preset).stem,
            protocols=[name for name in requested if name not in skipped],
            methods=[name for name in (methods or PRESET_METHODS.get(preset, METHODS)).split(",") if name],
            models=_parse_models(model or ()),
            towers={
                name: training_config(choice, None, init=init)
                for name, choice in _parse_pairs(towers or (), "--towers", "CONFIG")
            },
            seeds=seeds,
            skipped=skipped,
            cache=cache,
        )
    text, page, *_ = write_report(out)
    say(f"report: {text}, {page}")
    if json:
        print_json(results)
        return
    print_verdicts(results)


def _recordings(data: Path, names: Iterable[str], imported: Path) -> tuple[dict[str, Path], dict[str, str]]:
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
    found: dict[str, Path] = {}
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


def _parse_models(pairs: Iterable[str]) -> Mapping[str, Path]:
    return {
        name: shipped_model(SHIPPED_NAMES[file]) if file in SHIPPED_NAMES else Path(file)
        for name, file in _parse_pairs(pairs, "--model", "FILE")
    }


def _parse_pairs(words: Iterable[str], option: str, value: str) -> Iterator[tuple[str, str]]:
    """Yield the name and the value of each NAME=VALUE of an option. Raises BadInput if a word has another form."""
    for word in words:
        name, equals, chosen = word.partition("=")
        if not equals or not name or "/" in name:
            raise BadInput(f"{option} must have the form NAME={value}, got {word!r}")
        yield name, chosen
