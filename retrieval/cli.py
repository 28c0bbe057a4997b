"""The command line `retrieve`: what each command does. Heavy packages are imported inside the command that needs them.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 the job ran and failed, 2 wrong use or bad input.
"""

import argparse
import dataclasses
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retrieval.arguments import build_parser
from retrieval.errors import BadInput, RetrievalError
from retrieval.interruption import noticed_interrupts
from retrieval.progress import Bar

if TYPE_CHECKING:
    from retrieval.config import Config
    from retrieval.dataset import Split
    from robot.collect import Progress

DEFAULT_PRESET = "small"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    _replace_closed_streams()
    arguments = build_parser().parse_args(argv)
    logging.basicConfig(format="%(message)s", stream=sys.stderr, level=logging.WARNING)
    with noticed_interrupts() as interrupts:
        try:
            COMMANDS[arguments.command](arguments)
            sys.stdout.flush()
            return 0
        except BrokenPipeError:  # the reader of stdout has left, as `| head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except KeyboardInterrupt:
            return _fail(arguments, "stopped by Ctrl-C", 1)
        except Exception as error:
            if arguments.debug:
                raise
            return _explain(arguments, error, interrupted=bool(interrupts))


def _explain(arguments: argparse.Namespace, error: Exception, interrupted: bool) -> int:
    """Say what went wrong in one line; returns the exit code."""
    code = getattr(error, "exit_code", None)  # every error tree of the project carries one
    if code is not None:
        return _fail(arguments, str(error), code)
    if interrupted:
        return _fail(arguments, "stopped by Ctrl-C", 1)
    if isinstance(error, OSError):
        named = isinstance(error, FileNotFoundError | IsADirectoryError | NotADirectoryError | PermissionError)
        return _fail(arguments, f"{error.filename or 'a file'}: {error.strerror or error}", 2 if named else 1)
    return _fail(arguments, f"unexpected {type(error).__name__}: {error} (run with --debug and report it)", 1)


def _replace_closed_streams() -> None:
    """A stream that the shell has closed (`2>&-`) is None, and printing to None prints to stdout."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def _fail(arguments: argparse.Namespace, message: str, code: int) -> int:
    print(f"retrieve {arguments.command}: {message}", file=sys.stderr)
    return code


def run_demo(arguments: argparse.Namespace) -> None:
    """`retrieve demo`."""
    from retrieval import demo

    demo.run_demo(arguments.out, arguments.objects, arguments.jobs)


def run_collect(arguments: argparse.Namespace) -> None:
    """`retrieve collect`."""
    from functools import partial

    from robot.attempt_log import acceptance_table
    from robot.collect import CollectSettings, collect
    from robot.rig import load_rig

    gate, gate_name = _load_gate(arguments.gate)
    settings = CollectSettings(grasps=arguments.grasps)
    try:
        with _CollectBar() as bar:
            tallies = collect(
                partial(load_rig, arguments.rig, seed=arguments.seed),
                arguments.out,
                objects=arguments.objects,
                seed=arguments.seed,
                settings=settings,
                gate=gate,
                gate_name=gate_name,
                jobs=arguments.jobs,
                progress=bar,
            )
    except KeyboardInterrupt:
        _say(f"what was collected is whole in {arguments.out}; the same command goes on with it")
        raise
    _say(acceptance_table(tallies, wanted=settings.grasps))
    accepted = sum(each.accepted for each in tallies)
    if accepted == 0:
        raise RetrievalError(f"no grasp was accepted; {arguments.out}/attempts.jsonl says why")
    _say(f"{arguments.out}: {accepted} accepted grasps of {len(tallies)} objects")
    if arguments.preview:
        from robot.sim.preview import write_preview

        folder = arguments.out if arguments.out.name not in ("", "..") else arguments.out.resolve()
        beside = folder.with_name(f"{folder.name}-preview.png")  # every image inside belongs to a grasp
        _say(f"preview: {write_preview(arguments.out, beside)}")


def _load_gate(path: Path | None) -> tuple[Any, str | None]:
    """A learned gate, and a name that is another one for other weights; None for the collector's own rule."""
    if path is None:
        return None, None
    from retrieval.grasp_success import load_gate
    from retrieval.stored import file_digest

    gate = load_gate(path)
    return gate, f"learned, sha256 {file_digest(path)}"


