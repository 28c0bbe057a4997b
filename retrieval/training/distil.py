"""Teaches a candidate_encoder the order in which the classifier puts photos (Hinton, Vinyals, Dean, arXiv:1503.02531).

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
from retrieval.errors import JobInterrupted
from retrieval.model.candidate_encoder import CandidateEncoder, PartialStatistics
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import FusionHead, Matcher, candidate_encoder_of
from retrieval.training.batches import FeatureSource, recorded_features
from retrieval.training.features import Features
from retrieval.training.fit import Plan, fit

BATCH_TOUCHES, BATCH_PHOTOS = 32, 2048
"""In a batch; every touch is judged with every photo."""
LEARNING_RATE = 2e-3
SPREAD_WEIGHT = 0.3
"""Of the squared error of all scores, beside the divergence at the top: it steadies the start."""
MIN_WEIGHT = 0.5
"""Of the nearer one of two blended ones."""
POOL_SIZE, POOL_RENEWAL_STEPS = 50_000, 100
"""Blended photos of which the nearest are taught, and after how many steps they are others."""
POOL_FRACTION = 0.75
"""Of a batch, at most: the nearest of the pool."""
WARMUP_DIVISOR = 6
"""The first of so many parts of the steps is without a pool: a student that knows nothing finds nothing."""
CANDIDATE_FRACTION = 0.01
"""Of the photos that are candidates when a candidate_encoder is measured."""
MAX_GRASPS = 8192
"""Grasps whose halves are blended."""
MAX_QUERIES = 512
"""At most so many validation touches are kept in a checkpoint."""


def distil(
    matcher: Matcher,
    touch_partials: Tensor,
    photo_partials: Tensor,
    *,
    width: int,
    steps: int,
    seed: int,
    linear: int = 0,
    quiet: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Give `matcher` a candidate_encoder of `width` hidden units and `linear` numbers that are linear in the contrastive
    embedding (`retrieval.model.config.MatcherConfig`), taught by `matcher.head`; nothing else of it changes.

    touch_partials, photo_partials (N, half): of training objects. The same seed gives the same candidate_encoder. Raises
    JobInterrupted once `should_stop()`, NumericalError for a loss that is not finite; the matcher is then as it was.
    """
    config = dataclasses.replace(matcher.config, candidate_width=width, candidate_linear=linear)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        candidate_encoder = candidate_encoder_of(config).to(touch_partials.device)
    touch_spread, photo_spread = (
        PartialStatistics.of(part, config.partial_width - config.hidden) for part in (touch_partials, photo_partials)
    )
    candidate_encoder.initialise_linear(photo_partials, touch_spread, photo_spread)
    generator, head = torch.Generator().manual_seed(seed), matcher.head.eval()
    crowd = _PhotoSampler(candidate_encoder, photo_partials, photo_spread, generator)

    def loss(step: int) -> Tensor:
        touches = blend(touch_partials, BATCH_TOUCHES, generator)
        read = touch_spread(touches)
        photos = crowd.photos(step - steps // WARMUP_DIVISOR, read)
        scores = candidate_encoder.scores(read, photo_spread(photos))
        return distillation_loss(scores, all_logits(head, touches, photos))

    optimizer, plan = torch.optim.Adam(candidate_encoder.parameters()), Plan(steps, LEARNING_RATE)
    with Bar("teach candidate_encoder", steps, "steps", quiet=quiet) as bar:
        if fit(optimizer, plan, range(steps), loss, bar=bar, should_stop=should_stop) < steps:
            raise JobInterrupted("stopped before the candidate_encoder was taught")
    candidate_encoder.fold_statistics(touch_spread, photo_spread)
    matcher.config, matcher.candidate_encoder = config, candidate_encoder.eval()


class _PhotoSampler:
    """Photos to teach with: blends drawn for a step, and of a pool of blends those nearest to its touches."""

    def __init__(
        self,
        candidate_encoder: CandidateEncoder,
        partials: Tensor,
        spread: PartialStatistics,
        generator: torch.Generator,
    ) -> None:
        self._pruner, self._partials, self._spread, self._generator = candidate_encoder, partials, spread, generator
        self._pool, self._embeddings = Blends.sample(partials, 0, generator), partials[:0]

    @torch.no_grad()
    def photos(self, step: int, touches: Tensor) -> Tensor:
        """Partials (PHOTOS, half) for a step and its touches (T, half), centred and scaled; before step 0 of drawn
        blends alone.
        """
        if step < 0:
            return blend(self._partials, BATCH_PHOTOS, self._generator)
        if step % POOL_RENEWAL_STEPS == 0:
            self._pool = Blends.sample(self._partials, POOL_SIZE, self._generator)
            rows = torch.arange(POOL_SIZE, device=self._partials.device)
            partials = (
                self._pool.of(self._partials, rows[start : start + BATCH_PHOTOS])
                for start in range(0, POOL_SIZE, BATCH_PHOTOS)
            )
            self._embeddings = torch.cat([self._pruner.photo(self._spread(part)) for part in partials])
        each = max(1, round(POOL_FRACTION * BATCH_PHOTOS / len(touches)))
        near = (self._pruner.touch(touches) @ self._embeddings.T).topk(each).indices
        near = torch.tensor(sorted(set(near.flatten().tolist())), device=near.device)
        others = blend(self._partials, BATCH_PHOTOS - len(near), self._generator)
        return torch.cat([self._pool.of(self._partials, near), others])


def distillation_loss(scores: Tensor, logits: Tensor) -> Tensor:
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
    weight: Tensor

    @classmethod
    def sample(cls, partials: Tensor, count: int, generator: torch.Generator) -> Self:
        """`count` blends of rows of `partials` (N, half)."""
        pairs = torch.randint(len(partials), (2, count), generator=generator).to(partials.device)
        weight = MIN_WEIGHT + (1 - MIN_WEIGHT) * torch.rand(count, 1, generator=generator).to(partials.device)
        return cls(pairs, weight)

    def of(self, partials: Tensor, rows: Tensor) -> Tensor:
        """(len(rows), half): those blends, each between two of `partials` and nearer to the first."""
        nearer, other = self.pairs[:, rows]
        return torch.lerp(partials[other], partials[nearer], self.weight[rows])


def blend(partials: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count, half) blends of `partials` (N, half), drawn for themselves."""
    return Blends.sample(partials, count, generator).of(partials, torch.arange(count, device=partials.device))


@torch.no_grad()
def all_logits(head: FusionHead, touch_partials: Tensor, photo_partials: Tensor) -> Tensor:
    """(T, N) match logits of every touch with every photo, a touch at a time: all at once take T times the memory."""
    return torch.stack([head(touch[None], photo_partials) for touch in touch_partials])


def agreement_metrics(matcher: Matcher, touch_partials: Tensor, photo_partials: Tensor) -> dict[str, float]:
    """Metrics of a candidate_encoder: the share of touches whose winner is among the nearest 1 % of the photos."""
    candidates = max(1, round(CANDIDATE_FRACTION * len(photo_partials)))
    ranks = exhaustive_top1_ranks(matcher, touch_partials, photo_partials)
    return {"candidate_agreement_at_1_percent": float((ranks < candidates).mean())}


def exhaustive_top1_ranks(matcher: Matcher, touch_partials: Tensor, photo_partials: Tensor) -> NDArray[np.int64]:
    """(T,) place from 0, in the candidate_encoder's order, of the photo that the head puts first for each touch."""
    assert matcher.candidate_encoder is not None
    with torch.inference_mode():
        winners = all_logits(matcher.head, touch_partials, photo_partials).argmax(1)
        nearness = matcher.candidate_encoder.touch(touch_partials) @ matcher.candidate_encoder.photo(photo_partials).T
        nearer = nearness > nearness.gather(1, winners[:, None])
    return nearer.sum(1).cpu().numpy()


def recorded_partials(
    matcher: Matcher,
    source: FeatureSource,
    grasps: Sequence[Grasp],
    seed: int,
    *,
    quiet: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[Tensor, Tensor]:
    """Partials (N, half) of the touches of grasps and of their photos; of `MAX_GRASPS` grasps, drawn by the seed, if there
    are more.
    """
    order = torch.randperm(len(grasps), generator=torch.Generator().manual_seed(seed))[:MAX_GRASPS]
    sample = [grasps[row] for row in order.tolist()]
    touches, photos = recorded_features(
        matcher, source, sample, what="candidate_encoder", quiet=quiet, should_stop=should_stop
    )
    with torch.inference_mode():
        return matcher.touch_encoding(touches).partial, matcher.photo_encoding(
            torch.stack(list(photos.values()))
        ).partial


@torch.inference_mode()
def feature_partials(matcher: Matcher, features: Features) -> tuple[Tensor, Tensor]:
    """Partials (G, half) of the touches and of the photos of features."""
    touch, photo = torch.from_numpy(features.touch).flatten(1), torch.from_numpy(features.photo)
    return matcher.touch_encoding(touch).partial, matcher.photo_encoding(photo).partial


def select_queries(touch_partials: Tensor, seed: int) -> NDArray[np.float16] | None:
    """Up to QUERIES of touch halves (N, half), drawn by the seed, of those that float16 holds; None for none."""
    partials = touch_partials.cpu().half()
    partials = partials[torch.isfinite(partials).all(1)]
    chosen = torch.randperm(len(partials), generator=torch.Generator().manual_seed(seed))[:MAX_QUERIES]
    return np.asarray(partials[chosen.sort().values].numpy()) if len(chosen) else None


def with_candidate_encoder(
    made: Checkpoint,
    config: Config,
    train: tuple[Tensor, Tensor],
    validation: tuple[Tensor, Tensor] | None = None,
    *,
    quiet: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> Checkpoint:
    """The checkpoint `made` with the candidate_encoder that `config` asks for, its queries and its own measure among the metrics.

    train, validation: touch halves and photo halves (N, half) of training objects, and of validation objects where
    there are any; the candidate_encoder is measured by touches of these among the photos of all. The matcher of `made` is taken
    over. Raises as `distil`.
    """
    settings, matcher, metrics = config.training, made.matcher, made.provenance["metrics"]
    width, linear, steps = config.matcher.candidate_width, config.matcher.candidate_linear, settings.distil_steps
    seed = settings.seed
    distil(matcher, *train, width=width, linear=linear, steps=steps, seed=seed, quiet=quiet, should_stop=should_stop)
    queries = None if validation is None else select_queries(validation[0], settings.seed)
    if validation is not None and queries is not None:
        touches = torch.from_numpy(queries).to(validation[1].device).float()
        metrics = metrics | agreement_metrics(matcher, touches, torch.cat([train[1], validation[1]]))
    about = made.provenance | {"metrics": metrics}
    return dataclasses.replace(made, matcher=matcher, config=config, provenance=about, queries=queries)


def add_candidate_encoder(
    made: Checkpoint,
    config: Config,
    source: FeatureSource,
    train: Sequence[Grasp],
    validation: Sequence[Grasp],
    *,
    quiet: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> Checkpoint:
    """The checkpoint `made` with the candidate_encoder that `config` asks for, taught by recorded grasps.

    `validation` may be empty. Its matcher is taken over, and lies where `source` computes. Raises as `distil`.
    """
    partials = [
        recorded_partials(made.matcher, source, grasps, config.training.seed, quiet=quiet, should_stop=should_stop)
        for grasps in (train, validation)
        if grasps
    ]
    with source.step_context():
        return with_candidate_encoder(made, config, *partials, quiet=quiet, should_stop=should_stop)
