"""Calibrate a checkpoint after training: posterior, reference touches, verification and gel check."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from retrieval.data.dataset import Grasp
from retrieval.model.checkpoint import Checkpoint
from retrieval.training.batches import FeatureSource, recorded_features
from retrieval.training.calibration.gel_check import (
    PENALTY,
    GelCheckFeatures,
    contact_levels,
    fit_gel_check,
    fit_gel_head,
)
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.references import fit_references
from retrieval.training.calibration.touches import ScoredTouches, score_grasps
from retrieval.training.calibration.verification import fit_verification

MAX_GRASPS = 400
"""Largest number of grasps from each part of the split."""
MIN_GRASPS = 40
"""Number of validation grasps that the gel check needs; thresholds from fewer grasps would reject too many touches."""
FOREIGN_COUNT = 700
"""Number of foreign pictures for fitting; half as many others are drawn for validation."""


def calibrate_checkpoint(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: int = FOREIGN_COUNT,
    max_grasps: int = MAX_GRASPS,
    quiet: bool = False,
) -> Checkpoint:
    """Return the checkpoint with calibrations and a gel check, if there are enough validation grasps.

    A posterior needs three validation objects, and a touch with a second photo of its object. At most `max_grasps`
    grasps of each part are used, and `foreign` foreign pictures for fitting. The checkpoint's matcher is reused and
    modified.
    """
    seed, matcher = checkpoint.config.training.seed, checkpoint.matcher
    grasps = _sample_grasps(validation, seed, max_grasps)
    if not train or not grasps:
        return checkpoint
    touches, photos = recorded_features(matcher, source, grasps, what="posterior", quiet=quiet)
    scored = [
        each
        for pooled in ((False, True) if matcher.config.cell_dim else (False,))
        if (each := score_grasps(matcher, grasps, touches, photos, pooled=pooled)) is not None
    ]
    if scored:
        checkpoint = with_calibrations(checkpoint, scored[:1], scored[1:], seed=seed)
    return with_gel_check(checkpoint, source, train, validation, foreign=foreign, max_grasps=max_grasps, quiet=quiet)


def with_calibrations(
    checkpoint: Checkpoint,
    scored: Sequence[ScoredTouches],
    pooled: Sequence[ScoredTouches] = (),
    verified: Sequence[ScoredTouches] | None = None,
    *,
    seed: int = 0,
) -> Checkpoint:
    """Return the checkpoint with calibrations.

    Args:
        checkpoint: The checkpoint.
        scored: Touches of objects outside the fit, of one matcher or several.
        pooled: The same without late interaction, for an index without cells; empty for a model without cells.
        verified: Touches for verification. Default: `scored`.
        seed: Seed of the trials.
    """
    posterior = fit_posterior(*scored, seed=seed)
    checkpoint = dataclasses.replace(
        checkpoint,
        posterior=posterior,
        references=fit_references(*scored, seed=seed),
        verification=fit_verification(scored if verified is None else verified, posterior, seed),
    )
    if not pooled:
        return checkpoint
    return dataclasses.replace(
        checkpoint,
        pooled_posterior=fit_posterior(*pooled, seed=seed),
        pooled_references=fit_references(*pooled, seed=seed),
    )


def with_gel_check(
    checkpoint: Checkpoint,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    foreign: int = FOREIGN_COUNT,
    max_grasps: int = MAX_GRASPS,
    quiet: bool = False,
) -> Checkpoint:
    """Return the checkpoint with a gel check, if there are `MIN_GRASPS` validation grasps (`calibrate_checkpoint`)."""
    seed, matcher, settings = checkpoint.config.training.seed, checkpoint.matcher, checkpoint.config.preprocessing
    train, validation = (_sample_grasps(part, seed, max_grasps) for part in (train, validation))
    if len(validation) < MIN_GRASPS:
        return checkpoint
    fitting, test = (
        GelCheckFeatures.of(
            matcher,
            settings,
            grasps,
            recorded_features(matcher, source, grasps, what="gel check", quiet=quiet)[0],
            count,
            seed + number,
        )
        for number, (grasps, count) in enumerate(((train, foreign), (validation, foreign // 2)))
    )
    matcher.gel_head = fit_gel_head(fitting, PENALTY * FOREIGN_COUNT / foreign)
    check = fit_gel_check(matcher.gel_head, test, contact_levels(validation))
    return dataclasses.replace(checkpoint, gel_check=check)


def _sample_grasps(grasps: Sequence[Grasp], seed: int, count: int) -> list[Grasp]:
    """Return the first `count` grasps, object by object in random order."""
    names = sorted({grasp.object_id for grasp in grasps})
    place = dict(zip(names, np.random.default_rng([seed, 5]).permutation(len(names)).argsort(), strict=True))
    return sorted(grasps, key=lambda grasp: place[grasp.object_id])[:count]
