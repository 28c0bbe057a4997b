"""The matcher: two towers, the fusion head that judges a pair, and the projections for candidate search.

The first layer of the head is linear in the concatenation of the modalities, so it is stored as two halves:
`W [t; v] + b = (W_t t + b) + W_v v`. A photo's half can be computed once, stored, and added to any touch's. Where the
cosine of the embeddings counts too (`MatcherConfig.cosine`), a half ends with its embedding times the root of the
scale, so that halves are still all that is stored of a photo.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from retrieval.errors import BadInput
from retrieval.model.candidate_encoder import CandidateEncoder
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.losses.contrastive import LOG_SCALE_INIT, LOG_SCALE_MAX
from retrieval.model.towers import build_tower

COSINE_SCALE_INIT = 4.0
"""What a cosine of 1 adds to the logit before anything is learned."""


class ImageEncoding(NamedTuple):
    """What the matcher keeps of one image: its share of the head's first layer and its place in the metric space.

    half (B, half) and embedding (B, embedding_dim), float32; embeddings have norm 1.
    """

    partial: Tensor
    embedding: Tensor


MIN_RELATIVE_DEVIATION = 0.02
"""A feature that varies by less than this share of its mean is not scaled up to vary by 1."""


class Standardise(nn.BatchNorm1d):
    """Each feature centred and scaled by its statistics over the training batches; without parameters.

    A channel that hardly varies around a large mean would be scaled up until the rounding of its weights to float16,
    a thousandth of the mean, is as large as what it says: quiet features stay quiet.
    """

    def __init__(self, features: int) -> None:
        super().__init__(features, affine=False)

    def forward(self, features: Tensor) -> Tensor:
        """(B, F) of features (B, F)."""
        scaled: Tensor = super().forward(features)
        mean, variance = self.get_buffer("running_mean"), self.get_buffer("running_var")
        if self.training:
            variance, mean = torch.var_mean(features.detach(), dim=0, correction=0)
        return scaled * ((variance + self.eps) / self._floored_variance(mean, variance)).sqrt()

    def mean_and_scale(self) -> tuple[Tensor, Tensor]:
        """Mean (F,) and scale (F,): in evaluation mode this is `(features - mean) * scale`."""
        mean, variance = self.get_buffer("running_mean"), self.get_buffer("running_var")
        return mean, torch.rsqrt(self._floored_variance(mean, variance))

    def _floored_variance(self, mean: Tensor, variance: Tensor) -> Tensor:
        """(F,) variances, those of quiet features raised."""
        return torch.maximum(variance + self.eps, (MIN_RELATIVE_DEVIATION * mean).square())


class FusionHead(nn.Module):
    """Late fusion (Lin et al., ICRA 2019): two layers of `hidden` units with ReLU, dropout between, one logit."""

    def __init__(self, touch_features: int, photo_features: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.touch_partial = nn.Linear(touch_features, hidden)
        self.photo_partial = nn.Linear(photo_features, hidden, bias=False)
        self.dropout = nn.Dropout(dropout)
        self.second = nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, 1)
        # PyTorch's default for the concatenated layer: uniform within 1 / sqrt(all inputs).
        bound = 1 / math.sqrt(self.touch_partial.in_features + self.photo_partial.in_features)
        for parameter in (self.touch_partial.weight, self.touch_partial.bias, self.photo_partial.weight):
            nn.init.uniform_(parameter, -bound, bound)

    def forward(self, touch_partial: Tensor, photo_partial: Tensor) -> Tensor:
        """Match logits (P,) of pairs of halves (P, half); either side broadcasts from (1, half)."""
        hidden = self.second.in_features
        x = self.dropout(functional.relu(touch_partial[..., :hidden] + photo_partial[..., :hidden]))
        x = functional.relu(self.second(x))
        cosine = (touch_partial[..., hidden:] * photo_partial[..., hidden:]).sum(-1)
        return self.out(x).squeeze(-1) + cosine  # type: ignore[no-any-return]


class Matcher(nn.Module):
    """Touch and photo in, halves and embeddings out; halves in, match logit out."""

    def __init__(self, config: MatcherConfig, views: int = 1) -> None:
        """views: pictures of a photo that stand side by side (`retrieval.data.views`)."""
        super().__init__()
        self.views = views
        self.config = config
        # One set of weights for all fingers.
        self.touch_tower = build_tower(config.tower, config.tower_output, config.architectures)
        self.photo_tower = build_tower(config.tower, config.tower_output, config.architectures)
        touch_features = config.fingers * self.touch_tower.feature_count
        photo_features = views * self.photo_tower.feature_count
        self.head = FusionHead(touch_features, photo_features, config.hidden, config.dropout)
        # After the head, so that their initial weights do not change the paper's.
        self.touch_projection = nn.Linear(touch_features, config.embedding_dim)
        self.photo_projection = nn.Linear(photo_features, config.embedding_dim)
        # At use a fixed affine map, so halves stay sums of shares.
        norm = Standardise if config.standardise else nn.Identity
        self.touch_norm, self.photo_norm = norm(touch_features), norm(photo_features)
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_INIT))
        self.cosine_scale = nn.Parameter(torch.tensor(COSINE_SCALE_INIT)) if config.cosine else None
        self.candidate_encoder = candidate_encoder_of(config) if config.candidate_width else None
        self.gel_head: GelHead | None = None  # fitted when the training is over (`retrieval.training.verdicts`)

    def touch_features(self, touches: Tensor) -> Tensor:
        """Features (B, fingers * features) of touches (B, fingers, 3, H, W) in 0..1, fingers in order a, b.

        Raises BadInput where the number of images is not the number of fingers this matcher was built for.
        """
        fingers = self.config.fingers
        if touches.ndim != 5 or touches.shape[1] != fingers:
            got = f"{touches.shape[1]} image(s)" if touches.ndim == 5 else f"an array of shape {tuple(touches.shape)}"
            raise BadInput(f"this matcher takes {fingers} gel image(s) for one touch; got {got}")
        features: Tensor = self.touch_tower(touches.flatten(0, 1))
        return features.float().view(len(touches), -1)

    def photo_features(self, photos: Tensor) -> Tensor:
        """Features (B, views * features) of photos (B, 3, H, views * W) in 0..1."""
        if self.views > 1:
            # Copied once, with channels last: convolutions in training take 1.4 times as long otherwise.
            count, _, height, _ = photos.shape
            side_by_side = photos.permute(0, 2, 3, 1).reshape(count, height, self.views, -1, 3)
            photos = side_by_side.transpose(1, 2).flatten(0, 1).permute(0, 3, 1, 2)
        features: Tensor = self.photo_tower(photos)
        return features.float().view(len(photos) // self.views, -1)

    def touch_encoding(self, features: Tensor) -> ImageEncoding:
        """Half of touch features, and their embedding by the contrastive projection."""
        features = self.touch_norm(features)
        return self._encoding(self.head.touch_partial(features), _unit(self.touch_projection(features)))

    def photo_encoding(self, features: Tensor) -> ImageEncoding:
        """Half of photo features, and their embedding by the contrastive projection."""
        features = self.photo_norm(features)
        return self._encoding(self.head.photo_partial(features), _unit(self.photo_projection(features)))

    def _encoding(self, share: Tensor, embedding: Tensor) -> ImageEncoding:
        if self.cosine_scale is None:
            return ImageEncoding(share, embedding)
        return ImageEncoding(torch.cat([share, embedding * self.cosine_scale.clamp(min=0.0).sqrt()], dim=-1), embedding)

    def touch_search_encoding(self, features: Tensor) -> ImageEncoding:
        """Half and embedding for candidate search of touch features."""
        code = self.touch_encoding(features)
        return (
            code
            if self.candidate_encoder is None
            else ImageEncoding(code.partial, self.candidate_encoder.touch(code.partial))
        )

    def gel_readings(self, features: Tensor) -> Tensor | None:
        """(B, fingers, 2) what touch features say of each finger's image (`GelHead`); None without a check."""
        if self.gel_head is None:
            return None
        readings: Tensor = self.gel_head(features.view(-1, self.config.fingers, self.touch_tower.feature_count))
        return readings

    def photo_search_encoding(self, features: Tensor) -> ImageEncoding:
        """Half and embedding for candidate search of photo features: what an index keeps."""
        code = self.photo_encoding(features)
        return (
            code
            if self.candidate_encoder is None
            else ImageEncoding(code.partial, self.candidate_encoder.photo(code.partial))
        )

    def forward(self, touches: Tensor, photos: Tensor) -> Tensor:
        """Match logits (P,) of pairs: touches (P, fingers, 3, H, W) with photos (P, 3, H, W)."""
        touch = self.touch_encoding(self.touch_features(touches))
        photo = self.photo_encoding(self.photo_features(photos))
        return self.head(touch.partial, photo.partial)  # type: ignore[no-any-return]

    @torch.no_grad()
    def clamp_scale(self) -> None:
        """Hold the scale of the contrastive scores at 100 at most; on the parameter, so that it can come back."""
        self.log_scale.clamp_(0.0, LOG_SCALE_MAX)


