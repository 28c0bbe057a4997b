"""Predictions: the scores of a fitted method for all queries, with the times."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.queries import Queries
from retrieval.methods.method import Method, sum_over_sets
from retrieval.model.encode import one_thread
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
