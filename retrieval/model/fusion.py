"""The matcher: two towers, the fusion head that scores a pair, and the projections for candidate search.

The first layer of the head is linear in the concatenation of the modalities, so it is stored as two layers: `W [t; v] +
b = (W_t t + b) + W_v v`. Each term is a partial activation. The partial activation of a photo is computed once, stored,
and added to that of any touch. If the logit adds the cosine of the embeddings (`MatcherConfig.cosine`), a partial
activation continues with its embedding times the root of the scale. With late interaction (`MatcherConfig.cell_dim`) it
ends with the vectors of the image's cells. So the head needs nothing else of a photo.
"""

import copy
import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from retrieval.errors import BadInput
from retrieval.model.candidate_encoder import CandidateEncoder
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.late_interaction import CellEncoder, cell_scores, paired_cell_scores
from retrieval.model.towers.tower import Tower, build_tower

LOG_SCALE_INIT, LOG_SCALE_MAX = math.log(1 / 0.07), math.log(100.0)
"""Initial and largest log of the factor of cosines in the contrastive loss."""
COSINE_SCALE_INIT = 4.0
"""Initial amount that a cosine of 1 adds to the logit."""


class ImageEncoding(NamedTuple):
    """Partial activations (B, partial) and unit embeddings (B, embedding_dim) of images, float32."""

    partial: Tensor
    embedding: Tensor


MIN_RELATIVE_DEVIATION = 0.02
"""Features whose standard deviation is below this fraction of their mean are not scaled up to a deviation of 1."""


class Standardise(nn.BatchNorm1d):
    """Centre and scale each feature by its statistics over the training batches; no parameters.

    A channel that hardly varies around a large mean is not scaled up to unit variance. Rounding the tower's weights to
    float16 shifts it by a thousandth of its mean; scaling up would make this error as large as the signal.
    """

    def __init__(self, features: int) -> None:
        super().__init__(features, affine=False)

    def forward(self, features: Tensor) -> Tensor:
        """Return standardised features (B, F)."""
        mean, variance = self.get_buffer("running_mean"), self.get_buffer("running_var")
        if torch.onnx.is_in_onnx_export():  # batch normalisation requires a width that the exporter does not know
            return (features - mean) * torch.rsqrt(self._floored_variance(mean, variance))
        scaled: Tensor = super().forward(features)
        if self.training:
            variance, mean = torch.var_mean(features.detach(), dim=0, correction=0)
        return scaled * ((variance + self.eps) / self._floored_variance(mean, variance)).sqrt()

    def _floored_variance(self, mean: Tensor, variance: Tensor) -> Tensor:
        """Return variances (F,), raised for features that hardly vary."""
        return torch.maximum(variance + self.eps, (MIN_RELATIVE_DEVIATION * mean).square())


