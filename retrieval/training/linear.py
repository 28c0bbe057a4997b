"""The linear fit: canonical correlations of published towers' features, as an ordinary matcher.

Touches are encoded by the gel tower of the package (`retrieval.model.towers.weights.gel_tower`) and by a published
tower side by side, photos by the published one, so that the fit suits other sensors and cameras than those of the
simulated rig. The match logit is the scaled cosine of the canonical variates (`retrieval.training.cca`).
"""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import nn

from retrieval.console.output import say
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.config import Config, load_config
from retrieval.model.encode import one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import SLOPE_BOUNDS
from retrieval.model.towers.weights import GEL, SHIPPED
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.cca import CcaProjections, select_settings, tower_widths
from retrieval.training.features import Features
from retrieval.training.initial_weights import build_matcher

PRESET = "linear"
PUBLISHED_TOWER = "mobilenet_v2"
"""Backbone of the published tower and of the gel tower."""
SHIPPED_TOWER, SHIPPED_PHOTO_PX = "mobilenet_v2_stride16", 160
"""Backbone and photo size of the shipped photo tower, which replaces a published one without weights."""
NO_WEIGHTS = "random"
"""Value of `init` to use no published tower."""


def linear_config(fingers: int, init: str = "imagenet") -> Config:
    """Return the configuration of the towers of the linear fit.

    Args:
        fingers: Number of gel images of a touch.
        init: Weights of the published MobileNetV2: "imagenet" or a file. "random": touches are encoded by the gel tower
            alone, and photos by that of the shipped model.
    """
    config = load_config(PRESET)
    matcher, training = dataclasses.replace(config.matcher, fingers=fingers), config.training
    if init == NO_WEIGHTS:
        matcher = dataclasses.replace(matcher, tower=PUBLISHED_TOWER, photo_tower=SHIPPED_TOWER)
        training = dataclasses.replace(training, init=NO_WEIGHTS, init_touch=GEL, init_photo=SHIPPED)
        preprocessing = dataclasses.replace(config.preprocessing, photo_px=SHIPPED_PHOTO_PX)
        return Config(matcher, training, preprocessing)
    return dataclasses.replace(config, matcher=matcher, training=dataclasses.replace(training, init=init))


def available_config(fingers: int, init: str) -> Config:
    """Return `linear_config`, without the published tower if `init` is "imagenet" and cannot be downloaded.

    Raises:
        BadInput: `init` names a tower of the package.
    """
    if init in (GEL, SHIPPED):
        raise BadInput(f'The initial weights must be "imagenet", "random" or a file of MobileNetV2, got {init!r}.')
    config = linear_config(fingers, init)
    if init == "imagenet":
        try:
            build_matcher(config)
        except CheckpointError as error:
            say(f"{error}. Without them, the linear fit has the package's towers only: 9 points worse on VT60")
            return linear_config(fingers, NO_WEIGHTS)
    return config


@one_thread()
def fit_linear(features: Features, config: Config, folds: Sequence[Sequence[str]]) -> tuple[Config, Matcher]:
    """Fit the projections to features of the towers of `config`; the objects of a fold are held out together.

    Returns:
        The configuration and a matcher without the weights of its towers.
    """
    choice = select_settings(features, tower_widths(config, features), folds)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    install_projections(matcher, choice.projections, *_log_odds(choice.held_out_touches))
    return dataclasses.replace(config, training=config.training.with_given_weights()), matcher


@torch.no_grad()
def install_projections(matcher: Matcher, projections: CcaProjections, scale: float, offset: float) -> None:
    """Make the match logit `scale * cosine + offset` of the projected features; the head's layers contribute 0."""
    for layer, found in ((matcher.touch_projection, projections.touch), (matcher.photo_projection, projections.photo)):
        assert isinstance(layer, nn.Linear)  # the preset has no hidden layer
        used = found.weight.shape[1]  # shorter encodings leave zeros, which do not change the cosine
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:used] = torch.from_numpy(found.weight.T.astype(np.float32))
        layer.bias[:used] = torch.from_numpy(found.bias.astype(np.float32))
    for parameter in matcher.head.parameters():
        parameter.zero_()
    assert matcher.cosine_scale is not None
    matcher.cosine_scale.fill_(scale)
    matcher.head.out.bias.fill_(offset)


def _log_odds(parts: Iterable[ScoredTouches]) -> tuple[float, float]:
    """Return scale and offset from cosine to log-odds of a match, with equally many true and false pairs.

    A weak penalty on the scale keeps both finite if cosines separate the pairs.

    Raises:
        BadInput: No object has two grasps.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import

    cosines, labels = [], []
    for part in parts:
        same = part.touch_owner[:, None] == part.photo_owner
        rng = np.random.default_rng(0)
        pairs = [rng.permutation(np.flatnonzero(mask.ravel())) for mask in (same & ~part.own, ~same)]
        count = min(len(pairs[0]), len(pairs[1]), 20_000)
        cosines += [part.logits.ravel()[drawn[:count]] for drawn in pairs]
        labels += [np.ones(count), np.zeros(count)]
    x, y = np.concatenate(cosines, dtype=np.float64)[:, None], np.concatenate(labels)
    if not len(x):
        raise BadInput("no touch has another photo of its object; record at least two grasps of each object")
    centre = x.mean()
    found = LogisticRegression(C=1e3, tol=1e-8).fit(x - centre, y)
    scale = max(found.coef_.item(), SLOPE_BOUNDS[0])  # the head cannot rank by a negative one
    return scale, found.intercept_.item() - scale * centre
