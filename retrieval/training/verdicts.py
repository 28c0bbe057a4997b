"""What a checkpoint needs beyond its ranking, fitted when its training is over: a posterior, and a check of touches.

The posterior (`retrieval.model.posterior`) is fitted on touches and photos of validation objects. The check
(`retrieval.model.fusion_scorer`) reads the touch tower's features: its linear layer is fitted on touches and untouched gels
of training objects and on foreign pictures, its thresholds on those of validation objects.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, touch_features
from retrieval.model.fusion import GEL_CLASSES, MIN_RELATIVE_DEVIATION, GelHead, Matcher, scorer_of
from retrieval.model.fusion_scorer import CONTACT, NO_CONTACT, NOT_A_GEL, GelCheck, contact_level
from retrieval.model.posterior import ScoredTouches, fit_posterior
from retrieval.model.reference_calibration import ReferenceTouches, fit_reference_calibration, touch_embeddings
from retrieval.training.batches import FeatureSource, recorded_features
from retrieval.training.foreign_images import draw_foreign

MAX_GRASPS = 400
"""Grasps, at most, that each part of the split gives."""
MIN_GRASPS = 40
"""Validation grasps that a check of touches needs: the thresholds of fewer would refuse too many others."""
FOREIGN_COUNT = 700
"""Foreign pictures to learn from; others, half as many, are judged."""
FALSE_ALARM_RATE = 0.005
"""Share of validation gels that may be called foreign, and of untouched ones that may be called touches."""
MARGIN = 1.0
"""Log-odds beyond that, for both: gels that were not recorded differ a little."""
LOW_CONTACT_RATE = 0.02
"""Share of validation touches that may be called untouched: those that hardly press the gel say hardly anything."""
PENALTY = 0.02
"""Of the squared weights of the check's linear layer, for features of unit variance; less for more pictures."""
_MAX_PIECES = 100

StopRequested = Callable[[], bool]
Readings = NDArray[np.float32]


