"""Calibrate a checkpoint after training: posterior, reference touches, verification and gel check."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from retrieval.data.dataset import Grasp
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.posterior import Posterior
from retrieval.model.references import ReferenceCalibration
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

    A posterior needs three validation objects, and a touch with a second photo of its object. A model with late
    interaction has a second one, for an index without cells. At most `max_grasps` grasps of each part are used, and
    `foreign` foreign pictures for fitting. The checkpoint's matcher is reused and modified.
    """
    seed, matcher = checkpoint.config.training.seed, checkpoint.matcher
    grasps = _sample_grasps(validation, seed)[:max_grasps]
    if not train or not grasps:
        return checkpoint
    touches, photos = recorded_features(matcher, source, grasps, what="posterior", quiet=quiet)
    if (scored := score_grasps(matcher, grasps, touches, photos)) is not None:
        posterior, references = fit_calibrations([scored], seed)
        verification = fit_verification([scored], posterior, seed)
        checkpoint = dataclasses.replace(
            checkpoint, posterior=posterior, references=references, verification=verification
        )
        if matcher.config.cell_dim:
            pooled = score_grasps(matcher, grasps, touches, photos, pooled=True)
            assert pooled is not None  # the same touches and photos
            posterior, references = fit_calibrations([pooled], seed)
            checkpoint = dataclasses.replace(checkpoint, pooled_posterior=posterior, pooled_references=references)
    return with_gel_check(checkpoint, source, train, validation, foreign=foreign, max_grasps=max_grasps, quiet=quiet)


def fit_calibrations(parts: Sequence[ScoredTouches], seed: int = 0) -> tuple[Posterior, ReferenceCalibration | None]:
    """Return the posterior and the calibration of reference touches; `parts` come from one matcher or several."""
    return fit_posterior(*parts, seed=seed), fit_references(*parts, seed=seed)


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
    train, validation = (_sample_grasps(part, seed)[:max_grasps] for part in (train, validation))
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


def _sample_grasps(grasps: Sequence[Grasp], seed: int) -> list[Grasp]:
    """Return the grasps object by object, in random order of the objects."""
    by_object: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(grasp)
    names = sorted(by_object)
    order = np.random.default_rng([seed, 5]).permutation(len(names))
    return [grasp for index in order for grasp in by_object[names[index]]]
