"""Predicting and scoring are two steps with a file between them: scores, and the digest of what made them."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.evaluation.queries import Queries
from retrieval.methods.base import Method, add_up
from retrieval.model.checkpoint import read_tensors, write_tensors
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
    chosen: dict[str, Any]
    seconds: dict[str, float]


@one_thread()
def predict(method: Method, features: Features, queries: Queries, fit_s: float) -> Predictions:
    """Scores of a fitted method, computed on one thread; `fit_s` is how long fitting took."""
    touch, photo = features.touch[queries.touches], features.photo[queries.photos]
    start = time.perf_counter()
    touch_codes = method.encode_touch(touch)
    touched = time.perf_counter()
    photo_codes = method.encode_photo(photo)
    encoded = time.perf_counter()
    scores = method.score(touch_codes, photo_codes)
    scored = time.perf_counter()
    sets = {size: _set_scores(method, scores, touch_codes, photo_codes, rows) for size, rows in queries.sets.items()}
    seconds = {
        "fit": fit_s,
        "encode_touch": (touched - start) / len(touch),
        "encode_photo": (encoded - touched) / len(photo),
        "score": (scored - encoded) / scores.size,
        "query": _query_s(method, touch[:1], photo_codes),
    }
    return Predictions(scores, sets, method.chosen, seconds)


def _set_scores(
    method: Method, single: Scores, touch_codes: Scores, photo_codes: Scores, sets: NDArray[np.int64]
) -> Scores:
    """Scores of sets; where a method adds up its scores of single touches, these are not computed again."""
    if type(method)._score_sets is not Method._score_sets:
        return method.score_sets(touch_codes, photo_codes, sets)
    return add_up(single, sets)


def _query_s(method: Method, touch: Scores, photo_codes: Scores, repeats: int = 5) -> float:
    """Median time of one touch against the whole gallery, its features given."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        method.score(method.encode_touch(touch), photo_codes)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def write_predictions(path: Path, predictions: Predictions, made_by: Mapping[str, Any]) -> None:
    """Write scores with what made them (JSON types: method, seed, digests of features and queries, ...)."""
    tensors = {"scores": torch.from_numpy(predictions.scores)}
    tensors |= {f"sets_{size}": torch.from_numpy(scores) for size, scores in predictions.set_scores.items()}
    header = {"made_by": dict(made_by), "chosen": predictions.chosen, "seconds": predictions.seconds}
    write_tensors(path, tensors, header)


def read_predictions(path: Path, made_by: Mapping[str, Any]) -> Predictions:
    """Read what `write_predictions` wrote. Raises BadInput for scores that something else made, CheckpointError for a
    file that is missing or damaged."""
    tensors, header = read_tensors(path)
    found = header.get("made_by", {})
    if other := sorted(key for key in found.keys() | made_by.keys() if found.get(key) != made_by.get(key)):
        raise BadInput(
            f"{path} holds predictions of another {other[0].replace('_', ' ')} than is to be scored; delete the file, "
            "and they are made again"
        )
    sets = {int(name.removeprefix("sets_")): tensors[name].numpy() for name in tensors if name != "scores"}
    return Predictions(tensors["scores"].numpy(), dict(sorted(sets.items())), header["chosen"], header["seconds"])
