"""Distil the fusion head's ranking of photos into a candidate encoder (Hinton, Vinyals, Dean, arXiv:1503.02531).

The head (teacher) scores every pair of a batch of touches and photos. The candidate encoder (student) learns the
softmax of these scores over the photos. This loss gives the top of the ranking, from which candidates are taken, a
large weight.

Training examples are mixup blends of two recorded partial activations, so a few thousand recorded photos represent a
large catalogue. The head's term is affine in the normalised features, so a blend of two terms is the term of the
blended features. The embedding part (`cosine`) is blended too, and is then shorter than that of a real image.

In a large catalogue many photos score nearly as high as the exhaustive top-1; a few thousand photos contain few such
hard negatives. Therefore, after a warm-up, up to three quarters of a batch's photos come from a large pool of blends:
those nearest to its touches by the embeddings of the current student.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from retrieval.data.dataset import Grasp
from retrieval.model.candidate_encoder import CandidateEncoder, PartialStatistics
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher, candidate_encoder_of
from retrieval.training.batches import FeatureSource, recorded_features
from retrieval.training.features import Features
from retrieval.training.loop import Plan, train_loop

ROWS = 2048
"""Grasps of `feature_partials` at a time."""
BATCH_TOUCHES, BATCH_PHOTOS = 32, 2048
"""Numbers of touches and photos in a batch; every touch is scored with every photo."""
LEARNING_RATE = 2e-3
SQUARED_ERROR_WEIGHT = 0.3
"""Weight of the squared error of all scores, in addition to the divergence; it stabilises the start."""
MIN_WEIGHT = 0.5
"""Smallest weight of the first of two blended rows."""
POOL_SIZE, POOL_RENEWAL_STEPS = 50_000, 100
"""Number of blended photos in the pool, and number of steps until a new pool is drawn."""
POOL_FRACTION = 0.75
"""Largest fraction of a batch that comes from the pool."""
WARMUP_DIVISOR = 6
"""The first 1 / WARMUP_DIVISOR of the steps uses no pool, since an untrained student cannot choose from it."""
MAX_GRASPS = 8192
"""Largest number of grasps whose partial activations are blended."""
MAX_QUERIES = 512
"""Largest number of validation touches stored in a checkpoint."""


def distil(matcher: Matcher, touch_partials: Tensor, photo_partials: Tensor, settings: Config) -> None:
    """Train a candidate encoder from `matcher.head`, and add it to `matcher`; the other weights do not change.

    The partial activations (N, P) and (M, P) are those of touches and photos of training objects; their cells are not
    used. `settings` are those of the matcher with the candidate encoder.

    Raises:
        NumericalError: The loss is not finite; the matcher is unchanged.
    """
    seed, steps, config = settings.training.seed, settings.training.distil_steps, settings.matcher
    touch_partials, photo_partials = (part[:, : config.pooled_width] for part in (touch_partials, photo_partials))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        candidate_encoder = candidate_encoder_of(config).to(touch_partials.device)
    touch_statistics, photo_statistics = (
        PartialStatistics.of(part, config.pooled_width - config.hidden) for part in (touch_partials, photo_partials)
    )
    candidate_encoder.initialise_linear(photo_partials, touch_statistics, photo_statistics)
    generator, head = torch.Generator().manual_seed(seed), matcher.head.eval()
    sampler = PhotoSampler(candidate_encoder, photo_partials, photo_statistics, generator)

    def loss(step: int, _: int) -> Tensor:
        touches = blend(touch_partials, BATCH_TOUCHES, generator)
        standardised = touch_statistics(touches)
        photos = sampler.photos(step - steps // WARMUP_DIVISOR, standardised)
        scores = candidate_encoder.scores(standardised, photo_statistics(photos))
        with torch.no_grad():
            logits = head.all_logits(touches, photos)
        return distillation_loss(scores, logits)

    train_loop(
        candidate_encoder,
        torch.optim.Adam(candidate_encoder.parameters()),
        Plan(steps, LEARNING_RATE, validate_every=steps),
        lambda left: left,
        loss,
        title="fitting the candidate encoder",
    )
    candidate_encoder.fold_statistics(touch_statistics, photo_statistics)
    matcher.config, matcher.candidate_encoder = config, candidate_encoder.eval()


class PhotoSampler:
    """Sampler of photos for distillation: random blends, and the blends of a pool that are nearest to the touches."""

    def __init__(
        self,
        candidate_encoder: CandidateEncoder,
        partials: Tensor,
        statistics: PartialStatistics,
        generator: torch.Generator,
    ) -> None:
        self._encoder, self._partials, self._statistics = candidate_encoder, partials, statistics
        self._generator = generator
        self._pool, self._embeddings = partials[:0], partials[:0]

    @torch.no_grad()
    def photos(self, step: int, touches: Tensor) -> Tensor:
        """Return partial activations (BATCH_PHOTOS, P) for a step and its standardised touches (T, P).

        Steps count from the end of the warm-up. Before step 0, all photos are random blends.
        """
        if step < 0:
            return blend(self._partials, BATCH_PHOTOS, self._generator)
        if step % POOL_RENEWAL_STEPS == 0:
            self._pool = blend(self._partials, POOL_SIZE, self._generator)
            parts = torch.split(self._pool, BATCH_PHOTOS)
            self._embeddings = torch.cat([self._encoder.photo(self._statistics(part)) for part in parts])
        each = max(1, round(POOL_FRACTION * BATCH_PHOTOS / len(touches)))
        nearest = (self._encoder.touch(touches) @ self._embeddings.T).topk(each).indices
        near: Tensor = nearest.unique()  # type: ignore[no-untyped-call]
        others = blend(self._partials, BATCH_PHOTOS - len(near), self._generator)
        return torch.cat([self._pool[near], others])


def distillation_loss(scores: Tensor, logits: Tensor) -> Tensor:
    """Return the mean of KL(softmax(logits) || softmax(scores)) over touches, plus a weighted squared error.

    `scores` (T, N) are those of the student, `logits` those of the head; a constant added to a row has no effect.
    """
    divergence = functional.kl_div(
        functional.log_softmax(scores, 1), functional.log_softmax(logits, 1), log_target=True, reduction="batchmean"
    )
    centred = logits - logits.mean(1, keepdim=True)
    error = (scores - scores.mean(1, keepdim=True) - centred).square().mean() / logits.var().clamp(min=1e-6)
    return divergence + SQUARED_ERROR_WEIGHT * error


def blend(partials: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` random blends (count, P) of two rows each of `partials` (N, P)."""
    first, second = torch.randint(len(partials), (2, count), generator=generator).to(partials.device)
    weight = MIN_WEIGHT + (1 - MIN_WEIGHT) * torch.rand(count, 1, generator=generator).to(partials.device)
    return torch.lerp(partials[second], partials[first], weight)


