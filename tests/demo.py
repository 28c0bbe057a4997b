"""`make demo`: the main job from end to end on drawn pictures, with the commands that a user would type.

    python -m tests.demo demo           draw, train, index, query; ends with a ranked table and demo/query.html
    python -m tests.demo ship OUT       draw many objects and train the checkpoint that comes with the package

The pictures are drawn by `tests/synthetic.py`: a relief shades the photo and indents the gel. They are no simulation
of contact and no measure of what the method does on real sensors.
"""

import argparse
import sys
from pathlib import Path

from retrieval import cli
from tests import synthetic

FOLDER = Path("demo")
SEED_UNSEEN = 50  # objects of another seed than the recording's: never trained on


def main() -> int:
    """Run one of the two jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    jobs.add_parser("demo", help="the main job from end to end")
    ship = jobs.add_parser("ship", help="train the checkpoint that comes with the package")
    ship.add_argument("out", type=Path)
    ship.add_argument("--objects", type=int, default=520)
    ship.add_argument("--grasps", type=int, default=6)
    ship.add_argument("--iterations", type=int, default=1500)
    arguments = parser.parse_args()
    if arguments.job == "ship":
        return train_shipped(arguments)
    return run_demo()


def run_demo() -> int:
    """Draw, train, index, query; stops at the first command that fails."""
    say("These are drawn test pictures (tests/synthetic.py), not a simulation of contact and not real touches.")
    recording = FOLDER / "recording"
    if not (recording / "recording.json").exists():
        say("drawing a recording: 72 objects, 6 grasps each")
        synthetic.write_recording(recording, synthetic.make_objects(72), 6, before=False)
    unseen = synthetic.make_objects(20, seed=SEED_UNSEEN)
    if not (FOLDER / "catalog").exists():
        say("drawing a catalogue: 20 other objects, 3 photos each")
        synthetic.write_catalogue(FOLDER / "catalog", unseen)
    model = FOLDER / "model.safetensors"
    if not model.exists():
        code = retrieve("train", recording, "--out", model, "--config", "small", "--iterations", "150")
        if code:
            return code
    code = retrieve("build-index", FOLDER / "catalog", "--model", model, "--out", FOLDER / "index")
    if code:
        return code
    in_hand = unseen[5]
    touches = synthetic.write_queries(FOLDER / "touches", [in_hand], touches_per_object=3)[in_hand.object_id]
    gelsight = [argument for touch in touches for argument in ("--gelsight", *touch)]
    page = FOLDER / "query.html"
    code = retrieve("query", *gelsight, "--index", FOLDER / "index", "--html", page, "--top", "8")
    say(f"in the hand: {in_hand.object_id}, which the model never saw. Open {page}")
    return code


def train_shipped(arguments: argparse.Namespace) -> int:
    """Draw many objects beside OUT and train on them."""
    recording = arguments.out.with_name("recording")
    if not (recording / "recording.json").exists():
        synthetic.write_recording(recording, synthetic.make_objects(arguments.objects), arguments.grasps, before=False)
    resume = ["--resume"] if arguments.out.with_suffix(".state.safetensors").exists() else []
    return retrieve(
        *("train", recording, "--out", arguments.out, "--config", "small"),
        *("--iterations", str(arguments.iterations), *resume),
    )


def retrieve(*arguments: object) -> int:
    """Say a command as a user would type it, and run it."""
    words = [str(argument) for argument in arguments]
    say("$ retrieve " + " ".join(words))
    return cli.main(words)


def say(text: str) -> None:
    """Print for people, on stderr like all progress."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
