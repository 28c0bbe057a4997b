"""Foreign pictures (not gel images), for training the gel check.

Synthetic pictures (plain, noise, clouds, ramps, stripes), photos, pieces of photos, and gel images in false colours.
"""

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np

from retrieval.data.resize import RgbImage

_Draw = Callable[[np.random.Generator, int], np.ndarray]


def draw_foreign(
    count: int, px: int, photos: Sequence[RgbImage], gels: Sequence[RgbImage], seed: int = 0
) -> Iterator[tuple[str, RgbImage]]:
    """Yield `count` foreign pictures (px, px, 3) float32 in 0..1, each with the name of its kind; kinds alternate.

    `photos` (H, W, 3) are resized and cut into pieces, `gels` (H, W, 3) recoloured; both may be empty. `px` is at
    least 8.
    """
    kinds: dict[str, _Draw] = dict(SYNTHETIC_KINDS)
    if len(photos):
        kinds |= {"photo": _of_one(photos, _whole), "piece of a photo": _of_one(photos, _piece)}
    if len(gels):
        kinds["false colours"] = _of_one(gels, _false_colours)
    names = list(kinds)
    for number in range(count):
        name = names[number % len(names)]
        picture = kinds[name](np.random.default_rng([seed, number]), px)
        yield name, np.ascontiguousarray(np.clip(picture, 0, 1), dtype=np.float32)


def _of_one(pictures: Sequence[RgbImage], change: Callable[[RgbImage, np.random.Generator, int], np.ndarray]) -> _Draw:
    """Return a function that changes a random one of the pictures."""
    return lambda rng, px: change(pictures[int(rng.integers(len(pictures)))], rng, px)


def _plain(rng: np.random.Generator, px: int) -> np.ndarray:
    """Draw a plain picture (black, white or coloured), with or without camera noise."""
    colour = [np.zeros(3), np.ones(3), rng.random(3)][min(int(rng.integers(4)), 2)]
    return np.asarray(colour + rng.normal(0, rng.choice([0.0, 0.002, 0.01, 0.02]), (px, px, 3)))


def _noise(rng: np.random.Generator, px: int) -> np.ndarray:
    """Draw independent squares of 1 to 16 pixels, coloured or grey."""
    side = -(-px // 2 ** int(rng.integers(5)))
    squares = rng.normal(0.5, rng.uniform(0.02, 0.5), (side, side, int(rng.choice([1, 3]))))
    return _resized(np.broadcast_to(squares, (side, side, 3)), px, cv2.INTER_NEAREST)


def _clouds(rng: np.random.Generator, px: int) -> np.ndarray:
    picture = np.full((px, px, 3), rng.uniform(0.1, 0.9))
    for side in rng.integers(2, 40, 3):
        picture += rng.uniform(0.02, 0.25) * _resized(rng.normal(size=(side, side, 3)), px, cv2.INTER_CUBIC)
    grey = rng.random() < 0.3
    return np.repeat(picture.mean(2, keepdims=True), 3, axis=2) if grey else picture


def _ramp(rng: np.random.Generator, px: int) -> np.ndarray:
    rows, columns = np.mgrid[:px, :px, :1][:2] / px - 0.5
    colour, down, right = rng.random((3, 3))
    return np.asarray(colour + rng.uniform(0.2, 2) * (rows * (down - 0.5) + columns * (right - 0.5)))


def _stripes(rng: np.random.Generator, px: int) -> np.ndarray:
    rows, columns = np.mgrid[:px, :px] / px
    angle, waves = rng.uniform(0, np.pi), rng.uniform(4, 50)
    wave = np.sin(2 * np.pi * waves * (rows * np.sin(angle) + columns * np.cos(angle)))
    weight = (np.sign(wave) if rng.random() < 0.5 else wave)[..., None] / 2 + 0.5
    one, other = rng.random((2, 3))
    return np.asarray(one + (other - one) * weight)


SYNTHETIC_KINDS: dict[str, _Draw] = {
    "plain": _plain,
    "noise": _noise,
    "clouds": _clouds,
    "ramp": _ramp,
    "stripes": _stripes,
}


def _whole(photo: RgbImage, rng: np.random.Generator, px: int) -> np.ndarray:
    """Resize the photo like a gel image, and make it lighter or darker."""
    return rng.uniform(0.5, 1.4) * _resized(photo, px, cv2.INTER_AREA)


def _piece(photo: RgbImage, rng: np.random.Generator, px: int) -> np.ndarray:
    """Cut a square of at least 0.3 of the photo's shorter side, and make it lighter or darker."""
    side = max(1, int(min(photo.shape[:2]) * rng.uniform(0.3, 1)))
    top, left = (int(rng.integers(length - side + 1)) for length in photo.shape[:2])
    return rng.uniform(0.5, 1.4) * _resized(photo[top : top + side, left : left + side], px, cv2.INTER_AREA)


def _false_colours(gel: RgbImage, rng: np.random.Generator, px: int) -> np.ndarray:
    """Return a gel image with exchanged, grey, negative, tinted or mixed channels, as if under other lamps."""
    picture = _resized(gel, px, cv2.INTER_AREA)
    other_orders = ((0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    change = int(rng.integers(5))
    if change == 0:
        return picture[..., other_orders[int(rng.integers(5))]]
    if change == 1:
        return np.repeat(picture.mean(2, keepdims=True), 3, axis=2) * rng.uniform(0.4, 1.6)
    if change == 2:
        return 1 - picture
    return picture * rng.uniform(0.2, 2, 3) if change == 3 else picture @ (np.eye(3) + rng.normal(0, 0.5, (3, 3)))


def _resized(picture: np.ndarray, px: int, interpolation: int) -> np.ndarray:
    return np.asarray(cv2.resize(np.ascontiguousarray(picture, np.float32), (px, px), interpolation=interpolation))
