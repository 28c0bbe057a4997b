"""`retrieve benchmark`: what the matcher is worth on real data, by protocols with controls."""

import shlex
from collections.abc import Iterable, Mapping
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
    announce_resume,
    training_config,
)
from retrieval.console.files import PAGE, RESULTS, TEXT, require_ours
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput
from retrieval.evaluation.real import PROTOCOLS
from retrieval.search.defaults import SHIPPED_NAMES, shipped_model

HELP = "FusionScorer methods on public data sets of real touches, with controls."
PRESET = "real"
METHODS = "cca_towers,cca_pca,cca,late_fusion,chance"
PRESET_METHODS = {"adapt": "cca_towers,chance"}
"""Of presets that are made for one of the methods."""
OUTPUT_FILES = {"results.json": RESULTS, "report.md": TEXT, "report.html": PAGE}

app = typer.Typer(name="benchmark", help=HELP, short_help=HELP, subcommand_metavar="DATA_KIND [ARGS]...")


@app.callback()
def _group() -> None:
    """A group, though it has one command so far."""


@app.command(cls=Command)
def real(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="folder with vt60/, billets/, ..., or recordings of them", show_default=False
        ),
    ],
    *,
    out: ReportOut,
    protocols: Annotated[
        str | None,
        typer.Option(help=f"which to ask, with commas between: {', '.join(PROTOCOLS)} (default: those with data)"),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help=f"methods to fit, with commas between (default: {METHODS}; of preset adapt {PRESET_METHODS['adapt']})"
        ),
    ] = None,
    preset: Annotated[str, typer.Option(help="towers and heads: preset or TOML file")] = PRESET,
    init: Init = None,
    iterations: Iterations = None,
    model: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse, metavar="NAME=FILE...", help="checkpoints to ask as they are, a row each"
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(parser=COUNT, help="how often folds are drawn and methods fitted")] = 3,
    cache: Annotated[
        Path | None, typer.Option(help="folder of recordings, features and measures (default: OUT/cache)")
    ] = None,
    json: Json = False,
) -> None:
    """Ask protocols of real data, with controls; goes on where it was stopped. Writes a report."""
    from retrieval.evaluation.real.benchmark import benchmark
    from retrieval.report.real import print_verdicts, write_report

    for name, kind in OUTPUT_FILES.items():
        require_ours(out / name, kind)
    asked = list(dict.fromkeys(protocols.split(","))) if protocols else PROTOCOLS.names()
    data_set_of = {name: PROTOCOLS.resolve(name).data_set for name in asked}
    config = training_config(preset, iterations, init=init)
    cache = cache or out / "cache"
    with announce_resume(f"what was made is kept in {cache}"):
        recordings, missing = _recordings(data, data_set_of.values(), cache / "recordings")
        skipped = {name: missing[of] for name, of in data_set_of.items() if of in missing}
        if protocols or len(skipped) < len(asked):
            for name, why in skipped.items():
                say(f"{name}: left out, {why}; with it: {_command_with_data(data, out, name, data_set_of[name])}")
        if len(skipped) == len(asked):
            raise BadInput(f"{data} must hold data of a protocol; {'; '.join(dict.fromkeys(missing.values()))}")
        results = benchmark(
            recordings,
            out,
            config=config,
            preset=Path(preset).stem,
            protocols=[name for name in asked if name not in skipped],
            methods=[name for name in (methods or PRESET_METHODS.get(preset, METHODS)).split(",") if name],
            models=_parse_models(model or ()),
            seeds=seeds,
            skipped=skipped,
            cache=cache,
        )
    text, page, *_ = write_report(out, recordings)
    say(f"report: {text}, {page}")
    if json:
        print_json(results)
        return
    print_verdicts(results)


def _recordings(data: Path, names: Iterable[str], made: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Recordings by data set, those that are no recordings yet imported below `made`; and what is missing, why."""
    from retrieval.data.dataset import recording_source
    from robot.importers import data_set_of

    if not data.is_dir():
        raise BadInput(f"{data} must be a folder with data sets in it, such as vt60/ or billets/")
    folders = [path for path in (data, *sorted(data.iterdir())) if (path / "recording.json").is_file()]
    recorded = {recording_source(folder): folder for folder in reversed(folders)}
    found: dict[str, Path] = {}
    missing: dict[str, str] = {}
    for name in dict.fromkeys(names):
        about = data_set_of(name)
        if about.source in recorded:
            found[name] = recorded[about.source]
        elif (data / name).is_dir():
            found[name] = run_importer(name, data / name, made / name).folder
        else:
            missing[name] = f"there is no {name}/ with {about.expects.replace('`', '')}, and no recording of it"
    return found, missing


def _parse_models(given: Iterable[str]) -> Mapping[str, Path]:
    models: dict[str, Path] = {}
    for word in given:
        name, equals, file = word.partition("=")
        if not equals or not name or "/" in name:
            raise BadInput(f"a model is given as NAME=FILE, got {word!r}")
        models[name] = shipped_model(SHIPPED_NAMES[file]) if file in SHIPPED_NAMES else Path(file)
    return models


def _command_with_data(data: Path, out: Path, protocol: str, data_set: str) -> str:
    """What to run who has the data."""
    run = f"retrieve benchmark real {shlex.quote(str(data))} --out {shlex.quote(str(out))} --protocols {protocol}"
    if data_set != "rct":
        return run
    target = shlex.quote(str(data / "rct"))
    return f"retrieve import rct RCT --out {target} --option touch=... photo=... && {run}"
