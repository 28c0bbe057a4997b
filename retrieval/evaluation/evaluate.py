"""Run an evaluation from recording to results.json: encode, fit, predict, score. Finished steps are not repeated."""

import os
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.console.interruption import resumable
from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording, Split, folder_of
from retrieval.errors import BadInput
from retrieval.evaluation import SCHEMA_VERSION
from retrieval.evaluation.cache import write_document
from retrieval.evaluation.controls import (
    CEILING_METHOD,
    CEILINGS,
    CONTROL_METHOD,
    CONTROLS,
    ceiling_experiments,
    control_experiments,
    score_control,
)
from retrieval.evaluation.data import EvaluationData, prepare
from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import draw_queries
from retrieval.evaluation.scoring import Measures, score_method
from retrieval.evaluation.verification import score_verification
from retrieval.methods import METHODS
from retrieval.methods.method import Method
from retrieval.metrics.intervals import compare
from retrieval.model.config import Config, named_config
from retrieval.model.encode import one_thread, photo_features, touch_features
from retrieval.training.batches import BatchImages
from retrieval.training.features import encode_recording
from retrieval.version import __version__

PredictionsByMethod = Mapping[str, Sequence[Predictions]]
"""Predictions by method, one for each training seed."""
DRAWS = 10_000
COMPARED_MEASURES = ("pair_accuracy", "topn_k5")
"""Measures of the comparisons between the first method and each other one."""


