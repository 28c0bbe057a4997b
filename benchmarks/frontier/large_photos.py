"""Large photos, decoded at full size or at a fraction of their size by the JPEG cosine transform."""

import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle

import numpy as np
from PIL import Image

from retrieval.data.images import decode, picture_size
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, to_float
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.model.encode import encode_photos
from robot.sim.camera import PinholeCamera
from robot.sim.objects.draw import draw_object
from robot.sim.scene import Scene

PHOTOS, SIDE, SIZE = 12, 2048, (4000, 3000)
"""Number of photos and their side in pixels; they are then resized to a phone's photo size."""
FRACTIONS = (2, 4, 8)
QUALITY, LOWER = 92, 85
_SEED = 70_000
_NAME = "a simulated photo"
Decoder = Callable[[bytes], RgbImage]


def reduced(sample: Sample) -> ApproximationResult:
    """Measure the change of views, logits and answers, and the time of one photo."""
    count, side, size = (3, 256, (1600, 1200)) if sample.scale.quick else (PHOTOS, SIDE, SIZE)
    settings = sample.checkpoint.config.preprocessing
    pictures = [photographed(number, side).resize(size, Image.Resampling.LANCZOS) for number in range(count)]
    files, again = ([as_jpeg(picture, quality) for picture in pictures] for quality in (QUALITY, LOWER))
    points, decode_functions = zip(*decoders(settings), strict=True)
    views = [[load(file) for file in files] for load in decode_functions]
    points = time_points(points, [_load_next(load, files) for load in decode_functions], sample.scale.repeats)
    return ApproximationResult(
        "Large photos: size at which they are decoded",
        f"{count} simulated photos, JPEG files of {size[0]:,} x {size[1]:,} pixels. A JPEG file can be decoded at 1/2, "
        "1/4 or 1/8 of its size by its own cosine transform. With `reduced` in its preprocessing, as in the presets "
        "for new models, a model receives a photo decoded at the smallest of these sizes that has two pixels a side "
        "for each pixel of a view, and is trained on such photos. The errors here are those of a change after "
        f"training. The tolerance is the effect of saving the photos at quality {LOWER} instead of {QUALITY}.",
        tuple(_panels(sample, points, views, [decode_functions[0](file) for file in again])),
    )


def decoders(settings: Preprocessing) -> Iterator[tuple[Tradeoff, Decoder]]:
    """Yield (a point without its error, its decoder from the bytes of a photo's file): full size first."""
    plain, needed = (dataclasses.replace(settings, reduced=each) for each in (False, True))

    def at(fraction: int, data: bytes) -> RgbImage:
        image = decode(data, _NAME, min(picture_size(data, _NAME)) // fraction)
        return settings.photo(to_float(image))

    fixed = "a fixed fraction"
    yield (
        Tradeoff(fixed, "whole", 0.0, is_default=not settings.reduced),
        lambda data: plain.photo_from_bytes(data, _NAME).views,
    )
    for fraction in FRACTIONS:
        yield Tradeoff(fixed, f"1/{fraction}", 0.0), partial(at, fraction)
    chosen = Tradeoff("reduced", "what the views need", 0.0, is_default=settings.reduced)
    yield chosen, lambda data: needed.photo_from_bytes(data, _NAME).views


def _panels(
    sample: Sample, points: Sequence[Tradeoff], views: Sequence[Sequence[RgbImage]], again: Sequence[RgbImage]
) -> Iterator[Panel]:
    """Yield the panels.

    Args:
        sample: the sample.
        points: the settings, with their times.
        views: views of each point, first those of photos decoded at full size.
        again: views of photos that were saved again, decoded at full size.
    """
    whole, time = np.array(views[0]), "decoding one photo and cropping its views, one thread"
    logits = [_logits(sample, images) for images in (*views, again)]
    grey = [255 * float(np.abs(np.array(images) - whole).mean()) for images in (*views, again)]
    logit_changes = [float(np.abs(each - logits[0]).mean()) for each in logits]
    first = [each.argmax(1) != logits[0].argmax(1) for each in logits]
    reference = "photos decoded whole"
    for title, unit, errors in (
        ("change of views", "grey levels, mean", grey),
        ("change of match logits", "nats, mean", logit_changes),
    ):
        made = tuple(dataclasses.replace(point, error=error) for point, error in zip(points, errors[:-1], strict=True))
        yield Panel(title, time, unit, reference, float(f"{errors[-1]:.2g}"), made)
    flips = tuple(
        dataclasses.replace(
            miss_rate_point(point.series, point.setting, wrong, point.is_default), seconds=point.seconds
        )
        for point, wrong in zip(points, first[:-1], strict=True)
    )
    tolerance = round(100 * float(first[-1].mean()), 2)
    yield Panel("another photo ranked first", time, "% of touches", reference, tolerance, flips)


def _logits(sample: Sample, views: Sequence[RgbImage]) -> Array:
    """Return match logits (touches, photos)."""
    partials = encode_photos(sample.checkpoint.matcher, views).partial.numpy()
    return np.array([sample.logits(touch, partials) for touch in sample.queries["partial"]])


def _load_next(load: Decoder, files: Sequence[bytes]) -> Callable[[], RgbImage]:
    """Return a function that decodes one photo after the other."""
    photos = cycle(files)
    return lambda: load(next(photos))


def photographed(number: int, side: int) -> Image.Image:
    """Photograph a scene of the simulated rig with this many pixels a side and the rig's field of view."""
    camera = PinholeCamera(px=side, focal_px=PinholeCamera.focal_px * side / PinholeCamera.px)
    scene = Scene(draw_object(_SEED, number), camera=camera, seed=number, outputs={"photo"})
    return Image.fromarray(scene.run()["photo"])


def as_jpeg(picture: Image.Image, quality: int) -> bytes:
    """Encode the picture as a JPEG file."""
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
