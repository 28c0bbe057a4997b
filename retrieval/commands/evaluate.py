"""`retrieve evaluate`: compare methods on unseen objects."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import (
    COUNT,
    DEFAULT_PRESET,
    SEED,
    Init,
    Iterations,
    Json,
    Recording,
    ReportOut,
    SplitFile,
    read_split,
    training_config,
)
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput
from retrieval.methods import METHODS


def evaluate(
    recording: Recording,
    *,
    out: ReportOut,
    methods: Annotated[
        str | None, typer.Option(help=f"methods to compare, separated by commas: {', '.join(METHODS)} (default: all)")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="a preset, such as tiny, small, mobilenet or relief, or a TOML file (default: small)"),
    ] = None,
    model: Annotated[Path | None, typer.Option(help="checkpoint to evaluate, instead of fitting one")] = None,
    init: Init = None,
    iterations: Iterations = None,
    seeds: Annotated[int, typer.Option(parser=COUNT, help="training runs per method")] = 1,
    seed: Annotated[
        int | None,
        typer.Option(parser=SEED, help="seed of split, queries and first training (default: that of the preset)"),
    ] = None,
    split: SplitFile = None,
    cache: Annotated[
        Path | None, typer.Option(help="folder that stores image features (default: OUT/features)")
    ] = None,
    json: Json = False,
) -> None:
    """Compare methods on unseen objects and write a report. Resumes a stopped run."""
    from retrieval.evaluation.evaluate import evaluate as run
    from retrieval.report.evaluation import write_report

    if model and (preset or init):
        raise BadInput("--model already defines towers and settings; give either --model or --preset and --init")
    results = run(
        recording,
        out,
        config=training_config(preset, iterations, init=init, seed=seed),
        preset="of the model" if model else Path(preset or DEFAULT_PRESET).stem,
        methods=methods.split(",") if methods else tuple(METHODS),
        model=model,
        seeds=seeds,
        split=read_split(split),
        cache=cache,
    )
    text, page, *_ = write_report(out)
    say(f"report: {text}, {page}")
    if json:
        print_json(results)
        return
    from retrieval.report.results import read_results
    from retrieval.report.terminal import print_measures

    print_measures(read_results(out))
