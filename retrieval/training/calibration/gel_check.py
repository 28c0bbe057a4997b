"""Fit the gel check: is this a gel image, and does it show contact (`retrieval.model.gel_check`)?

The gel head is fitted on features of touches and no-contact frames of training objects and on foreign pictures:
synthetic ones (plain, noise, clouds, ramps, stripes), photos, and pieces of photos. The thresholds are chosen on
touches and no-contact frames of validation objects.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle, pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from retrieval.data.dataset import Grasp
from retrieval.data.images import read_rgb
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize
from retrieval.model.encode import Image, touch_features
from retrieval.model.fusion import GEL_CLASSES, MIN_RELATIVE_DEVIATION, GelHead, Matcher
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL, GelCheck, contact_level

FALSE_ALARM_RATE = 0.005
"""At most this fraction of validation gel images may be classified as foreign. At most this fraction of no-contact
frames may be classified as touches."""
MARGIN = 1.0
"""A threshold in log-odds is at least this much above the quantile of the validation images, because other gels differ
a little."""
LOW_CONTACT_RATE = 0.02
"""At least this fraction of validation touches is classified as no contact: the weakest carry little information."""
PENALTY = 0.02
"""Penalty on the squared weights of the check's linear layer, for features of unit variance. The penalty is smaller if
there are more foreign pictures."""
_MAX_PHOTOS, _PHOTO_PX = 400, 256
"""Largest number of photos for foreign pictures, and their shorter side in pixels."""


@dataclass(frozen=True)
class ForeignPictures:
    """The foreign pictures of a gel check.

    Attributes:
        count: Their number for fitting; half as many others test the check.
        margin: Margin of their threshold in log-odds (`MARGIN`).
    """

    count: int = 700
    margin: float = MARGIN


FOREIGN = ForeignPictures()
"""The foreign pictures of a user's own training."""


@dataclass(frozen=True, eq=False)
class GelCheckFeatures:
    """Features of the touch tower, on the CPU.

    Attributes:
        touch: (G, fingers, F) of touches.
        no_contact: (U, fingers, F) of no-contact frames; U = 0 if none are recorded.
        foreign: (N, F) of foreign pictures.
    """

    touch: Tensor
    no_contact: Tensor
    foreign: Tensor

    @classmethod
    def of(
        cls,
        matcher: Matcher,
        settings: Preprocessing,
        grasps: Sequence[Grasp],
        touches: Tensor,
        foreign: ForeignPictures,
        seed: int,
    ) -> "GelCheckFeatures":
        """Encode no-contact frames of grasps and foreign pictures, drawn from a seed.

        `touches` are the features (G, fingers * F) of the grasps' touches, perhaps with cells.
        """
        fingers = matcher.config.fingers
        frames = _no_contact_images(settings, grasps, fingers)
        rows = np.linspace(0, len(grasps) - 1, min(_MAX_PHOTOS, len(grasps))).round().astype(int)
        # Whole photos, not the model's views of them: a photo given instead of a gel image is mostly background.
        photos = [_small_photo(path) for row in rows for path in grasps[row].photos]
        # A touch needs one picture per finger, so each foreign picture is repeated.
        pictures = [[each] * fingers for _, each in draw_foreign(foreign.count, settings.touch_px, photos, seed)]
        pooled = matcher.touch_tower.feature_count

        def of_fingers(features: Tensor) -> Tensor:
            """Return the features (N, fingers, F) of each finger, without cells."""
            return features.cpu().reshape(len(features), fingers, -1)[..., :pooled]

        return cls(
            of_fingers(touches),
            of_fingers(touch_features(matcher, frames)) if frames else torch.zeros(0, fingers, pooled),
            of_fingers(touch_features(matcher, pictures))[:, 0],
        )


def _small_photo(path: Path) -> RgbImage:
    photo = read_rgb(path)
    factor = min(1.0, _PHOTO_PX / min(photo.shape[:2]))
    height, width = (round(factor * side) for side in photo.shape[:2])
    return resize(photo, (height, width))