def evaluate(
    recording: AnyRecording,
    out: Path,
    *,
    config: Config | str = "small",
    preset: str | None = None,
    methods: Sequence[str | type[Method]] = tuple(METHODS),
    model: Path | None = None,
    seeds: int = 1,
    split: Split | None = None,
    cache: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Compare methods on unseen objects; write results.json and timings.json.

    A stopped run resumes: files under `out` from the same settings are reused. Equal settings give byte-identical
    results.

    Args:
        recording: A folder, or the object that `robot.read_recording` returns.
        out: Folder of the results.
        config: Towers, heads and split, if `model` does not give them: a `Config` (`Config.using` accepts your own
            towers and losses), or an argument of `load_config`. Its seed is the seed of every random draw.
        preset: Name of the configuration in the report. Default: the configuration's name.
        methods: Names, or your own classes, which the report lists by class name.
        model: A checkpoint to evaluate instead of one that is fitted here.
        seeds: Number of training runs of each method; the first seed is that of `config`.
        split: Objects of each part. Default: the split of `model`; without a model, a random split.
        cache: Folder of encoded features. Default: `out`/features.
        quiet: No progress on stderr.

    Returns:
        The content of results.json.

    Raises:
        ConfigError: A method is unknown.
        DatasetError: The recording cannot be evaluated.
        CheckpointError: `model` cannot be read.
        JobInterrupted: After Ctrl-C.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny")
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))
    >>> results = retrieval.evaluate("lab", Path("report"), config=config, methods=["cca", "chance"], quiet=True)
    >>> list(results["methods"])
    ['cca', 'chance']
    """
    names = [METHODS.name_of(method) for method in methods]
    if not names or seeds < 1:
        raise BadInput(f"An evaluation needs at least 1 method and 1 seed, got {len(names)} and {seeds}.")
    config, preset_name = named_config(config, preset)
    out.mkdir(parents=True, exist_ok=True)
    seed = config.training.seed
    seed_list = list(range(seed, seed + seeds))
    with resumable(out):
        data = prepare(folder_of(recording), out, config, model=model, split=split, quiet=quiet)
        experiment, controls = _experiments(data, out, cache or out / "features", seed, quiet)
        jobs = {name: experiment.seeds_of(name, seed_list) for name in dict.fromkeys(names)}
        predictions = {name: [experiment.run(name, each) for each in seeds_used] for name, seeds_used in jobs.items()}
        groups = [
            ("controls", CONTROLS, CONTROL_METHOD, controls),
            ("ceilings", CEILINGS, CEILING_METHOD, ceiling_experiments(experiment)),
        ]
        controls_and_ceilings = {
            group: {
                name: score_control(descriptions[name], method, one, seed, draws=DRAWS)
                for name, one in experiments.items()
            }
            for group, descriptions, method, experiments in groups
        }
    results = {
        **_about(data, experiment, preset_name, seed_list),
        **_score_methods(experiment, predictions, seed, quiet),
        "verification": (
            score_verification(experiment, predictions["late_fusion"], jobs["late_fusion"], seed)
            if "late_fusion" in jobs
            else None
        ),
        **controls_and_ceilings,
    }
    write_document(out / "results.json", results)
    write_document(out / "timings.json", _timings(data, predictions))
    return results


def _experiments(
    data: EvaluationData, out: Path, cache: Path, seed: int, quiet: bool
) -> tuple[Experiment, dict[str, Experiment]]:
    """Return the experiment of the evaluation, and those of the controls."""
    encode = partial(encode_recording, matcher=data.matcher, config=data.config, cache=cache, quiet=quiet)
    experiment = Experiment(
        folder=out,
        config=data.config,
        split=data.split,
        features=encode(data.grasps),
        queries=draw_queries(data.grasps, data.split, seed),
        checkpoint=data.checkpoint,
        shuffled=False,
        quiet=quiet,
        matcher=data.matcher,
    )
    return experiment, control_experiments(experiment, data, cache, seed)


def _about(data: EvaluationData, experiment: Experiment, preset: str, seeds: list[int]) -> dict[str, Any]:
    features = experiment.features
    return {
        "schema_version": SCHEMA_VERSION,
        "software": __version__,
        "recording": {
            "path_name": data.name,
            "source": data.source,
            "digest": data.digest,
            "objects": len(set(features.object_ids)),
            "grasps": len(features),
        },
        "split": {**data.split.to_dict(), "from": data.split_from},
        "setting": {
            "preset": preset,
            "model": data.checkpoint.digest if data.checkpoint else None,
            "config": data.config.without_paths(),
            "seeds": seeds,
            "draws": DRAWS,
            "features": {
                "touch": features.touch.shape[2],
                "photo": features.photo.shape[1],
                "fingers": features.touch.shape[1],
                "digest": features.digest,
            },
        },
    }


def _score_methods(experiment: Experiment, predictions: PredictionsByMethod, seed: int, quiet: bool) -> dict[str, Any]:
    """Return "methods" and "comparisons" of results.json."""
    entries: dict[str, Any] = {}
    measures: dict[str, list[Measures]] = {}
    with Bar("score", len(predictions), "methods", quiet=quiet) as bar:
        for name, by_seed in predictions.items():
            entries[name], measures[name] = score_method(experiment.queries, by_seed, draws=DRAWS, seed=seed)
            bar.advance(note=name)
    return {"methods": entries, "comparisons": _compare_methods(measures, seed)}


def _compare_methods(measures: Mapping[str, list[Measures]], seed: int) -> list[dict[str, Any]]:
    first, *others = measures
    return [
        {"a": first, "b": other, "measure": key}
        | compare([one[key] for one in measures[first]], [one[key] for one in measures[other]], draws=DRAWS, seed=seed)
        for key in COMPARED_MEASURES
        for other in others
        if key in measures[first][0] and key in measures[other][0]
    ]


def _timings(data: EvaluationData, predictions: PredictionsByMethod) -> dict[str, Any]:
    found = {name: _method_times([one.seconds for one in by_seed]) for name, by_seed in predictions.items()}
    if {"late_fusion", "retrieve_rerank"} <= set(found):  # both use one training run
        found["retrieve_rerank"]["fit_s"] = found["late_fusion"]["fit_s"]
    return {
        "machine": {"cpus": os.cpu_count(), "threads": 1},
        "encode": _tower_times(data),
        "methods": found,
    }


def _method_times(by_seed: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Return the median times of a method over the seeds; a checkpoint has no time of fitting."""
    seconds = {key: float(np.median([one[key] for one in by_seed])) for key in by_seed[0]}
    return {
        "fit_s": seconds["fit"] or None,
        "encode_touch_ms": 1e3 * seconds["encode_touch"],
        "encode_photo_ms": 1e3 * seconds["encode_photo"],
        "score_us_per_photo": 1e6 * seconds["score"],
        "query_ms": 1e3 * seconds["query"],
    }


@one_thread()
def _tower_times(data: EvaluationData, count: int = 4, repeats: int = 3) -> dict[str, Any]:
    """Return the median times of the towers for one touch and one photo, on one thread, without reading files."""
    grasps = data.grasps[:count]
    images = BatchImages(data.config.preprocessing)
    touches, photos = [images.touch(grasp) for grasp in grasps], [images.photo(grasp.photo) for grasp in grasps]
    times: dict[str, list[float]] = {"touch_ms": [], "photo_ms": []}
    for touch, photo in zip(touches * repeats, photos * repeats, strict=True):
        start = time.perf_counter()
        touch_features(data.matcher, [touch])
        middle = time.perf_counter()
        photo_features(data.matcher, [photo])
        times["touch_ms"].append(1e3 * (middle - start))
        times["photo_ms"].append(1e3 * (time.perf_counter() - middle))
    return {**{name: float(np.median(found)) for name, found in times.items()}, "where": "towers"}
