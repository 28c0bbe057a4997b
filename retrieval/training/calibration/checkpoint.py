"""Calibration of a checkpoint after its training: posterior, reference touches, openings, verification, gel check."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.data.dataset import Grasp
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import default_device
from retrieval.model.gel_check import CONTACT
from retrieval.training.batches import FeatureSource, FrozenFeatures, recorded_features
from retrieval.training.calibration.gel_check import (
    FOREIGN,
    PENALTY,
    ForeignPictures,
    GelCheckFeatures,
    contact_levels,
    fit_gel_check,
    fit_gel_head,
)
from retrieval.training.calibration.opening import fit_opening
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.references import fit_references
from retrieval.training.calibration.scores import ScoredTouches, score_grasps
from retrieval.training.calibration.verification import fit_verification
from retrieval.training.features import Features, features_by_image

MAX_CALIBRATION_GRASPS = 400
"""Largest number of grasps from each part of the split."""
MIN_GRASPS = 20
"""Number of validation grasps that the gel check needs; thresholds from fewer grasps would reject too many touches."""


def calibrate_checkpoint(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: ForeignPictures = FOREIGN,
    max_grasps: int = MAX_CALIBRATION_GRASPS,
) -> Checkpoint:
    """Return the checkpoint with calibrations and a gel check, if there are enough validation grasps.

    A posterior needs three validation objects, and a touch with a second photo of its object. At most `max_grasps`
    grasps of each part are used. `foreign` are the foreign pictures of the gel check. The checkpoint's matcher is
    reused and modified.
    """
    seed, matcher = checkpoint.config.training.seed, checkpoint.matcher
    grasps = _sample_grasps(validation, seed, max_grasps)
    if not train or not grasps:
        return checkpoint
    touches, photos = recorded_features(matcher, source, grasps)
    scored = score_grasps(matcher, grasps, touches, photos)
    checkpoint = dataclasses.replace(checkpoint, opening=fit_opening([*train, *validation]))
    checkpoint = with_gel_check(checkpoint, source, train, validation, foreign=foreign, max_grasps=max_grasps)
    if scored is None:
        return checkpoint
    return with_calibrations(checkpoint, [scored], [refused_touches(checkpoint, touches)], seed=seed)


def with_calibrations(
    checkpoint: Checkpoint,
    scored: Sequence[ScoredTouches],
    refused: Sequence[NDArray[np.bool_]],
    *,
    seed: int = 0,
) -> Checkpoint:
    """Return the checkpoint with calibrations on touches of objects outside the fit, of one matcher or several.

    `refused`: whether the gel check refuses each touch of each part (`fit_verification`).
    """
    pooled = [part.pooled for part in scored if part.pooled is not None]
    posterior = fit_posterior(*scored, seed=seed)
    return dataclasses.replace(
        checkpoint,
        posterior=posterior,
        references=fit_references(*scored, seed=seed),
        verification=fit_verification(scored, posterior, seed, refused),
        pooled_posterior=fit_posterior(*pooled, seed=seed) if pooled else checkpoint.pooled_posterior,
        pooled_references=fit_references(*pooled, seed=seed) if pooled else checkpoint.pooled_references,
    )


def with_gel_check(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: ForeignPictures = FOREIGN,
    max_grasps: int = MAX_CALIBRATION_GRASPS,
) -> Checkpoint:
    """Return the checkpoint with a new gel check (`calibrate_checkpoint`).

    With fewer than `MIN_GRASPS` validation grasps it has none: the check of another sensor would refuse these touches.
    """
    seed, matcher, settings = checkpoint.config.training.seed, checkpoint.matcher, checkpoint.config.preprocessing
    train, validation = (_sample_grasps(part, seed, max_grasps) for part in (train, validation))
    if len(validation) < MIN_GRASPS:
        matcher.gel_head = None
        return dataclasses.replace(checkpoint, gel_check=None)
    half = dataclasses.replace(foreign, count=foreign.count // 2)
    fitting, test = (
        GelCheckFeatures.of(
            matcher, settings, grasps, recorded_features(matcher, source, grasps)[0], pictures, seed + number
        )
        for number, (grasps, pictures) in enumerate(((train, foreign), (validation, half)))
    )
    head = fit_gel_head(fitting, PENALTY * FOREIGN.count / foreign.count)
    check = fit_gel_check(head, test, contact_levels(validation), foreign.margin)
    matcher.gel_head = head.to(default_device())
    return dataclasses.replace(checkpoint, gel_check=check)


@torch.inference_mode()
def refused_touches(checkpoint: Checkpoint, touches: Tensor) -> NDArray[np.bool_]:
    """Return (T,) whether the gel check refuses touches with these features (T, fingers * F); none without a check."""
    readings = checkpoint.matcher.gel_readings(touches.to(next(checkpoint.matcher.parameters()).device))
    if checkpoint.gel_check is None or readings is None:
        return np.zeros(len(touches), np.bool_)
    return np.not_equal(checkpoint.gel_check.classify(readings.cpu().numpy()), CONTACT)


def with_sensor_calibrations(checkpoint: Checkpoint, grasps: Sequence[Grasp], features: Features) -> Checkpoint:
    """Return the checkpoint with a gel check and the evidence of openings, from all grasps of a recording.

    The gel check is fitted on half of the objects, with thresholds from the others. `features` are those of the grasps.
    """
    names, device = sorted({grasp.object_id for grasp in grasps}), default_device()
    halves = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    checkpoint.matcher.to(device)
    source = FrozenFeatures(features_by_image(grasps, features, device))
    return with_gel_check(dataclasses.replace(checkpoint, opening=fit_opening(grasps)), source, *halves)


def _sample_grasps(grasps: Sequence[Grasp], seed: int, count: int) -> list[Grasp]:
    """Return the first `count` grasps, object by object in random order."""
    names = sorted({grasp.object_id for grasp in grasps})
    place = dict(zip(names, np.random.default_rng([seed, 5]).permutation(len(names)).argsort(), strict=True))
    return sorted(grasps, key=lambda grasp: place[grasp.object_id])[:count]
