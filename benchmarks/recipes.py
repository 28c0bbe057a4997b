"""Accuracy of the recipes of `retrieve train` on objects that were left out of everything.

    python -m benchmarks.recipes RECORDING --objects 100 --held-out 100 --init mobilenet_v2.pth

Of the recording, `--held-out` random objects are left out, and `retrieve train` gets `--objects` of the others. Then
each recipe is fitted to the same objects and identifies the touches of the objects that were left out: top-1 accuracy
among one random photo of each. With `--folds` above 1 this is repeated with other objects. 95 % intervals resample
objects; paired differences are from the recipe that `retrieve train` took. The low-pass control is the linear fit to
touches of 8 x 6 pixels.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from retrieval.console.progress import show_progress
from retrieval.data.dataset import Split, load_grasps
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure
from retrieval.report.numbers import difference, with_interval
from retrieval.training.choice import CONTROL, Comparison, HeldOut, identification, pose
from retrieval.training.recipes import RECIPES
from retrieval.training.selection import LOW_PASS
from retrieval.training.train import train

TAKEN = "taken by `retrieve train`"


def measure(
    recording: Path, objects: int | None, held_out: int, folds: int, init: str, seed: int
) -> tuple[dict[str, Measure], list[str], float]:
    """Return the accuracies by recipe, the recipe that was taken in each fold, and the seconds of each training."""
    names = np.random.default_rng(seed).permutation(sorted({grasp.object_id for grasp in load_grasps(recording)}))
    parts: dict[str, list[HeldOut]] = defaultdict(list)
    taken, seconds = [], 0.0
    for fold in range(folds):
        left_out, others = names[:held_out].tolist(), names[held_out:].tolist()
        names = np.roll(names, -held_out)
        fitted, rest = others[:objects], others[objects:] if objects else []
        with tempfile.TemporaryDirectory() as folder:
            begin = time.monotonic()
            split = Split(seed, tuple(fitted), (), (*left_out, *rest))
            made = train(recording, Path(folder) / "model.safetensors", init=init, split=split)
            seconds += (time.monotonic() - begin) / folds
            taken.append(made.provenance["recipe"])
            grasps = [grasp for grasp in load_grasps(recording) if grasp.object_id not in rest]
            comparison = Comparison(pose(recording, grasps, Path(folder) / "parts", init=init), [left_out])
            recipes = {
                name: recipe for name in RECIPES if not (recipe := RECIPES.load(name)).obstacle(comparison.problem)
            }
            for name, recipe in recipes.items():
                fit = recipe(comparison.problem)
                parts[name] += comparison.held_out(name, fit)
                if name == taken[-1]:
                    parts[TAKEN].append(parts[name][-1])
                if name == CONTROL:
                    parts[LOW_PASS] += comparison.held_out(name, fit, "low_pass")
        print(f"fold {fold + 1} of {folds}: {len(fitted)} objects, recipe {taken[-1]}", flush=True)
    return {name: identification(part) for name, part in parts.items()}, taken, seconds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--objects", type=int, help="objects that are fitted (default: all that are not left out)")
    parser.add_argument("--held-out", type=int, required=True, help="objects that are left out of each fold")
    parser.add_argument("--folds", type=int, default=1)
    parser.add_argument("--init", default="imagenet", help="weights of MobileNetV2: imagenet, a file, or random")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    show_progress()
    begin = time.monotonic()
    found, taken, seconds = measure(
        options.recording, options.objects, options.held_out, options.folds, options.init, options.seed
    )
    result = found[TAKEN]
    print(f"| {options.recording} | top-1, % | minus taken, points |\n|---|---|---|")
    for name, accuracy in found.items():
        gain = "" if name == TAKEN else difference(compare([accuracy], [result]))
        print(f"| {name} | {with_interval(summarise([accuracy]))} | {gain} |")
    print(f"| chance | {100 * result.chance[0]:.1f} | |")
    print(f"taken: {', '.join(taken)}; one training {seconds:.0f} s, everything {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main()
