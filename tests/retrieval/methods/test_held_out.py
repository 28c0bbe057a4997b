"""Which objects are held out together: half of each kind, so that some of its look-alikes train and some do not."""

from itertools import pairwise

import numpy as np
import pytest

from retrieval.methods.selection import appearance_order, held_out_folds
from retrieval.training.features import Features

KINDS = [[f"{kind}{number}" for number in range(4)] for kind in "abcdefghi"]
NAMES = sorted(name for kind in KINDS for name in kind)


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


@pytest.mark.parametrize("named", [False, True])
def test_half_of_each_kind_is_held_out_together_though_nobody_names_the_kinds(named):
    kind_of = {name: name[0] for name in NAMES} if named else None
    folds = held_out_folds(photographed(KINDS), kind_of)
    assert sorted(name for fold in folds for name in fold) == NAMES
    assert list(map(len, folds)) == [9, 9, 9, 9]
    shares = [sorted(len(set(kind) & set(fold)) for fold in folds) for kind in KINDS]
    assert shares.count([0, 0, 2, 2]) == 8  # of four look-alikes two are held out, two train
    assert shares.count([1, 1, 1, 1]) == 1  # and the kind in the middle, which the chunks cut


def test_objects_that_look_alike_are_neighbours():
    order = appearance_order(photographed(KINDS))
    assert sorted(order) == NAMES
    assert sum(one[0] != other[0] for one, other in pairwise(order)) == len(KINDS) - 1


def test_kinds_that_are_named_go_before_looks_and_a_kind_that_is_missing_for_one_object_counts_for_none():
    crossed = {name: name[1] for name in NAMES}  # not what the photos show
    seen = photographed(KINDS)
    parts = held_out_folds(seen, crossed)
    assert {sum(name[1] == number for fold in parts[:2] for name in fold) for number in "0123"} <= {4, 5}
    assert held_out_folds(seen, {name: name[1] for name in NAMES[1:]}) == held_out_folds(seen)


def test_kinds_of_odd_numbers_even_out_over_the_held_out_folds():
    kinds = [["a1", "a2", "a3"], ["b1"], ["c1", "c2", "c3"], ["d1"]]
    parts = held_out_folds(photographed(kinds), {name: name[0] for kind in kinds for name in kind})
    assert list(map(len, parts)) == [4, 4]
    assert {sum(name[0] == "a" for name in part) for part in parts} == {1, 2}


def test_objects_of_one_sequence_stay_together_though_they_are_of_two_kinds():
    parts = held_out_folds(photographed(KINDS), linked=[["a0", "b3"]])
    assert any({"a0", "b3"} <= set(part) for part in parts)
    assert sorted(name for fold in parts for name in fold) == NAMES


def test_the_seed_draws_other_held_out_folds_of_named_kinds():
    seen, kind_of = photographed(KINDS), {name: name[0] for name in NAMES}
    assert held_out_folds(seen, kind_of) == held_out_folds(seen, kind_of) != held_out_folds(seen, kind_of, seed=1)


def test_two_objects_are_a_half_each():
    assert held_out_folds(photographed([["a", "b"]])) == [("a",), ("b",)]
