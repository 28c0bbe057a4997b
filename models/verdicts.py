"""Accuracy of "match", "none of these", "no contact" and "not a gel image" for the shipped checkpoint.

    python -m models.verdicts FOLDER
        writes FOLDER/verdicts.md, verdicts.json and risk.png; continues an interrupted run

The objects and gels have seeds that the checkpoint was not trained on: 120 touched objects (the recording of `python -m
models.shipped score FOLDER`), and 880 photo-only objects, so that catalogues of up to 1,000 objects can be
searched with the queried object and without it. Then it tests inputs that are not touches. Pictures of real sensors and
things are tested if the variable TOUCH_DATA names a folder that has them. Results on simulated touches do not predict
those on real sensors.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import softmax

from models import shipped
from models.recognition import interval
from retrieval.console.progress import Bar, show_progress
from retrieval.data.dataset import load_grasps
from retrieval.data.images import read_rgb
from retrieval.data.resize import RgbImage
from retrieval.metrics.intervals import binomial_interval
from retrieval.metrics.measure import weight_below
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import for_inference, photo_features, touch_batch
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.shipped import shipped_model
from retrieval.training.calibration.gel_check import draw_foreign
from retrieval.training.calibration.posterior import IdentificationTrials
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.features import encode_recording
from robot.collection import CollectSettings, collect
from robot.rig import load_rig
from robot.sim.objects.draw import draw_object

TOUCHED, PHOTOGRAPHED, GRASPS = 120, 1000, 8
SIZES, SET_SIZES, SETS = (20, 100, 1000), (1, 2, 3, 5), 4
INPUTS, DRAWS = 1000, 1000
OTHER_OPTICS, OTHER_OBJECTS = "gelsight", 50


def main(argv: list[str] | None = None) -> int:
    """Make both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", type=Path, default=shipped_model(), help="another checkpoint than the shipped one")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    show_progress()
    folder, checkpoint = arguments.folder, load_checkpoint(arguments.model)
    if checkpoint.posterior is None or checkpoint.gel_check is None:
        parser.error(f"{arguments.model} has no posterior or no check of touches; train it again")
    size = (TOUCHED, GRASPS, shipped.SEED_SCORED, arguments.jobs)
    if code := shipped.collect(folder / "recording", shipped.RIG, *size):
        return code
    photograph(folder / "photographed")
    catalogues, curves = evaluate_catalogues(checkpoint, folder)
    inputs = list(evaluate_inputs(checkpoint, folder, arguments.jobs))
    document = {"model": checkpoint.digest, "catalogues": catalogues, "inputs": inputs, "risk": curves}
    (folder / "verdicts.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    (folder / "verdicts.md").write_text("\n".join(as_markdown(document)) + "\n", "utf-8")
    plot(curves, folder / "risk.png")
    print((folder / "verdicts.md").read_text("utf-8"))
    return 0


def photograph(folder: Path) -> None:
    """Write a photo of each object that is not touched."""
    folder.mkdir(parents=True, exist_ok=True)
    with load_rig(str(shipped.RIG), seed=shipped.SEED_SCORED) as rig, Bar("photograph", PHOTOGRAPHED, "objects") as bar:
        bar.advance(TOUCHED)
        for index in range(TOUCHED, PHOTOGRAPHED):
            name = draw_object(shipped.SEED_SCORED, index).object_id
            if not (folder / f"{name}.png").is_file():
                rig.prepare(name, 0)
                cv2.imwrite(str(folder / f"{name}.part.png"), rig.camera.read(depth=False).colour[..., ::-1])
                (folder / f"{name}.part.png").rename(folder / f"{name}.png")
            bar.advance()


# Catalogues with the object and without it -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OpenSetRatios:
    """Log likelihood ratios of catalogues with the queried object and without it.

    Attributes:
        present: (T, K) ratios with the object, which comes first.
        absent: (T, K) ratios without it.
        owner: (T,) the object of each query.
    """

    present: NDArray[np.float64]
    absent: NDArray[np.float64]
    owner: NDArray[np.int64]


def evaluate_catalogues(made: Checkpoint, folder: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row for each size of catalogue and number of grasps, and the curves of risk against coverage."""
    scored = score_photos(made, folder)
    rows, curves = [], {}
    for grasps in SET_SIZES:
        for size, ratios in query_sets(made, scored, grasps):
            rows.append({"objects": size, "grasps": grasps, "questions": len(ratios.owner)} | measured(ratios))
            curves[f"{size} objects, {grasps} grasp{'s' * (grasps > 1)}"] = risk_against_coverage(ratios)
    return rows, curves


def score_photos(made: Checkpoint, folder: Path) -> ScoredTouches:
    """Return match logits of the touches of the touched objects with photos of all."""
    grasps = load_grasps(folder / "recording")
    features = encode_recording(grasps, made.matcher, made.config, folder / "features")
    files = sorted((folder / "photographed").glob("*.png"))
    images: Iterator[RgbImage] = map(made.config.preprocessing.load_photo, files)
    with torch.inference_mode():
        photos = torch.cat([torch.from_numpy(features.photo), photo_features(made.matcher, images)])
        touches = made.matcher.touch_encoding(torch.from_numpy(features.touch).flatten(1)).partial.numpy()
        partials = made.matcher.photo_encoding(photos).partial.numpy()
    scorer = made.matcher.head.scorer
    touch_owner = features.owner
    owner = np.concatenate([touch_owner, touch_owner.max() + 1 + np.arange(len(files))])
    own = np.zeros((len(touch_owner), len(owner)), dtype=bool)
    own[np.arange(len(touch_owner)), np.arange(len(touch_owner))] = True
    return ScoredTouches(
        np.stack([scorer.logits(touch_partial[None], partials) for touch_partial in touches]), touch_owner, owner, own
    )


def query_sets(made: Checkpoint, scored: ScoredTouches, grasps: int) -> Iterator[tuple[int, OpenSetRatios]]:
    """Yield sets of this many grasps for every size of catalogue; the other objects are drawn by a seed."""
    assert made.posterior is not None
    rng = np.random.default_rng([7, grasps])
    sets = []
    for name in np.unique(scored.touch_owner):
        own = np.flatnonzero(scored.touch_owner == name)
        if len(own) > grasps:
            sets += [[row] for row in own] if grasps == 1 else [rng.permutation(own)[:grasps] for _ in range(SETS)]
    rows = np.array(sets)
    ratios = IdentificationTrials.of(scored, rows).log_ratios(made.posterior)
    owner = scored.touch_owner[rows[:, 0]]
    keys = rng.random(ratios.shape)
    keys[np.arange(len(rows)), owner] = -1
    ranked = np.take_along_axis(ratios, np.argsort(keys, axis=1), 1)
    for size in SIZES:
        count = min(size, ranked.shape[1] - 1)
        yield size, OpenSetRatios(ranked[:, :count], ranked[:, 1 : count + 1], owner)


def measured(ratios: OpenSetRatios) -> dict[str, Any]:
    """Return fractions with 95 % intervals over objects, resampled with all their queries."""
    present, absent = (posterior_probabilities(part) for part in (ratios.present, ratios.absent))
    first_right = ratios.present.argmax(1) == 0
    accepted, accepted_absent = (part[:, 1:].max(1) > part[:, 0] for part in (present, absent))
    known, unknown = -present[:, 0], -absent[:, 0]
    found: dict[str, Callable[[NDArray[np.int64]], float]] = {
        "top1": lambda rows: float(first_right[rows].mean()),
        "match_and_right": lambda rows: float((accepted & first_right)[rows].mean()),
        "match_and_wrong": lambda rows: float((accepted & ~first_right)[rows].mean()),
        "none_though_there": lambda rows: float((~accepted)[rows].mean()),
        "match_though_absent": lambda rows: float(accepted_absent[rows].mean()),
        "auroc_of_none": lambda rows: auroc(known[rows], unknown[rows]),
        "false_accepts_at_95": lambda rows: float((unknown[rows] >= np.quantile(known[rows], 0.05)).mean()),
    }
    draws = list(redrawn(ratios.owner))
    every = np.arange(len(ratios.owner))
    values = {name: resampled(measure, every, draws) for name, measure in found.items()}
    probabilities = np.concatenate([present[:, 1:].max(1), absent[:, 1:].max(1)])
    is_right = np.concatenate([first_right, np.zeros(len(absent), dtype=bool)])
    return {**values, "calibration_error": calibration_error(probabilities, is_right)}


def posterior_probabilities(ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return probabilities (T, 1 + K) of "none of these" and each object, at even odds, as in `Posterior`."""
    return np.asarray(softmax(np.column_stack([np.zeros(len(ratios)), ratios - np.log(ratios.shape[1])]), axis=1))


def redrawn(owner: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    rng, names = np.random.default_rng(11), np.unique(owner)
    rows = [np.flatnonzero(owner == name) for name in names]
    for _ in range(DRAWS):
        yield np.concatenate([rows[place] for place in rng.integers(len(rows), size=len(rows))])


def resampled(
    measure: Callable[[NDArray[np.int64]], float], every: NDArray[np.int64], draws: Sequence[NDArray[np.int64]]
) -> list[float]:
    """Return a measure with its 95 % interval over draws of rows."""
    values = [measure(rows) for rows in draws]
    return [measure(every), *(float(bound) for bound in np.quantile(values, (0.025, 0.975)))]


def auroc(known: NDArray[np.float64], unknown: NDArray[np.float64]) -> float:
    """Return the probability that a query with the object scores higher than one without; ties count half."""
    return float(weight_below(known, unknown).mean() / len(unknown))


def calibration_error(stated: NDArray[np.float64], true: NDArray[np.bool_]) -> float:
    """Return the mean distance between stated probability and frequency, over 10 equal bins."""
    bins = np.minimum((10 * stated).astype(int), 9)
    return float(np.abs(np.bincount(bins, weights=stated - true, minlength=10)).sum() / len(stated))


def risk_against_coverage(ratios: OpenSetRatios) -> dict[str, list[float]]:
    """Return the fraction answered, and the fraction of wrong ones among these, by decreasing top-1 probability.

    Half of the queries are without the object, and every answer to these is wrong.
    """
    parts = [posterior_probabilities(part)[:, 1:] for part in (ratios.present, ratios.absent)]
    probabilities = np.concatenate([part.max(1) for part in parts])
    wrong = np.concatenate([parts[0].argmax(1) != 0, np.ones(len(parts[1]), dtype=bool)])
    order = np.argsort(-probabilities, kind="stable")
    counts = np.arange(1, len(order) + 1)
    risk = np.cumsum(wrong[order]) / counts
    shown = np.unique(np.linspace(len(order) // 100, len(order) - 1, 100).astype(int))
    return {"coverage": (counts[shown] / len(order)).tolist(), "risk": risk[shown].tolist()}


# Inputs that are not touches -------------------------------------------------------------------------------


def evaluate_inputs(made: Checkpoint, folder: Path, jobs: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each kind of input: their number, and their verdicts."""
    assert made.gel_check is not None
    fast = for_inference(made.matcher, "touch_tower")
    for name, expected, pictures in inputs(made, folder, jobs):
        readings = []
        for start in range(0, len(pictures), 16):
            with torch.inference_mode():
                features = fast.touch_features(touch_batch([read() for read in pictures[start : start + 16]]))
                reading = fast.gel_readings(features)
                assert reading is not None
                readings.append(reading.numpy())
        verdicts = made.gel_check.classify(np.concatenate(readings))
        right = verdicts.count(expected)
        yield {
            "input": name,
            "count": len(verdicts),
            "wanted": expected,
            "called": {verdict: verdicts.count(verdict) for verdict in (CONTACT, NO_CONTACT, NOT_A_GEL)},
            "share": [right / len(verdicts), *binomial_interval(right, len(verdicts))],
        }


Reader = Callable[[], list[RgbImage]]


def inputs(made: Checkpoint, folder: Path, jobs: int) -> Iterator[tuple[str, str, list[Reader]]]:
    """Yield name, expected verdict, and readers of touches (an image for each finger)."""
    settings, fingers = made.config.preprocessing, made.config.matcher.fingers
    grasps = load_grasps(folder / "recording")

    def files(paths: Sequence[Path]) -> Reader:
        return lambda: [settings.touch(read_rgb(path)) for path in paths]

    def alike(picture: RgbImage) -> Reader:
        return lambda: [settings.touch(picture)] * fingers

    yield "touches", CONTACT, [files(grasp.touches) for grasp in grasps][:INPUTS]
    yield "no-contact gels", NO_CONTACT, [files(grasp.backgrounds) for grasp in grasps][:INPUTS]
    photos = [read_rgb(path) for path in sorted((folder / "photographed").glob("*.png"))[:200]]
    drawn: dict[str, list[RgbImage]] = {}
    for name, picture in draw_foreign(INPUTS, 240, photos, seed=99):
        drawn.setdefault(name, []).append(picture)
    for name, level in (("black", 0.0), ("white", 1.0)):
        yield name, NOT_A_GEL, [alike(np.full((240, 320, 3), level, dtype=np.float32))]
    for name, pictures in drawn.items():
        yield name, NOT_A_GEL, [alike(picture) for picture in pictures]
    yield "photos, whole", NOT_A_GEL, [alike(photo) for photo in photos]
    yield f"another sensor: simulated {OTHER_OPTICS} gels", NOT_A_GEL, other_optics(folder, jobs, files)
    data = Path(os.environ.get("TOUCH_DATA", "data"))
    for name, pattern, step in (
        ("another sensor: real optical finger (VT60)", "vt60/touch/*/*/*.jpg", 50),
        ("another sensor: real GelSight Mini (billets)", "billets/*/*_touch.png", 1),
        ("real photos (VT60)", "vt60/vision/*/*/*.jpg", 15),
        ("real photos (billets)", "billets/*/*_photo.jpg", 1),
    ):
        if paths := sorted(data.glob(pattern))[::step]:
            yield name, NOT_A_GEL, [files([path] * fingers) for path in paths]


def other_optics(folder: Path, jobs: int, files: Callable[[Sequence[Path]], Reader]) -> list[Reader]:
    """Collect touches of the same objects by gels with the lamps of another sensor."""
    rig = folder / "other_optics.toml"
    rig.write_text(f'rig = "sim"\noptics = "{OTHER_OPTICS}"\n', "utf-8")
    recording = folder / "other_optics"
    make = partial(load_rig, str(rig), seed=shipped.SEED_SCORED)
    collect(
        make, recording, objects=OTHER_OBJECTS, seed=shipped.SEED_SCORED, settings=CollectSettings(grasps=2), jobs=jobs
    )
    return [files(grasp.touches) for grasp in load_grasps(recording)]


# Output ----------------------------------------------------------------------------------------------------


def as_markdown(document: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of both tables."""
    columns = {
        "top1": "R@1",
        "match_and_right": "match, right",
        "match_and_wrong": "match, wrong",
        "none_though_there": "none, though present",
        "match_though_absent": "object absent: match",
        "auroc_of_none": "AUROC",
        "false_accepts_at_95": "false accepts at 95 %",
    }
    yield "| objects | grasps | " + " | ".join(columns.values()) + " | calibration error |"
    yield "|---|---|" + "---|" * (len(columns) + 1)
    for row in document["catalogues"]:
        cells = [interval(*row[name]) for name in columns]
        yield f"| {row['objects']:,} | {row['grasps']} | " + " | ".join(cells) + f" | {row['calibration_error']:.3f} |"
    yield ""
    yield "| input | number | expected verdict | fraction | contact / no contact / not a gel image |"
    yield "|---|---|---|---|---|"
    for row in document["inputs"]:
        counts = " / ".join(str(count) for count in row["called"].values())
        yield f"| {row['input']} | {row['count']} | {row['wanted']} | {interval(*row['share'])} | {counts} |"


def plot(curves: dict[str, Any], path: Path) -> None:
    """Plot risk against coverage, a panel for each size of catalogue."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(SIZES), figsize=(12, 3.8), sharey=True, layout="constrained")
    for size, panel in zip(SIZES, axes, strict=True):
        for grasps in SET_SIZES:
            name = f"{size} objects, {grasps} grasp{'s' * (grasps > 1)}"
            panel.plot(curves[name]["coverage"], curves[name]["risk"], label=f"{grasps} grasp{'s' * (grasps > 1)}")
        panel.axhline(1 - 0.5 / size, color="grey", linestyle=":", linewidth=1, label="chance")
        panel.set(title=f"{size:,} objects", xlabel="coverage", xlim=(0, 1), ylim=(0, 1))
    axes[0].set_ylabel("risk: fraction of wrong answers")
    axes[0].legend(loc="lower right", fontsize=8)
    figure.suptitle("Half of the queries are of objects that are not in the catalogue", fontsize=10)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
