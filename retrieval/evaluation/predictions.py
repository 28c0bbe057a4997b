"""Predicting and scoring are two steps with a file between them: scores, and the digest of what made them."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.evaluation.cache import CacheKey, read_cached, write_cached
from retrieval.evaluation.queries import Queries
from retrieval.methods.method import Method, sum_over_sets
from retrieval.model.encode import one_thread
from retrieval.training.features import Features

Scores = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Predictions:
    """What a method says of all queries.

    scores (Q, P): touches with photos; set_scores: by number of grasps, (S, P) of sets with photos. chosen: what the
    method chose on validation objects. seconds: how long things took; no result depends on it.
    """

    scores: Scores
    set_scores: dict[int, Scores]
    best_params: dict[str, Any]
    seconds: dict[str, float]


@one_thread()
def predict(method: Method, features: Features, queries: Queries, fit_s: float) -> Predictions:
    """Scores of a fitted method, computed on one thread; `fit_s` is how long fitting took."""
    touch, photo = features.touch[queries.touches], features.photo[queries.photos]
    start = time.perf_counter()
    touch_encodings = method.encode_touch(touch)
    touched = time.perf_counter()
    photo_encodings = method.encode_photo(photo)
    encoded = time.perf_counter()
    scores = method.score(touch_encodings, photo_encodings)
    scored = time.perf_counter()
    if type(method)._score_sets is Method._score_sets:  # it adds up scores of single touches: these are there
        sets = {size: sum_over_sets(scores, rows) for size, rows in queries.sets.items()}
    else:
        sets = {size: method.score_sets(touch_encodings, photo_encodings, rows) for size, rows in queries.sets.items()}
    seconds = {
        "fit": fit_s,
        "encode_touch": (touched - start) / len(touch),
        "encode_photo": (encoded - touched) / len(photo),
        "score": (scored - encoded) / scores.size,
        "query": _query_s(method, touch[:1], photo_encodings),
    }
    return Predictions(scores, sets, method.best_params, seconds)


def _query_s(method: Method, touch: Scores, photo_encodings: Scores, repeats: int = 5) -> float:
    """Median time of one touch against the whole gallery, its features given."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        method.score(method.encode_touch(touch), photo_encodings)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def write_predictions(path: Path, predictions: Predictions, cache_key: CacheKey) -> None:
    """Write scores with what made them (method, seed, digests of features and queries, ...)."""
    tensors = {"scores": torch.from_numpy(predictions.scores)}
    tensors |= {f"sets_{size}": torch.from_numpy(scores) for size, scores in predictions.set_scores.items()}
    write_cached(path, cache_key, tensors, {"best_params": predictions.best_params, "seconds": predictions.seconds})


def read_predictions(path: Path, cache_key: CacheKey) -> Predictions | None:
    """Read what `write_predictions` wrote; None where it is missing, damaged, or made by something else."""
    if (kept := read_cached(path, cache_key)) is None:
        return None
    tensors, header = kept
    sets = {int(name.removeprefix("sets_")): tensors[name].numpy() for name in tensors if name != "scores"}
    return Predictions(tensors["scores"].numpy(), dict(sorted(sets.items())), header["best_params"], header["seconds"])
