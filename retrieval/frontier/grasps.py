"""Number of grasps of the object in a query: top-1 error against the time of the query."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from retrieval.frontier.clock import time_points
from retrieval.frontier.pixels import SLACK, load_touch
from retrieval.frontier.points import ApproximationResult, Panel, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.model.encode import encode_touches

COUNTS = (1, 2, 3, 4, 5, 8)


def grasps(sample: Sample) -> ApproximationResult:
    """Measure queries of several grasps, whose logits are added."""
    owner = sample.owner[sample.touch_rows]
    max_count = int(np.unique(owner, return_counts=True)[1].min())
    codes = sample.touch_encodings(sample.touch_rows)["partial"]
    table = np.array([sample.logits(touch_partial, sample.real_photo_codes["partial"]) for touch_partial in codes])
    counts = [count for count in COUNTS if count <= max_count]
    points = [
        miss_rate_point(
            "",
            f"{count} grasp{'s' * (count > 1)}",
            _wrong(sample, table, _next_rows_of_object(owner, count), owner),
            count == 1,
        )
        for count in counts
    ]
    points = list(time_points(points, [partial(_query, sample, count) for count in counts], sample.scale.repeats))
    panel = Panel(
        title="top-1 error by number of grasps",
        time="decoding and encoding the touches and scoring every photo, one thread",
        unit="% of queries",
        reference=f"the object in the hand, one of {len(np.unique(owner))}",
        tolerance=round(min(point.error for point in points) + SLACK, 1),
        points=tuple(points),
        resolution=100 / len(owner),
    )
    return ApproximationResult(
        "Grasps of one object",
        "The logits of several grasps of the object in the hand are added. Every touch starts one set with the next "
        "touches of its object. The time is computing time; the arm needs longer.",
        (panel,),
    )


def _wrong(sample: Sample, table: Array, sets: NDArray[np.int64], owner: NDArray[np.int64]) -> NDArray[np.bool_]:
    photo_owner = sample.owner[sample.photo_rows]
    summed = table[sets].sum(1, dtype=np.float64)
    return np.asarray(photo_owner[summed.argmax(1)] != owner)


def _query(sample: Sample, count: int) -> Array:
    settings = sample.checkpoint.config.preprocessing
    touches = [load_touch(settings, sample.grasps[row]) for row in sample.touch_rows[:count]]
    return sample.logits(
        encode_touches(sample.checkpoint.matcher, touches).partial.numpy(), sample.real_photo_codes["partial"]
    )


def _next_rows_of_object(owner: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return (n, count): each row and the next rows of its object, cyclically."""
    groups = np.empty((len(owner), count), dtype=np.int64)
    for name in np.unique(owner):
        rows = np.flatnonzero(owner == name)
        groups[rows] = rows[(np.arange(len(rows))[:, None] + np.arange(count)) % len(rows)]
    return groups
