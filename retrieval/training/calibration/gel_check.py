"""Fit the gel check: is this a gel image, and does it show contact (`retrieval.model.gel_check`)?

The gel head is fitted on features of touches and no-contact frames of training objects and on foreign pictures. The
thresholds are chosen on touches and no-contact frames of validation objects.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from retrieval.data.dataset import Grasp
from retrieval.data.images import read_rgb
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize
from retrieval.model.encode import Image, touch_features
from retrieval.model.fusion import GEL_CLASSES, MIN_RELATIVE_DEVIATION, GelHead, Matcher
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL, GelCheck, contact_level
from retrieval.training.foreign_images import draw_foreign

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
"""Largest number of photos, and of gel images, for foreign pictures; shorter side of these photos in pixels."""

Readings = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class GelCheckFeatures:
    """Features of the touch tower, on the CPU.

    Attributes:
        touch: (G, fingers, F) of touches.
        no_contact: (U, fingers, F) of no-contact frames; U = 0 if none are recorded.
        foreign: (N, F) of foreign pictures.
        is_plainly_foreign: (N,) False for gel images in false colours.
    """

    touch: Tensor
    no_contact: Tensor
    foreign: Tensor
    is_plainly_foreign: NDArray[np.bool_]

    @classmethod
    def of(
        cls, matcher: Matcher, settings: Preprocessing, grasps: Sequence[Grasp], touches: Tensor, count: int, seed: int
    ) -> "GelCheckFeatures":
        """Encode no-contact frames of grasps and `count` foreign pictures, drawn from a seed.

        `touches` are the features (G, fingers * F) of the grasps' touches, perhaps with cells.
        """
        fingers = matcher.config.fingers
        frames = _no_contact_images(settings, grasps, fingers)
        rows = np.linspace(0, len(grasps) - 1, min(_MAX_PHOTOS, len(grasps))).round().astype(int)
        sample = [grasps[row] for row in rows]
        # Whole photos, not the model's views of them: a photo given instead of a gel image is mostly background.
        photos = [_small_photo(grasp.photo) for grasp in sample]
        gels = [settings.load_touch(grasp.touches[0], *grasp.backgrounds[:1]) for grasp in sample]
        names, drawn = zip(*draw_foreign(count, settings.touch_px, photos, gels, seed), strict=True)
        pooled = matcher.touch_tower.feature_count

        def of_fingers(features: Tensor) -> Tensor:
            """Return the features (N, fingers, F) of each finger, without cells."""
            return features.cpu().reshape(len(features), fingers, -1)[..., :pooled]

        return cls(
            of_fingers(touches),
            of_fingers(touch_features(matcher, frames)) if frames else torch.zeros(0, fingers, pooled),
            # A touch needs one picture per finger, so each foreign picture is repeated.
            of_fingers(touch_features(matcher, [[picture] * fingers for picture in drawn]))[:, 0],
            np.array([name != "false colours" for name in names]),
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
    from scipy.optimize import minimize

    kinds = [part.reshape(-1, part.shape[-1]).double().numpy() for part in (fitting.touch, fitting.no_contact)]
    kinds.append(fitting.foreign.double().numpy())
    x, labels = np.concatenate(kinds), np.repeat(np.arange(len(GEL_CLASSES)), [len(part) for part in kinds])
    centre, spread = x.mean(0), x.std(0)
    spread = np.maximum(spread, MIN_RELATIVE_DEVIATION * np.abs(centre))  # the same standardisation as in the matcher
    spread = np.where(spread > 1e-6, spread, 1.0)
    x = (x - centre) / spread
    present = np.array([len(part) > 0 for part in kinds])
    weights = np.array([1 / len(part) if len(part) else 0.0 for part in kinds])[labels] / present.sum()
    targets, absent = np.eye(len(GEL_CLASSES))[labels], np.where(present, 0.0, -1e4)

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        matrix = flat.reshape(-1, len(GEL_CLASSES))
        logits = x @ matrix[:-1] + matrix[-1] + absent
        logs = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
        residuals = weights[:, None] * (np.exp(logs) - targets)
        value = -float(weights @ (logs * targets).sum(1)) + penalty / 2 * float((matrix[:-1] ** 2).sum())
        return value, np.vstack([x.T @ residuals + penalty * matrix[:-1], residuals.sum(0)]).ravel()

    found = minimize(loss, np.zeros((x.shape[1] + 1) * len(GEL_CLASSES)), jac=True, method="L-BFGS-B")
    matrix = found.x.reshape(-1, len(GEL_CLASSES))
    head = GelHead(x.shape[1])
    with torch.no_grad():
        head.classifier.weight.copy_(torch.from_numpy((matrix[:-1] / spread[:, None]).T))
        head.classifier.bias.copy_(torch.from_numpy(matrix[-1] - (centre / spread) @ matrix[:-1] + absent))
    return head.eval()


def contact_levels(grasps: Sequence[Grasp]) -> tuple[list[float], list[float]]:
    """Return the contact levels, in grey levels, of no-contact frames and of touches; empty without such frames.

    A no-contact frame is compared with the one of the previous grasp, a touch with its own no-contact frame. The level
    of a grasp is the largest level of its fingers.
    """
    no_contact = [_largest_level(second, first) for first, second in _consecutive_frames(grasps)]
    touched = [_largest_level(grasp.touches, grasp.backgrounds) for grasp in grasps if grasp.backgrounds]
    return no_contact, touched


def _largest_level(images: Sequence[Path], frames: Sequence[Path]) -> float:
    pairs = zip(images, frames, strict=True)
    return max(contact_level(read_rgb(image), read_rgb(frame)) for image, frame in pairs)


@torch.inference_mode()
def fit_gel_check(head: GelHead, test: GelCheckFeatures, levels: tuple[Sequence[float], Sequence[float]]) -> GelCheck:
    """Return the check with thresholds from validation pictures and `contact_levels`, and the fractions it rejects.

    The logit of a grasp is the highest logit of its fingers.
    """
    touch, no_contact = head(test.touch).numpy(), head(test.no_contact).numpy()  # (G, fingers, 2)
    foreign: Readings = head(test.foreign[:, None]).numpy()
    gels = np.concatenate([touch, no_contact])[..., 0].max(1)
    check = GelCheck(
        foreign_above=float(np.quantile(gels, 1 - FALSE_ALARM_RATE)) + MARGIN,
        contact_above=contact_threshold(no_contact[..., 1].max(1) + MARGIN, touch[..., 1].max(1))
        if len(no_contact)
        else None,
        level_above=contact_threshold(*levels) if all(map(len, levels)) else None,
        rates={},
    )
    rates = {
        "touches_rejected_as_foreign": _fraction(check.classify(touch), NOT_A_GEL),
        "touches_rejected_as_no_contact": _fraction(check.classify(touch), NO_CONTACT),
        "foreign_rejected": _fraction(check.classify(foreign[test.is_plainly_foreign]), NOT_A_GEL),
    }
    if len(no_contact):
        rates["no_contact_accepted"] = _fraction(check.classify(no_contact), CONTACT)
    return dataclasses.replace(check, rates=rates)


def contact_threshold(no_contact: ArrayLike, touch: ArrayLike) -> float:
    """Return the threshold between values of no-contact frames and of touches.

    At most `FALSE_ALARM_RATE` of the no-contact values lie above it; if it can be higher, until `LOW_CONTACT_RATE` of
    the touches lie below it.
    """
    low, high = np.asarray(no_contact, dtype=np.float64), np.asarray(touch, dtype=np.float64)
    return float(max(np.quantile(low, 1 - FALSE_ALARM_RATE), np.quantile(high, LOW_CONTACT_RATE)))


def _fraction(verdicts: Sequence[str], name: str) -> float:
    return verdicts.count(name) / len(verdicts)