class _CollectBar:
    """Shows robot.collect's progress on a bar, which is made when the first is told."""

    def __init__(self) -> None:
        self._bar: Bar | None = None

    def __call__(self, now: "Progress") -> None:
        if self._bar is None:
            self._bar = Bar("collect", now.wanted, "grasps", done=now.settled).__enter__()
        note = f"{now.objects_done} of {now.objects} objects, {now.accept_rate:.0%} of {now.attempts} attempts accepted"
        self._bar.advance(now.settled - self._bar.done, note)

    def __enter__(self) -> "_CollectBar":
        return self

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.__exit__(*error)


def run_import(arguments: argparse.Namespace) -> None:
    """`retrieve import`."""
    from robot.importers import load_importer

    recording = load_importer(arguments.name)(arguments.source, arguments.out)
    for note in recording.notes:
        _say(note)
    objects = len({grasp.object_id for grasp in recording.grasps})
    _say(f"{arguments.out}: {len(recording.grasps)} grasps of {objects} objects")


def run_check(arguments: argparse.Namespace) -> None:
    """`retrieve check`."""
    from retrieval.check import check_recording

    if arguments.split and arguments.model:
        raise BadInput("give --split or --model, not both")
    split = _read_split(arguments.split)
    if arguments.model:
        from retrieval.checkpoint import load_checkpoint

        split = load_checkpoint(arguments.model).split
    findings = check_recording(arguments.recording, split)
    if arguments.json:
        _print_json({"findings": [dataclasses.asdict(finding) for finding in findings]})
    for finding in findings:
        _say(f"{finding.severity}: {finding.message}")
    errors = sum(finding.severity == "error" for finding in findings)
    _say(f"{arguments.recording}: {errors} error(s), {len(findings) - errors} warning(s)")
    if errors:
        raise RetrievalError(f"{arguments.recording} is not fit for training; see the errors above")


def run_train(arguments: argparse.Namespace) -> None:
    """`retrieve train`."""
    if arguments.task == "grasp-success":
        _train_gate(arguments)
    else:
        _train_matcher(arguments)


def _train_matcher(arguments: argparse.Namespace) -> None:
    from retrieval import defaults, distributed
    from retrieval.train import train

    try:
        checkpoint = train(
            arguments.recording,
            arguments.out,
            _training_config(arguments),
            split=_read_split(arguments.split),
            resume=arguments.resume,
        )
        if distributed.rank():
            return
    finally:
        distributed.stop()
    defaults.remember("model", arguments.out)
    metrics = checkpoint.provenance["metrics"]
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in metrics.items())
    _say(f"{arguments.out}: kept step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")


def _train_gate(arguments: argparse.Namespace) -> None:
    """`retrieve train --task grasp-success`."""
    refused = {"--config": arguments.config, "--init": arguments.init, "--split": arguments.split}
    for option, value in {**refused, "--resume": arguments.resume}.items():
        if value:
            raise BadInput(f"{option} is of matchers; --task grasp-success takes --iterations and --seed")
    from retrieval.grasp_success import train_gate

    given = {name: getattr(arguments, name) for name in ("iterations", "seed")}
    report = train_gate(
        arguments.recording, arguments.out, **{name: value for name, value in given.items() if value is not None}
    )
    for line in report.lines():
        _say(line)


def _training_config(arguments: argparse.Namespace) -> "Config":
    from retrieval.config import load_config

    config = load_config(arguments.config or DEFAULT_PRESET)
    given = {name: getattr(arguments, name) for name in ("init", "seed")}
    changed = {name: value for name, value in given.items() if value is not None}
    steps = config.training.iterations if arguments.iterations is None else arguments.iterations
    return dataclasses.replace(config, training=dataclasses.replace(config.training.of_steps(steps), **changed))


def _read_split(path: Path | None) -> "Split | None":
    if path is None:
        return None
    from retrieval.dataset import Split

    try:
        return Split.from_dict(json.loads(path.read_text("utf-8")))
    except ValueError as error:
        raise BadInput(f"{path} is not a JSON file: {error}") from error


