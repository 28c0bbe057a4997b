"""Which objects are held out together: half of each kind, so that none is judged with all of its kind known."""

import numpy as np
import pytest

from retrieval.methods.held_out import grouped, held_out_folds, look_alikes
from retrieval.training.features import Features

KINDS = [[f"{kind}{number}" for number in range(4)] for kind in "abcdefghi"]


def photographed(kinds, noise=0.3, seed=0):
    """Objects whose photos show their kind, and themselves a little; three photos of each."""
    rng = np.random.default_rng(seed)
    names, photos = [], []
    for members in kinds:
        shared = rng.standard_normal(20)
        for name in members:
            own = shared + noise * rng.standard_normal(20)
            for _ in range(3):
                names.append(name)
                photos.append(own + 0.1 * rng.standard_normal(20))
    ids = tuple(f"{name}-{row}" for row, name in enumerate(names))
    return Features(ids, tuple(names), np.zeros((len(names), 1, 1), np.float32), np.array(photos, np.float32))


def test_objects_that_look_alike_are_grouped_though_nobody_names_their_kind():
    assert sorted(map(sorted, look_alikes(photographed(KINDS)))) == KINDS


def test_few_objects_are_one_group():
    assert look_alikes(photographed([["a", "b", "c"]])) == [["a", "b", "c"]]


def test_objects_that_nobody_names_a_group_of_stand_alone():
    assert grouped("abcd", {"a": 1, "c": 1}) == [["a", "c"], ["b"], ["d"]]


@pytest.mark.parametrize("size", [6, 9, 18])
@pytest.mark.parametrize("seed", range(5))
def test_half_of_each_kind_is_held_out_together_while_the_other_half_teaches(size, seed):
    folds = held_out_folds(KINDS, size, seed)
    assert sorted(name for fold in folds for name in fold) == sorted(name for kind in KINDS for name in kind)
    assert len(folds) == 36 // size
    assert max(map(len, folds)) - min(map(len, folds)) <= 4
    for kind in KINDS:
        assert sorted(len(set(kind) & set(fold)) for fold in folds if set(kind) & set(fold)) == [2, 2]


def test_of_an_odd_kind_the_larger_half_is_held_out_together():
    folds = held_out_folds([["a1", "a2", "a3"], ["b"], ["c1", "c2"]], 3, 0)
    assert sorted(len({"a1", "a2", "a3"} & set(fold)) for fold in folds) == [1, 2]
    assert sorted(len({"c1", "c2"} & set(fold)) for fold in folds) == [1, 1]


def test_objects_of_one_sequence_stay_together_though_they_are_of_two_kinds():
    for seed in range(5):
        folds = held_out_folds(KINDS, 9, seed, linked=[["a0", "b3"]])
        assert any({"a0", "b3"} <= set(fold) for fold in folds)
        assert sorted(name for fold in folds for name in fold) == sorted(name for kind in KINDS for name in kind)


def test_the_seed_draws_other_halves():
    assert held_out_folds(KINDS, 9, 0) == held_out_folds(KINDS, 9, 0) != held_out_folds(KINDS, 9, 1)
