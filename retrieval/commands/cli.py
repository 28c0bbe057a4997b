"""The command line `retrieve`: what each command does. Heavy packages are imported inside the command that needs them.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 the job ran and failed, 2 wrong use or bad input.
"""

import argparse
import dataclasses
import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from indexes.store.regular import read_json
from retrieval.commands.arguments import build_parser
from retrieval.commands.rig_commands import run_collect, run_import, run_rig
from retrieval.console.files import PAGE, RESULTS, TEXT, TIMINGS, require_ours, text_bytes, write_output
from retrieval.console.interruption import noticed_interrupts
from retrieval.console.output import give_up_stdout, prepare_streams, print_json, printing, say
from retrieval.errors import BadInput, RetrievalError

if TYPE_CHECKING:
    from retrieval.data.dataset import Split
    from retrieval.model.config import Config

DEFAULT_PRESET = "small"
LONGEST = 2000
"""Characters of a message; what stands in a hostile file may be of any length."""
EVALUATION = {"results.json": RESULTS, "timings.json": TIMINGS, "report.md": TEXT, "report.html": PAGE}
_WRONG_PATHS = {
    *(errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.EINVAL, errno.ENAMETOOLONG, errno.ELOOP),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    _replace_closed_streams()
    prepare_streams()
    arguments = build_parser().parse_args(argv)
    with noticed_interrupts() as interrupts:
        try:
            code = COMMANDS[arguments.command](arguments)
            with printing():
                sys.stdout.flush()
            return code if isinstance(code, int) else 0
        except BrokenPipeError:  # the reader of stdout has left, as `| head` does
            give_up_stdout()
            return 1
        except KeyboardInterrupt:
            return _stopped(arguments, interrupts)
        except Exception as error:
            if arguments.debug:
                raise
            return _explain(arguments, error, interrupts)


def _stopped(arguments: argparse.Namespace, interrupts: list[int]) -> int:
    by = "SIGTERM" if signal.SIGTERM in interrupts else "Ctrl-C"
    return _fail(arguments, f"stopped by {by}", 1)


def _explain(arguments: argparse.Namespace, error: Exception, interrupts: list[int]) -> int:
    """Say what went wrong in one line; returns the exit code."""
    code = getattr(error, "exit_code", None)  # every error tree of the project carries one
    if code is not None:
        return _fail(arguments, str(error), code)
    if interrupts:
        return _stopped(arguments, interrupts)
    if isinstance(error, OSError):
        return _fail(arguments, *_of_file(error))
    return _fail(arguments, f"unexpected {type(error).__name__}: {error} (run with --debug and report it)", 1)


def _of_file(error: OSError) -> tuple[str, int]:
    """What went wrong with which file, and the exit code: 2 where another path would have done."""
    reason = error.strerror or str(error)
    return f"{error.filename or 'a file'}: {reason}", 2 if error.errno in _WRONG_PATHS else 1


def _replace_closed_streams() -> None:
    """A stream that the shell has closed (`2>&-`) is None, and printing to None prints to stdout."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def _fail(arguments: argparse.Namespace, message: str, code: int) -> int:
    say(f"retrieve {arguments.command}: {message if len(message) <= LONGEST else message[:LONGEST] + ' ...'}")
    return code


def run_demo(arguments: argparse.Namespace) -> None:
    """`retrieve demo`."""
    from retrieval.commands import demo

    demo.run_demo(arguments.out, arguments.objects, arguments.jobs)


def run_check(arguments: argparse.Namespace) -> None:
    """`retrieve check`."""
    from retrieval.data.check.recording import check_recording

    if arguments.split and arguments.model:
        raise BadInput("give --split or --model, not both")
    split = _read_split(arguments.split)
    if arguments.model:
        from retrieval.model.checkpoint import load_checkpoint

        split = load_checkpoint(arguments.model).split
    findings = check_recording(arguments.recording, split)
    if arguments.json:
        print_json({"findings": [dataclasses.asdict(finding) for finding in findings]})
    for finding in findings:
        say(f"{finding.severity}: {finding.message}")
    errors, warnings = (sum(one.severity == severity for one in findings) for severity in ("error", "warning"))
    say(f"{arguments.recording}: {errors} error(s), {warnings} warning(s)")
    if errors:
        raise RetrievalError(f"{arguments.recording} is not fit for training; see the errors above")


def run_train(arguments: argparse.Namespace) -> None:
    """`retrieve train`."""
    if arguments.task == "grasp-success":
        _train_gate(arguments)
    else:
        _train_matcher(arguments)


def _train_matcher(arguments: argparse.Namespace) -> None:
    from retrieval.search import defaults
    from retrieval.training import distributed
    from retrieval.training.train import train

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
    say(f"{arguments.out}: kept step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")


def _train_gate(arguments: argparse.Namespace) -> None:
    """`retrieve train --task grasp-success`."""
    refused = {"--config": arguments.config, "--init": arguments.init, "--split": arguments.split}
    for option, value in {**refused, "--resume": arguments.resume}.items():
        if value:
            raise BadInput(f"{option} is of matchers; --task grasp-success takes --iterations and --seed")
    from retrieval.training.grasp_success import train_gate

    given = {name: getattr(arguments, name) for name in ("iterations", "seed")}
    report = train_gate(
        arguments.recording, arguments.out, **{name: value for name, value in given.items() if value is not None}
    )
    for line in report.lines():
        say(line)


def _training_config(arguments: argparse.Namespace) -> "Config":
    from retrieval.model.config import load_config

    config = load_config(arguments.config or DEFAULT_PRESET)
    given = {name: getattr(arguments, name) for name in ("init", "seed")}
    changed = {name: value for name, value in given.items() if value is not None}
    steps = config.training.iterations if arguments.iterations is None else arguments.iterations
    return dataclasses.replace(config, training=dataclasses.replace(config.training.of_steps(steps), **changed))


def _read_split(path: Path | None) -> "Split | None":
    if path is None:
        return None
    from retrieval.data.dataset import Split

    try:
        return Split.from_dict(read_json(path))
    except ValueError as error:
        raise BadInput(f"{path} is not a JSON file: {error}") from error


def run_build_index(arguments: argparse.Namespace) -> None:
    """`retrieve build-index`."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.search import defaults
    from retrieval.search.build import build_index

    path, why = defaults.find_model(arguments.model, arguments.out)
    say(f"model: {path} ({why})")
    try:
        report = build_index(
            arguments.catalogue,
            load_checkpoint(path),
            arguments.out,
            objects_from=arguments.objects_from,
            kind=arguments.kind,
            min_recall=arguments.min_recall,
            max_ms=arguments.max_ms,
        )
    except KeyboardInterrupt:
        say(f"what was embedded is kept in {arguments.out}; the same command goes on with it")
        raise
    defaults.remember("index", arguments.out)
    for line in report.lines():
        say(line)
    if arguments.json:
        print_json(report.to_dict())
    if report.without_photo:
        count = len(report.without_photo)
        raise RetrievalError(f"the index is written, but {count} object(s) have no photo that can be read; see above")


def run_query(arguments: argparse.Namespace) -> int:
    """`retrieve query`; its exit code says the verdict."""
    from retrieval.search import defaults

    path, why = defaults.find_index(arguments.index)
    if arguments.index is None:
        say(f"index: {path} ({why})")
    from retrieval.search.answer import EXIT_CODES, in_words
    from retrieval.search.searcher import Searcher

    if arguments.html:
        require_ours(arguments.html, PAGE)
    searcher = Searcher.open(path, model=arguments.model, verify=not arguments.no_verify)
    result = searcher.query(
        arguments.gelsight,
        background=arguments.background,
        top=arguments.top,
        candidates=arguments.candidates,
        none_prior=arguments.none_prior,
    )
    if arguments.html:
        from retrieval.report.query import query_html

        write_output(arguments.html, text_bytes(query_html(result, searcher.catalogue)), PAGE)
        say(f"page: {arguments.html}")
    say(f"model: {result.index['model']} (trained on: {result.index['trained_on']})")
    if arguments.json:
        print_json(result.to_dict())
    else:
        from retrieval.report.terminal import print_table

        print_table(result)
    say(in_words(result))
    return EXIT_CODES[result.verdict]


def run_export(arguments: argparse.Namespace) -> None:
    """`retrieve export`."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.export import export
    from retrieval.search import defaults

    path, why = defaults.find_model(arguments.model)
    say(f"model: {path} ({why})")
    result = export(load_checkpoint(path), arguments.out)
    say(str(result))
    if arguments.json:
        print_json(dataclasses.asdict(result))


def run_evaluate(arguments: argparse.Namespace) -> None:
    """`retrieve evaluate`."""
    from retrieval.evaluation.run import evaluate
    from retrieval.methods import METHODS
    from retrieval.report.evaluation import write_report

    if arguments.model and (arguments.config or arguments.init):
        raise BadInput("a model has its towers and its settings; give --model, or --preset and --init")
    for name, kind in EVALUATION.items():
        require_ours(arguments.out / name, kind)
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
        say(f"what was made is kept in {arguments.out}; the same command goes on with it")
        raise
    text, page, *_ = write_report(arguments.out, arguments.recording)
    say(f"report: {text}, {page}")
    if arguments.json:
        print_json(results)
        return
    from retrieval.report.results import read_results
    from retrieval.report.terminal import print_measures

    print_measures(read_results(arguments.out))


def run_frontier(arguments: argparse.Namespace) -> None:
    """`retrieve frontier`."""
    from retrieval.lab import reports as frontier_report

    if arguments.stability:
        from retrieval.lab.hard_cases import rig as hard_cases

        document = frontier_report.report_stability(arguments.out, robot=hard_cases.hard_cases)
    else:
        from retrieval.lab.frontier.contact import closing_points, contact_points
        from retrieval.lab.optics.photometric import optics_points

        document = frontier_report.report_frontier(
            arguments.out,
            model=arguments.model,
            recording=arguments.recording,
            simulation={"contact": contact_points, "closing": closing_points, "gel_optics": optics_points},
            only=arguments.only,
            quick=arguments.quick,
        )
    if arguments.json:
        print_json(document)
    if document.get("failed"):
        raise RetrievalError(f"{document['failed']} of {len(document['cases'])} hard cases do not hold; see the page")


COMMANDS: dict[str, Callable[[argparse.Namespace], int | None]] = {
    "demo": run_demo,
    "collect": run_collect,
    "import": run_import,
    "rig": run_rig,
    "check": run_check,
    "train": run_train,
    "build-index": run_build_index,
    "query": run_query,
    "export": run_export,
    "evaluate": run_evaluate,
    "frontier": run_frontier,
}


if __name__ == "__main__":
    sys.exit(main())
