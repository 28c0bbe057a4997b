"""Teaches a pruner the order in which the classifier puts photos (Hinton, Vinyals, Dean, arXiv:1503.02531).

The classifier judges every pair of a batch of touches and photos; the student's scores learn its softmax over the
photos. That asks for the top of the order above all, which is what candidates are taken from. Both are drawn afresh
each step as blends of two recorded ones: halves are affine in features, so that a blend of halves is the half of a
blend of features, and a few thousand recorded photos stand for the crowd that a large catalogue is. In such a crowd a
winner stands among others that are nearly as good, and a few thousand photos have few of these: so most of a batch are
the nearest of a pool of many, by the student as it is so far.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

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
from retrieval.model.fusion import FusionHead, Matcher, pruner_of
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
POOL, RENEWED = 50_000, 100
"""Blended photos of which the nearest are taught, and after how many steps they are others."""
NEAR = 0.75
"""Of a batch, at most: the nearest of the pool."""
ALONE = 6
"""The first of so many parts of the steps is without a pool: a student that knows nothing finds nothing."""
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
    linear: int = 0,
    quiet: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Give `matcher` a pruner of `width` hidden units and `linear` numbers that are linear in the contrastive
    embedding (`retrieval.model.config.MatcherConfig`), taught by `matcher.head`; nothing else of it changes.

    touch_halves, photo_halves (N, half): of training objects. The same seed gives the same pruner. Raises
    Interrupted once `stopped()`, NumericalError for a loss that is not finite; the matcher is then as it was.
    """
    config = dataclasses.replace(matcher.config, pruner_width=width, pruner_linear=linear)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        pruner = pruner_of(config).to(touch_halves.device)
    touch_spread, photo_spread = (Spread.of(part, config.half - config.hidden) for part in (touch_halves, photo_halves))
    pruner.begin_with_axes(photo_halves, touch_spread, photo_spread)
    generator, head = torch.Generator().manual_seed(seed), matcher.head.eval()
    crowd = _Crowd(pruner, photo_halves, photo_spread, generator)

    def loss(step: int) -> Tensor:
        touches = blend(touch_halves, TOUCHES, generator)
        read = touch_spread(touches)
        photos = crowd.photos(step - steps // ALONE, read)
        scores = pruner.scores(read, photo_spread(photos))
        return order_loss(scores, all_logits(head, touches, photos))

    optimizer, plan = torch.optim.Adam(pruner.parameters()), Plan(steps, LEARNING_RATE)
    with Bar("teach pruner", steps, "steps", quiet=quiet) as bar:
        if fit(optimizer, plan, range(steps), loss, bar=bar, stopped=stopped) < steps:
            raise Interrupted("stopped before the pruner was taught")
    pruner.absorb(touch_spread, photo_spread)
    matcher.config, matcher.pruner = config, pruner.eval()


class _Crowd:
    """Photos to teach with: blends drawn for a step, and of a pool of blends those nearest to its touches."""

    def __init__(self, pruner: Pruner, halves: Tensor, spread: Spread, generator: torch.Generator) -> None:
        self._pruner, self._halves, self._spread, self._generator = pruner, halves, spread, generator
        self._pool, self._embeddings = Blends.drawn(halves, 0, generator), halves[:0]

    @torch.no_grad()
    def photos(self, step: int, touches: Tensor) -> Tensor:
        """Halves (PHOTOS, half) for a step and its touches (T, half), centred and scaled; before step 0 of drawn
        blends alone."""
        if step < 0:
            return blend(self._halves, PHOTOS, self._generator)
        if step % RENEWED == 0:
            self._pool = Blends.drawn(self._halves, POOL, self._generator)
            rows = torch.arange(POOL, device=self._halves.device)
            halves = (self._pool.of(self._halves, rows[start : start + PHOTOS]) for start in range(0, POOL, PHOTOS))
            self._embeddings = torch.cat([self._pruner.photo(self._spread(part)) for part in halves])
        each = max(1, round(NEAR * PHOTOS / len(touches)))
        near = (self._pruner.touch(touches) @ self._embeddings.T).topk(each).indices
        near = torch.tensor(sorted(set(near.flatten().tolist())), device=near.device)
        others = blend(self._halves, PHOTOS - len(near), self._generator)
        return torch.cat([self._pool.of(self._halves, near), others])


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


class Blends(NamedTuple):
    """Which rows are blended: pairs (2, n) of them, and the share (n, 1) of the first of each."""

    pairs: Tensor
    share: Tensor

    @classmethod
    def drawn(cls, halves: Tensor, count: int, generator: torch.Generator) -> Self:
        """`count` blends of rows of `halves` (N, half)."""
        pairs = torch.randint(len(halves), (2, count), generator=generator).to(halves.device)
        share = LEAST_SHARE + (1 - LEAST_SHARE) * torch.rand(count, 1, generator=generator).to(halves.device)
        return cls(pairs, share)

    def of(self, halves: Tensor, rows: Tensor) -> Tensor:
        """(len(rows), half): those blends, each between two of `halves` and nearer to the first."""
        nearer, other = self.pairs[:, rows]
        return torch.lerp(halves[other], halves[nearer], self.share[rows])


def blend(halves: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count, half) blends of `halves` (N, half), drawn for themselves."""
    return Blends.drawn(halves, count, generator).of(halves, torch.arange(count, device=halves.device))


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
    width, linear, steps = config.matcher.pruner_width, config.matcher.pruner_linear, settings.distil_steps
    seed = settings.seed
    distil(matcher, *train, width=width, linear=linear, steps=steps, seed=seed, quiet=quiet, stopped=stopped)
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
