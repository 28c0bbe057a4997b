"""Queries, and the scores of a method for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.evaluation.inputs import thin_grasps
from retrieval.evaluation.queries import (
    SETS_OF_AN_OBJECT,
    MethodScores,
    Queries,
    draw_queries,
    score_queries,
)
from retrieval.evaluation.results import PairThreshold
from retrieval.methods.chance import Chance
from retrieval.methods.method import MethodSettings
from retrieval.metrics.registry import SET_SIZES
from retrieval.training.features import Features
from tests.conftest import TINY

SPLIT = Split(0, train=("a", "b"), validation=("c", "d"), test=("e", "f"))


def recorded(counts):
    """Return grasps of objects in turn; every third photo is shared with the next grasp."""
    grasps = []
    for name, count in counts.items():
        for number in range(count):
            photo = Path(f"{name}-{number - number % 3 % 2}.png")
            grasps.append(Grasp(f"{name}-{number}", name, None, photo, (Path(f"{name}-{number}-a.png"),), ()))
    return grasps


GRASPS = recorded({"a": 20, "b": 3, "c": 20, "d": 6, "e": 24, "f": 2, "left out": 5})
MAX_GRASPS = {"train": 8, "validation": 12}
QUERIES = draw_queries(GRASPS, SPLIT, 0, MAX_GRASPS)


def test_queries_are_all_test_grasps_and_some_of_the_others_with_each_photo_file_once():
    names, counts = np.unique([GRASPS[row].object_id for row in QUERIES.touches], return_counts=True)
    assert dict(zip(names.tolist(), counts.tolist(), strict=True)) == {
        "a": MAX_GRASPS["train"], "b": 3, "c": MAX_GRASPS["validation"], "d": 6, "e": 24, "f": 2,
    }  # fmt: skip
    assert len(set(QUERIES.touches.tolist())) == len(QUERIES.touches)
    assert QUERIES.objects == ("a", "b", "c", "d", "e", "f")
    for rows, owner in ((QUERIES.touches, QUERIES.touch_owner), (QUERIES.photos, QUERIES.photo_owner)):
        assert [GRASPS[row].object_id for row in rows] == [QUERIES.objects[number] for number in owner]
    files = [GRASPS[row].photo for row in QUERIES.photos]
    assert len(set(files)) == len(files) < len(QUERIES.touches)
    assert [files[column] for column in QUERIES.own_photo] == [GRASPS[row].photo for row in QUERIES.touches]


def test_sets_have_different_grasps_of_one_object_and_leave_three_photos():
    have = {"c": 12, "d": 6, "e": 24, "f": 2}
    for size in SET_SIZES:
        sets = QUERIES.sets[size]
        owners = QUERIES.touch_owner[sets]
        assert (owners == owners[:, :1]).all()
        assert all(len(set(row)) == size for row in sets.tolist())
        names, counts = np.unique([QUERIES.objects[number] for number in owners[:, 0]], return_counts=True)
        assert set(names.tolist()) == {name for name, count in have.items() if count - size >= 3}
        assert set(counts.tolist()) == {SETS_OF_AN_OBJECT}


def test_a_control_encodes_evenly_spaced_grasps_of_each_object():
    thin = [grasp.grasp_id for grasp in thin_grasps(GRASPS, 3)]
    assert thin[:6] == ["a-0", "a-9", "a-19", "b-0", "b-1", "b-2"]
    assert [name for name in thin if name.startswith("f")] == ["f-0", "f-1"]  # it has no more
    assert thin_grasps(GRASPS, None) == GRASPS


@pytest.mark.parametrize("part", ["train", "validation", "test"])
def test_two_objects_of_each_part_must_be_recorded(part):
    lacking = [grasp for grasp in GRASPS if grasp.object_id != getattr(SPLIT, part)[0]]
    with pytest.raises(DatasetError, match=f"at least 2 {part} objects, but the recording has 1"):
        draw_queries(lacking, SPLIT, 0, MAX_GRASPS)


@pytest.fixture(scope="module")
def features():
    rng = np.random.default_rng(0)
    touch, photo = rng.standard_normal((len(GRASPS), 1, 6)), rng.standard_normal((len(GRASPS), 4))
    ids = tuple(zip(*((grasp.grasp_id, grasp.object_id) for grasp in GRASPS), strict=True))
    return Features(*ids, touch.astype(np.float32), photo.astype(np.float32))


def fitted(cls, features):
    method = cls(MethodSettings(TINY))
    method.fit(features.of_objects(SPLIT.train), features.of_objects(SPLIT.validation))
    return method


class Largest(Chance):
    """Method that scores a set by its largest score."""

    def _score_sets(self, touch_encodings, photo_encodings, sets):
        return self._score(touch_encodings, photo_encodings)[sets].max(1)


def test_scores_are_those_of_the_method_for_touches_and_sets(features):
    method = fitted(Chance, features)
    found = score_queries(method, features, QUERIES)
    codes = method.encode_touch(features.touch[QUERIES.touches]), method.encode_photo(features.photo[QUERIES.photos])
    np.testing.assert_allclose(found.scores, method.score(*codes), atol=1e-6)  # float32 sums
    largest = score_queries(fitted(Largest, features), features, QUERIES)
    for size, sets in QUERIES.sets.items():
        np.testing.assert_allclose(found.set_scores[size], method.score_sets(*codes, sets), rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(largest.set_scores[size], [found.scores[list(row)].max(0) for row in sets])


def test_tables_have_the_rows_and_photos_of_their_parts_and_mark_photos_of_own_grasps(features):
    found = score_queries(fitted(Chance, features), features, QUERIES)
    tables = found.tables(with_threshold=False)
    assert [set(table.photo_owner) for table in (tables.test, tables.all_objects)] == [{4, 5}, set(range(6))]
    for table in (tables.test, tables.all_objects):
        assert {QUERIES.objects[number] for number in table.touch_owner} == set(SPLIT.test)
        assert table.own.sum(1).tolist() == [1] * len(table.own)
    assert set(tables.sets) == set(SET_SIZES)
    for size, sets in tables.sets.items():
        assert {QUERIES.objects[number] for number in sets.touch_owner} <= set(SPLIT.test)
        assert (sets.own.sum(1) <= size).all()
        assert sets.own.any()
    assert {QUERIES.objects[number] for number in found.touches("validation").photo_owner} == set(SPLIT.validation)
    assert not replace(found, allows_own_photos=True).touches("test").own.any()


def test_pair_accuracy_uses_the_threshold_of_the_checkpoint_or_of_a_posterior_of_ten_validation_objects():
    def threshold(objects, own=None):
        owner, places = np.repeat(np.arange(objects), 4), np.arange(4 * objects)
        scores = np.random.default_rng(0).normal(2.0 * (owner[:, None] == owner) + 5).astype(np.float32)
        parts = ("validation",) * objects
        queries = Queries(places, places, places, owner, owner, tuple(map(str, range(objects))), parts, {})
        return MethodScores(queries, scores, {}, own, 0)

    few, enough = threshold(9).pair_threshold, threshold(10)
    assert (few.at, few.source) == (None, None)
    assert "at least 10 validation objects; the split has 9" in few.reason
    assert enough.pair_threshold.source == "validation objects"
    assert enough.posterior.log_ratio(enough.pair_threshold.at, 1) == pytest.approx(0, abs=1e-9)
    assert 5 < enough.pair_threshold.at < 7  # between the means of wrong and right pairs
    assert threshold(2, own=1.5).pair_threshold == PairThreshold(1.5, "the checkpoint")
