"""Loss of predicting an object's labels of relief and shape from the features of a tower."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from retrieval.data.labelled_pictures import FAMILIES, SIZES, ObjectLabels
from retrieval.data.pairs import PairBatch
from retrieval.errors import DatasetError
from retrieval.model.fusion import Matcher

SMOOTHING, DROPOUT = 0.05, 0.2


class LabelHead(nn.Module):
    """Predicts the families and sizes of an object (`ObjectLabels`) from features of its images.

    Attributes:
        families: Names of the families, for each of `FAMILIES`.
    """

    def __init__(self, features: int, labels: Sequence[ObjectLabels]) -> None:
        """Make a head whose predictions start at zero.

        Args:
            features: Length of a feature vector.
            labels: Labels of the training objects.
        """
        super().__init__()
        self.families = [sorted({each.families[index] for each in labels}) for index in range(len(FAMILIES))]
        sizes = np.array([each.size_targets for each in labels if not each.is_smooth])
        self.register_buffer("mean", torch.from_numpy(sizes.mean(0)).float(), persistent=False)
        self.register_buffer("deviation", torch.from_numpy(sizes.std(0) + 1e-6).float(), persistent=False)
        last = nn.Linear(features, sum(map(len, self.families)) + len(SIZES))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.BatchNorm1d(features, affine=False), nn.Dropout(DROPOUT), last)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return logits (B, kinds) of each of FAMILIES, then standardised SIZES (B, 4), of features (B, F)."""
        outputs: Tensor = self.layers(features.float())
        return torch.split(outputs, [*map(len, self.families), len(SIZES)], dim=1)

    def size_targets(self, labels: Sequence[ObjectLabels]) -> Tensor:
        """Return standardised sizes (B, 4)."""
        sizes = torch.tensor([each.size_targets for each in labels], device=self.get_buffer("mean").device)
        return (sizes - self.get_buffer("mean")) / self.get_buffer("deviation")

    def loss(self, features: Tensor, labels: Sequence[ObjectLabels]) -> Tensor:
        """Return the loss (scalar) of features (B, F) of objects: cross-entropies, and squared errors of the sizes.

        The sizes of smooth objects have no meaning and are left out.
        """
        *families, sizes = self(features)
        has_relief = torch.tensor([not each.is_smooth for each in labels], device=sizes.device)
        loss: Tensor = ((sizes - self.size_targets(labels)).square().mean(1) * has_relief).mean()
        for index, (names, logits) in enumerate(zip(self.families, families, strict=True)):
            targets = torch.tensor([names.index(each.families[index]) for each in labels], device=logits.device)
            loss = loss + functional.cross_entropy(logits, targets, label_smoothing=SMOOTHING)
        return loss


class LabelLoss(nn.Module):
    """The losses of a label head for each tower: on each finger's features, and on those of all views of a photo."""

    def __init__(self, matcher: Matcher, objects: Sequence[str], labels: Mapping[str, ObjectLabels]) -> None:
        """Make the heads.

        Args:
            matcher: The model in training.
            objects: Training objects, in the order of a batch's integers.
            labels: Labels by object.

        Raises:
            DatasetError: An object has no labels.
        """
        super().__init__()
        if missing := [name for name in objects if name not in labels]:
            raise DatasetError(
                f"training.predict_labels needs the labels of relief and shape of every object, as the simulated rig "
                f"writes them into recording.json; {missing[0]} has none: set predict_labels = 0"
            )
        self.labels = [labels[name] for name in objects]
        self.fingers, self.counts = matcher.config.fingers, matcher.pooled_counts
        self.touch, self.photo = (LabelHead(count, self.labels) for count in self.counts)

    def forward(self, batch: PairBatch, touch_features: Tensor, photo_features: Tensor) -> Tensor:
        """Return the sum of both losses (scalar) of a batch and its features (`Matcher.touch_features`)."""
        touch, photo = ([self.labels[row] for row in part] for part in (batch.touch_objects, batch.photo_objects))
        each = touch_features.reshape(len(touch) * self.fingers, -1)[:, : self.counts[0]]
        repeated = [label for label in touch for _ in range(self.fingers)]
        return self.touch.loss(each, repeated) + self.photo.loss(photo_features[:, : self.counts[1]], photo)
