"""Which training objects are held out together: several look-alikes at once.

A held-out object of which many look-alikes train is told more easily than an object that a user adds tomorrow. So
look-alikes are held out half of them together, the other half training.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from retrieval.training.features import Features

LOOK_ALIKES = 4
"""Objects of a group, on average, where nobody names the groups."""


def look_alikes(features: "Features") -> list[list[str]]:
    """Objects in groups that look alike, of `LOOK_ALIKES` on average: average linkage of the correlation of mean photo
    features, each standardised over the objects."""
    from scipy.cluster.hierarchy import fcluster, linkage  # slow to import

    names = sorted(set(features.object_ids))
    count = round(len(names) / LOOK_ALIKES)
    if count < 2:
        return [names]
    owner = features.owner
    means = np.stack([features.photo[owner == place].mean(0, dtype=np.float64) for place in range(len(names))])
    spread = means.std(0)
    shown = (means - means.mean(0))[:, spread > 0] / spread[spread > 0]
    shown = shown / np.maximum(np.linalg.norm(shown, axis=1, keepdims=True), 1e-12)
    group_of = fcluster(linkage(shown, "average"), count, "maxclust")
    return grouped(names, dict(zip(names, group_of.tolist(), strict=True)))


def grouped(names: Iterable[str], group_of: Mapping[str, object]) -> list[list[str]]:
    """Objects in the groups that are named; an object of no group stands alone."""
    found: dict[object, list[str]] = {}
    for name in sorted(names):
        found.setdefault(group_of.get(name, ("alone", name)), []).append(name)
    return list(found.values())


def held_out_folds(
    groups: Sequence[Sequence[str]], size: int, seed: int, linked: Sequence[Sequence[str]] = ()
) -> list[tuple[str, ...]]:
    """Objects in folds of about `size`, each object in one: of each group one half stands in one fold, the other half
    in another.

    linked: objects that must stay together, such as those of one sequence. Raises nothing: of fewer than twice `size`
    objects there are two folds.
    """
    rng = np.random.default_rng([seed, 29])
    unit_of = {name: tuple(sorted(unit)) for unit in linked for name in unit}
    total = sum(map(len, groups))
    folds: list[list[str]] = [[] for _ in range(max(2, min(round(total / size), total // 3)))]
    for place in rng.permutation(len(groups)):
        group = sorted(groups[place])
        units = list(dict.fromkeys(unit_of.get(name, (name,)) for name in group))
        order = [units[turn] for turn in rng.permutation(len(units))]
        middle = -(-len(order) // 2)
        targets = sorted(folds, key=len)[:2]
        for half, fold in zip((order[:middle], order[middle:]), targets, strict=True):
            known = {name for one in folds for name in one}
            fold += [name for unit in half for name in unit if name not in known]
    return [tuple(sorted(fold)) for fold in folds if fold]
