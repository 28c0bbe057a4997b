"""The words of the command line: every command with its options. What they do stands in retrieval.commands.cli."""

import argparse
from pathlib import Path
from typing import Any, NoReturn

from retrieval.console.output import printable
from retrieval.version import __version__

DEFAULT_MODEL = "that of the index here, else the last one trained from this folder, else the shipped one"


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the words of a command as everything is said."""

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = _Parser(
        prog="retrieve",
        description="From the gel images of a grasp, find the catalogue photo of the object in the hand.",
    )
    parser.add_argument("--version", action="version", version=f"touch-retrieval {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_collect(commands)
    _add_rig(commands)
    _add_import(commands)
    _add_check(commands)
    _add_train(commands)
    _add_build_index(commands)
    _add_query(commands)
    _add_export(commands)
    _add_evaluate(commands)
    _add_frontier(commands)
    return parser


def _command(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    return parser


def _add_demo(commands: Any) -> None:
    parser = _command(commands, "demo", "The whole job on the simulated rig; ends with an HTML page.")
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder to write (default: demo)")
    parser.add_argument("--objects", type=int, default=20, help="how many objects (default: 20)")
    parser.add_argument("--jobs", type=int, default=2, help="simulated rigs that work at once (default: 2)")


def _add_collect(commands: Any) -> None:
    parser = _command(commands, "collect", "Collect a recording with a rig on its own; goes on where it was stopped.")
    parser.add_argument(
        "--rig", default="sim", help="which rig, by name or TOML file (default: sim, the simulated one)"
    )
    parser.add_argument("--objects", type=int, default=98, help="how many objects (default: 98)")
    parser.add_argument("--grasps", type=int, default=44, help="accepted grasps of each object (default: 44)")
    parser.add_argument("--out", type=Path, required=True, help="recording folder to write or to go on with")
    parser.add_argument("--seed", type=int, default=0, help="seed of every random choice (default: 0)")
    parser.add_argument("--jobs", type=int, default=1, help="simulated rigs that work at once (default: 1)")
    parser.add_argument("--gate", type=Path, help="grasp-success checkpoint (default: a rule on the area of contact)")
    parser.add_argument("--preview", action="store_true", help="write a contact sheet, OUT-preview.png")
    parser.add_argument(
        "--dry-run", action="store_true", help="print the motions of one attempt at each object; nothing moves"
    )


def _add_rig(commands: Any) -> None:
    parser = _command(commands, "rig", "See what a rig of real devices is made of, and calibrate its camera.")
    tasks = parser.add_subparsers(dest="task", required=True, metavar="TASK")
    check = _command(tasks, "check", "List what is connected, or exercise each device of a rig gently.")
    check.add_argument("--rig", help="rig by name or TOML file (default: list what is connected)")
    check.add_argument("--no-motion", action="store_true", help="leave arm and jaws where they are")
    check.add_argument("--json", action="store_true", help="print one JSON document")
    calibrate = _command(tasks, "calibrate", "Where the camera stands, from points known in its frame and the rig's.")
    calibrate.add_argument(
        "points", type=Path, help="CSV: camera_x_mm, camera_y_mm, camera_z_mm, rig_x_mm, rig_y_mm, rig_z_mm"
    )
    calibrate.add_argument("--out", type=Path, default=Path("hand_eye.json"), help="file to write (hand_eye.json)")


def _add_import(commands: Any) -> None:
    parser = _command(commands, "import", "Turn a public data set into a recording.")
    parser.add_argument("name", metavar="NAME", help="which data set; an unknown name lists the known ones")
    parser.add_argument("source", metavar="SRC", type=Path, help="folder with the data set's own files")
    parser.add_argument("--out", type=Path, required=True, help="recording folder to write")


def _add_check(commands: Any) -> None:
    parser = _command(commands, "check", "Lint a recording: broken files, duplicates, leakage, swapped folders.")
    parser.add_argument("recording", type=Path, help="recording folder")
    parser.add_argument("--split", type=Path, help="JSON file with train, validation and test objects to check")
    parser.add_argument("--model", type=Path, help="check the split that this checkpoint was trained with")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _add_train(commands: Any) -> None:
    parser = _command(commands, "train", "Train a matcher, or a gate for `collect`, on a recording.")
    parser.add_argument("recording", type=Path, help="recording folder")
    parser.add_argument(
        "--task",
        choices=("match", "grasp-success"),
        default="match",
        help="match: does this touch belong to this photo? grasp-success: did the grasp succeed? (default: match)",
    )
    parser.add_argument("--out", type=Path, required=True, help="checkpoint to write (.safetensors)")
    parser.add_argument("--config", help="preset (small, mobilenet, paper) or TOML file (default: small)")
    parser.add_argument("--init", help="first weights of the towers: random, imagenet, or a state dict file")
    parser.add_argument("--iterations", type=int, help="optimiser steps, instead of the configuration's")
    parser.add_argument("--seed", type=int, help="seed of split, pairs and weights, instead of the configuration's")
    parser.add_argument("--split", type=Path, help="JSON file with train, validation and test objects")
    parser.add_argument("--resume", action="store_true", help="go on with an unfinished training of --out")


def _add_build_index(commands: Any) -> None:
    parser = _command(commands, "build-index", "Make a folder of photos searchable.")
    parser.add_argument("catalogue", type=Path, help="folder: <object>/<photo> or <object>.<ext>")
    parser.add_argument(
        "--objects-from",
        metavar="RULE",
        help="what names a photo's object: folder (the first one, else the file), stem (the file's name without its "
        "number), or a pattern such as {split}/{object}/{photo} or {object}_{view}.jpg (default: as the index has it, "
        "else folder)",
    )
    parser.add_argument("--model", help=f"checkpoint (default: {DEFAULT_MODEL})")
    parser.add_argument("--out", type=Path, default=Path("index"), help="index folder (default: index)")
    parser.add_argument("--kind", help="candidate index (default: exact, unless a bound asks for more); see the README")
    parser.add_argument(
        "--min-recall", type=float, help="least share of touches whose best photo must be found (default: 0.99)"
    )
    parser.add_argument("--max-ms", type=float, help="longest search in milliseconds: candidates and judging them")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _add_query(commands: Any) -> None:
    parser = _command(commands, "query", "Which object is in the hand?")
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
        help="no-contact frames, one per finger: some models subtract them, others see by them if there is a contact",
    )
    parser.add_argument("--index", help="index folder (default: ./index, else the last one built from this folder)")
    parser.add_argument("--model", help="checkpoint (default: the one the index was built with)")
    parser.add_argument("--top", type=int, default=10, help="objects to return (default: 10)")
    parser.add_argument(
        "--candidates", type=int, help="photos that the full classifier judges (default: what the index needs)"
    )
    parser.add_argument(
        "--none-prior",
        type=float,
        default=0.5,
        metavar="P",
        help="probability, before anything is felt, that the catalogue lacks the object (default: 0.5)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--html", type=Path, help="write a page with photos and gel images")
    parser.add_argument("--no-verify", action="store_true", help="skip the checksums of a huge index")


def _add_export(commands: Any) -> None:
    parser = _command(
        commands,
        "export",
        "Write a checkpoint's touch encoder as ONNX; `query` finds it beside the checkpoint and does without PyTorch.",
    )
    parser.add_argument("model", nargs="?", help=f"checkpoint (default: {DEFAULT_MODEL})", metavar="MODEL")
    parser.add_argument("--out", type=Path, help="file to write (default: beside the checkpoint, ending in .onnx)")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _add_evaluate(commands: Any) -> None:
    parser = _command(
        commands,
        "evaluate",
        "Compare methods on objects they never saw; goes on where it was stopped. Writes a report.",
    )
    parser.add_argument("recording", type=Path, help="recording folder")
    parser.add_argument("--out", type=Path, required=True, help="folder for results.json, report.md and report.html")
    parser.add_argument("--methods", help="methods to compare, with commas between (default: all)")
    parser.add_argument(
        "--preset",
        dest="config",
        metavar="PRESET",
        help="preset (tiny, small, mobilenet, paper) or TOML file (default: small)",
    )
    parser.add_argument("--model", type=Path, help="checkpoint to judge, instead of one fitted here")
    parser.add_argument("--init", help="first weights of the towers: random, imagenet, or a state dict file")
    parser.add_argument("--iterations", type=int, help="optimiser steps, instead of the preset's")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each method (default: 1)")
    parser.add_argument("--seed", type=int, help="seed of split, queries and first training, instead of the preset's")
    parser.add_argument("--split", type=Path, help="JSON file with train, validation and test objects")
    parser.add_argument("--cache", type=Path, help="folder where features of images are kept (default: OUT/features)")
    parser.add_argument("--json", action="store_true", help="print the results as one JSON document")


def _add_frontier(commands: Any) -> None:
    parser = _command(
        commands,
        "frontier",
        "Error against run time of every approximation; goes on where it was stopped. Writes plots and a page.",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for frontier.json, frontier.html and plots")
    parser.add_argument("--recording", type=Path, help="grasps of unseen objects (default: a small one is collected)")
    parser.add_argument("--model", help=f"checkpoint (default: {DEFAULT_MODEL})")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these approximations only")
    parser.add_argument("--quick", action="store_true", help="smallest sizes, to see that it runs; concludes nothing")
    parser.add_argument(
        "--stability", action="store_true", help="instead: run the hard cases of every numerical kernel"
    )
    parser.add_argument("--json", action="store_true", help="print the results as one JSON document")
