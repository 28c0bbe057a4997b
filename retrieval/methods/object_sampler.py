"""What the small learned methods draw their batches with."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def seeded_generator(seed: int) -> Iterator[torch.Generator]:
    """A generator for what is drawn, and torch's own stream (first weights, dropout) seeded, its state put back."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield torch.Generator().manual_seed(seed)


class ObjectSampler:
    """Draws of grasps by object, without a loop over items. owner (n,): object of each row, from 0."""

    def __init__(self, owner: Tensor, generator: torch.Generator) -> None:
        self._rows = torch.argsort(owner, stable=True)
        self._counts = torch.bincount(owner)
        self._starts = self._counts.cumsum(0) - self._counts
        self._generator = generator
        self.objects = len(self._counts)

    def distinct_objects(self, count: int) -> Tensor:
        """(count,) objects, each at most once."""
        return torch.randperm(self.objects, generator=self._generator)[:count]

    def other_objects(self, objects: Tensor, each: int) -> Tensor:
        """(B, each) for each of `objects` (B,) so many others, uniformly, with replacement."""
        drawn = torch.randint(self.objects - 1, (len(objects), each), generator=self._generator)
        return drawn + (drawn >= objects[:, None])

    def rows(self, objects: Tensor) -> Tensor:
        """One row of each of `objects` (any shape), uniformly."""
        drawn = torch.rand(objects.shape, generator=self._generator, dtype=torch.float64)
        return self._rows[self._starts[objects] + (drawn * self._counts[objects]).long()]

    def sets(self, objects: Tensor, most: int) -> tuple[Tensor, Tensor]:
        """Sets of 1..most distinct rows of each of `objects` (B,): (B, most) rows and (B, most) which of them count.

        A set's size is uniform, but no larger than its object's number of rows.
        """
        counts = self._counts[objects]
        order = torch.rand(len(objects), max(int(counts.max()), most), generator=self._generator)
        order[torch.arange(order.shape[1]) >= counts[:, None]] = torch.inf
        places = order.argsort(1)[:, :most]
        sizes = torch.randint(1, most + 1, (len(objects),), generator=self._generator).minimum(counts)
        counted = torch.arange(most) < sizes[:, None]
        return self._rows[self._starts[objects][:, None] + places.where(counted, 0)], counted
