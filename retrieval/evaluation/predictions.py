"""Prediction files: the scores of a method, with a digest of all inputs that determine them."""

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
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.features import Features

Scores = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Predictions:
    """Scores of a method for all queries.

    Attributes:
        scores: (Q, P) of touches with photos.
        set_scores: By number of grasps, (S, P) of sets of grasps with photos.
        best_params: Parameters that the method selected on validation objects.
        seconds: Run times; no result depends on them.
    """

    scores: Scores
    set_scores: dict[int, Scores]
    best_params: dict[str, Any]
    seconds: dict[str, float]


def scored_touches(queries: Queries, predictions: Predictions, part: str) -> ScoredTouches:
    """Return the scores of the touches with the photos of one part ("train", "validation" or "test")."""
    touches, photos = queries.of_part(queries.touch_owner, part), queries.of_part(queries.photo_owner, part)
    return ScoredTouches(
        predictions.scores[np.ix_(touches, photos)],
        queries.touch_owner[touches],
        queries.photo_owner[photos],
        queries.own_photo[touches][:, None] == photos,
    )


@one_thread()
def predict(method: Method, features: Features, queries: Queries, fit_s: float) -> Predictions:
    """Return the scores of a fitted method, computed on one thread.

    Args:
        method: The fitted method.
        features: Tower features of all grasps.
        queries: Touches and photos to score.
        fit_s: Seconds that fitting took.
    """
    touch, photo = features.touch[queries.touches], features.photo[queries.photos]
    start = time.perf_counter()
    touch_encodings = method.encode_touch(touch)
    touches_done = time.perf_counter()
    photo_encodings = method.encode_photo(photo)
    photos_done = time.perf_counter()
    scores = method.score(touch_encodings, photo_encodings)
    scores_done = time.perf_counter()
    if type(method)._score_sets is Method._score_sets:  # the sum of single scores, which are computed
        sets = {size: sum_over_sets(scores, rows) for size, rows in queries.sets.items()}
    else:
        sets = {size: method.score_sets(touch_encodings, photo_encodings, rows) for size, rows in queries.sets.items()}
    seconds = {
        "fit": fit_s,
        "encode_touch": (touches_done - start) / len(touch),
        "encode_photo": (photos_done - touches_done) / len(photo),
        "score": (scores_done - photos_done) / scores.size,
        "query": _query_s(method, touch[:1], photo_encodings),
    }
    return Predictions(scores, sets, method.best_params, seconds)


def _query_s(method: Method, touch: Scores, photo_encodings: Scores, repeats: int = 5) -> float:
    """Return the median time of one touch against the whole gallery, from its features."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        method.score(method.encode_touch(touch), photo_encodings)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def write_predictions(path: Path, predictions: Predictions, cache_key: CacheKey) -> None:
    """Write scores with the digest of their inputs (method, seed, features, queries, ...)."""
    tensors = {"scores": torch.from_numpy(predictions.scores)}
    tensors |= {f"sets_{size}": torch.from_numpy(scores) for size, scores in predictions.set_scores.items()}
    write_cached(path, cache_key, tensors, {"best_params": predictions.best_params, "seconds": predictions.seconds})


def read_predictions(path: Path, cache_key: CacheKey) -> Predictions | None:
    """Return the predictions in a file; None if it is missing, damaged, or has another key."""
    if (stored := read_cached(path, cache_key)) is None:
        return None
    tensors, header = stored
    sets = {int(name.removeprefix("sets_")): tensors[name].numpy() for name in tensors if name != "scores"}
    return Predictions(tensors["scores"].numpy(), dict(sorted(sets.items())), header["best_params"], header["seconds"])
