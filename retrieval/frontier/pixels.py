"""Input size of the towers: top-1 error against the time to encode one image."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.data.preprocessing import Preprocessing
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.model.encode import encode_photos, encode_touches

SIZE_RATIOS = (0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0, 1.25, 1.5)
"""Image sizes to measure, relative to the size that the model was trained with."""
SLACK = 2.0
"""Tolerated increase of the top-1 error over the trained size, percent of queries."""


def image_size(sample: Sample) -> ApproximationResult:
    """Measure image sizes: the towers accept any size, but were trained with one."""
    settings, query_rows = sample.checkpoint.config.preprocessing, sample.touch_rows[: sample.scale.touches]
    touched, photographed = ([sample.grasps[row] for row in rows] for rows in (query_rows, sample.photo_rows))
    touches, photos = partial(_encode_touches, sample), partial(_encode_photos, sample)
    trained_touches = sample.touch_encodings(query_rows)["partial"]
    return ApproximationResult(
        "Image size",
        "Gel images or photos are resized before encoding; the other modality has the size that the model was trained "
        "with. A query is one touch, and the gallery contains the photos of all unseen objects.",
        (
            _panel(
                sample,
                "gel images",
                settings.touch_px,
                lambda px: (touches(touched, px), sample.real_photo_codes["partial"]),
                partial(touches, touched[:1]),
            ),
            _panel(
                sample,
                "photos",
                settings.photo_px,
                lambda px: (trained_touches, photos(photographed, px)),
                partial(photos, photographed[:1]),
            ),
        ),
    )


def _panel(
    sample: Sample,
    images: str,
    trained: int,
    partials: Callable[[int], tuple[Array, Array]],
    encode_one: Callable[[int], object],
) -> Panel:
    sizes = sorted(
        {16 * round(ratio * trained / 16) for ratio in ((0.5, 1.0) if sample.scale.quick else SIZE_RATIOS)} | {trained}
    )
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    with Bar(f"sizes of {images}", len(sizes), "sizes", quiet=sample.quiet) as bar:
        for px in sizes:
            touches, photos = partials(px)
            points.append(miss_rate_point("", f"{px} px", _wrong(sample, touches, photos), px == trained))
            works.append(partial(encode_one, px))
            bar.advance()
    points = list(time_points(points, works, sample.scale.repeats))
    at_trained = next(point.error for point in points if point.is_default)
    return Panel(
        title=f"top-1 error by size of {images}",
        time=f"decoding and encoding one {'touch' if images == 'gel images' else 'photo'}, one thread",
        unit="% of queries",
        reference=f"the object in the hand, one of {len(np.unique(sample.owner))}",
        tolerance=round(at_trained + SLACK, 1),
        points=tuple(points),
        resolution=100 / len(touches),
    )


def _wrong(sample: Sample, touches: Array, photos: Array) -> NDArray[np.bool_]:
    best = np.array([int(sample.logits(touch_partial, photos).argmax()) for touch_partial in touches])
    return np.asarray(sample.owner[sample.photo_rows][best] != sample.owner[sample.touch_rows[: len(best)]])


def _encode_touches(sample: Sample, grasps: Sequence[Grasp], px: int) -> Array:
    settings = dataclasses.replace(sample.checkpoint.config.preprocessing, touch_px=px)
    images = (load_touch(settings, grasp) for grasp in grasps)
    return encode_touches(sample.checkpoint.matcher, images, 16).partial.numpy()


def load_touch(settings: Preprocessing, grasp: Grasp) -> list[Array]:
    """Return the preprocessed images of one touch, one per finger."""
    without = settings.background == "none"
    references = [None] * len(grasp.touches) if without else grasp.backgrounds
    return [settings.load_touch(*pair) for pair in zip(grasp.touches, references, strict=True)]


def _encode_photos(sample: Sample, grasps: Sequence[Grasp], px: int) -> Array:
    settings = dataclasses.replace(sample.checkpoint.config.preprocessing, photo_px=px)
    images = (settings.load_photo(grasp.photo) for grasp in grasps)
    return encode_photos(sample.checkpoint.matcher, images).partial.numpy()