def _no_contact_images(settings: Preprocessing, grasps: Sequence[Grasp], fingers: int) -> list[list[Image]]:
    """Return preprocessed no-contact frames.

    With background subtraction, the reference is the no-contact frame of the previous grasp, since a frame minus
    itself has no noise.
    """
    if settings.background == "none":
        frames = [grasp.backgrounds for grasp in grasps if len(grasp.backgrounds) == fingers]
        return [list(map(settings.load_touch, paths)) for paths in frames]
    return [list(map(settings.load_touch, second, first)) for first, second in _consecutive_frames(grasps)]


def _consecutive_frames(grasps: Iterable[Grasp]) -> Iterator[tuple[tuple[Path, ...], tuple[Path, ...]]]:
    """Yield the no-contact frames of two consecutive grasps of one object, which show the same gels."""
    for first, second in pairwise(grasps):
        if first.object_id == second.object_id and first.backgrounds and second.backgrounds:
            yield first.backgrounds, second.backgrounds


def fit_gel_head(fitting: GelCheckFeatures, penalty: float = PENALTY) -> GelHead:
    """Fit a softmax regression on standardised features, with equal weight for each class and an L2 penalty.

    Without no-contact frames, the head never predicts that class.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import

    parts = fitting.touch.flatten(0, 1), fitting.no_contact.flatten(0, 1), fitting.foreign
    kinds = [part.double().numpy() for part in parts]
    counts = np.array([len(part) for part in kinds])
    x, labels = np.concatenate(kinds), np.repeat(np.arange(len(GEL_CLASSES)), counts)
    centre, spread = x.mean(0), x.std(0)
    spread = np.maximum(spread, MIN_RELATIVE_DEVIATION * np.abs(centre))  # the same standardisation as in the matcher
    spread = np.where(spread > 1e-6, spread, 1.0)
    present = np.flatnonzero(counts)
    two = len(present) == 2  # then scikit-learn fits the difference of two opposite rows: half of their penalty
    model = LogisticRegression(C=(2 if two else 1) / penalty, tol=1e-6, max_iter=15_000)
    model.fit((x - centre) / spread, labels, 1 / counts[labels] / len(present))
    rows = np.array([[-0.5], [0.5]]) if two else np.eye(len(present))
    matrix, bias = np.zeros((len(GEL_CLASSES), x.shape[1])), np.full(len(GEL_CLASSES), -1e4)
    matrix[present], bias[present] = rows @ model.coef_ / spread, rows @ model.intercept_
    head = GelHead(x.shape[1])
    with torch.no_grad():
        head.classifier.weight.copy_(torch.from_numpy(matrix))
        head.classifier.bias.copy_(torch.from_numpy(bias - matrix @ centre))
    return head.eval()


def contact_levels(grasps: Sequence[Grasp]) -> tuple[list[float], list[float]]:
    """Return the contact levels, in grey levels, of no-contact frames and of touches; empty without such frames.

    A no-contact frame is compared with the one of the previous grasp, a touch with its own no-contact frame. The level
    of a grasp is the largest level of its fingers.
    """
    touched = [_largest_level(grasp.touches, grasp.backgrounds) for grasp in grasps if grasp.backgrounds]
    return [_largest_level(second, first) for first, second in _consecutive_frames(grasps)], touched


def _largest_level(images: Sequence[Path], frames: Sequence[Path]) -> float:
    pairs = zip(images, frames, strict=True)
    return max(contact_level(read_rgb(image), read_rgb(frame)) for image, frame in pairs)


@torch.inference_mode()
def fit_gel_check(
    head: GelHead,
    test: GelCheckFeatures,
    levels: tuple[Sequence[float], Sequence[float]],
    margin: float = MARGIN,
) -> GelCheck:
    """Return the check with thresholds from validation pictures and `contact_levels`, and the fractions it rejects.

    The logit of a grasp is the highest logit of its fingers. `margin` is that of the threshold of foreign pictures.
    """
    touch, no_contact = head(test.touch).numpy(), head(test.no_contact).numpy()  # (G, fingers, 2)
    foreign = head(test.foreign[:, None]).numpy()
    gels = np.concatenate([touch, no_contact])[..., 0].max(1)
    check = GelCheck(
        foreign_above=float(np.quantile(gels, 1 - FALSE_ALARM_RATE)) + margin,
        contact_above=contact_threshold(no_contact[..., 1].max(1) + MARGIN, touch[..., 1].max(1))
        if len(no_contact)
        else None,
        level_above=contact_threshold(*levels) if all(map(len, levels)) else None,
        rates={},
    )
    rates = {
        "touches_rejected_as_foreign": _fraction(check.classify(touch), NOT_A_GEL),
        "touches_rejected_as_no_contact": _fraction(check.classify(touch), NO_CONTACT),
        "foreign_rejected": _fraction(check.classify(foreign), NOT_A_GEL),
    }
    if len(no_contact):
        rates["no_contact_accepted"] = _fraction(check.classify(no_contact), CONTACT)
    return dataclasses.replace(check, rates=rates)


def contact_threshold(no_contact: ArrayLike, touch: ArrayLike) -> float:
    """Return the threshold between values of no-contact frames and of touches (n,).

    At most `FALSE_ALARM_RATE` of the no-contact values lie above it; if it can be higher, until `LOW_CONTACT_RATE` of
    the touches lie below it.
    """
    low, high = np.asarray(no_contact, dtype=np.float64), np.asarray(touch, dtype=np.float64)
    return float(max(np.quantile(low, 1 - FALSE_ALARM_RATE), np.quantile(high, LOW_CONTACT_RATE)))


def _fraction(verdicts: Sequence[str], name: str) -> float:
    return verdicts.count(name) / len(verdicts)


# Foreign pictures ------------------------------------------------------------------------------------------


def draw_foreign(count: int, px: int, photos: Sequence[RgbImage], seed: int = 0) -> Iterator[tuple[str, RgbImage]]:
    """Yield `count` foreign pictures (px, px, 3) float32 in 0..1, each with the name of its kind; kinds alternate.

    `photos` (H, W, 3) are resized and cut into pieces; they may be empty. `px` is at least 8.
    """
    names = [*SYNTHETIC_KINDS, *(PHOTO_KINDS if photos else ())]
    for number, name in zip(range(count), cycle(names), strict=False):
        rng = np.random.default_rng([seed, number])
        if name in SYNTHETIC_KINDS:
            picture = SYNTHETIC_KINDS[name](rng, px)
        else:
            picture = PHOTO_KINDS[name](rng, px, photos[int(rng.integers(len(photos)))])
        yield name, np.ascontiguousarray(np.clip(picture, 0, 1), dtype=np.float32)


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


def _whole(rng: np.random.Generator, px: int, photo: RgbImage) -> np.ndarray:
    """Resize the photo like a gel image, and make it lighter or darker."""
    return rng.uniform(0.5, 1.4) * _resized(photo, px, cv2.INTER_AREA)


def _piece(rng: np.random.Generator, px: int, photo: RgbImage) -> np.ndarray:
    """Cut a square of at least 0.3 of the photo's shorter side, and make it lighter or darker."""
    side = max(1, int(min(photo.shape[:2]) * rng.uniform(0.3, 1)))
    top, left = (int(rng.integers(length - side + 1)) for length in photo.shape[:2])
    return rng.uniform(0.5, 1.4) * _resized(photo[top : top + side, left : left + side], px, cv2.INTER_AREA)


SYNTHETIC_KINDS = {"plain": _plain, "noise": _noise, "clouds": _clouds, "ramp": _ramp, "stripes": _stripes}
PHOTO_KINDS = {"photo": _whole, "piece of a photo": _piece}


def _resized(picture: np.ndarray, px: int, interpolation: int) -> np.ndarray:
    return np.asarray(cv2.resize(np.ascontiguousarray(picture, np.float32), (px, px), interpolation=interpolation))