def run_build_index(arguments: argparse.Namespace) -> None:
    """`retrieve build-index`."""
    from retrieval import defaults
    from retrieval.build import build_index
    from retrieval.checkpoint import load_checkpoint

    path, why = defaults.find_model(arguments.model)
    _say(f"model: {path} ({why})")
    report = build_index(
        arguments.catalogue,
        load_checkpoint(path),
        arguments.out,
        kind=arguments.kind,
        min_recall=arguments.min_recall,
        max_ms=arguments.max_ms,
    )
    defaults.remember("index", arguments.out)
    for line in report.lines():
        _say(line)
    if arguments.json:
        _print_json(report.to_dict())


def run_query(arguments: argparse.Namespace) -> None:
    """`retrieve query`."""
    from retrieval import defaults

    path, why = defaults.find_index(arguments.index)
    if arguments.index is None:
        _say(f"index: {path} ({why})")
    from retrieval.search import Searcher

    searcher = Searcher.open(path, model=arguments.model, verify=not arguments.no_verify)
    result = searcher.query(
        arguments.gelsight,
        background=arguments.background,
        top=arguments.top,
        candidates=arguments.candidates,
    )
    if arguments.html:
        from retrieval.report.query import query_html

        arguments.html.parent.mkdir(parents=True, exist_ok=True)
        arguments.html.write_text(query_html(result, searcher.catalogue), "utf-8")
        _say(f"page: {arguments.html}")
    _say(f"model: {result.index['model']} (trained on: {result.index['trained_on']})")
    if arguments.json:
        _print_json(result.to_dict())
        return
    from retrieval.report.terminal import print_table

    print_table(result)
    if result.verdict == "no match":
        _say("no photo is above the reject threshold: the object may not be in the catalogue")


def run_export(arguments: argparse.Namespace) -> None:
    """`retrieve export`."""
    from retrieval import defaults
    from retrieval.checkpoint import load_checkpoint
    from retrieval.export import export

    path, why = defaults.find_model(arguments.model)
    _say(f"model: {path} ({why})")
    result = export(load_checkpoint(path), arguments.out)
    _say(str(result))
    if arguments.json:
        _print_json(dataclasses.asdict(result))


def run_evaluate(arguments: argparse.Namespace) -> None:
    """`retrieve evaluate`."""
    from retrieval.evaluation.run import evaluate
    from retrieval.methods import METHODS
    from retrieval.report.evaluation import write_report

    if arguments.model and (arguments.config or arguments.init):
        raise BadInput("a model has its towers and its settings; give --model, or --preset and --init")
    try:
        results = evaluate(
            arguments.recording,
            arguments.out,
            config=_training_config(arguments),
            preset="of the model" if arguments.model else Path(arguments.config or DEFAULT_PRESET).stem,
            methods=arguments.methods.split(",") if arguments.methods else tuple(METHODS),
            model=arguments.model,
            seeds=arguments.seeds,
            split=_read_split(arguments.split),
            cache=arguments.cache,
        )
    except KeyboardInterrupt:
        _say(f"what was made is kept in {arguments.out}; the same command goes on with it")
        raise
    text, page, *_ = write_report(arguments.out, arguments.recording)
    _say(f"report: {text}, {page}")
    if arguments.json:
        _print_json(results)


def run_frontier(arguments: argparse.Namespace) -> None:
    """`retrieve frontier`."""
    from retrieval import frontier_report

    if arguments.stability:
        from robot import hard_cases

        document = frontier_report.report_stability(arguments.out, robot=hard_cases.hard_cases)
    else:
        from robot.sim.frontier import closing_points, contact_points
        from robot.sim.photometric import optics_points

        document = frontier_report.report_frontier(
            arguments.out,
            model=arguments.model,
            recording=arguments.recording,
            simulation={"contact": contact_points, "closing": closing_points, "gel_optics": optics_points},
            only=arguments.only,
            quick=arguments.quick,
        )
    if arguments.json:
        _print_json(document)
    if document.get("failed"):
        raise RetrievalError(f"{document['failed']} of {len(document['cases'])} hard cases do not hold; see the page")


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": run_demo,
    "collect": run_collect,
    "import": run_import,
    "check": run_check,
    "train": run_train,
    "build-index": run_build_index,
    "query": run_query,
    "export": run_export,
    "evaluate": run_evaluate,
    "frontier": run_frontier,
}


def _print_json(document: Any) -> None:
    print(json.dumps(document, allow_nan=False))


def _say(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
