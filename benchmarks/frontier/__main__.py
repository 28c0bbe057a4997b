"""`python -m benchmarks.frontier --out FOLDER [--only NAME ...] [--recording R] [--model M] [--quick]`."""

import argparse
from functools import partial
from pathlib import Path

from benchmarks.frontier import APPROXIMATIONS, NEED_NO_MODEL
from retrieval.commands.frontier import recording_of
from retrieval.console.progress import show_progress
from retrieval.frontier.measure import measure_frontier


def main(argv: list[str] | None = None) -> None:
    """Write frontier.json, frontier.html and figures/ of the kernels' approximations."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frontier", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for frontier.json, frontier.html and plots")
    parser.add_argument("--only", nargs="+", default=(), choices=APPROXIMATIONS, metavar="NAME")
    parser.add_argument("--recording", type=Path, help="grasps of unseen objects (default: a small one is collected)")
    parser.add_argument("--model", help="a checkpoint (default: the shipped one)")
    parser.add_argument("--quick", action="store_true", help="smallest sizes, as a quick test")
    arguments = parser.parse_args(argv)
    show_progress()
    measure_frontier(
        arguments.out,
        arguments.model,
        partial(recording_of, arguments.recording, arguments.out, arguments.quick),
        only=arguments.only,
        quick=arguments.quick,
        table=APPROXIMATIONS,
        model_free=NEED_NO_MODEL,
    )


if __name__ == "__main__":
    main()
