"""Teaches a pruner the order in which the classifier puts photos (Hinton, Vinyals, Dean, arXiv:1503.02531).

The classifier judges every pair of a batch of touches and photos; the student's scores learn its softmax over the
photos. That asks for the top of the order above all, which is what candidates are taken from. Both are drawn afresh
each step as blends of two recorded ones: halves are affine in features, so that a blend of halves is the half of a
blend of features, and a few thousand recorded photos stand for the crowd that a large catalogue is.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.errors import Interrupted
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import FusionHead, Matcher
from retrieval.model.pruner import Pruner, Spread
from retrieval.training.batches import FeatureSource, recorded_features
from retrieval.training.features import Features
from retrieval.training.fit import Plan, fit

TOUCHES, PHOTOS = 32, 2048
"""In a batch; every touch is judged with every photo."""
LEARNING_RATE = 2e-3
SPREAD_WEIGHT = 0.3
"""Of the squared error of all scores, beside the divergence at the top: it steadies the start."""
LEAST_SHARE = 0.5
"""Of the nearer one of two blended ones."""
SHARE = 0.01
"""Of the photos that are candidates when a pruner is measured."""
MOST = 8192
"""Grasps whose halves are blended."""
QUERIES = 512
"""At most so many validation touches are kept in a checkpoint."""


def distil(
    matcher: Matcher,
    touch_halves: Tensor,
    photo_halves: Tensor,
    *,
    width: int,
    steps: int,
    seed: int,
    quiet: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Give `matcher` a pruner of `width` hidden units, taught by `matcher.head`; nothing else of it changes.

    touch_halves, photo_halves (N, half): of training objects. The same seed gives the same pruner. Raises
    Interrupted once `stopped()`, NumericalError for a loss that is not finite; the matcher is then as it was.
    """
    config = dataclasses.replace(matcher.config, pruner_width=width)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        pruner = Pruner(config.half, width, config.embedding_dim).to(touch_halves.device)
    touch_spread, photo_spread = Spread.of(touch_halves), Spread.of(photo_halves)
    generator, head = torch.Generator().manual_seed(seed), matcher.head.eval()

    def loss(_: int) -> Tensor:
        touches = blend(touch_halves, TOUCHES, generator)
        photos = blend(photo_halves, PHOTOS, generator)
        scores = pruner.scores(touch_spread(touches), photo_spread(photos))
        return order_loss(scores, all_logits(head, touches, photos))

    optimizer, plan = torch.optim.Adam(pruner.parameters()), Plan(steps, LEARNING_RATE)
    with Bar("teach pruner", steps, "steps", quiet=quiet) as bar:
        if fit(optimizer, plan, range(steps), loss, bar=bar, stopped=stopped) < steps:
            raise Interrupted("stopped before the pruner was taught")
    pruner.absorb(touch_spread, photo_spread)
    matcher.config, matcher.pruner = config, pruner.eval()


def order_loss(scores: Tensor, logits: Tensor) -> Tensor:
    """Divergence of the student's softmax over photos from the head's, and a share of the spread's error.

    scores, logits (T, N), each free by a constant a row. Mean over touches of KL(softmax(logits) || softmax(scores)).
    """
    divergence = functional.kl_div(
        functional.log_softmax(scores, 1), functional.log_softmax(logits, 1), log_target=True, reduction="batchmean"
    )
    centred = logits - logits.mean(1, keepdim=True)
    error = (scores - scores.mean(1, keepdim=True) - centred).square().mean() / logits.var().clamp(min=1e-6)
    return divergence + SPREAD_WEIGHT * error


