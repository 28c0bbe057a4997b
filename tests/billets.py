"""Real touches against real photos: places on steel billets that the model never saw.

    python -m tests.billets --data BILLETS --weights MOBILENET.pt --out FOLDER

Nine billets, sixteen places each; a place has one touch (one finger) and one photo. Every welded billet is held out
once, with one ground billet: of the other seven, five train and two choose the checkpoint. Then all is scored. The
same is done with touches of which nothing is left but an 8 x 6 blurred colour thumbnail: what that control reaches is
lighting and gel drift of the capture, or coarse shape, and no sense of touch. Writes report.md and results.json.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, PairSampler, Split, load_grasps
from retrieval.data.images import read_rgb
from retrieval.data.resize import resize
from retrieval.metrics.binomial import binomial_interval
from retrieval.metrics.guesses import guess_curve
from retrieval.metrics.pairs import pair_accuracy
from retrieval.model.config import load_config
from retrieval.model.encode import encode_photos, encode_touches
from retrieval.training.batches import BatchImages
from retrieval.training.features import blurred
from retrieval.training.train import train
from robot.importers import load_importer

WELDED = tuple(f"welded{number}" for number in range(1, 6))
GROUND = tuple(f"ground{number}" for number in range(1, 5))
KS = (5, 10)


def main() -> int:
    """Run all folds with real touches and with the control."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--weights", required=True, help="MobileNetV2 state dict trained on ImageNet")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--config", default="mobilenet")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(2)
    recording = arguments.out / "recording"
    load_importer("billets")(arguments.data, recording)
    thumbnails = write_control(recording, arguments.out / "control")
    runs = {"touch": recording, "control": thumbnails}
    results = {name: run(name, folder, arguments) for name, folder in runs.items()}
    results["billet_from_thumbnail"] = name_the_billet(load_grasps(thumbnails))
    (arguments.out / "results.json").write_text(json.dumps(results, indent=1))
    text = report(results)
    (arguments.out / "report.md").write_text(text)
    print(text)
    return 0


def write_control(recording: Path, out: Path) -> Path:
    """The same recording with touches reduced to an 8 x 6 thumbnail, enlarged again."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "images").mkdir(exist_ok=True)
    for name in ("recording.json", "metadata.jsonl"):
        (out / name).write_bytes((recording / name).read_bytes())
    for grasp in load_grasps(recording):
        (out / "images" / grasp.photo.name).write_bytes(grasp.photo.read_bytes())
        small = blurred(read_rgb(grasp.touches[0]))
        cv2.imwrite(str(out / "images" / grasp.touches[0].name), np.rint(small[..., ::-1] * 255).astype(np.uint8))
    return out


def run(name: str, recording: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Every fold of one kind of touch; outcomes pooled over folds."""
    config = load_config(arguments.config)
    changes = {"init": arguments.weights, "seed": arguments.seed}
    if arguments.iterations:
        changes["iterations"] = arguments.iterations
    config = dataclasses.replace(config, training=dataclasses.replace(config.training, **changes))
    grasps = load_grasps(recording)
    outcomes: dict[str, Any] = {}
    for fold, welded in enumerate(WELDED):
        split = fold_split(grasps, welded, GROUND[fold % len(GROUND)], fold)
        out = arguments.out / f"{name}-{welded}.safetensors"
        checkpoint = train(recording, out, config, split=split)
        with BatchImages(checkpoint.config, torch.device("cpu")) as images:
            held_out = split.select(grasps, "test")
            touch = encode_touches(checkpoint.matcher, (images.touch(grasp) for grasp in held_out))
            photo = encode_photos(checkpoint.matcher, (images.photo(grasp.photo) for grasp in held_out))
        with torch.inference_mode():
            scores = checkpoint.matcher.head(touch.half[:, None], photo.half[None]).numpy()
        score_fold(outcomes, held_out, scores, arguments.seed)
        print(f"{name} {welded}: validation {checkpoint.provenance['metrics']}", file=sys.stderr)
    return outcomes


def fold_split(grasps: list[Grasp], welded: str, ground: str, fold: int) -> Split:
    """Test on one welded and one ground billet, validate on the next of each."""
    validation = {WELDED[(fold + 1) % len(WELDED)], GROUND[(fold + 1) % len(GROUND)]}
    parts: dict[str, list[str]] = {"train": [], "validation": [], "test": []}
    for grasp in grasps:
        test = grasp.sequence_id in (welded, ground)
        part = "test" if test else "validation" if grasp.sequence_id in validation else "train"
        parts[part].append(grasp.object_id)
    return Split.from_dict({"seed": 0, **parts})