def candidate_encoder_of(config: MatcherConfig) -> CandidateEncoder:
    """An untaught candidate_encoder of a matcher."""
    return CandidateEncoder(config.partial_width, config.candidate_width, config.embedding_dim, config.candidate_linear)


def _unit(x: Tensor) -> Tensor:
    return functional.normalize(x.float(), dim=-1, eps=1e-6)


def scorer_of(head: FusionHead) -> FusionScorer:
    """What follows the halves of a head, dropout off whatever its mode; a view of its weights where they lie on the
    CPU.
    """
    parts = (head.second.weight, head.second.bias, head.out.weight[0], head.out.bias)
    return FusionScorer(*(part.detach().cpu().numpy() for part in parts))


def score_partials(
    head: FusionHead,
    touch_partials: Tensor,
    photo_partials: NDArray[np.floating[Any]],
    rows: NDArray[np.int64] | None = None,
) -> NDArray[np.float32]:
    """`FusionScorer.logits` of a head in PyTorch and touch halves (G, half)."""
    return scorer_of(head).logits(touch_partials.detach().cpu().numpy(), photo_partials, rows)


GEL_CLASSES = ("contact", "no_contact", "foreign")
"""What the gel head tells apart."""


class GelHead(nn.Module):
    """A linear layer to one logit for each of KINDS."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.classifier = nn.Linear(features, len(GEL_CLASSES))

    def forward(self, features: Tensor) -> Tensor:
        """Readings (B, fingers, 2) of features (B, fingers, F): log-odds of "no gel image" against both others, and of
        contact against an untouched gel.
        """
        contact, no_contact, foreign = self.classifier(features).unbind(-1)
        gel = torch.logsumexp(torch.stack([contact, no_contact], dim=-1), dim=-1)  # ONNX knows no logaddexp
        return torch.stack([foreign - gel, contact - no_contact], dim=-1)