class FusionHead(nn.Module):
    """Match logits of partial activations, with cells or without.

    The first term is late fusion (Lin et al., ICRA 2019): two layers of `hidden` units with ReLU, dropout between, one
    logit. The cosine of the embeddings and the late interaction of the cells add to it, if the matcher has them.
    """

    def __init__(self, touch_features: int, photo_features: int, config: MatcherConfig) -> None:
        """Make the layers for this number of features of a touch and of a photo, with random weights."""
        super().__init__()
        self.cosine_end, self.cell_dim, hidden = config.pooled_width, config.cell_dim, config.hidden
        self.touch_partial = nn.Linear(touch_features, hidden)
        self.photo_partial = nn.Linear(photo_features, hidden, bias=False)
        self.dropout = nn.Dropout(config.dropout)
        self.second = nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, 1)
        # PyTorch's default for the concatenated layer: uniform within 1 / sqrt(all inputs).
        bound = 1 / math.sqrt(self.touch_partial.in_features + self.photo_partial.in_features)
        for parameter in (self.touch_partial.weight, self.touch_partial.bias, self.photo_partial.weight):
            nn.init.uniform_(parameter, -bound, bound)

    def forward(self, touch_partial: Tensor, photo_partial: Tensor) -> Tensor:
        """Return match logits (P,) of touches (P, a) with photos (P, b); a first axis of 1 broadcasts."""
        pooled = slice(self.second.in_features, self.cosine_end)
        logits = self._fusion(touch_partial, photo_partial)
        logits = logits + (touch_partial[..., pooled] * photo_partial[..., pooled]).sum(-1)
        if photo_partial.shape[-1] > self.cosine_end:
            logits = logits + paired_cell_scores(self._cells(touch_partial), self._cells(photo_partial))
        return logits

    def all_logits(self, touch_partials: Tensor, photo_partials: Tensor) -> Tensor:
        """Return match logits (T, N) of every touch (T, a) with every photo (N, b)."""
        pooled = slice(self.second.in_features, self.cosine_end)
        logits = self._fusion(touch_partials[:, None], photo_partials[None])
        logits = logits + touch_partials[:, pooled] @ photo_partials[:, pooled].T
        if photo_partials.shape[-1] > self.cosine_end:
            logits = logits + cell_scores(self._cells(touch_partials), self._cells(photo_partials))
        return logits

    def _fusion(self, touch_partial: Tensor, photo_partial: Tensor) -> Tensor:
        hidden = self.second.in_features
        x = self.dropout(functional.relu(touch_partial[..., :hidden] + photo_partial[..., :hidden]))
        x = functional.relu(self.second(x))
        return self.out(x).squeeze(-1)  # type: ignore[no-any-return]

    @property
    def scorer(self) -> FusionScorer:
        """The layers after the partial activations, without dropout, in numpy; weights on the CPU are shared."""
        second, bias, out, out_bias = (
            part.detach().cpu().numpy()
            for part in (self.second.weight, self.second.bias, self.out.weight[0], self.out.bias)
        )
        return FusionScorer(second, bias, out, out_bias, cosine_dim=self.cosine_end - len(out), cell_dim=self.cell_dim)

    def _cells(self, partial: Tensor) -> Tensor:
        """Return the vectors (..., cells, cell_dim) of the cells of partial activations (..., partial)."""
        cells = partial[..., self.cosine_end :]
        return cells.reshape(*cells.shape[:-1], -1, self.cell_dim)


GEL_CLASSES = ("contact", "no_contact", "foreign")
"""Classes of the gel head."""


