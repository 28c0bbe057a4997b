"""Which objects are held out together, to choose settings and to say what a score means: half of a kind at once.

A held-out object, all of whose look-alikes train, is told more easily than one that a user adds tomorrow. So half of
the objects of a kind are held out together, while the other half trains.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from retrieval.training.features import Features


FEWEST_FOR_FOUR = 12
"""Objects that four folds need, three in each; fewer make two folds."""


def held_out_folds(
    features: "Features",
    kind_of: Mapping[str, str] | None = None,
    linked: Iterable[Sequence[str]] = (),
    seed: int = 0,
) -> list[tuple[str, ...]]:
    """The objects in four folds, or two: of each kind every second object stands in one fold, the others in another.

    kind_of: the kind of each object, where the recording names it; otherwise objects that look alike are of one kind
    (`by_looks`). linked: objects that stay together, such as those of one sequence.
    """
    names = sorted(set(features.object_ids))
    if kind_of is not None and all(name in kind_of for name in names):
        shuffled = [names[place] for place in np.random.default_rng([seed, 29]).permutation(len(names))]
        order = sorted(shuffled, key=lambda name: kind_of[name])
    else:
        order = by_looks(features)
    unit_of = {name: tuple(each for each in sorted(unit) if each in names) for unit in linked for name in unit}
    sides: list[list[str]] = [[], []]
    for unit in dict.fromkeys(unit_of.get(name, (name,)) for name in order):
        min(sides, key=len).extend(unit)
    if len(names) < FEWEST_FOR_FOUR or any(len(unit) > 1 for unit in unit_of.values()):
        return [tuple(sorted(side)) for side in sides]
    return [tuple(sorted(part.tolist())) for side in sides for part in np.array_split(side, 2)]


def by_looks(features: "Features") -> list[str]:
    """The objects in an order in which neighbours look alike: leaves of average linkage, in optimal order (Bar-Joseph,
    Gifford and Jaakkola 2001), of the mean photo features of each object, standardised over the objects."""
    from scipy.cluster.hierarchy import leaves_list, linkage  # slow to import

    names, owner = sorted(set(features.object_ids)), features.owner
    if len(names) < 3:
        return names
    means = np.stack([features.photo[owner == place].mean(0, dtype=np.float64) for place in range(len(names))])
    spread = means.std(0)
    shown = (means - means.mean(0))[:, spread > 0] / spread[spread > 0]
    shown = shown / np.maximum(np.linalg.norm(shown, axis=1, keepdims=True), 1e-12)
    return [names[place] for place in leaves_list(linkage(shown, "average", optimal_ordering=True))]
