"""The checkpoint that comes with the package: how it was made, and how good it is on objects that it never saw.

    python -m tests.shipped make FOLDER --init WEIGHTS   collect on the simulated rig, train, and store as float16 in
                                                         FOLDER/simulated-mobilenet.safetensors
    python -m tests.shipped score [FOLDER]               collect other objects (into FOLDER, or a folder that is then
                                                         removed) and judge the shipped checkpoint on them

Simulated touches are no measure of what the method does on real sensors.
"""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval import cli, defaults
from retrieval.batches import TrainedFeatures
from retrieval.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from retrieval.dataset import Grasp, PairSampler, load_grasps
from retrieval.encode import encode_photos, encode_touches
from retrieval.evaluation.metrics import guess_curve
from retrieval.fusion import score_halves
from retrieval.train import pair_logits

# Worlds of the simulated rig. The demo has one of its own (retrieval.demo.SEED).
SEED_TRAINED, SEED_SCORED = 10_000, 30_000
RIG = Path(__file__).with_name("shipped_rig.toml")


def main(argv: list[str] | None = None) -> int:
    """Run one of the two jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    make = jobs.add_parser("make", help="collect and train the checkpoint that comes with the package")
    make.add_argument("folder", type=Path)
    make.add_argument("--init", type=Path, required=True, help="state dict of MobileNetV2, torchvision's key names")
    make.add_argument("--objects", type=int, default=700)
    make.add_argument("--grasps", type=int, default=4)
    make.add_argument("--iterations", type=int, default=2000)
    score = jobs.add_parser("score", help="judge it on other objects")
    score.add_argument("folder", type=Path, nargs="?")
    score.add_argument("--objects", type=int, default=100)
    score.add_argument("--grasps", type=int, default=6)
    score.add_argument("--jobs", type=int, default=2)
    score.add_argument("--model", type=Path, help="another checkpoint than the shipped one")
    arguments = parser.parse_args(argv)
    return make_shipped(arguments) if arguments.job == "make" else score_shipped(arguments)


def make_shipped(arguments: argparse.Namespace) -> int:
    """Collect and train; what is there already is gone on with."""
    recording, trained = arguments.folder / "recording", arguments.folder / "trained.safetensors"
    resume = ["--resume"] if trained.with_suffix(".state.safetensors").exists() else []
    train = ("train", recording, "--out", trained, "--config", "mobilenet", "--init", arguments.init)
    code = collect(recording, arguments.objects, arguments.grasps, SEED_TRAINED, jobs=2)
    code = code or retrieve(*train, "--iterations", arguments.iterations, *resume)
    if not code:
        store(load_checkpoint(trained), arguments.folder / defaults.SHIPPED)
    return code


def store(made: Checkpoint, out: Path) -> None:
    """Write a checkpoint once more, as float16; where its first weights lay on this machine concerns nobody."""
    training = dataclasses.replace(made.config.training, init="imagenet")
    save_checkpoint(
        out,
        made.matcher,
        dataclasses.replace(made.config, training=training),
        split=made.split,
        calibration=made.calibration,
        provenance=made.provenance,
        float16=True,
    )


def score_shipped(arguments: argparse.Namespace) -> int:
    """Pair accuracy and K-way guesses of the shipped checkpoint, with intervals resampled by object."""
    with tempfile.TemporaryDirectory() as temporary:
        recording = (arguments.folder or Path(temporary)) / "recording"
        if code := collect(recording, arguments.objects, arguments.grasps, SEED_SCORED, arguments.jobs):
            return code
        print_table(load_grasps(recording), arguments.model or defaults.shipped_model())
    return 0


def print_table(grasps: list[Grasp], model: Path) -> None:
    """Judge every touch against photos of its own object's other grasps and of the other objects."""
    checkpoint = load_checkpoint(model)
    pairs = PairSampler(grasps, seed=0).every_touch()
    with TrainedFeatures(checkpoint.config, torch.device("cpu")) as images:
        logits = pair_logits(checkpoint.matcher, pairs, images)
        touch = encode_touches(checkpoint.matcher, (images.touch(grasp) for grasp in grasps))
        photo = encode_photos(checkpoint.matcher, (images.photo(grasp.photo) for grasp in grasps))
    names, owner = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)
    table = np.array([score_halves(checkpoint.matcher.head, half[None], photo.half.numpy()) for half in touch.half])
    right = np.where(logits > 0, pairs.labels, 1 - pairs.labels).reshape(len(grasps), -1).mean(1)
    touched = np.searchsorted(names, [grasp.object_id for grasp in pairs.grasps])
    print("| test | value | 95 % interval (objects resampled) | chance |\n|---|---|---|---|")
    print(f"| pair accuracy | {by_object(right, touched)} | 0.50 |")
    for k in (5, 10):
        guesses = [first_guess(table, owner, number, k) for number in range(len(grasps))]
        print(f"| K={k}, first guess | {by_object(np.array(guesses), owner)} | {1 / k:.2f} |")
    count = len(grasps) / len(names)
    print(
        f"\n{len(names)} objects that were never trained on, {count:.1f} touches each; no photo of a touch's own grasp."
    )


def first_guess(table: NDArray[Any], owner: NDArray[Any], touch: int, k: int) -> float:
    """Chance that the true photo beats those of k - 1 other objects; each object shows the photo of its next grasp.

    The photo of the touch's own grasp is never shown: object and light stand there as they did for no other.
    """
    shown = {int(name): int(np.flatnonzero(owner == name)[0]) for name in np.unique(owner)}
    own = np.flatnonzero(owner == owner[touch])
    true = own[(np.flatnonzero(own == touch)[0] + 1) % len(own)]
    others = [photo for name, photo in shown.items() if name != owner[touch]]
    return float(guess_curve(table[touch, true], table[touch, others], k)[0])


def collect(recording: Path, objects: int, grasps: int, seed: int, jobs: int) -> int:
    """`retrieve collect` on the simulated rig."""
    size = ("--objects", objects, "--grasps", grasps, "--seed", seed)
    return retrieve("collect", "--rig", RIG, *size, "--jobs", jobs, "--out", recording)


def by_object(values: NDArray[Any], owner: NDArray[Any]) -> str:
    """Mean of the objects' means, and its bootstrap interval."""
    means = np.array([values[owner == number].mean() for number in range(owner.max() + 1)])
    drawn = np.random.default_rng(0).choice(means, (10_000, len(means))).mean(1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{means.mean():.3f} | {low:.3f} to {high:.3f}"


def retrieve(*arguments: object) -> int:
    """Say a command as a user would type it, and run it."""
    words = [str(argument) for argument in arguments]
    print("$ retrieve " + " ".join(words), file=sys.stderr, flush=True)
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(main())
