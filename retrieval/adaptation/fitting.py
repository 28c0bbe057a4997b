"""The checkpoint: codes fitted on all own objects become a matcher's projections, folds say what its logits mean."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from retrieval.adaptation.data import AdaptationData
from retrieval.adaptation.estimate import Estimate
from retrieval.data.dataset import Grasp, Split, data_digest
from retrieval.methods.cca_towers import GRID, MAX_CALIBRATION_TOUCHES, CcaProjections, fit_projections
from retrieval.metrics.pairs import fit_calibration
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import default_device, one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import ScoredTouches, fit_posterior
from retrieval.model.reference_calibration import ReferenceTouches, fit_reference_calibration
from retrieval.training.batches import FrozenFeatures
from retrieval.training.features import Features, features_by_image
from retrieval.training.verdicts import with_verdicts


@one_thread()
def fit_matcher(data: AdaptationData, estimate: Estimate | None, out: Path) -> Checkpoint:
    """The checkpoint of codes fitted on all own objects; without an estimate by the widest ridges."""
    features, config, matcher = data.features, data.config, data.matcher
    if estimate:
        projections = estimate.choice.projections
        scale, offset = _log_odds(part.scored for part in estimate.choice.held_out_touches)
    else:
        touch, most = features.touch.reshape(len(features), -1), max(GRID)
        projections = dict(fit_projections(touch, features.photo, features.owner, data.blocks, [most]))[most]
        scale, offset = 1.0, 0.0
    install_codes(matcher, projections, scale, offset)
    objects = tuple(sorted(set(features.object_ids)))
    return Checkpoint(
        path=out,
        digest="",
        config=config,
        provenance={
            "step": 0,
            "source": data.source,
            "data_digest": data_digest(data.grasps),
            "metrics": estimate.to_dict() if estimate else {},
        },
        gel_check=None,
        matcher=matcher,
        split=Split(config.training.seed, train=objects, validation=(), test=()),
    )


def _log_odds(parts: Iterable[ScoredTouches]) -> tuple[float, float]:
    """Scale and offset that make of a cosine the log-odds of a match, with as many pairs that match as do not."""
    cosines, labels = [], []
    for part in parts:
        same = part.touch_owner[:, None] == part.photo_owner
        rng = np.random.default_rng(0)
        pairs = [rng.permutation(np.flatnonzero(some.ravel())) for some in (same & ~part.own, ~same)]
        count = min(len(pairs[0]), len(pairs[1]), 20_000)
        cosines += [part.logits.ravel()[some[:count]] for some in pairs]
        labels += [np.ones(count), np.zeros(count)]
    found = fit_calibration(np.concatenate(cosines), np.concatenate(labels))
    return found.slope, found.intercept


@torch.no_grad()
def install_codes(matcher: Matcher, projections: CcaProjections, scale: float, offset: float) -> None:
    """Make the matcher judge by `scale * cosine + offset` of the codes; its layers of the head add nothing."""
    for layer, found in ((matcher.touch_projection, projections.touch), (matcher.photo_projection, projections.photo)):
        used = found.weight.shape[1]  # codes may be shorter than the layer: the rest stays 0, which no cosine sees
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:used] = torch.from_numpy(found.weight.T.astype(np.float32))
        layer.bias[:used] = torch.from_numpy(found.bias.astype(np.float32))
    for parameter in matcher.head.parameters():
        parameter.zero_()
    matcher.head.out.bias.fill_(offset)
    assert matcher.cosine_scale is not None
    matcher.cosine_scale.fill_(scale)


def calibrate_fit(made: Checkpoint, data: AdaptationData, estimate: Estimate | None, *, quiet: bool) -> Checkpoint:
    """The fitted checkpoint with a check of touches, and with the posterior of the folds: what a match is worth is told
    by objects left out, as codes know those that they were fitted on too well. Without an estimate it has no
    posterior.
    """
    made = _with_gel_check(made, data.grasps, data.features, quiet)
    if estimate is None:
        return dataclasses.replace(made, posterior=None, references=None)
    # Touches of objects that were held out, half of each kind together, with the match logits of the matcher.
    assert made.matcher.cosine_scale is not None
    scale, offset = made.matcher.cosine_scale.item(), made.matcher.head.out.bias.item()
    left_out = [
        ReferenceTouches(dataclasses.replace(part.scored, logits=scale * part.scored.logits + offset), part.embeddings)
        for part in estimate.choice.held_out_touches
    ]
    return _with_posterior(made, left_out)


def calibrate_baseline(start: Checkpoint, data: AdaptationData, estimate: Estimate, *, quiet: bool) -> Checkpoint:
    """The model that one started from, with a check of touches and a posterior fitted to own objects."""
    made = _with_gel_check(start, data.grasps, estimate.baseline.features, quiet)
    folds = [sorted(set(fold.left_out.object_ids)) for fold in estimate.folds]
    about = {"source": data.source, "data_digest": data_digest(data.grasps)}
    provenance = start.provenance | {"adapted_to": about, "metrics": estimate.to_dict()}
    return _with_posterior(
        dataclasses.replace(made, provenance=provenance),
        estimate.baseline.reference_touches(folds, MAX_CALIBRATION_TOUCHES),
    )


def _with_posterior(made: Checkpoint, left_out: list[ReferenceTouches]) -> Checkpoint:
    """The checkpoint with a posterior and the worth of reference touches, both fitted on touches of objects left
    out.
    """
    posterior = fit_posterior(*(part.scored for part in left_out))
    return dataclasses.replace(made, posterior=posterior, references=fit_reference_calibration(*left_out))


def _with_gel_check(made: Checkpoint, grasps: list[Grasp], features: Features, quiet: bool) -> Checkpoint:
    """The checkpoint with a check of touches: fitted on one half of the objects, thresholds from the other half."""
    device = default_device()
    names = sorted({grasp.object_id for grasp in grasps})
    partials = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    made.matcher.to(device)
    with FrozenFeatures(made.config, device, features_by_image(grasps, features, device)) as source:
        return with_verdicts(made, source, *partials, quiet=quiet)
