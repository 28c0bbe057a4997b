"""`make demo`: the main job from end to end on drawn pictures, with the commands that a user would type.

    python -m tests.demo demo           draw, train, index, query; ends with a ranked table and demo/query.html
    python -m tests.demo ship OUT       draw many objects and train the checkpoint that comes with the package
    python -m tests.demo score          judge that checkpoint on other drawn objects

The pictures are drawn by `tests/synthetic.py`: a relief shades the photo and indents the gel. They are no simulation
of contact and no measure of what the method does on real sensors.
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval import cli, defaults
from retrieval.batches import TrainedFeatures
from retrieval.build import build_index
from retrieval.checkpoint import load_checkpoint
from retrieval.dataset import PairSampler, load_grasps
from retrieval.encode import encode_photos, encode_touches
from retrieval.evaluation.metrics import guess_curve
from retrieval.fusion import score_halves
from retrieval.search import Searcher
from retrieval.train import pair_logits
from tests import synthetic

FOLDER = Path("demo")
# Objects of other seeds than the recordings': never trained on.
SEED_UNSEEN = 50
SEED_SCORED = 60
GRASPS = 3


def main(argv: list[str] | None = None) -> int:
    """Run one of the two jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    demo = jobs.add_parser("demo", help="the main job from end to end")
    demo.add_argument("--objects", type=int, default=200)
    demo.add_argument("--iterations", type=int, default=250)
    ship = jobs.add_parser("ship", help="train the checkpoint that comes with the package")
    ship.add_argument("out", type=Path)
    ship.add_argument("--objects", type=int, default=520)
    ship.add_argument("--grasps", type=int, default=6)
    ship.add_argument("--iterations", type=int, default=1500)
    score = jobs.add_parser("score", help="judge that checkpoint on other drawn objects")
    score.add_argument("--objects", type=int, default=100)
    score.add_argument("--grasps", type=int, default=6)
    arguments = parser.parse_args(argv)
    run = {"demo": run_demo, "ship": train_shipped, "score": score_shipped}[arguments.job]
    return run(arguments)


def run_demo(arguments: argparse.Namespace) -> int:
    """Draw, train, index, query; stops at the first command that fails."""
    os.environ["XDG_STATE_HOME"] = str(FOLDER / "state")  # what users' own commands remember stays theirs
    say("These are drawn test pictures (tests/synthetic.py), not a simulation of contact and not real touches.")
    unseen = draw_once(arguments.objects)
    model, index, page = FOLDER / "model.safetensors", FOLDER / "index", FOLDER / "query.html"
    train = ("train", FOLDER / "recording", "--out", model, "--config", "small", "--iterations", arguments.iterations)
    steps = [] if model.exists() else [train]
    steps.append(("build-index", FOLDER / "catalog", "--model", model, "--out", index))
    touches = synthetic.write_queries(FOLDER / "touches", unseen, touches_per_object=GRASPS)
    in_hand = unseen[5].object_id
    gelsight = [argument for touch in touches[in_hand] for argument in ("--gelsight", *touch)]
    steps.append(("query", *gelsight, "--index", index, "--html", page, "--top", "8"))
    for step in steps:
        if code := retrieve(*step):
            return code
    say(f"in the hand: {in_hand}, which the model never saw. Open {page}")
    build_index(FOLDER / "catalog", load_checkpoint(defaults.shipped_model()), FOLDER / "index-shipped", quiet=True)
    for name, folder in (("this model", index), ("the shipped model", FOLDER / "index-shipped")):
        say(f"{name}, {GRASPS} grasps of each unseen object: {first_places(folder, touches)}")
    return 0


def draw_once(objects: int) -> list[synthetic.DrawnObject]:
    """Draw what is not there yet; returns the catalogue's objects, which the recording does not hold."""
    unseen = synthetic.make_objects(20, seed=SEED_UNSEEN)
    if not (FOLDER / "model.safetensors").exists():
        say(f"drawing a recording: {objects} objects, 4 grasps each")
        shutil.rmtree(FOLDER, ignore_errors=True)
        synthetic.write_recording(FOLDER / "recording", synthetic.make_objects(objects), 4, before=False)
    if not (FOLDER / "catalog").exists():
        say("drawing a catalogue: 20 other objects, 3 photos each")
        synthetic.write_catalogue(FOLDER / "catalog", unseen)
    return unseen


def first_places(index: Path, touches: dict[str, list[tuple[Path, ...]]]) -> str:
    """How often the true object comes first, and among the first five."""
    searcher = Searcher.open(index)
    ranks = []
    for name, grasps in touches.items():
        names = [match.object_id for match in searcher.query(grasps, top=len(touches)).results]
        ranks.append(names.index(name) + 1)
    first, five, count = sum(rank == 1 for rank in ranks), sum(rank <= 5 for rank in ranks), len(ranks)
    return f"first for {first} of {count} (chance 1), among the first five for {five} (chance 5)"


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


def score_shipped(arguments: argparse.Namespace) -> int:
    """Pair accuracy and K-way guesses of the shipped checkpoint, with intervals resampled by object."""
    checkpoint = load_checkpoint(defaults.shipped_model())
    with tempfile.TemporaryDirectory() as folder:
        objects = synthetic.make_objects(arguments.objects, seed=SEED_SCORED)
        recording = synthetic.write_recording(Path(folder) / "recording", objects, arguments.grasps, before=False)
        grasps = load_grasps(recording)
        pairs = PairSampler(grasps, seed=0).every_touch()
        with TrainedFeatures(checkpoint.config, torch.device("cpu")) as images:
            logits = pair_logits(checkpoint.matcher, pairs, images)
            touch = encode_touches(checkpoint.matcher, (images.touch(grasp) for grasp in grasps))
            photo = encode_photos(checkpoint.matcher, (images.photo(grasp.photo) for grasp in grasps))
    names, owner = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)
    first = photo.half[[int(np.flatnonzero(owner == number)[0]) for number in range(len(names))]].numpy()
    table = np.array([score_halves(checkpoint.matcher.head, half[None], first) for half in touch.half])
    right = np.where(logits > 0, pairs.labels, 1 - pairs.labels).reshape(len(grasps), -1).mean(1)
    touched = np.searchsorted(names, [grasp.object_id for grasp in pairs.grasps])
    print("| test | value | 95 % interval (objects resampled) | chance |\n|---|---|---|---|")
    print(f"| pair accuracy | {by_object(right, touched)} | 0.50 |")
    for k in (5, 10):
        guesses = [guess_curve(line[own], np.delete(line, own), k)[0] for line, own in zip(table, owner, strict=True)]
        print(f"| K={k}, first guess | {by_object(np.array(guesses), owner)} | {1 / k:.2f} |")
    print(f"\n{len(names)} objects that were never trained on, {arguments.grasps} touches each, one photo an object.")
    return 0


def by_object(values: NDArray[Any], owner: NDArray[Any]) -> str:
    """Mean of the objects' means, and its bootstrap interval."""
    means = np.array([values[owner == number].mean() for number in range(owner.max() + 1)])
    drawn = np.random.default_rng(0).choice(means, (10_000, len(means))).mean(1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{means.mean():.3f} | {low:.3f} to {high:.3f}"


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
