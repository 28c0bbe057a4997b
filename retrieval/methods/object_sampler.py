"""Batch sampling for the small learned methods."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def seeded_generator(seed: int) -> Iterator[torch.Generator]:
    """Yield a seeded generator for draws; seed torch's own stream (initial weights, dropout), and restore it after."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield torch.Generator().manual_seed(seed)


class ObjectSampler:
    """Samples grasps by object, without a loop over items."""

    def __init__(self, owner: Tensor, generator: torch.Generator) -> None:
        """Index the rows.

        Args:
            owner: (n,) object of each row, from 0.
            generator: Source of the draws.
        """
        self._rows = torch.argsort(owner, stable=True)
        self._counts = torch.bincount(owner)
        self._starts = self._counts.cumsum(0) - self._counts
        self._generator = generator
        self.objects = len(self._counts)

    def distinct_objects(self, count: int) -> Tensor:
        """Return (count,) objects, each at most once."""
        return torch.randperm(self.objects, generator=self._generator)[:count]

    def other_objects(self, objects: Tensor, each: int) -> Tensor:
        """Return (B, each): for each of `objects` (B,) other objects, uniformly, with replacement."""
        drawn = torch.randint(self.objects - 1, (len(objects), each), generator=self._generator)
        return drawn + (drawn >= objects[:, None])

    def rows(self, objects: Tensor) -> Tensor:
        """Return one row of each of `objects` (any shape), uniformly."""
        drawn = torch.rand(objects.shape, generator=self._generator, dtype=torch.float64)
        return self._rows[self._starts[objects] + (drawn * self._counts[objects]).long()]

    def sets(self, objects: Tensor, max_size: int) -> tuple[Tensor, Tensor]:
        """Return sets of 1..max_size distinct rows of each of `objects` (B,): rows (B, max_size) and a mask of members.

        A set's size is uniform, but at most its object's number of rows.
        """
        counts = self._counts[objects]
        order = torch.rand(len(objects), max(int(counts.max()), max_size), generator=self._generator)
        order[torch.arange(order.shape[1]) >= counts[:, None]] = torch.inf
        places = order.argsort(1)[:, :max_size]
        sizes = torch.randint(1, max_size + 1, (len(objects),), generator=self._generator).minimum(counts)
        counted = torch.arange(max_size) < sizes[:, None]
        return self._rows[self._starts[objects][:, None] + places.where(counted, 0)], counted