@torch.inference_mode()
def feature_partials(matcher: Matcher, features: Features) -> tuple[Tensor, Tensor]:
    """Return partial activations (G, P) of the touches and of the photos of features."""
    # One part after another, because the hidden layer of the cells takes more memory than the features.
    touch, photo = (torch.split(torch.from_numpy(part), ROWS) for part in (features.touch_rows, features.photo))
    touch_partials = torch.cat([matcher.touch_encoding(part).partial for part in touch])
    return touch_partials, torch.cat([matcher.photo_encoding(part).partial for part in photo])


def select_queries(touch_partials: Tensor, seed: int) -> NDArray[np.float16] | None:
    """Return up to MAX_QUERIES random touch partial activations (N, P) that are finite in float16; None without any."""
    partials = touch_partials.cpu().half()
    partials = partials[torch.isfinite(partials).all(1)]
    chosen = torch.randperm(len(partials), generator=torch.Generator().manual_seed(seed))[:MAX_QUERIES]
    return np.asarray(partials[chosen.sort().values].numpy()) if len(chosen) else None


def add_candidate_encoder(
    checkpoint: Checkpoint, config: Config, source: FeatureSource, train: Sequence[Grasp], validation: Sequence[Grasp]
) -> Checkpoint:
    """Return `checkpoint` with a candidate encoder distilled on recorded grasps, and validation touches (`queries`).

    At most `MAX_GRASPS` random grasps of each part are used. The matcher, which is reused and modified, must be on the
    device of `source`. `train` has grasps, `validation` may be empty.
    """
    matcher, seed = checkpoint.matcher, config.training.seed

    @torch.inference_mode()
    def partials(grasps: Sequence[Grasp]) -> tuple[Tensor, Tensor]:
        order = torch.randperm(len(grasps), generator=torch.Generator().manual_seed(seed))[:MAX_GRASPS]
        touches, photos = recorded_features(matcher, source, [grasps[row] for row in order.tolist()])
        photo_partials = matcher.photo_encoding(torch.stack(list(photos.values()))).partial
        return matcher.touch_encoding(touches).partial, photo_partials

    queries = select_queries(partials(validation)[0], seed) if validation else None
    with source.step_context():
        distil(matcher, *partials(train), config)
    return dataclasses.replace(checkpoint, config=config, queries=queries)
