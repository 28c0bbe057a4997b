"""Real-data protocols: disjoint splits, every object tested once for each seed, the right galleries."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import BadInput, ConfigError, DatasetError
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS
from retrieval.evaluation.aggregate import verdict
from retrieval.evaluation.inputs import clock_features, missing_no_contact_reason
from retrieval.evaluation.protocol import RecordingFacts
from retrieval.evaluation.results import Verdict
from retrieval.evaluation.touch_to_touch import TouchToTouch
from retrieval.metrics.intervals import Difference, Summary, compare_splits, summarise_splits
from retrieval.metrics.measure import Measure, pooled


def facts(sequence_of, about=None, splits=None):
    grasps = [
        Grasp(f"{name}-{turn}", name, sequence, Path(f"{name}.jpg"), (Path(f"{name}-{turn}.png"),), ())
        for name, sequence in sequence_of.items()
        for turn in range(2)
    ]
    return RecordingFacts(Path("drawn"), "drawn", grasps, about or {}, splits or {})


def vt60(instances=4):
    classes = ["bottleempty", "ball", "bottlefull", *(f"kind{number}" for number in range(7))]
    about = {f"{kind}-{n}": kind for kind in classes for n in range(instances)}
    return facts(dict.fromkeys(about), about)


def billets():
    kinds = (*(f"welded{n}" for n in range(5)), *(f"ground{n}" for n in range(4)))
    return facts({f"{kind}-{place:02}": kind for kind in kinds for place in range(16)})


RECORDINGS = {
    "vt60-choices": vt60(),
    "vt60-seen-classes": vt60(),
    "vt60-random": vt60(),
    "vt60-classes": vt60(),
    "billets-unseen": billets(),
    "billets-places": billets(),
    "objectfolder": facts(
        dict.fromkeys("abcdefgh"), splits={"published": Split(0, tuple("abcd"), tuple("ef"), tuple("gh"))}
    ),
    "rct": facts(dict.fromkeys(f"m{n}" for n in range(60))),
    "feeling-of-success": facts(dict.fromkeys(f"o{n}" for n in range(105))),
}
WITHOUT_SPLIT = {"physiclear"}
"""Protocols without training; test_touch_to_touch tests them."""


def folds(name, seed=0):
    return PROTOCOLS.load(name).folds(RECORDINGS[name], seed)


def test_every_protocol_has_a_recording_here():
    assert set(RECORDINGS) | WITHOUT_SPLIT | {UNSEEN_OBJECTS} == set(PROTOCOLS)
    assert all(isinstance(PROTOCOLS.load(name), TouchToTouch) == (name in WITHOUT_SPLIT) for name in PROTOCOLS)


@pytest.mark.parametrize("name", RECORDINGS)
def test_parts_are_disjoint_and_have_at_least_two_objects(name):
    for split in folds(name):
        parts = [set(part) for part in (split.train, split.validation, split.test)]
        assert sum(map(len, parts)) == len(set.union(*parts))
        assert min(map(len, parts)) >= 2
        assert set.union(*parts) <= set(RECORDINGS[name].names)


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_seed_tests_the_same_objects_each_once(name):
    tested = [Counter(each for split in folds(name, seed) for each in split.test) for seed in range(3)]
    if PROTOCOLS.load(name).choices:
        assert all(set(each) == set(tested[0]) for each in tested)  # each object in some choice
    else:
        assert tested[0] == tested[1] == tested[2]
        assert set(tested[0].values()) == {1}


def test_choices_hold_out_all_pairs_of_instance_numbers_then_random_ones():
    splits = folds("vt60-choices")
    assert [len(split.test) for split in splits] == [18] * 15
    assert [len(split.train + split.validation) for split in splits] == [18] * 15
    numbers = [[{name[-1] for name in split.test}, Counter(name[:-2] for name in split.test)] for split in splits]
    assert [sorted(one) for one, _ in numbers[:6]] == [list(f"{i}{j}") for i in range(4) for j in range(i + 1, 4)]
    assert all(set(classes.values()) == {2} for _, classes in numbers)
    assert len({split.test for split in splits}) == 15
    assert [split.test for split in folds("vt60-choices", 1)][:6] == [split.test for split in splits[:6]]


def test_a_choice_has_two_galleries_of_one_object_of_each_class():
    protocol = PROTOCOLS.load("vt60-choices")
    for split in folds("vt60-choices"):
        gallery_of = protocol.gallery_of(RECORDINGS["vt60-choices"], split)
        assert set(gallery_of) == set(split.test)
        for gallery in set(gallery_of.values()):
            members = [name[:-2] for name in split.test if gallery_of[name] == gallery]
            assert (len(members), len(set(members))) == (9, 9)


@pytest.mark.parametrize("name", RECORDINGS)
def test_folds_depend_on_the_seed(name):
    assert folds(name, 1) == folds(name, 1)
    if name != "objectfolder":  # has a published split
        assert [set(one.train) for one in folds(name, 0)] != [set(one.train) for one in folds(name, 1)]


def test_full_bottles_are_in_no_part():
    for name in ("vt60-seen-classes", "vt60-random", "vt60-classes"):
        for split in folds(name):
            assert not [each for each in (*split.train, *split.validation, *split.test) if "bottlefull" in each]
        assert sum(len(split.test) for split in folds(name)) == 36


def test_a_fold_of_seen_classes_tests_one_instance_of_each_class():
    for split in folds("vt60-seen-classes"):
        kinds = [each.split("-")[0] for each in split.test]
        assert len(kinds) == len(set(kinds)) == 9
        assert set(kinds) == {each.split("-")[0] for each in (*split.train, *split.validation)}


def test_a_fold_of_unseen_classes_tests_all_objects_of_three_classes():
    for split in folds("vt60-classes"):
        kinds = {each.split("-")[0] for each in split.test}
        assert len(kinds) == 3
        assert len(split.test) == 12
        assert not kinds & {each.split("-")[0] for each in (*split.train, *split.validation)}


def test_a_test_billet_is_unseen_and_ground_billets_are_left_out():
    tested = []
    for split in folds("billets-unseen"):
        sides = [{each.split("-")[0] for each in part} for part in (split.train, split.validation, split.test)]
        assert [len(side) for side in sides] == [3, 1, 1]
        assert len(set.union(*sides)) == 5
        tested += sides[2]
    assert sorted(tested) == [f"welded{n}" for n in range(5)]


def test_places_of_all_welded_billets_test_and_train():
    for split in folds("billets-places"):
        for part, count in ((split.train, 8), (split.validation, 4), (split.test, 4)):
            assert Counter(each.split("-")[0] for each in part) == {f"welded{n}": count for n in range(5)}


def test_the_papers_protocol_uses_98_objects_and_tests_18():
    (split,) = folds("feeling-of-success")
    assert (len(split.test), len(split.train) + len(split.validation)) == (18, 80)


def test_objectfolder_requires_the_published_split():
    (split,) = folds("objectfolder", seed=2)
    assert (split.seed, split.train, split.validation, split.test) == (2, tuple("abcd"), tuple("ef"), tuple("gh"))
    with pytest.raises(DatasetError, match=r"split\.json"):
        PROTOCOLS.load("objectfolder").folds(facts(dict.fromkeys("ab")), 0)


def test_an_unknown_protocol_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"vt60-seen-classes, .*; got 'ycb'"):
        PROTOCOLS.load("ycb")


# Controls and verdicts -------------------------------------------------------------------------------


def test_clock_features_are_similar_for_near_places_only():
    found = clock_features(100)
    assert found.shape == (100, 84)
    steps = np.linalg.norm(found - found[50], axis=1)
    assert (np.diff(steps[50:56]) > 0).all()
    assert steps[51] < steps[90] / 3


def test_no_contact_control_needs_one_frame_per_grasp():
    grasps = RECORDINGS["rct"].grasps[:4]
    assert "lacks" in missing_no_contact_reason(grasps)

    def with_frames(names):
        return [
            Grasp(one.grasp_id, one.object_id, None, one.photo, one.touches, (Path(name),))
            for one, name in zip(grasps, names, strict=True)
        ]

    assert "share one no-contact frame" in missing_no_contact_reason(with_frames("xxxx"))
    assert missing_no_contact_reason(with_frames("xxxy")) is None


ABOVE = Difference(0.1, 0.01, 0.2, False, 0.01)


@pytest.mark.parametrize(("low", "high", "counts"), [(0.01, 0.2, True), (-0.01, 0.2, False), (0.0, 0.2, False)])
@pytest.mark.parametrize("control", ["low_pass", "order"])
def test_a_result_counts_as_touch_only_if_both_intervals_are_above_0(low, high, counts, control):
    summary = Summary([0.4], [0.3], [0.5], [0.2], 10, 10, False, "ten", [[0.4]])
    found = verdict(summary, {"low_pass": ABOVE, "order": ABOVE, control: Difference(0.1, low, high, False, 0.1)})
    assert found == Verdict(counts_as_touch=counts, above_chance=True)


def of_choices(*values):
    """Return a measure of each choice: its objects differ from the value by 0.1 in either direction."""
    numbers = ((0, 1), (1, 2), (0, 2))
    return [
        Measure(np.array([[value - 0.1], [value + 0.1], [value + 0.1]]), np.array([a, b, b]), np.array([0.25]), "four")
        for value, (a, b) in zip(values, numbers, strict=True)
    ]


def test_an_interval_over_choices_is_the_corrected_resampled_t_interval():
    found = summarise_splits(of_choices(0.5, 0.6, 0.7), ratio=1.0)
    # s^2 = .01; (1 / 3 + 1) s^2 = .01333; t of 2 degrees of freedom at .975: 4.30265
    half = 4.30265 * np.sqrt((1 / 3 + 1) * 0.01)
    assert found.value == [pytest.approx(0.6)]
    assert found.low == [pytest.approx(0.6 - half, abs=1e-5)]
    assert found.high == [1.0]  # .6 + .4968, limited to 1
    assert np.ravel(found.repeats) == pytest.approx([0.5, 0.6, 0.7])
    assert (found.objects, found.queries, found.few_objects) == (3, 9, True)
    difference = compare_splits(of_choices(0.5, 0.6, 0.7), of_choices(0.4, 0.4, 0.4), ratio=1.0)
    assert difference.value == pytest.approx(0.2)
    assert difference.low == pytest.approx(0.2 - half, abs=1e-5)
    # t = .2 / sqrt(.01333) = 1.7321; of 2 degrees of freedom both tails beyond it have 1 - t / sqrt(t^2 + 2)
    assert difference.p == pytest.approx(1 - 1.7320508 / np.sqrt(5))
    with pytest.raises(BadInput, match="needs at least two splits; got 1"):
        summarise_splits(of_choices(0.5, 0.6, 0.7)[:1], ratio=1.0)


def test_pooled_galleries_have_every_query_under_its_unit():
    one = Measure(np.array([[0.5], [1.0]]), np.array([3, 7]), np.array([0.25]), "four")
    two = Measure(np.array([[0.0]]), np.array([3]), np.array([0.5]), "two")
    whole = pooled([one, two], {3: 1, 7: 0})
    assert whole.owner.tolist() == [0, 1, 1]
    assert whole.values.ravel().tolist() == [1.0, 0.5, 0.0]
    assert whole.chance.tolist() == [pytest.approx((0.25 + (0.25 + 0.5) / 2) / 2)]  # equal unit weights
