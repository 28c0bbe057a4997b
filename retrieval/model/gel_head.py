"""The gel head: is an image a gel image, and does it show contact?"""

import torch
from torch import Tensor, nn

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