def blend(halves: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count, hidden) halves, each between two of `halves` (N, half) and nearer to the first."""
    pairs = torch.randint(len(halves), (2, count), generator=generator).to(halves.device)
    share = LEAST_SHARE + (1 - LEAST_SHARE) * torch.rand(count, 1, generator=generator).to(halves.device)
    return torch.lerp(halves[pairs[1]], halves[pairs[0]], share)


@torch.no_grad()
def all_logits(head: FusionHead, touch_halves: Tensor, photo_halves: Tensor) -> Tensor:
    """(T, N) match logits of every touch with every photo, a touch at a time: all at once take T times the memory."""
    return torch.stack([head(touch[None], photo_halves) for touch in touch_halves])


def measured(matcher: Matcher, touch_halves: Tensor, photo_halves: Tensor) -> dict[str, float]:
    """Metrics of a pruner: the share of touches whose winner is among the nearest 1 % of the photos."""
    candidates = max(1, round(SHARE * len(photo_halves)))
    ranks = winner_ranks(matcher, touch_halves, photo_halves)
    return {"pruner_finds_winner_in_nearest_percent": float((ranks < candidates).mean())}


def winner_ranks(matcher: Matcher, touch_halves: Tensor, photo_halves: Tensor) -> NDArray[np.int64]:
    """(T,) place from 0, in the pruner's order, of the photo that the head puts first for each touch."""
    assert matcher.pruner is not None
    with torch.inference_mode():
        winners = all_logits(matcher.head, touch_halves, photo_halves).argmax(1)
        nearness = matcher.pruner.touch(touch_halves) @ matcher.pruner.photo(photo_halves).T
        nearer = nearness > nearness.gather(1, winners[:, None])
    return nearer.sum(1).cpu().numpy()


def recorded_halves(
    matcher: Matcher,
    source: FeatureSource,
    grasps: Sequence[Grasp],
    seed: int,
    *,
    quiet: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[Tensor, Tensor]:
    """Halves (N, half) of the touches of grasps and of their photos; of `MOST` grasps, drawn by the seed, if there
    are more."""
    order = torch.randperm(len(grasps), generator=torch.Generator().manual_seed(seed))[:MOST]
    drawn = [grasps[row] for row in order.tolist()]
    touches, photos = recorded_features(matcher, source, drawn, what="pruner", quiet=quiet, stopped=stopped)
    with torch.inference_mode():
        return matcher.touch_code(touches).half, matcher.photo_code(torch.stack(list(photos.values()))).half


@torch.inference_mode()
def feature_halves(matcher: Matcher, features: Features) -> tuple[Tensor, Tensor]:
    """Halves (G, half) of the touches and of the photos of features."""
    touch, photo = torch.from_numpy(features.touch).flatten(1), torch.from_numpy(features.photo)
    return matcher.touch_code(touch).half, matcher.photo_code(photo).half


def kept_queries(touch_halves: Tensor, seed: int) -> NDArray[np.float16] | None:
    """Up to QUERIES of touch halves (N, half), drawn by the seed, of those that float16 holds; None for none."""
    halves = touch_halves.cpu().half()
    halves = halves[torch.isfinite(halves).all(1)]
    chosen = torch.randperm(len(halves), generator=torch.Generator().manual_seed(seed))[:QUERIES]
    return np.asarray(halves[chosen.sort().values].numpy()) if len(chosen) else None


def with_pruner(
    made: Checkpoint,
    config: Config,
    train: tuple[Tensor, Tensor],
    validation: tuple[Tensor, Tensor] | None = None,
    *,
    quiet: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Checkpoint:
    """The checkpoint `made` with the pruner that `config` asks for, its queries and its own measure among the metrics.

    train, validation: touch halves and photo halves (N, half) of training objects, and of validation objects where
    there are any; the pruner is measured by touches of these among the photos of all. The matcher of `made` is taken
    over. Raises as `distil`.
    """
    settings, matcher, metrics = config.training, made.matcher, made.provenance["metrics"]
    width, steps = config.matcher.pruner_width, settings.distil_steps
    distil(matcher, *train, width=width, steps=steps, seed=settings.seed, quiet=quiet, stopped=stopped)
    queries = None if validation is None else kept_queries(validation[0], settings.seed)
    if validation is not None and queries is not None:
        touches = torch.from_numpy(queries).to(validation[1].device).float()
        metrics = metrics | measured(matcher, touches, torch.cat([train[1], validation[1]]))
    about = made.provenance | {"metrics": metrics}
    return dataclasses.replace(made, matcher=matcher, config=config, provenance=about, queries=queries)


def add_pruner(
    made: Checkpoint,
    config: Config,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    quiet: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Checkpoint:
    """The checkpoint `made` with the pruner that `config` asks for, taught by recorded grasps.

    `validation` may be empty. Its matcher is taken over, and lies where `source` computes. Raises as `distil`.
    """
    halves = [
        recorded_halves(made.matcher, source, grasps, config.training.seed, quiet=quiet, stopped=stopped)
        for grasps in (train, validation)
        if grasps
    ]
    with source.stepping():
        return with_pruner(made, config, *halves, quiet=quiet, stopped=stopped)
