"""Accuracy on unseen objects against the number of training objects, and of grasps of each.

    python -m benchmarks.models.scaling RECORDING UNSEEN --out FOLDER --preset mobilenet --init WEIGHTS

RECORDING contains training and validation objects, UNSEEN is a recording of other objects; all of its touches are
scored. Training sets are nested: 20 objects are among the 80. With `--photographed 0 1000 10000` (and --photos,
--touches), each number of touched objects is combined with this many photo-only objects, paired by their labels with
touch-only ones, and the plot has a line for each. With `--seeds 3` every randomised method is trained three times, and
its numbers are means over them. It writes scaling.json and scaling.png in FOLDER; existing fits and features are
reused.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.models.recognition import summary_cell
from retrieval.data.dataset import Grasp, data_digest, load_grasps
from retrieval.evaluation.calibrate import calibrate_pairs
from retrieval.evaluation.evaluate import DRAWS
from retrieval.evaluation.scoring import summaries
from retrieval.methods import METHODS
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.methods.method import Method, MethodSettings
from retrieval.metrics.measure import Measure
from retrieval.metrics.registry import MethodScoreTables, compute
from retrieval.metrics.table import ScoreTable
from retrieval.model.config import Config, load_config
from retrieval.training.features import Features, encode_recording
from retrieval.training.train import labelled_pairs
from robot.recording.folder import read_recording

LINES = ("-", "--", "-.")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
KNOWN = {"shape": slice(0, 1), "relief": slice(1, 2), "both": slice(0, 2)}
"""Words of a simulated object's name ("mug-ribs-0-00001") that describe it."""
PHOTO_ONLY = 8
"""Added to numbers of touched objects in plots, because 0 has no place on a logarithmic axis."""
SHOWN = {
    "pair_accuracy": "pair accuracy",
    "topn_k5": "top-1 accuracy, K = 5",
    "topn_k10": "top-1 accuracy, K = 10",
    "topn_k100": "top-1 accuracy, K = 100",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every point, then write the table and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("unseen", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="mobilenet")
    parser.add_argument("--init", default="imagenet", help="first weights of the towers")
    for side in ("photo", "touch"):
        parser.add_argument(
            f"--init-{side}", default="", help="first weights of one tower, from `retrieve train --task relief`"
        )
    for pictures in ("photos", "touches"):
        parser.add_argument(f"--{pictures}", default="", help="folder of labelled ones, for additional training pairs")
    parser.add_argument("--photographed", type=int, nargs="+", help="numbers of photo-only objects in training pairs")
    parser.add_argument("--views", nargs="+", help="ablation: other views of a photo than the preset's")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=["late_fusion", "cca"])
    parser.add_argument("--objects", type=int, nargs="+", default=[20, 80, 320, 1280])
    parser.add_argument(
        "--grasps", type=int, nargs="+", default=[1, 2, 4], help="maximum number of grasps of each object"
    )
    parser.add_argument("--validation", type=int, default=100, help="objects for model choice and calibration")
    parser.add_argument("--fingers", type=int, default=2, help="ablation: use only this many fingers")
    parser.add_argument("--opening", action="store_true", help="addition: use the opening of the jaws")
    parser.add_argument("--known", choices=list(KNOWN), help="oracle: this property of the object is known")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each method")
    parser.add_argument("--touch-px", type=int, help="ablation: side of the gel images in pixels")
    parser.add_argument("--cache", type=Path, help="folder for encoded features (default: FOLDER/features)")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = measure(arguments)
    (arguments.out / "scaling.json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    print(table(found["points"]))
    draw = plot if arguments.photographed is None else plot_photographed
    draw(found["points"]).savefig(arguments.out / "scaling.png", dpi=110)
    return 0


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit and score every training set: each number of objects with all grasps, then all objects with fewer."""
    config = _config(arguments)
    cache = arguments.cache or arguments.out / "features"
    recordings = (arguments.recording, arguments.unseen)
    (recorded, recorded_digest), (unseen, unseen_digest) = (
        _features(one, config, cache, arguments) for one in recordings
    )
    pairs = recorded.of_objects(())
    if config.training.photos:
        pairs = _encoded(labelled_pairs(config), config, cache, arguments)
    names = [str(name) for name in np.random.default_rng(0).permutation(sorted(set(recorded.object_ids)))]
    validation, pool = recorded.of_objects(names[: arguments.validation]), names[arguments.validation :]
    max_grasps = max(arguments.grasps)
    sizes = sorted({min(count, len(pool)) for count in arguments.objects})
    requested = [(count, max_grasps) for count in sizes] + [
        (sizes[-1], grasps) for grasps in arguments.grasps if grasps < max_grasps
    ]
    pair_objects = [str(name) for name in np.random.default_rng(1).permutation(sorted(set(pairs.object_ids)))]
    photo_only_counts = sorted(
        {min(count, len(pair_objects)) for count in arguments.photographed or [len(pair_objects)]}
    )
    points = []
    for (count, grasps), photographed in product(requested, photo_only_counts):
        if not count and not photographed:
            continue
        touched, paired = (
            first_grasps(recorded.of_objects(pool[:count]), grasps),
            pairs.of_objects(pair_objects[:photographed]),
        )
        train = touched.concatenate(paired) if count and photographed else touched if count else paired
        folder = arguments.out / f"{count}-objects-{grasps}-grasps-{photographed}-photographed"
        for name in arguments.methods:
            seeds = range(arguments.seeds if METHODS.load(name).is_seeded else 1)
            trained = [METHODS.load(name)(MethodSettings(config, seed, folder)) for seed in seeds]
            for method in trained:
                method.fit(train, validation)
            size = {"method": name, "objects": count, "grasps": grasps, "photographed": photographed}
            size |= {"touches": len(train), "pairs": len(paired), "seeds": len(seeds)}
            points.append(size | score_methods(trained, validation, unseen, arguments.known))
            print(table(points[-1:]).splitlines()[-1], flush=True)
    return {
        "preset": arguments.preset,
        "iterations": config.training.iterations,
        "fingers": arguments.fingers,
        "opening": arguments.opening,
        "known": arguments.known,
        "touch_px": config.preprocessing.touch_px,
        "views": config.preprocessing.views,
        "recording": recorded_digest,
        "unseen": unseen_digest,
        "points": points,
    }


def _config(arguments: argparse.Namespace) -> Config:
    config = load_config(arguments.preset)
    training = dataclasses.replace(
        config.training.with_iterations(arguments.iterations),
        init=arguments.init,
        init_photo=arguments.init_photo,
        init_touch=arguments.init_touch,
        photos=arguments.photos,
        touches=arguments.touches,
    )
    preprocessing = dataclasses.replace(
        config.preprocessing,
        touch_px=arguments.touch_px or config.preprocessing.touch_px,
        views=tuple(arguments.views or config.preprocessing.views),
    )
    return dataclasses.replace(config, training=training, preprocessing=preprocessing)


def _features(recording: Path, config: Config, cache: Path, arguments: argparse.Namespace) -> tuple[Features, str]:
    grasps = load_grasps(recording)
    features = _encoded(grasps, config, cache, arguments)
    if arguments.opening:
        features = with_opening(features, recording)
    return features, data_digest(grasps)


def _encoded(grasps: Sequence[Grasp], config: Config, cache: Path, arguments: argparse.Namespace) -> Features:
    features = encode_recording(grasps, frozen_matcher(config), config, cache)
    return dataclasses.replace(features, touch=features.touch[:, : arguments.fingers].copy())


def with_opening(features: Features, recording: Path) -> Features:
    """Add the opening of the jaws in millimetres as one more feature of each finger."""
    known = {line.grasp_id: line.opening_mm for line in read_recording(recording).grasps}
    openings = np.array([known[name] for name in features.grasp_ids], dtype=np.float32)
    column = np.broadcast_to(openings[:, None, None], (*features.touch.shape[:2], 1))
    return dataclasses.replace(features, touch=np.concatenate([features.touch, column], axis=2))


def first_grasps(features: Features, maximum: int) -> Features:
    """Return the first grasps of each object, at most this many."""
    place = [features.object_ids[:row].count(name) for row, name in enumerate(features.object_ids)]
    return features.select(np.flatnonzero(np.array(place) < maximum))


def score_methods(
    trained: Sequence[Method], validation: Features, unseen: Features, known: str | None
) -> dict[str, Any]:
    """Return summaries of the measures on unseen objects: means over training runs, and those of the mean scores.

    The latter are under "together".
    """
    scored = [tuple(scores_of(method, part, known) for part in (validation, unseen)) for method in trained]
    single = summaries([_measures(*tables) for tables in scored], DRAWS, seed=0)
    together = (mean_scores(tables) for tables in zip(*scored, strict=True))
    return single | {"together": summaries([_measures(*together)], DRAWS, seed=0)}


def _measures(validation: ScoreTable, unseen: ScoreTable) -> dict[str, Measure]:
    return compute(MethodScoreTables(unseen, unseen, {}, calibrate_pairs(validation, seed=0), seed=0), SHOWN)


def mean_scores(tables: Sequence[ScoreTable]) -> ScoreTable:
    """Return the mean scores of several training runs."""
    return dataclasses.replace(tables[0], scores=np.mean([table.scores for table in tables], axis=0))


def scores_of(method: Method, features: Features, known: str | None = None) -> ScoreTable:
    """Score every touch with every photo; if shape or relief is known, photos of another one come last."""
    scores = method.score(method.encode_touch(features.touch), method.encode_photo(features.photo))
    if known:
        labels = ["-".join(name.split("-")[KNOWN[known]]) for name in features.object_ids]
        scores[np.array(labels)[:, None] != np.array(labels)] -= np.ptp(scores) + 1
    return ScoreTable(scores, features.owner, features.owner, np.eye(len(features), dtype=bool))


def shown(points: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return name and label of the measures of the points; too few unseen objects allow fewer measures."""
    return {name: label for name, label in SHOWN.items() if name in points[0]}


def table(points: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of the points."""
    measures = shown(points)
    lines = [
        "| method | training objects | grasps of each | photo-only objects | " + " | ".join(measures.values()) + " |",
        "|---|---|---|---|" + "---|" * len(measures),
    ]
    for point in points:
        cells = [summary_cell(point[name]) for name in measures]
        sizes = (f"{point['objects']:,}", str(point["grasps"]), f"{point['photographed']:,}")
        lines.append("| " + " | ".join((point["method"], *sizes, *cells)) + " |")
    return "\n".join(lines)


def plot(points: Sequence[dict[str, Any]]) -> Figure:
    """Plot accuracy against objects at the most grasps, and against grasps at the most objects."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    grasps, objects = max(point["grasps"] for point in points), max(point["objects"] for point in points)
    _panel(left, [point for point in points if point["grasps"] == grasps], "objects")
    _panel(right, [point for point in points if point["objects"] == objects], "grasps")
    left.set(xlabel=f"training objects, {grasps} grasps of each", ylabel="accuracy, unseen objects", ylim=(0, 1))
    right.set(xlabel=f"grasps of each of {objects:,} training objects")
    right.legend(loc="lower right", fontsize="small", facecolor="white", edgecolor="none", framealpha=1)
    return figure


def plot_photographed(points: Sequence[dict[str, Any]]) -> Figure:
    """Plot each measure of the first method against touched objects; a line per number of photo-only objects."""
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    points = [point for point in points if point["method"] == points[0]["method"]]
    counts = sorted({point["photographed"] for point in points})
    measures = shown(points)
    for axes, (name, label) in zip(figure.subplots(1, len(measures)), measures.items(), strict=True):
        for number, count in enumerate(counts):
            own = [point for point in points if point["photographed"] == count]
            own.sort(key=lambda point: int(point["objects"]))
            value, low, high = (np.array([each[name][part][0] for each in own]) for part in ("value", "low", "high"))
            x = np.array([each["objects"] for each in own]) + PHOTO_ONLY
            colour = colormaps["viridis"](0.9 * number / max(len(counts) - 1, 1))
            bars = [list(value - low), list(high - value)]
            axes.errorbar(x, value, bars, marker="o", capsize=3, color=colour, label=f"{count:,} photo-only")
        axes.axhline(points[0][name]["chance"][0], color="black", linestyle=":", linewidth=1)
        ticks = sorted({point["objects"] for point in points})
        axes.set(xscale="log", xlabel="touched objects", title=label, ylim=(0, 1))
        axes.set_xticks([tick + PHOTO_ONLY for tick in ticks], [f"{tick:,}" for tick in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small", facecolor="white", edgecolor="none", framealpha=1)
    return figure


def _panel(axes: Axes, points: Sequence[dict[str, Any]], key: str) -> None:
    methods = list(dict.fromkeys(point["method"] for point in points))
    for (name, label), colour in zip(shown(points).items(), COLOURS, strict=False):
        for method, style in zip(methods, LINES, strict=False):
            own = sorted((point for point in points if point["method"] == method), key=lambda point: int(point[key]))
            value, low, high = (np.array([point[name][part][0] for point in own]) for part in ("value", "low", "high"))
            words = f"{label}, {method.replace('_', ' ')}"
            bars = [list(value - low), list(high - value)]
            x = [point[key] for point in own]
            axes.errorbar(x, value, bars, marker="o", capsize=3, color=colour, linestyle=style, label=words)
        axes.axhline(points[0][name]["chance"][0], color=colour, linestyle=":", linewidth=1)
    ticks = sorted({point[key] for point in points})
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{count:,}" for count in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    raise SystemExit(main())
