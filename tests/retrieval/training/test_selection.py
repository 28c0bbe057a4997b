"""Folds of held-out objects: half of each kind, so that some similar objects train and some do not."""

import numpy as np
import pytest

from retrieval.training.features import Features
from retrieval.training.selection import held_out_folds

KINDS = [[f"{kind}{number}" for number in range(4)] for kind in "abcdefghi"]
NAMES = sorted(name for kind in KINDS for name in kind)


def features_of(kinds, noise=0.3, seed=0):
    """Return objects whose photo features are those of their kind with some of their own; three photos each."""
    rng = np.random.default_rng(seed)
    names, photos = [], []
    for members in kinds:
        of_kind = rng.standard_normal(20)
        for name in members:
            own = of_kind + noise * rng.standard_normal(20)
            for _ in range(3):
                names.append(name)
                photos.append(own + 0.1 * rng.standard_normal(20))
    ids = tuple(f"{name}-{row}" for row, name in enumerate(names))
    return Features(ids, tuple(names), np.zeros((len(names), 1, 1), np.float32), np.array(photos, np.float32))


@pytest.mark.parametrize("named", [False, True])
def test_half_of_each_kind_is_held_out_together_even_without_named_kinds(named):
    kind_of = {name: name[0] for name in NAMES} if named else None
    folds = held_out_folds(features_of(KINDS), kind_of)
    assert sorted(name for fold in folds for name in fold) == NAMES
    assert list(map(len, folds)) == [9, 9, 9, 9]
    overlaps = [sorted(len(set(kind) & set(fold)) for fold in folds) for kind in KINDS]
    assert overlaps.count([0, 0, 2, 2]) == 8  # of four similar objects two are held out, two train
    assert overlaps.count([1, 1, 1, 1]) == 1  # except the kind in the middle, which the chunks divide


def test_named_kinds_override_appearance_unless_the_kind_of_an_object_is_missing():
    crossed = {name: name[1] for name in NAMES}  # differs from the photos
    features = features_of(KINDS)
    parts = held_out_folds(features, crossed)
    assert {sum(name[1] == number for fold in parts[:2] for name in fold) for number in "0123"} <= {4, 5}
    assert held_out_folds(features, {name: name[1] for name in NAMES[1:]}) == held_out_folds(features)


def test_objects_of_one_sequence_stay_together_although_they_are_of_two_kinds():
    parts = held_out_folds(features_of(KINDS), linked=[["a0", "b3"]])
    assert any({"a0", "b3"} <= set(part) for part in parts)
    assert sorted(name for fold in parts for name in fold) == NAMES
