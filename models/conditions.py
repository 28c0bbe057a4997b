"""Recognition in photos that are taken otherwise than those of the rig (`models.photography.CONDITIONS`).

    retrieve collect --rig models/shipped_rig.toml --objects 100 --grasps 4 --seed 918273 --out grasps/
    python -m models.conditions grasps/ --rig models/shipped_rig.toml --seed 918273 --photos photos/ --model shipped

Each object of the recording is photographed three times in each condition; all photos of a catalogue are in the same
one, and the touches are unchanged. The camera of the photos is unknown to the model, which assumes one as `build-index`
does, or its field is stated. It prints top-1 of one touch among one photo of each of 10 and of 100 objects, with 95 %
intervals over objects, for each model. A touch that the gel check refuses gives no evidence.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from models.photography import CONDITIONS
from models.pictures import LabelledPicture, collect_pictures
from models.recognition import all_scores, interval, photo_partials, top1
from retrieval.console.progress import show_progress
from retrieval.data.camera import assumed_camera
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.views import FIELD_MM
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure
from retrieval.metrics.table import ScoreTable
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.search.opening import find_model
from retrieval.training.calibration.checkpoint import refused_touches
from retrieval.training.features import encode_recording

CANDIDATES = (10, 100)
AS_THE_RIG, *CHANGED, _ = CONDITIONS
MEAN = "mean of the changed ones"
OTHER_FIELD = 0.1
"""Logarithm of the ratio of fields from which a condition is also measured with its field stated."""


def main(argv: Sequence[str] | None = None) -> int:
    """Take the photos that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", default="sim", help="rig of the recording")
    parser.add_argument("--seed", type=int, required=True, help="seed of the recording")
    parser.add_argument("--photos", type=Path, required=True, help="folder of the photos")
    parser.add_argument("--model", action="append", required=True, help="a checkpoint, or `shipped`")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(argv)
    show_progress()
    grasps = load_grasps(options.recording)
    objects = len({grasp.object_id for grasp in grasps})
    photos = collect_pictures(
        "conditions", options.photos, objects=objects, seed=options.seed, rig=options.rig, jobs=options.jobs
    )
    for model in options.model:
        print(f"\n{model}\n\n{table(measures(load_checkpoint(find_model(model)[0]), grasps, photos, options.photos))}")
    return 0


@torch.inference_mode()
def measures(
    checkpoint: Checkpoint, grasps: Sequence[Grasp], photos: Sequence[LabelledPicture], folder: Path
) -> dict[str, dict[int, Measure]]:
    """Return top-1 by condition and number of candidates."""
    features = encode_recording(grasps, checkpoint.matcher, checkpoint.config, folder, photo_variant="none")
    touches = checkpoint.matcher.touch_encoding(torch.from_numpy(features.touch_rows)).partial
    refused = refused_touches(checkpoint, torch.from_numpy(features.touch_rows))
    names = sorted(set(features.object_ids))
    of_condition: dict[str, dict[int, Measure]] = {}
    for condition, how in CONDITIONS.items():
        shown = [photo for photo in photos if photo.name.rpartition("-")[0] == condition and photo.object_id in names]
        owner = np.array([names.index(photo.object_id) for photo in shown])
        assumed = assumed_camera((photo.object_id, photo.file, ()) for photo in shown)
        cameras = {condition: assumed}
        if abs(math.log(how.camera.field_mm / FIELD_MM)) > OTHER_FIELD:
            cameras[f"{condition}, its field stated"] = assumed._replace(field_mm=how.camera.field_mm)
        for name, camera in cameras.items():
            partials = photo_partials(checkpoint, [photo.file for photo in shown], camera)
            scores = all_scores(checkpoint, touches, partials)
            scores[refused] = np.median(scores)
            scored = ScoreTable(scores, features.owner, owner, np.zeros(scores.shape, np.bool_))
            of_condition[name] = {k: top1(scored, k, photos=1) for k in CANDIDATES if k <= len(names)}
    return of_condition


def table(of_condition: dict[str, dict[int, Measure]]) -> str:
    """Return a Markdown table of the conditions, and the mean of the changed ones on the same touches."""
    counts = list(of_condition[AS_THE_RIG])
    mean = {}
    for k in counts:
        first = of_condition[AS_THE_RIG][k]
        mean[k] = Measure(
            np.mean([of_condition[name][k].values for name in CHANGED], axis=0), first.owner, first.chance, ""
        )
    lines = ["| photos | " + " | ".join(f"K = {k}" for k in counts) + " |", "|---|" + "---|" * len(counts)]
    for name, found in {**of_condition, MEAN: mean}.items():
        cells = [summarise([found[k]]) for k in counts]
        text = " | ".join(interval(cell.value[0], cell.low[0], cell.high[0]) for cell in cells)
        lines.append(f"| {name} | {text} |")
    return "\n".join([*lines, "| chance | " + " | ".join(f"{1 / k:.2f}" for k in counts) + " |"])


if __name__ == "__main__":
    raise SystemExit(main())
