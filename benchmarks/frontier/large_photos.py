"""Photos as large as a phone's, decoded whole or at a fraction of their size by their own cosine transform."""

import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle

import numpy as np
from PIL import Image

from retrieval.data.images import decode, picture_size
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage
from retrieval.data.views import tile_views
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point, smallest_error
from retrieval.frontier.sample import Array, Sample
from retrieval.model.encode import encode_photos
from robot.sim.camera import PinholeCamera
from robot.sim.objects.draw import draw_object
from robot.sim.scene import Scene

PHOTOS, SIDE, SIZE = 12, 2048, (4000, 3000)
"""How many are drawn, so many pixels a side; then their sides are stretched to those of a phone's."""
FRACTIONS = (2, 4, 8)
QUALITY, LOWER = 92, 85
_SEED = 70_000
_NAME = "a drawn photo"
See = Callable[[bytes], RgbImage]


def reduced(sample: Sample) -> ApproximationResult:
    """How far views, logits and answers move, and the time of one photo."""
    count, side, size = (3, 256, (1600, 1200)) if sample.scale.quick else (PHOTOS, SIDE, SIZE)
    settings = sample.checkpoint.config.preprocessing
    pictures = [photographed(number, side).resize(size, Image.Resampling.LANCZOS) for number in range(count)]
    files, again = ([as_jpeg(picture, quality) for picture in pictures] for quality in (QUALITY, LOWER))
    points, ways = zip(*decoders(settings), strict=True)
    views = [[see(file) for file in files] for see in ways]
    points = time_points(points, [_seeing(see, files) for see in ways], sample.scale.repeats)
    return ApproximationResult(
        "Large photos: size at which they are decoded",
        f"{count} drawn photos, JPEG files of {size[0]:,} x {size[1]:,} pixels. A JPEG file can be decoded at 1/2, 1/4 "
        "or 1/8 of its size by its own cosine transform. With `reduced` among its preprocessing, as presets for new "
        "models have it, a model sees a photo decoded at the smallest of these that leaves its views two pixels a side "
        "for each of theirs, and learns from such photos: the errors here are those of a change afterwards. Tolerated "
        f"is what saving the photos at quality {LOWER} instead of {QUALITY} moves.",
        tuple(_panels(sample, points, views, [ways[0](file) for file in again])),
    )


def decoders(settings: Preprocessing) -> Iterator[tuple[Tradeoff, See]]:
    """(a point without its error, how it sees the bytes of a photo's file): whole first."""
    plain, needed = (dataclasses.replace(settings, reduced=each) for each in (False, True))

    def at(fraction: int, data: bytes) -> RgbImage:
        image = decode(data, _NAME, min(picture_size(data, _NAME)) // fraction)
        return tile_views(image, settings.views, settings.photo_px)

    fixed = "a fixed fraction"
    yield (
        Tradeoff(fixed, "whole", 0.0, is_default=not settings.reduced),
        lambda data: plain.photo_from_bytes(data, _NAME),
    )
    for fraction in FRACTIONS:
        yield Tradeoff(fixed, f"1/{fraction}", 0.0), partial(at, fraction)
    chosen = Tradeoff("reduced", "what the views need", 0.0, is_default=settings.reduced)
    yield chosen, lambda data: needed.photo_from_bytes(data, _NAME)


def _panels(
    sample: Sample, points: Sequence[Tradeoff], views: Sequence[Sequence[RgbImage]], again: Sequence[RgbImage]
) -> Iterator[Panel]:
    """views: of each point, the first of whole photos; again: of whole photos that were saved again."""
    whole, time = np.array(views[0]), "decoding one photo and cutting its views, one thread"
    logits = [_logits(sample, seen) for seen in (*views, again)]
    grey = [255 * float(np.abs(np.array(seen) - whole).mean()) for seen in (*views, again)]
    moved = [float(np.abs(each - logits[0]).mean()) for each in logits]
    first = [each.argmax(1) != logits[0].argmax(1) for each in logits]
    reference = "photos decoded whole"
    for title, unit, errors in (
        ("how far views move", "grey levels, mean", grey),
        ("how far match logits move", "nats, mean", moved),
    ):
        made = tuple(dataclasses.replace(point, error=error) for point, error in zip(points, errors[:-1], strict=True))
        yield Panel(title, time, unit, reference, float(f"{errors[-1]:.2g}"), made, smallest_error(made))
    flips = tuple(
        dataclasses.replace(
            miss_rate_point(point.series, point.setting, wrong, point.is_default), seconds=point.seconds
        )
        for point, wrong in zip(points, first[:-1], strict=True)
    )
    most = round(100 * float(first[-1].mean()), 2)
    yield Panel("another photo first", time, "% of touches", reference, most, flips, 100 / len(logits[0]))


def _logits(sample: Sample, views: Sequence[RgbImage]) -> Array:
    """(touches, photos)."""
    partials = encode_photos(sample.checkpoint.matcher, views).partial.numpy()
    return np.array([sample.logits(touch, partials) for touch in sample.queries["partial"]])


def _seeing(see: See, files: Sequence[bytes]) -> Callable[[], RgbImage]:
    """One photo after the other."""
    photos = cycle(files)
    return lambda: see(next(photos))


def photographed(number: int, side: int) -> Image.Image:
    """A scene of the simulated rig, by a camera of so many pixels a side that sees as much as the rig's."""
    camera = PinholeCamera(px=side, focal_px=PinholeCamera.focal_px * side / PinholeCamera.px)
    scene = Scene(draw_object(_SEED, number), camera=camera, seed=number, outputs={"photo"})
    return Image.fromarray(scene.run()["photo"])


def as_jpeg(picture: Image.Image, quality: int) -> bytes:
    """The picture as a JPEG file."""
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
