"""Write a fit into a checkpoint: projections from all recorded objects, calibration from held-out objects."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from retrieval.adaptation.data import AdaptationData
from retrieval.adaptation.estimate import Estimate
from retrieval.data.dataset import Grasp, Split, data_digest
from retrieval.data.licences import LICENCES
from retrieval.methods.cca_towers import GRID, MAX_CALIBRATION_TOUCHES, CcaProjections, fit_projections
from retrieval.metrics.pairs import fit_calibration
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import default_device, one_thread
from retrieval.model.fusion import Matcher
from retrieval.training.batches import FrozenFeatures
from retrieval.training.calibration.calibrate import fit_calibrations, with_gel_check
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.calibration.verification import fit_verification
from retrieval.training.features import Features, features_by_image


@one_thread()
def fit_matcher(data: AdaptationData, estimate: Estimate | None, out: Path) -> Checkpoint:
    """Return a checkpoint with projections fitted to all objects; without an estimate, those of the largest ridge."""
    features, config, matcher = data.features, data.config, data.matcher
    if estimate:
        projections = estimate.choice.projections
        scale, offset = _log_odds(part.scored for part in estimate.choice.held_out_touches)
    else:
        touch, largest = features.touch.reshape(len(features), -1), max(GRID)
        projections = dict(fit_projections(touch, features.photo, features.owner, data.blocks, [largest]))[largest]
        scale, offset = 1.0, 0.0
    install_projections(matcher, projections, scale, offset)
    objects = tuple(sorted(set(features.object_ids)))
    return Checkpoint(
        path=out,
        digest="",
        config=config,
        provenance={
            "step": 0,
            "source": data.source,
            LICENCES: [dataclasses.asdict(licence) for licence in data.licences],
            "data_digest": data_digest(data.grasps),
            "metrics": estimate.to_dict() if estimate else {},
        },
        gel_check=None,
        verification=None,
        matcher=matcher,
        split=Split(config.training.seed, train=objects, validation=(), test=()),
    )


def _log_odds(parts: Iterable[ScoredTouches]) -> tuple[float, float]:
    """Return scale and offset from cosine to log-odds of a match, with equally many true and false pairs."""
    cosines, labels = [], []
    for part in parts:
        same = part.touch_owner[:, None] == part.photo_owner
        rng = np.random.default_rng(0)
        pairs = [rng.permutation(np.flatnonzero(mask.ravel())) for mask in (same & ~part.own, ~same)]
        count = min(len(pairs[0]), len(pairs[1]), 20_000)
        cosines += [part.logits.ravel()[drawn[:count]] for drawn in pairs]
        labels += [np.ones(count), np.zeros(count)]
    found = fit_calibration(np.concatenate(cosines), np.concatenate(labels))
    return found.slope, found.intercept


@torch.no_grad()
def install_projections(matcher: Matcher, projections: CcaProjections, scale: float, offset: float) -> None:
    """Make the match logit `scale * cosine + offset` of the projected features; the layers of the head contribute 0."""
    for layer, found in ((matcher.touch_projection, projections.touch), (matcher.photo_projection, projections.photo)):
        assert isinstance(layer, nn.Linear)  # the configuration of `adapt` has no hidden layer
        used = found.weight.shape[1]  # shorter encodings leave zeros, which do not change the cosine
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:used] = torch.from_numpy(found.weight.T.astype(np.float32))
        layer.bias[:used] = torch.from_numpy(found.bias.astype(np.float32))
    for parameter in matcher.head.parameters():
        parameter.zero_()
    matcher.head.out.bias.fill_(offset)
    assert matcher.cosine_scale is not None
    matcher.cosine_scale.fill_(scale)


def calibrate_fit(
    checkpoint: Checkpoint, data: AdaptationData, estimate: Estimate | None, *, quiet: bool
) -> Checkpoint:
    """Add the gel check and the calibrations to a fitted checkpoint.

    The calibrations are fitted on the estimate's held-out touches, because the projections are overfitted to the fitted
    objects; without an estimate there are none.
    """
    checkpoint = _with_gel_check(checkpoint, data.grasps, data.features, quiet)
    if estimate is None:
        return dataclasses.replace(checkpoint, posterior=None, references=None, verification=None)
    # Touches of held-out objects (half of each kind at a time), with the match logits of the matcher.
    assert checkpoint.matcher.cosine_scale is not None
    scale, offset = checkpoint.matcher.cosine_scale.item(), checkpoint.matcher.head.out.bias.item()
    left_out = [
        dataclasses.replace(part, scored=dataclasses.replace(part.scored, logits=scale * part.scored.logits + offset))
        for part in estimate.choice.held_out_touches
    ]
    posterior, references = fit_calibrations(left_out)
    return dataclasses.replace(
        checkpoint,
        posterior=posterior,
        references=references,
        verification=fit_verification(left_out, posterior),
    )


def calibrate_baseline(start: Checkpoint, data: AdaptationData, estimate: Estimate, *, quiet: bool) -> Checkpoint:
    """Return the start model with a gel check and calibrations fitted to the recorded objects."""
    checkpoint = _with_gel_check(start, data.grasps, estimate.baseline.features, quiet)
    folds = [sorted(set(fold.left_out.object_ids)) for fold in estimate.folds]
    about = {"source": data.source, "data_digest": data_digest(data.grasps)}
    licences = [dataclasses.asdict(licence) for licence in data.licences]
    provenance = start.provenance | {"adapted_to": about, LICENCES: licences, "metrics": estimate.to_dict()}
    touches = partial(estimate.baseline.calibration_touches, max_touches=MAX_CALIBRATION_TOUCHES)
    posterior, references = fit_calibrations(touches(folds))
    made = dataclasses.replace(
        checkpoint,
        provenance=provenance,
        posterior=posterior,
        references=references,
        # Nothing was fitted to the objects, so all of them can be compared with each other.
        verification=fit_verification(touches([data.features.object_ids]), posterior),
    )
    if start.config.matcher.cell_dim:
        posterior, references = fit_calibrations(touches(folds, pooled=True))
        made = dataclasses.replace(made, pooled_posterior=posterior, pooled_references=references)
    return made


def _with_gel_check(checkpoint: Checkpoint, grasps: list[Grasp], features: Features, quiet: bool) -> Checkpoint:
    """Return the checkpoint with a gel check: fitted on half of the objects, with thresholds from the others."""
    device = default_device()
    names = sorted({grasp.object_id for grasp in grasps})
    groups = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    checkpoint.matcher.to(device)
    source = FrozenFeatures(checkpoint.config, device, features_by_image(grasps, features, device))
    return with_gel_check(checkpoint, source, *groups, quiet=quiet)
