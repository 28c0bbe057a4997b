"""Real-data protocols: disjoint splits, every object tested once for each seed, the right galleries."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS
from retrieval.evaluation.aggregate import verdict
from retrieval.evaluation.inputs import missing_no_contact_reason
from retrieval.evaluation.protocol import RecordingFacts
from retrieval.evaluation.results import Verdict
from retrieval.evaluation.touch_to_touch import TouchToTouch
from retrieval.metrics.intervals import Difference, Summary


def facts(sequence_of, about=None, splits=None):
    grasps = [
        Grasp(f"{name}-{turn}", name, sequence, Path(f"{name}.jpg"), (Path(f"{name}-{turn}.png"),), ())
        for name, sequence in sequence_of.items()
        for turn in range(2)
    ]
    return RecordingFacts(Path("drawn"), "drawn", grasps, about or {}, splits or {})


def vt60():
    classes = ["bottleempty", "ball", "bottlefull", *(f"kind{number}" for number in range(7))]
    about = {f"{kind}-{n}": kind for kind in classes for n in range(4)}
    return facts(dict.fromkeys(about), about)


def billets():
    kinds = (*(f"welded{n}" for n in range(5)), *(f"ground{n}" for n in range(4)))
    return facts({f"{kind}-{place:02}": kind for kind in kinds for place in range(16)})


RECORDINGS = {
    **dict.fromkeys(("vt60-choices", "vt60-seen-classes", "vt60-random", "vt60-classes"), vt60()),
    **dict.fromkeys(("billets-unseen", "billets-places"), billets()),
    "objectfolder": facts(
        dict.fromkeys("abcdefgh"), splits={"published": Split(0, tuple("abcd"), tuple("ef"), tuple("gh"))}
    ),
    "feeling-of-success": facts(dict.fromkeys(f"o{n}" for n in range(105))),
}
WITHOUT_SPLIT = {name for name in PROTOCOLS if isinstance(PROTOCOLS.load(name), TouchToTouch)}
"""Protocols without training; test_touch_to_touch tests them."""


def folds(name, seed=0):
    return PROTOCOLS.load(name).folds(RECORDINGS[name], seed)


def test_every_protocol_has_a_recording_here():
    assert set(RECORDINGS) | WITHOUT_SPLIT | {UNSEEN_OBJECTS} == set(PROTOCOLS)


@pytest.mark.parametrize("name", RECORDINGS)
def test_parts_are_disjoint_and_every_seed_tests_the_same_objects_each_once(name):
    for split in folds(name):
        parts = [set(part) for part in (split.train, split.validation, split.test)]
        assert sum(map(len, parts)) == len(set.union(*parts))
        assert min(map(len, parts)) >= 2
        assert set.union(*parts) <= set(RECORDINGS[name].names)
    tested = [Counter(each for split in folds(name, seed) for each in split.test) for seed in range(3)]
    if PROTOCOLS.load(name).choices:
        assert all(set(each) == set(tested[0]) for each in tested)  # each object in some choice
    else:
        assert tested[0] == tested[1] == tested[2]
        assert set(tested[0].values()) == {1}
    assert folds(name, 1) == folds(name, 1)
    if name != "objectfolder":  # has a published split
        assert [set(one.train) for one in folds(name, 0)] != [set(one.train) for one in folds(name, 1)]


def test_choices_hold_out_all_pairs_of_instance_numbers_then_random_ones_in_two_galleries_of_each_class():
    splits, protocol = folds("vt60-choices"), PROTOCOLS.load("vt60-choices")
    assert len({split.test for split in splits}) == 15
    pairs = [sorted({name[-1] for name in split.test}) for split in splits[:6]]
    assert pairs == [list(f"{i}{j}") for i in range(4) for j in range(i + 1, 4)]
    assert [split.test for split in folds("vt60-choices", 1)][:6] == [split.test for split in splits[:6]]
    for split in splits:
        assert len(split.train + split.validation) == 18
        assert set(Counter(name[:-2] for name in split.test).values()) == {2}
        gallery_of = protocol.gallery_of(RECORDINGS["vt60-choices"], split)
        assert set(gallery_of) == set(split.test)
        for gallery in set(gallery_of.values()):
            members = [name[:-2] for name in split.test if gallery_of[name] == gallery]
            assert (len(members), len(set(members))) == (9, 9)


def test_folds_of_vt60_test_one_instance_of_each_class_or_all_of_three_classes_and_no_full_bottle():
    def kinds(*parts):
        return [each.split("-")[0] for part in parts for each in part]

    for name in ("vt60-seen-classes", "vt60-random", "vt60-classes"):
        for split in folds(name):
            assert "bottlefull" not in kinds(split.train, split.validation, split.test)
        assert sum(len(split.test) for split in folds(name)) == 36
    for split in folds("vt60-seen-classes"):
        assert sorted(kinds(split.test)) == sorted(set(kinds(split.train, split.validation)))
    for split in folds("vt60-classes"):
        assert (len(split.test), len(set(kinds(split.test)))) == (12, 3)
        assert not set(kinds(split.test)) & set(kinds(split.train, split.validation))


def test_a_test_billet_is_unseen_or_a_quarter_of_its_places_and_ground_billets_are_left_out():
    tested, welded = [], {f"welded{n}" for n in range(5)}
    for split in folds("billets-unseen"):
        sides = [{each.split("-")[0] for each in part} for part in (split.train, split.validation, split.test)]
        assert [len(side) for side in sides] == [3, 1, 1]
        assert set.union(*sides) == welded
        tested += sides[2]
    assert sorted(tested) == sorted(welded)
    for split in folds("billets-places"):
        for part, count in ((split.train, 8), (split.validation, 4), (split.test, 4)):
            assert Counter(each.split("-")[0] for each in part) == dict.fromkeys(welded, count)


def test_the_published_splits_of_the_paper_and_of_objectfolder():
    (split,) = folds("feeling-of-success")
    assert (len(split.test), len(split.train) + len(split.validation)) == (18, 80)
    (split,) = folds("objectfolder", seed=2)
    assert (split.seed, split.train, split.validation, split.test) == (2, tuple("abcd"), tuple("ef"), tuple("gh"))
    with pytest.raises(DatasetError, match=r"split\.json"):
        PROTOCOLS.load("objectfolder").folds(facts(dict.fromkeys("ab")), 0)


# Controls and verdicts -------------------------------------------------------------------------------


def test_no_contact_control_needs_one_frame_per_grasp():
    grasps = RECORDINGS["feeling-of-success"].grasps[:4]
    assert "lacks" in missing_no_contact_reason(grasps)
    for names, reason in (("xxxx", "all touches share one no-contact frame"), ("xxxy", "None")):
        framed = [replace(one, backgrounds=(Path(name),)) for one, name in zip(grasps, names, strict=True)]
        assert str(missing_no_contact_reason(framed)).startswith(reason)


@pytest.mark.parametrize(("low", "counts"), [(0.01, True), (-0.01, False), (0.0, False)])
@pytest.mark.parametrize("control", ["low_pass", "order"])
def test_a_result_counts_as_touch_only_if_both_intervals_are_above_0(low, counts, control):
    above, found = (Difference(0.1, end, 0.2, False, 0.01) for end in (0.01, low))
    for chance in (0.2, 0.3):
        summary = Summary([0.4], [0.3], [0.5], [chance], 10, 10, False, "ten", [[0.4]])
        expected = Verdict(counts_as_touch=counts, above_chance=chance == 0.2)
        assert verdict(summary, {"low_pass": above, "order": above, control: found}) == expected
