"""Steel billets: which place of a billet was touched. Welded billets alone where there are such: touches of ground ones
look nearly blank, and what names those is the drift of the capture.
"""

from collections import defaultdict

import numpy as np

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts, registered_metrics, topn_accuracy

_PARTS = 4


def by_billet(facts: RecordingFacts) -> dict[str, list[str]]:
    """Places of each welded billet, sorted; of all billets where none is called welded. Raises DatasetError."""
    found: dict[str, list[str]] = defaultdict(list)
    for place, billet in facts.sequence_of.items():
        found[billet].append(place)
    welded = {name: places for name, places in found.items() if name.startswith("welded")}
    billets = {name: sorted(places) for name, places in sorted((welded or found).items())}
    if len(billets) < 3:
        raise DatasetError(
            f"to train, to choose and to test there must be 3 billets at least; there are {len(billets)}"
        )
    return billets


def _unseen(facts: RecordingFacts, seed: int) -> list[Split]:
    billets = by_billet(facts)
    names = list(billets)
    found = []
    for number, name in enumerate(names):
        others = names[number + 1 :] + names[:number]
        chooses = others[seed % len(others)]
        trains = [place for other in others if other != chooses for place in billets[other]]
        found.append(Split(seed, tuple(sorted(trains)), tuple(billets[chooses]), tuple(billets[name])))
    return found


def _places(facts: RecordingFacts, seed: int) -> list[Split]:
    parts: list[list[str]] = [[] for _ in range(_PARTS)]
    for number, places in enumerate(by_billet(facts).values()):
        order = np.random.default_rng([seed, 29, number]).permutation(len(places))
        for turn, place in enumerate(order):
            parts[turn % _PARTS].append(places[place])
    found = []
    for number, test in enumerate(parts):
        chooses = parts[(number + 1) % _PARTS]
        trains = [place for part in parts if part is not test and part is not chooses for place in part]
        found.append(Split(seed, tuple(sorted(trains)), tuple(sorted(chooses)), tuple(sorted(test))))
    return found


UNSEEN = Protocol(
    "billets",
    "Billets: a place of an unseen welded billet",
    "Each welded billet is left out once, another one chooses settings; the gallery holds the places of that billet.",
    _unseen,
    {**topn_accuracy(5), **topn_accuracy(10), **topn_accuracy(16), **registered_metrics("pair_auc")},
    allows_own_photos=True,
    is_by_sequence=True,
    binomial_measure="topn_k16",
)
PLACES = Protocol(
    "billets",
    "Billets: an unseen place of a seen welded billet",
    "A quarter of the places of each welded billet tests, a quarter chooses, half trains; every place is tested once. "
    "The gallery holds the four test places of the same billet.",
    _places,
    {**topn_accuracy(4), **registered_metrics("pair_auc")},
    allows_own_photos=True,
    is_by_sequence=True,
    binomial_measure="topn_k4",
)