class GelHead(nn.Module):
    """A linear layer to one logit for each of `GEL_CLASSES`."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.classifier = nn.Linear(features, len(GEL_CLASSES))

    def forward(self, features: Tensor) -> Tensor:
        """Return readings (B, fingers, 2) of features (B, fingers, F).

        The first is the log-odds of "no gel image" against both other classes, the second that of contact against a
        no-contact gel.
        """
        contact, no_contact, foreign = self.classifier(features).unbind(-1)
        gel = torch.logsumexp(torch.stack([contact, no_contact], dim=-1), dim=-1)  # ONNX has no logaddexp
        return torch.stack([foreign - gel, contact - no_contact], dim=-1)


class Matcher(nn.Module):
    """Maps touches and photos to partial activations and embeddings, and partial activations to match logits."""

    def __init__(self, config: MatcherConfig, views: int = 1) -> None:
        """Build the layers with random weights; a photo is `views` views side by side (`retrieval.data.views`)."""
        super().__init__()
        self.views = views
        self.config = config
        # All fingers use one set of weights.
        self.touch_tower = build_tower(config.tower, config.tower_output)
        self.photo_tower = build_tower(config.photo_tower or config.tower, config.tower_output)
        if config.cell_dim:
            self.touch_tower.divide(config.touch_cells)
            self.photo_tower.divide(config.photo_cells)
        touch_features = config.fingers * self.touch_tower.feature_count
        photo_features = views * self.photo_tower.feature_count
        self.head = FusionHead(touch_features, photo_features, config)
        # Created after the head: its random initial weights are then those of the paper's model.
        self.touch_projection = _projection(touch_features, config)
        self.photo_projection = _projection(photo_features, config)
        # In evaluation mode a fixed affine map, so the head's first layer remains a sum of two terms.
        norm = Standardise if config.standardise else nn.Identity
        self.touch_norm, self.photo_norm = norm(touch_features), norm(photo_features)
        self.touch_cells = self.photo_cells = None
        if config.cell_dim:
            self.touch_cells = _cell_encoder(self.touch_tower, self.touch_tower.feature_count, config, weighted=True)
            self.photo_cells = _cell_encoder(self.photo_tower, photo_features, config, weighted=False)
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_INIT))
        self.cosine_scale = nn.Parameter(torch.tensor(COSINE_SCALE_INIT)) if config.cosine else None
        self.candidate_encoder = candidate_encoder_of(config) if config.candidate_width else None
        self.gel_head: GelHead | None = None  # fitted after training (`retrieval.training.calibration.gel_check`)

    def touch_features(self, touches: Tensor) -> Tensor:
        """Return features (B, fingers * output_count) of touches (B, fingers, 3, H, W) in 0..1, fingers in order a, b.

        Raises:
            BadInput: A touch has another number of images than this matcher has fingers.
        """
        fingers = self.config.fingers
        if touches.ndim != 5 or touches.shape[1] != fingers:
            got = f"{touches.shape[1]} image(s)" if touches.ndim == 5 else f"an array of shape {tuple(touches.shape)}"
            raise BadInput(f"this matcher takes {fingers} gel image(s) for one touch; got {got}")
        features: Tensor = self.touch_tower(touches.flatten(0, 1))
        return features.float().reshape(-1, fingers * self.touch_tower.output_count)

    def photo_features(self, photos: Tensor) -> Tensor:
        """Return features (B, F) of photos (B, 3, H, views * W) in 0..1."""
        if self.views > 1:
            # One copy with channels last: without it, convolutions in training take 1.4 times as long.
            count, _, height, _ = photos.shape
            side_by_side = photos.permute(0, 2, 3, 1).reshape(count, height, self.views, -1, 3)
            photos = side_by_side.transpose(1, 2).flatten(0, 1).permute(0, 3, 1, 2)
        outputs: Tensor = self.photo_tower(photos).float().reshape(-1, self.views, self.photo_tower.output_count)
        pooled = self.photo_tower.feature_count
        # The cells are those of the last view: a zoom into the object, if the preprocessing has one.
        return torch.cat([outputs[..., :pooled].flatten(1), outputs[:, -1, pooled:]], dim=1)

    @property
    def pooled_counts(self) -> tuple[int, int]:
        """Lengths of the features of a finger and of a photo, without cells."""
        return self.touch_tower.feature_count, self.views * self.photo_tower.feature_count

    def touch_encoding(self, features: Tensor) -> ImageEncoding:
        """Return partial activations of touch features, and their embeddings by the contrastive projection."""
        each = features.reshape(-1, self.config.fingers, self.touch_tower.output_count)
        pooled, cells = each.tensor_split((self.touch_tower.feature_count,), dim=-1)
        layers = self.touch_norm, self.head.touch_partial, self.touch_projection, self.touch_cells
        return self._encoding(pooled.flatten(1), cells, *layers)

    def photo_encoding(self, features: Tensor) -> ImageEncoding:
        """Return partial activations of photo features, and their embeddings by the contrastive projection."""
        pooled, cells = features.tensor_split((self.pooled_counts[1],), dim=1)
        layers = self.photo_norm, self.head.photo_partial, self.photo_projection, self.photo_cells
        return self._encoding(pooled, cells, *layers)

    def _encoding(
        self,
        pooled: Tensor,
        cells: Tensor,
        norm: nn.Module,
        partial: nn.Module,
        projection: nn.Module,
        cell_encoder: CellEncoder | None,
    ) -> ImageEncoding:
        """Return the encoding of features (B, F) and of the cells of these images by the layers of a modality."""
        pooled = norm(pooled)
        parts, embedding = [partial(pooled)], functional.normalize(projection(pooled).float(), dim=-1, eps=1e-6)
        if self.cosine_scale is not None:
            parts.append(embedding * self.cosine_scale.clamp(min=0.0).sqrt())
        if cell_encoder is not None:
            parts.append(cell_encoder(cells, pooled).reshape(pooled.shape[0], -1))
        return ImageEncoding(torch.cat(parts, dim=-1), embedding)

    def touch_search_encoding(self, features: Tensor) -> ImageEncoding:
        """Return partial activations and search embeddings of touch features."""
        partial, embedding = self.touch_encoding(features)
        if self.candidate_encoder is not None:
            embedding = self.candidate_encoder.touch(partial[:, : self.config.pooled_width])
        return ImageEncoding(partial, embedding)

    def photo_search_encoding(self, features: Tensor) -> ImageEncoding:
        """Return partial activations and search embeddings of photo features, as an index stores them."""
        partial, embedding = self.photo_encoding(features)
        if self.candidate_encoder is not None:
            embedding = self.candidate_encoder.photo(partial[:, : self.config.pooled_width])
        return ImageEncoding(partial, embedding)

    def gel_readings(self, features: Tensor) -> Tensor | None:
        """Return the readings (B, fingers, 2) of each finger's features (`GelHead`); None without a gel head."""
        if self.gel_head is None:
            return None
        each = features.reshape(-1, self.config.fingers, self.touch_tower.output_count)
        readings: Tensor = self.gel_head(each[..., : self.touch_tower.feature_count])
        return readings

    def encode_touches(self, touches: Tensor) -> tuple[Tensor, ...]:
        """Return partial activations, search embeddings and, with a gel head, readings of touches (B, ...)."""
        features = self.touch_features(touches)
        readings = self.gel_readings(features)
        return *self.touch_search_encoding(features), *(() if readings is None else (readings,))

    def forward(self, touches: Tensor, photos: Tensor) -> Tensor:
        """Return match logits (P,) of pairs: touches (P, fingers, 3, H, W) with photos (P, 3, H, views * W)."""
        touch = self.touch_encoding(self.touch_features(touches))
        photo = self.photo_encoding(self.photo_features(photos))
        return self.head(touch.partial, photo.partial)  # type: ignore[no-any-return]

    def without_cells(self) -> "Matcher":
        """Return a copy without late interaction; its partial activations and logits are the pooled ones."""
        pooled = copy.deepcopy(self)
        pooled.config = dataclasses.replace(self.config, cell_dim=0)
        pooled.touch_cells, pooled.photo_cells, pooled.head.cell_dim = None, None, 0
        pooled.touch_tower.divide(0)
        pooled.photo_tower.divide(0)
        return pooled

    @torch.no_grad()
    def clamp_scale(self) -> None:
        """Clamp the contrastive scale to 1..100 in the parameter; a clamp in the loss would stop its gradient."""
        self.log_scale.clamp_(0.0, LOG_SCALE_MAX)


def candidate_encoder_of(config: MatcherConfig) -> CandidateEncoder:
    """Return an untrained candidate encoder with the sizes of a matcher."""
    return CandidateEncoder(config.pooled_width, config.candidate_width, config.embedding_dim, config.candidate_linear)


def _cell_encoder(tower: Tower, features: int, config: MatcherConfig, *, weighted: bool) -> CellEncoder:
    """Return the network of the cells of images by a tower, with `features` features of the whole image."""
    channels = tower.cell_channels
    norm = Standardise(channels) if config.standardise else nn.Identity()
    return CellEncoder(tower.cells**2, channels, features, config.cell_dim, norm, weighted=weighted)


def _projection(features: int, config: MatcherConfig) -> nn.Module:
    """Return a projection to an embedding: linear, or with one hidden layer."""
    if not config.projection_hidden:
        return nn.Linear(features, config.embedding_dim)
    return nn.Sequential(
        nn.Linear(features, config.projection_hidden),
        nn.ReLU(),
        nn.Dropout(config.dropout),
        nn.Linear(config.projection_hidden, config.embedding_dim),
    )