def score_fold(outcomes: dict[str, Any], grasps: list[Grasp], scores: NDArray[np.float32], seed: int) -> None:
    """Add a fold's outcomes: one 50/50 pair test and one K-way test per touch and gallery, seeded."""
    rng = np.random.default_rng([seed, 7])
    galleries = {
        "one welded billet": [row for row, grasp in enumerate(grasps) if grasp.sequence_id in WELDED],
        "welded and ground": list(range(len(grasps))),
    }
    for name, rows in galleries.items():
        chosen = [grasps[row] for row in rows]
        table = scores[np.ix_(rows, rows)]
        kept = outcomes.setdefault(name, {"pair": [], **{f"K={k}": [] for k in KS}, **{f"curve{k}": [] for k in KS}})
        kept["pair"] += pair_outcomes(chosen, table, seed, rng)
        for row in range(len(rows)):
            others = np.delete(table[row], row)
            for k in KS:
                rivals = rng.choice(others, k - 1, replace=False)
                kept[f"K={k}"].append(settled(guess_curve(float(table[row, row]), rivals, k)[0], rng))
                kept[f"curve{k}"].append(guess_curve(float(table[row, row]), others, k).tolist())


def pair_outcomes(grasps: list[Grasp], table: NDArray[np.float32], seed: int, rng: np.random.Generator) -> list[int]:
    """One true and one false pair for each touch: 1 where the logit is on the right side of 0."""
    sampler = PairSampler(grasps, seed=seed, positives=1, negatives=1)
    pairs = sampler.every_touch()
    column = {grasp.photo: number for number, grasp in enumerate(grasps)}
    line = {grasp.grasp_id: number for number, grasp in enumerate(grasps)}
    outcomes = []
    for touch, photo, label in zip(pairs.touch_index, pairs.photo_index, pairs.labels, strict=True):
        logit = table[line[pairs.grasps[touch].grasp_id], column[pairs.photos[photo]]]
        outcomes.append(settled(pair_accuracy(np.array([logit, -logit]), np.array([label, 1 - label])), rng))
    return outcomes


def settled(chance: float, rng: np.random.Generator) -> int:
    """1 or 0; equals are settled by a draw, so that a constant scorer is at chance."""
    return int(chance) if chance in (0.0, 1.0) else int(rng.random() < chance)


def name_the_billet(grasps: list[Grasp]) -> dict[str, Any]:
    """How often the nearest other thumbnail is of the same billet: what the capture alone gives away."""
    thumbnails = np.array([resize(read_rgb(grasp.touches[0]), (6, 8)).ravel() for grasp in grasps])
    distance = np.linalg.norm(thumbnails[:, None] - thumbnails[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.argmin(1)
    right = [int(grasps[row].sequence_id == grasps[near].sequence_id) for row, near in enumerate(nearest)]
    ground = [hit for hit, grasp in zip(right, grasps, strict=True) if grasp.sequence_id in GROUND]
    return {"all": right, "ground": ground}


def report(results: dict[str, Any]) -> str:
    """The table, with exact 95 % intervals and chance."""
    lines = ["| gallery | test | touch | control (blurred thumbnail) | chance |", "|---|---|---|---|---|"]
    for gallery, kept in results["touch"].items():
        control = results["control"][gallery]
        for test, chance in (("pair", 0.5), *((f"K={k}", 1 / k) for k in KS)):
            label = "pair accuracy" if test == "pair" else f"{test}, first guess"
            lines.append(f"| {gallery} | {label} | {share(kept[test])} | {share(control[test])} | {chance:.2f} |")
        for k in KS:
            curves = [np.mean(part[f"curve{k}"], axis=0)[:3] for part in (kept, control)]
            shown = [", ".join(f"{value:.3f}" for value in curve) for curve in curves]
            chance_curve = ", ".join(f"{guess / k:.2f}" for guess in (1, 2, 3))
            lines.append(
                f"| {gallery} | K={k}, guesses 1, 2, 3, all draws | {shown[0]} | {shown[1]} | {chance_curve} |"
            )
    for which, hits in results["billet_from_thumbnail"].items():
        lines.append(f"| {which} billets | billet named by the nearest thumbnail | - | {share(hits)} | {1 / 9:.2f} |")
    return "\n".join(lines) + "\n"


def share(outcomes: list[int]) -> str:
    """A share with its exact interval and counts."""
    low, high = binomial_interval(sum(outcomes), len(outcomes))
    return f"{np.mean(outcomes):.3f} [{low:.3f}, {high:.3f}] ({sum(outcomes)}/{len(outcomes)})"


if __name__ == "__main__":
    sys.exit(main())