def with_verdicts(
    made: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: int = FOREIGN_COUNT,
    quiet: bool = False,
    should_stop: StopRequested = lambda: False,
) -> Checkpoint:
    """The checkpoint with a posterior and a check of touches, as far as validation grasps can teach them.

    A posterior needs three validation objects and another photo of a touch's object, a check of touches needs
    `MIN_GRASPS` validation grasps. foreign: pictures to learn from that are no gels. The matcher of `made` is taken
    over. Raises JobInterrupted.
    """
    seed, matcher = made.config.training.seed, made.matcher
    learned, scored = _sample_grasps(train, seed), _sample_grasps(validation, seed)
    if not learned or not scored:
        return made
    touches, photos = recorded_features(matcher, source, scored, what="posterior", quiet=quiet, should_stop=should_stop)
    asked = posterior_touches(matcher, scored, touches, photos)
    made = dataclasses.replace(
        made,
        posterior=None if asked is None else fit_posterior(asked.scored, seed=seed),
        references=None if asked is None else fit_reference_calibration(asked, seed=seed),
    )
    if len(scored) < MIN_GRASPS:
        return made
    others, _ = recorded_features(
        matcher, source, learned, what="check of touches", quiet=quiet, should_stop=should_stop
    )
    preprocessing = made.config.preprocessing
    fitting = GelCheckFeatures.of(matcher, preprocessing, learned, others, foreign, seed)
    test = GelCheckFeatures.of(matcher, preprocessing, scored, touches, foreign // 2, seed + 1)
    matcher.gel_head = fit_gel_head(fitting, PENALTY * FOREIGN_COUNT / foreign)
    check = fit_gel_check(matcher.gel_head, test, contact_levels(scored))
    return dataclasses.replace(made, gel_check=check)


def _sample_grasps(grasps: Sequence[Grasp], seed: int) -> list[Grasp]:
    """Grasps of objects drawn by the seed, all of each while there is room."""
    by_object: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(grasp)
    names = sorted(by_object)
    order = np.random.default_rng([seed, 5]).permutation(len(names))
    return [grasp for place in order for grasp in by_object[names[place]]][:MAX_GRASPS]


# Which object was it? --------------------------------------------------------------------------------------


def posterior_touches(
    matcher: Matcher, grasps: Sequence[Grasp], touches: Tensor, photos: dict[Path, Tensor]
) -> ReferenceTouches | None:
    """What a posterior is fitted on: touches (G, fingers * F) of grasps and their photos; None where these are too
    few.
    """
    objects = sorted({grasp.object_id for grasp in grasps})
    shows = {grasp.photo: grasp.object_id for grasp in grasps}
    own = np.array([[grasp.photo == photo for photo in photos] for grasp in grasps])
    touch_owner = np.array([objects.index(grasp.object_id) for grasp in grasps])
    photo_owner = np.array([objects.index(shows[photo]) for photo in photos])
    if len(objects) < 3 or not ((touch_owner[:, None] == photo_owner) & ~own).any():
        return None
    with torch.inference_mode():
        touch_partials = matcher.touch_encoding(touches).partial.cpu().numpy()
        photo_partials = matcher.photo_encoding(torch.stack(list(photos.values()))).partial.cpu().numpy()
    classify = scorer_of(matcher.head)
    logits = np.stack([classify.logits(partial[None], photo_partials) for partial in touch_partials])
    embeddings = touch_embeddings(touch_partials, matcher.config.hidden)
    return ReferenceTouches(ScoredTouches(logits, touch_owner, photo_owner, own), embeddings)


# What does a gel image show? -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GelCheckFeatures:
    """Features of the touch tower, on the CPU: touch (G, fingers, F); untouched (U, fingers, F), U = 0 where nothing
    was recorded before a contact; foreign (N, F), and which of these are no gel in false colours (N,).
    """

    touch: Tensor
    no_contact: Tensor
    foreign: Tensor
    is_plainly_foreign: NDArray[np.bool_]

    @classmethod
    def of(
        cls, matcher: Matcher, settings: Preprocessing, grasps: Sequence[Grasp], touches: Tensor, count: int, seed: int
    ) -> "GelCheckFeatures":
        """Pictures of recorded grasps, whose touch features are known, and `count` foreign ones."""
        fingers = matcher.config.fingers
        frames = list(_no_contact_images(settings, grasps, fingers))
        some = [
            grasps[row] for row in np.linspace(0, len(grasps) - 1, min(_MAX_PIECES, len(grasps))).round().astype(int)
        ]
        photos = [settings.load_photo(grasp.photo) for grasp in some]
        gels = [settings.load_touch(grasp.touches[0], *grasp.backgrounds[:1]) for grasp in some]
        names, drawn = zip(*draw_foreign(count, settings.touch_px, photos, gels, seed), strict=True)
        shape = (-1, fingers, touches.shape[1] // fingers)
        return cls(
            touches.cpu().reshape(shape),
            touch_features(matcher, frames).cpu().reshape(shape) if frames else torch.zeros(0, *shape[1:]),
            # A tower sees one finger at a time; as many pictures as there are fingers stand for a touch.
            touch_features(matcher, [[picture] * fingers for picture in drawn]).cpu().reshape(shape)[:, 0],
            np.array([name != "false colours" for name in names]),
        )


def _no_contact_images(settings: Preprocessing, grasps: Sequence[Grasp], fingers: int) -> Iterator[list[Image]]:
    """Untouched gels as the tower sees them. Where it sees a difference from a no-contact frame, that frame is the one
    of the grasp before: a frame less itself holds no noise.
    """
    if settings.background == "none":
        for grasp in grasps:
            if len(grasp.backgrounds) == fingers:
                yield [settings.load_touch(path) for path in grasp.backgrounds]
        return
    for first, second in _consecutive_frames(grasps):
        yield [settings.load_touch(now, before) for before, now in zip(first, second, strict=True)]


def _consecutive_frames(grasps: Iterable[Grasp]) -> Iterator[tuple[tuple[Path, ...], tuple[Path, ...]]]:
    """No-contact frames of two grasps of one object, one after the other: of the same gels."""
    for first, second in pairwise(grasps):
        if first.object_id == second.object_id and first.backgrounds and second.backgrounds:
            yield first.backgrounds, second.backgrounds


def fit_gel_head(fitting: GelCheckFeatures, penalty: float = PENALTY) -> GelHead:
    """Softmax regression on standardised features, kinds alike whatever their numbers, with a penalty on the weights.

    Without untouched gels, that kind is never read.
    """
    from scipy.optimize import minimize

    kinds = [part.reshape(-1, part.shape[-1]).double().numpy() for part in (fitting.touch, fitting.no_contact)]
    kinds.append(fitting.foreign.double().numpy())
    x, which = np.concatenate(kinds), np.repeat(np.arange(len(GEL_CLASSES)), [len(part) for part in kinds])
    centre, spread = x.mean(0), x.std(0)
    spread = np.maximum(spread, MIN_RELATIVE_DEVIATION * np.abs(centre))  # as features are standardised for the matcher
    spread = np.where(spread > 1e-6, spread, 1.0)
    x = (x - centre) / spread
    present = np.array([len(part) > 0 for part in kinds])
    weights = np.array([1 / len(part) if len(part) else 0.0 for part in kinds])[which] / present.sum()
    targets, absent = np.eye(len(GEL_CLASSES))[which], np.where(present, 0.0, -1e4)

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        matrix = flat.reshape(-1, len(GEL_CLASSES))
        logits = x @ matrix[:-1] + matrix[-1] + absent
        logs = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
        slack = weights[:, None] * (np.exp(logs) - targets)
        value = -float(weights @ (logs * targets).sum(1)) + penalty / 2 * float((matrix[:-1] ** 2).sum())
        return value, np.vstack([x.T @ slack + penalty * matrix[:-1], slack.sum(0)]).ravel()

    found = minimize(loss, np.zeros((x.shape[1] + 1) * len(GEL_CLASSES)), jac=True, method="L-BFGS-B")
    matrix = found.x.reshape(-1, len(GEL_CLASSES))
    head = GelHead(x.shape[1])
    with torch.no_grad():
        head.classifier.weight.copy_(torch.from_numpy((matrix[:-1] / spread[:, None]).T))
        head.classifier.bias.copy_(torch.from_numpy(matrix[-1] - (centre / spread) @ matrix[:-1] + absent))
    return head.eval()


def contact_levels(grasps: Sequence[Grasp]) -> tuple[list[float], list[float]]:
    """Grey levels, the larger of the fingers', by which untouched gels differ from their own frame of another grasp,
    and touches from the frame before them; empty where nothing was recorded before a contact.
    """
    no_contact = [_largest_level(second, first) for first, second in _consecutive_frames(grasps)]
    touched = [_largest_level(grasp.touches, grasp.backgrounds) for grasp in grasps if grasp.backgrounds]
    return no_contact, touched


def _largest_level(images: Sequence[Path], frames: Sequence[Path]) -> float:
    pairs = zip(images, frames, strict=True)
    return max(contact_level(read_rgb(image), read_rgb(frame)) for image, frame in pairs)


@torch.inference_mode()
def fit_gel_check(head: GelHead, test: GelCheckFeatures, levels: tuple[Sequence[float], Sequence[float]]) -> GelCheck:
    """Thresholds by validation pictures, of which a grasp counts by the finger that says most; and what they refuse."""
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
    """Above all but `FALSE_ALARM_RATE` of the untouched readings, as far up as loses no more than `LOW_CONTACT_RATE` of the touches."""
    low, high = np.asarray(no_contact, dtype=np.float64), np.asarray(touch, dtype=np.float64)
    return float(max(np.quantile(low, 1 - FALSE_ALARM_RATE), np.quantile(high, LOW_CONTACT_RATE)))


def _fraction(verdicts: Sequence[str], name: str) -> float:
    return verdicts.count(name) / len(verdicts)
