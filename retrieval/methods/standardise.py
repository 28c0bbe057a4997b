"""Standardisation of features to mean 0 and variance 1 over the training grasps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.errors import BadInput

MIN_RELATIVE_SPREAD = 1e-6
"""Features whose spread is below this fraction of their size are constant in float32, and dropped."""


@dataclass(frozen=True, eq=False)
class Standardiser:
    """`(x - mean) / scale` of the features that vary.

    Attributes:
        columns: (F',) indices of these features.
        mean: (F',) their means.
        scale: (F',) their standard deviations.
    """

    columns: NDArray[np.int64]
    mean: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def fit(cls, x: NDArray[Any]) -> "Standardiser":
        """Return the statistics of x (n, ...), flattened to (n, F), in float64. Raises BadInput if all are constant."""
        x = _flat(x)
        mean, scale = x.mean(0), x.std(0)
        columns = np.flatnonzero(scale > MIN_RELATIVE_SPREAD * np.abs(x).max(0))
        if not len(columns):
            raise BadInput(
                f"features must differ between grasps; all {x.shape[1]} are constant over {len(x)}; check images"
            )
        return cls(columns, mean[columns], scale[columns])

    def __call__(self, x: NDArray[Any]) -> NDArray[np.float64]:
        """Return standardised features (n, F') of x (n, ...)."""
        return (_flat(x)[:, self.columns] - self.mean) / self.scale

    def tensor(self, x: NDArray[Any]) -> Tensor:
        """Return the standardised features as a float32 tensor."""
        return torch.from_numpy(self(x)).float()


def _flat(x: NDArray[Any]) -> NDArray[np.float64]:
    x = np.asarray(x)
    return np.asarray(x.reshape(len(x), int(np.prod(x.shape[1:]))), dtype=np.float64)
