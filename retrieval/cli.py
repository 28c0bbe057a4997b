"""The command line `retrieve`. Heavy packages are imported inside the command that needs them.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 the job ran and failed, 2 wrong use or bad input.
"""

import argparse
import dataclasses
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retrieval.errors import BadInput, RetrievalError
from retrieval.version import __version__

if TYPE_CHECKING:
    from retrieval.config import Config
    from retrieval.dataset import Split


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    _replace_closed_streams()
    arguments = build_parser().parse_args(argv)
    logging.basicConfig(format="%(message)s", stream=sys.stderr, level=logging.WARNING)
    with _noticed_interrupts() as interrupts:
        try:
            arguments.run(arguments)
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


@contextmanager
def _noticed_interrupts() -> Iterator[list[int]]:
    """The Ctrl-C signals so far; each raises KeyboardInterrupt as usual. One that breaks off an import may come out as
    another error: numpy.linalg half loaded raises RecursionError."""
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield seen
        return

    def on_interrupt(number: int, frame: object) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)


def _fail(arguments: argparse.Namespace, message: str, code: int) -> int:
    print(f"retrieve {arguments.command}: {message}", file=sys.stderr)
    return code


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = argparse.ArgumentParser(
        prog="retrieve",
        description="From the gel images of a grasp, find the catalogue photo of the object in the hand.",
    )
    parser.add_argument("--version", action="version", version=f"touch-retrieval {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_import(commands)
    _add_check(commands)
    _add_train(commands)
    _add_build_index(commands)
    _add_query(commands)
    return parser


def _command(commands: Any, name: str, text: str, run: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(run=run)
    return parser


def _add_import(commands: Any) -> None:
    parser = _command(commands, "import", "Turn a public data set into a recording.", run_import)
    parser.add_argument("name", metavar="NAME", help="which data set; an unknown name lists the known ones")
    parser.add_argument("source", metavar="SRC", type=Path, help="folder with the data set's own files")
    parser.add_argument("--out", type=Path, required=True, help="recording folder to write")


def _add_check(commands: Any) -> None:
    parser = _command(
        commands, "check", "Lint a recording: broken files, duplicates, leakage, swapped folders.", run_check
    )
    parser.add_argument("recording", type=Path, help="recording folder")
    parser.add_argument("--split", type=Path, help="JSON file with train, validation and test objects to check")
    parser.add_argument("--model", type=Path, help="check the split that this checkpoint was trained with")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _add_train(commands: Any) -> None:
    parser = _command(commands, "train", "Train a matcher on a recording.", run_train)
    parser.add_argument("recording", type=Path, help="recording folder")
    parser.add_argument("--out", type=Path, required=True, help="checkpoint to write (.safetensors)")
    parser.add_argument(
        "--config", default="small", help="preset (small, mobilenet, paper) or TOML file (default: small)"
    )
    parser.add_argument("--init", help="first weights of the towers: random, imagenet, or a state dict file")
    parser.add_argument("--iterations", type=int, help="optimiser steps, instead of the configuration's")
    parser.add_argument("--seed", type=int, help="seed of split, pairs and weights, instead of the configuration's")
    parser.add_argument("--split", type=Path, help="JSON file with train, validation and test objects")
    parser.add_argument("--resume", action="store_true", help="go on with an unfinished training of --out")


def _add_build_index(commands: Any) -> None:
    parser = _command(commands, "build-index", "Make a folder of photos searchable.", run_build_index)
    parser.add_argument("catalogue", type=Path, help="folder: <object>/<photo> or <object>.<ext>")
    parser.add_argument("--model", help="checkpoint (default: the last one trained, else the shipped one)")
    parser.add_argument("--out", type=Path, default=Path("index"), help="index folder (default: index)")
    parser.add_argument("--kind", help="candidate index (default: exact, unless it breaks --max-ms); see the README")
    parser.add_argument("--max-ms", type=float, help="longest candidate search in milliseconds")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _add_query(commands: Any) -> None:
    parser = _command(commands, "query", "Which object is in the hand?", run_query)
    parser.add_argument(
        "--gelsight",
        nargs="+",
        action="append",
        type=Path,
        required=True,
        metavar="IMAGE",
        help="gel images of one grasp, one per finger; again for more grasps of the same object",
    )
    parser.add_argument(
        "--background",
        nargs="+",
        type=Path,
        metavar="IMAGE",
        help="no-contact frames, one per finger, for models with a background policy",
    )
    parser.add_argument("--index", help="index folder (default: ./index, else the last one built)")
    parser.add_argument("--model", help="checkpoint (default: the one the index was built with)")
    parser.add_argument("--top", type=int, default=10, help="objects to return (default: 10)")
    parser.add_argument("--candidates", type=int, help="photos that the full classifier judges (default: 1000)")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--html", type=Path, help="write a page with photos and gel images")
    parser.add_argument("--no-verify", action="store_true", help="skip the checksums of a huge index")


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


def _training_config(arguments: argparse.Namespace) -> "Config":
    from retrieval.config import load_config

    config = load_config(arguments.config)
    given = {name: getattr(arguments, name) for name in ("init", "iterations", "seed")}
    changed = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **changed))


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
        from retrieval.report import query_html

        arguments.html.parent.mkdir(parents=True, exist_ok=True)
        arguments.html.write_text(query_html(result, searcher.catalogue), "utf-8")
        _say(f"page: {arguments.html}")
    _say(f"model: {result.index['model']} (trained on: {result.index['trained_on']})")
    if arguments.json:
        _print_json(result.to_dict())
        return
    from retrieval.report import print_table

    print_table(result)
    if result.verdict == "no match":
        _say("no photo is above the reject threshold: the object may not be in the catalogue")


def _print_json(document: Any) -> None:
    print(json.dumps(document, allow_nan=False))


def _say(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
