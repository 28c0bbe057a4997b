"""What a finger's image shows, read off the touch tower's features: contact, an untouched gel, or no gel image."""

import torch
from torch import Tensor, nn

KINDS = ("contact", "untouched", "foreign")


class GelHead(nn.Module):
    """A linear layer to one logit for each of KINDS."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.kinds = nn.Linear(features, len(KINDS))

    def forward(self, features: Tensor) -> Tensor:
        """Readings (B, fingers, 2) of features (B, fingers, F): log-odds of "no gel image" against both others, and of
        contact against an untouched gel."""
        contact, untouched, foreign = self.kinds(features).unbind(-1)
        gel = torch.logsumexp(torch.stack([contact, untouched], dim=-1), dim=-1)  # ONNX knows no logaddexp
        return torch.stack([foreign - gel, contact - untouched], dim=-1)
