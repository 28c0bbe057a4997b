"""Steel billets: identify the place of a billet that was touched.

Only welded billets are used if the recording has some. Touches of ground billets are nearly blank, so that only the
drift of the capture identifies them.
"""

from collections import defaultdict
from dataclasses import replace

import numpy as np

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.protocol import Protocol, RecordingFacts, split_of, topn_accuracy
from retrieval.metrics.registry import METRICS

_PARTS = 4


def by_billet(facts: RecordingFacts) -> dict[str, list[str]]:
    """Return the sorted places of each welded billet, or of all billets if none is named welded.

    Raises:
        DatasetError: There are fewer than three billets.
    """
    found: dict[str, list[str]] = defaultdict(list)
    for place, billet in facts.sequence_of.items():
        found[billet].append(place)
    welded = {name: places for name, places in found.items() if name.startswith("welded")}
    billets = {name: sorted(places) for name, places in sorted((welded or found).items())}
    if len(billets) < 3:
        raise DatasetError(
            f"Training, validation and test need at least 3 billets, but the recording has {len(billets)}."
        )
    return billets


def _unseen(facts: RecordingFacts, seed: int) -> list[Split]:
    billets = by_billet(facts)
    names, found = list(billets), []
    for number, name in enumerate(names):
        others = names[number + 1 :] + names[:number]
        validation = others[seed % len(others)]
        train = [place for other in others if other != validation for place in billets[other]]
        found.append(split_of(seed, train, billets[validation], billets[name]))
    return found


def _places(facts: RecordingFacts, seed: int) -> list[Split]:
    parts: list[list[str]] = [[] for _ in range(_PARTS)]
    for number, places in enumerate(by_billet(facts).values()):
        order = np.random.default_rng([seed, 29, number]).permutation(places).tolist()
        for turn, part in enumerate(parts):
            part.extend(order[turn::_PARTS])
    turned = [parts[number:] + parts[:number] for number in range(_PARTS)]  # test, validation, and two to train
    return [split_of(seed, [*first, *second], validation, test) for test, validation, first, second in turned]


UNSEEN = Protocol(
    "billets",
    "Billets: a place of an unseen welded billet",
    "Each welded billet is the test billet once; settings are selected on another one. The gallery contains the places "
    "of the test billet.",
    _unseen,
    {**topn_accuracy(5), **topn_accuracy(10), **topn_accuracy(16), "pair_auc": METRICS["pair_auc"]},
    allows_own_photos=True,
    is_by_sequence=True,
)
PLACES = replace(
    UNSEEN,
    title="Billets: an unseen place of a seen welded billet",
    rule="Of the places of each welded billet a quarter is for test, a quarter for validation and half for training; "
    "every place is tested once. The gallery contains the four test places of the same billet.",
    folds=_places,
    measures={**topn_accuracy(4), "pair_auc": METRICS["pair_auc"]},
)
