"""The checkpoint: codes fitted on all own objects become a matcher's projections, folds say what its logits mean."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from retrieval.adaptation.estimate import Estimate
from retrieval.adaptation.material import Material
from retrieval.data.dataset import Grasp, Split, data_digest
from retrieval.methods.cca_towers import GRID, MAX_CALIBRATION_TOUCHES, Codes, fit_codes
from retrieval.metrics.pairs import fit_calibration
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import default_device, one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import JudgedTouches, fit_posterior
from retrieval.model.references import FeltTouches, fit_references
from retrieval.training.batches import FrozenFeatures
from retrieval.training.features import Features, by_image
from retrieval.training.judgement import with_verdicts


@one_thread()
def fit_matcher(material: Material, estimate: Estimate | None, out: Path) -> Checkpoint:
    """The checkpoint of codes fitted on all own objects; without an estimate by the widest ridges."""
    features, config, matcher = material.features, material.config, material.matcher
    if estimate:
        codes = estimate.choice.codes
        scale, offset = _log_odds(part.judged for part in estimate.choice.held_out)
    else:
        touch, most = features.touch.reshape(len(features), -1), max(GRID)
        codes = dict(fit_codes(touch, features.photo, features.owner, material.blocks, [most]))[most]
        scale, offset = 1.0, 0.0
    install(matcher, codes, scale, offset)
    objects = tuple(sorted(set(features.object_ids)))
    return Checkpoint(
        path=out,
        digest="",
        config=config,
        provenance={
            "step": 0,
            "source": material.source,
            "data_digest": data_digest(material.grasps),
            "metrics": estimate.to_dict() if estimate else {},
        },
        gel_check=None,
        matcher=matcher,
        split=Split(config.training.seed, train=objects, validation=(), test=()),
    )


def _log_odds(parts: Iterable[JudgedTouches]) -> tuple[float, float]:
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
def install(matcher: Matcher, codes: Codes, scale: float, offset: float) -> None:
    """Make the matcher judge by `scale * cosine + offset` of the codes; its layers of the head add nothing."""
    for layer, found in ((matcher.touch_projection, codes.touch), (matcher.photo_projection, codes.photo)):
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


def with_probabilities(made: Checkpoint, material: Material, estimate: Estimate | None, *, quiet: bool) -> Checkpoint:
    """The fitted checkpoint with a check of touches, and with the posterior of the folds: what a match is worth is told
    by objects left out, as codes know those that they were fitted on too well. Without an estimate it has no
    posterior."""
    made = _checked(made, material.grasps, material.features, quiet)
    if estimate is None:
        return dataclasses.replace(made, posterior=None, references=None)
    # Touches of objects that were held out, half of each kind together, with the match logits of the matcher.
    assert made.matcher.cosine_scale is not None
    scale, offset = made.matcher.cosine_scale.item(), made.matcher.head.out.bias.item()
    left_out = [
        FeltTouches(dataclasses.replace(part.judged, logits=scale * part.judged.logits + offset), part.codes)
        for part in estimate.choice.held_out
    ]
    return _calibrated(made, left_out)


def start_with_probabilities(start: Checkpoint, material: Material, estimate: Estimate, *, quiet: bool) -> Checkpoint:
    """The model that one started from, with a check of touches and a posterior fitted to own objects."""
    made = _checked(start, material.grasps, estimate.known.features, quiet)
    folds = [sorted(set(fold.left_out.object_ids)) for fold in estimate.folds]
    about = {"source": material.source, "data_digest": data_digest(material.grasps)}
    provenance = start.provenance | {"adapted_to": about, "metrics": estimate.to_dict()}
    return _calibrated(
        dataclasses.replace(made, provenance=provenance), estimate.known.felt(folds, MAX_CALIBRATION_TOUCHES)
    )


def _calibrated(made: Checkpoint, left_out: list[FeltTouches]) -> Checkpoint:
    """The checkpoint with a posterior and the worth of reference touches, both fitted on touches of objects left
    out."""
    posterior = fit_posterior(*(part.judged for part in left_out))
    return dataclasses.replace(made, posterior=posterior, references=fit_references(*left_out))


def _checked(made: Checkpoint, grasps: list[Grasp], features: Features, quiet: bool) -> Checkpoint:
    """The checkpoint with a check of touches: fitted on one half of the objects, thresholds from the other half."""
    device = default_device()
    names = sorted({grasp.object_id for grasp in grasps})
    halves = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    made.matcher.to(device)
    with FrozenFeatures(made.config, device, by_image(grasps, features, device)) as source:
        return with_verdicts(made, source, *halves, quiet=quiet)
