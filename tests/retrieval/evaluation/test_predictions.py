"""Queries, and the scores of a method for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.evaluation.predictions import predict
from retrieval.evaluation.queries import SET_SIZES, SETS_OF_AN_OBJECT, draw_queries
from retrieval.methods.chance import Chance
from retrieval.methods.method import MethodSettings
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


def test_queries_hold_all_test_grasps_and_some_of_the_others():
    names, counts = np.unique([GRASPS[row].object_id for row in QUERIES.touches], return_counts=True)
    assert dict(zip(names.tolist(), counts.tolist(), strict=True)) == {
        "a": MAX_GRASPS["train"], "b": 3, "c": MAX_GRASPS["validation"], "d": 6, "e": 24, "f": 2,
    }  # fmt: skip
    assert len(set(QUERIES.touches.tolist())) == len(QUERIES.touches)


def test_touches_and_photos_have_the_right_objects_and_parts():
    assert QUERIES.objects == ("a", "b", "c", "d", "e", "f")
    for rows, owner in ((QUERIES.touches, QUERIES.touch_owner), (QUERIES.photos, QUERIES.photo_owner)):
        assert [GRASPS[row].object_id for row in rows] == [QUERIES.objects[number] for number in owner]
    for part in ("train", "validation", "test"):
        places = QUERIES.of_part(QUERIES.touch_owner, part)
        assert {GRASPS[row].object_id for row in QUERIES.touches[places]} == set(getattr(SPLIT, part))


def test_a_shared_photo_file_is_listed_once():
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


def test_queries_depend_on_the_seed():
    assert draw_queries(GRASPS, SPLIT, 0, MAX_GRASPS).digest == QUERIES.digest
    assert draw_queries(GRASPS, SPLIT, 1, MAX_GRASPS).digest != QUERIES.digest
    assert replace(QUERIES, sets={1: QUERIES.sets[1]}).digest != QUERIES.digest


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


@pytest.fixture(scope="module")
def predictions(features):
    return predict(fitted(Chance, features), features, QUERIES, 2.5)


def test_predictions_are_the_scores_of_the_queries_in_their_order(features, predictions):
    method = fitted(Chance, features)
    assert predictions.scores.shape == (len(QUERIES.touches), len(QUERIES.photos))
    for row, column in ((0, 0), (7, 20), (30, 5)):
        touch = features.touch[QUERIES.touches[row]][None]
        photo = features.photo[QUERIES.photos[column]][None]
        single = method.score(method.encode_touch(touch), method.encode_photo(photo))
        assert predictions.scores[row, column] == pytest.approx(single[0, 0], abs=1e-6)


def test_scores_of_sets_are_those_of_the_method(features, predictions):
    method = fitted(Chance, features)
    codes = method.encode_touch(features.touch[QUERIES.touches]), method.encode_photo(features.photo[QUERIES.photos])
    for size, sets in QUERIES.sets.items():
        np.testing.assert_allclose(predictions.set_scores[size], method.score_sets(*codes, sets), rtol=1e-6, atol=1e-6)
    fused = predict(fitted(Largest, features), features, QUERIES, 0.0)
    for size, sets in QUERIES.sets.items():
        expected = np.array([predictions.scores[list(row)].max(0) for row in sets])
        np.testing.assert_array_equal(fused.set_scores[size], expected)
