"""Grasps of a recording, object-disjoint splits, and the pair sampler."""

import dataclasses
import json
import shutil
from collections import Counter
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrieval.data.dataset import (
    Grasp,
    ImageCache,
    Split,
    data_digest,
    finger_count,
    load_grasps,
    make_split,
    recording_source,
)
from retrieval.data.pairs import PairSampler
from retrieval.errors import DatasetError
from robot.recording.folder import read_recording
from tests import synthetic


def grasp(object_id, number=0, sequence=None, fingers="ab", photo=None):
    name = f"{object_id}-{number}"
    touches = tuple(Path(f"{name}-{finger}.png") for finger in fingers)
    return Grasp(name, object_id, sequence, Path(photo or f"{name}.jpg"), touches, ())


def grasps_of(*counts):
    """`counts[i]` grasps of object number i."""
    return [grasp(f"object-{i:02d}", number) for i, count in enumerate(counts) for number in range(count)]


def pairs(batch):
    """Return (row of the touch, its object, the photo, the photo's object, label) of each pair."""
    return [
        (int(t), batch.grasps[t].object_id, batch.photos[p], str(batch.photos[p]).rsplit("-", 1)[0], float(label))
        for t, p, label in zip(batch.touch_index, batch.photo_index, batch.labels, strict=True)
    ]


def contents(batch):
    return {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in dataclasses.asdict(batch).items()
    }


counts = st.lists(st.integers(1, 7), min_size=2, max_size=9)
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def small_recording(tmp_path_factory):
    """Two objects with two grasps and a miss each."""
    folder = tmp_path_factory.mktemp("small") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(2), 2, misses=1)


def test_grasps_are_in_collection_order_and_their_files_in_finger_order(small_recording):
    rows = [json.loads(line) for line in (small_recording / "metadata.jsonl").read_text().splitlines()]
    rows = [row for row in rows if row["grasped"]]
    grasps = load_grasps(small_recording)
    assert [item.grasp_id for item in grasps] == [row["grasp_id"] for row in rows]
    for item, row in zip(grasps, rows, strict=True):
        assert item.object_id == row["object_id"]
        assert item.sequence_id == row["sequence_id"]
        assert item.session is None
        assert item.photo == small_recording / row["photo_file_name"]
        assert item.touches == tuple(small_recording / row[f"touch_{finger}_file_name"] for finger in "ab")
        assert item.backgrounds == tuple(small_recording / row[f"touch_{finger}_before_file_name"] for finger in "ab")
    assert grasps == load_grasps(str(small_recording)) == load_grasps(read_recording(small_recording))
    assert recording_source(small_recording) == "drawn test pictures, not a simulation of contact"


def test_a_recording_with_misses_only_and_a_folder_without_one_are_errors(tmp_path):
    folder = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(1), 0, misses=2)
    with pytest.raises(DatasetError, match=r"no successful grasp"):
        load_grasps(folder)
    with pytest.raises(DatasetError, match=r"recording\.json"):
        load_grasps(tmp_path)


def test_touches_with_different_numbers_of_fingers_are_refused_by_name():
    assert finger_count([grasp("mug", fingers="a")]) == 1
    assert finger_count([grasp("mug"), grasp("cup")]) == 2
    with pytest.raises(DatasetError, match="use a separate recording for each sensor"):
        finger_count([grasp("mug"), grasp("cup", fingers="a")])


def test_the_data_digest_depends_on_bytes_and_ids_and_not_on_the_folder(small_recording, tmp_path):
    shutil.copytree(small_recording, tmp_path / "r")
    grasps = load_grasps(tmp_path / "r")
    before = data_digest(grasps)
    assert before == data_digest(load_grasps(small_recording))
    assert before != data_digest(grasps[::-1])
    assert before != data_digest([dataclasses.replace(grasps[0], object_id="other"), *grasps[1:]])
    assert before != data_digest([dataclasses.replace(grasps[0], session="monday"), *grasps[1:]])
    for path in (grasps[0].photo, grasps[1].touches[1], grasps[2].backgrounds[0]):
        data = path.read_bytes()
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        assert data_digest(grasps) != before
        path.write_bytes(data)
    assert data_digest(grasps) == before
    grasps[1].touches[0].unlink()
    with pytest.raises(DatasetError, match=rf"{grasps[1].touches[0].name} cannot be read .*`retrieve check`"):
        data_digest(grasps)


def parts_of(split):
    return {"train": split.train, "validation": split.validation, "test": split.test}


@settings(max_examples=30)
@given(
    counts=st.lists(st.integers(1, 3), min_size=6, max_size=120),
    seed=seeds,
    validation=st.floats(0, 0.35),
    test=st.floats(0, 0.35),
)
def test_every_object_is_in_one_part_and_fractions_are_met_to_half_an_object_with_a_minimum_of_two(
    counts, seed, validation, test
):
    grasps = grasps_of(*counts)
    split = make_split(grasps, validation=validation, test=test, seed=seed)
    together = [name for part in parts_of(split).values() for name in part]
    assert sorted(together) == sorted({item.object_id for item in grasps})
    assert len(split.train) >= 2
    for fraction, part in ((validation, split.validation), (test, split.test)):
        if fraction * len(counts) < 2:
            assert len(part) == (2 if fraction else 0)
        else:
            assert abs(len(part) - fraction * len(counts)) <= 0.5


linked = st.lists(st.tuples(st.integers(0, 11), st.integers(0, 7)), min_size=1, max_size=20)


@settings(max_examples=20)
@given(links=linked, seed=seeds)
def test_objects_that_share_a_sequence_however_indirectly_stay_together(links, seed):
    """The oracle joins one pair of objects at a time until nothing changes."""
    grasps = [*grasps_of(*[1] * 12), *(grasp(f"object-{i:02d}", 1 + n, f"s{s}") for n, (i, s) in enumerate(links))]
    label = {item.object_id: item.object_id for item in grasps}
    for _ in range(len(label)):
        for one in grasps:
            for two in grasps:
                if one.sequence_id is not None and one.sequence_id == two.sequence_id:
                    label[one.object_id] = label[two.object_id] = min(label[one.object_id], label[two.object_id])
    try:
        split = make_split(grasps, validation=0.2, test=0.2, seed=seed)
    except DatasetError:
        assert len(set(label.values())) < 6  # six groups always make three parts of two
        return
    part_of = {name: part for part, names in parts_of(split).items() for name in names}
    for one, two in zip(label, label.values(), strict=True):
        assert part_of[one] == part_of[two]


@pytest.mark.parametrize("seed", range(4))
def test_a_large_group_stays_in_training_if_small_ones_meet_the_fraction(seed):
    """A naive draw takes the first group, here often ten objects for a target of four."""
    grasps = [*(grasp(f"linked-{i}", 0, "day one") for i in range(10)), *grasps_of(*[1] * 10)]
    split = make_split(grasps, validation=0.1, test=0.2, seed=seed)
    assert (len(split.train), len(split.validation), len(split.test)) == (14, 2, 4)


def test_a_split_depends_on_its_seed_and_not_on_the_order_of_grasps():
    grasps = grasps_of(*[2] * 20)
    split = make_split(grasps, validation=0.2, test=0.2, seed=1)
    assert split == make_split(grasps[::-1], validation=0.2, test=0.2, seed=1)
    others = {make_split(grasps, validation=0.2, test=0.2, seed=seed).test for seed in range(5)}
    assert len(others) == 5


@pytest.mark.parametrize(("validation", "test", "parts"), [(0.0, 0.0, 1), (0.2, 0.0, 2), (0.0, 0.2, 2), (0.2, 0.2, 3)])
def test_a_part_with_fraction_zero_is_empty_and_the_error_counts_too_few_objects(validation, test, parts):
    split = make_split(grasps_of(*[1] * 2 * parts), validation=validation, test=test, seed=0)
    assert (split.validation == ()) == (validation == 0)
    assert (split.test == ()) == (test == 0)
    few = 2 * parts - 1
    with pytest.raises(DatasetError, match=rf"into {parts} parts .* has {few} objects in {few} such groups"):
        make_split(grasps_of(*[1] * few), validation=validation, test=test, seed=0)


def test_a_split_can_be_stored_as_json_and_selects_its_grasps():
    grasps = grasps_of(*[2] * 8)
    split = make_split(grasps, validation=0.25, test=0.25, seed=4)
    assert Split.from_dict(json.loads(json.dumps(split.to_dict()))) == split
    assert Split.from_dict({"train": ["a", "b"], "validation": [], "test": ["c"]}) == Split(0, ("a", "b"), (), ("c",))
    for part, names in parts_of(split).items():
        assert split.select(grasps, part) == [item for item in grasps if item.object_id in names]


@settings(max_examples=20)
@given(
    counts=counts,
    seed=seeds,
    step=st.integers(0, 10**6),
    touches=st.integers(1, 7),
    share=st.booleans(),
    numbers=st.just((4, 4)) | st.tuples(st.integers(1, 5), st.integers(1, 5)),
)
def test_every_touch_has_the_requested_photos_and_every_photo_is_listed_once_with_its_object(
    counts, seed, step, touches, share, numbers
):
    grasps, (positives, negatives) = grasps_of(*counts), numbers
    sampler = PairSampler(grasps, seed=seed, positives=positives, negatives=negatives, share_photos=share)
    batch = sampler.batch(step, touches)
    rows, own = pairs(batch), {item.photo for item in grasps}
    for row in range(touches):
        mine = [pair for pair in rows if pair[0] == row]
        assert [label for *_, label in mine] == [1] * positives + [0] * negatives
        assert all((touch == photo) == bool(label) for _, touch, _, photo, label in mine)
        assert all(photo in own for _, _, photo, _, _ in mine)
    assert len(batch.photos) == len(set(batch.photos)) == len(batch.photo_objects)
    assert set(batch.photo_index.tolist()) == set(range(len(batch.photos)))
    names = sorted({item.object_id for item in grasps})
    assert [names[i] for i in batch.photo_objects] == [str(photo).rsplit("-", 1)[0] for photo in batch.photos]
    assert [names[i] for i in batch.touch_objects] == [item.object_id for item in batch.grasps]


@settings(max_examples=20)
@given(counts=counts, seed=seeds, touches=st.integers(1, 7))
def test_at_any_moment_every_object_has_been_used_equally_often(counts, seed, touches):
    sampler, used = PairSampler(grasps_of(*counts), seed=seed), Counter(range(len(counts)))
    used.subtract(range(len(counts)))
    for step in range(12):
        for index in sampler.batch(step, touches).touch_objects.tolist():
            used[index] += 1
            assert max(used.values()) - min(used.values()) <= 1


@settings(max_examples=20)
@given(counts=counts, seed=seeds)
def test_within_an_object_every_grasp_comes_once_before_any_comes_again(counts, seed):
    sampler, objects = PairSampler(grasps_of(*counts), seed=seed), len(counts)
    drawn = [item for step in range(2 * max(counts)) for item in sampler.batch(step, objects).grasps]
    for index, count in enumerate(counts):
        mine = [item.grasp_id for item in drawn if item.object_id == f"object-{index:02d}"]
        for start in range(0, len(mine) - count + 1, count):
            assert len(set(mine[start : start + count])) == count


def test_a_batch_depends_on_seed_and_step_and_not_on_earlier_calls_or_the_order_of_objects():
    grasps = grasps_of(*[6] * 8)
    batches = [contents(PairSampler(grasps, seed=seed).batch(step, 6)) for seed in (0, 1) for step in range(5)]
    assert len(set(map(str, batches))) == 10
    sampler = PairSampler(grasps[24:] + grasps[:24], seed=1)
    for step in (3, 0, 4, 1):
        sampler.evaluation_pairs()
        assert contents(sampler.batch(step, 6)) == batches[5 + step]
    first = [item.grasp_id for step in range(12) for item in sampler.batch(step, 8).grasps if "-00-" in item.grasp_id]
    assert first[:6] != first[6:]  # another order when all grasps of the object were used


def test_positives_are_drawn_without_repeats_where_the_object_has_enough_photos():
    for count in (2, 4, 9):
        batch = PairSampler(grasps_of(count, count), seed=0).batch(0, 2)
        photos = [photo for row, _, photo, _, label in pairs(batch) if label == 1 and row == 0]
        assert len(photos) == 4
        assert count < 4 or len(set(photos)) == 4


def test_a_photo_shared_by_grasps_of_one_object_counts_as_one():
    grasps = [grasp("mug", number, photo="mug-0.jpg") for number in range(3)] + grasps_of(2)
    batch = PairSampler(grasps, seed=0).evaluation_pairs()
    assert Counter(str(photo).rsplit("-", 1)[0] for photo in batch.photos) == {"mug": 1, "object-00": 2}


def test_shared_photos_are_half_as_many_and_each_is_a_positive_of_some_touch():
    grasps = grasps_of(*[9] * 12)
    for step in range(2):  # these two batches are one round of the objects
        shared = PairSampler(grasps, seed=0, share_photos=True).batch(step, 6)
        assert (len(shared.photos), len(shared.labels)) == (24, 48)
        assert len(PairSampler(grasps, seed=0).batch(step, 6).photos) > 36
        rows = pairs(shared)
        assert {photo for *_, photo, label in rows if not label} <= {photo for *_, photo, label in rows if label}
        for touch in range(6):  # its negatives are of four different objects
            assert len({owner for row, _, _, owner, label in rows if row == touch and not label}) == 4


def test_shared_negatives_use_every_other_object_and_each_of_its_photos_equally():
    """A touch's negatives are the photos of any other object with the same probability, shared or not.

    A naive draw over all other photos would use the object with twice as many photos twice as often.
    """
    grasps = grasps_of(*[4] * 5, 8)
    drawn: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    for share, photos in drawn.items():
        sampler = PairSampler(grasps, seed=1, share_photos=share, positives=3, negatives=2)
        for step in range(1000):
            batch = sampler.batch(step, 3)
            for touch, photo, label in zip(batch.touch_index, batch.photo_index, batch.labels, strict=True):
                if not label and batch.touch_objects[touch] == 0:
                    photos[str(batch.photos[photo])] += 1
    total = sum(drawn[True].values())
    assert total == sum(drawn[False].values()) == 1000
    for photos in drawn.values():
        for name, count in photos.items():
            expected = total / 5 / (8 if name.startswith("object-05") else 4)
            assert abs(count - expected) < 6 * expected**0.5, name  # six deviations of a fair draw
        assert len(photos) == 4 * 4 + 8


def test_the_evaluation_pairs_contain_every_touch_once_and_are_never_shared_and_always_the_same():
    grasps = grasps_of(3, 1, 5)
    sampler = PairSampler(grasps, seed=0)
    batch = sampler.evaluation_pairs()
    assert [item.grasp_id for item in batch.grasps] == [item.grasp_id for item in grasps]
    assert Counter(batch.touch_index.tolist()) == dict.fromkeys(range(9), 8)
    sampler.batch(0, 5)
    for again in (sampler, PairSampler(grasps, seed=0, share_photos=True)):
        assert contents(again.evaluation_pairs()) == contents(batch)


@pytest.mark.parametrize(
    ("grasps", "message"),
    [
        ([], "at least 2 objects in each part of the split; got 0"),
        (grasps_of(5), "at least 2 objects in each part of the split; got 1"),
        ([grasp("mug", photo="same.jpg"), grasp("cup", photo="same.jpg")], "two objects share a photo file"),
    ],
)
def test_fewer_than_two_objects_and_a_photo_of_two_objects_are_refused(grasps, message):
    """A shared photo would be its own negative."""
    with pytest.raises(DatasetError, match=message):
        PairSampler(grasps, seed=0)


def test_an_image_is_loaded_once_while_it_fits_in_the_cache_and_otherwise_each_time():
    load = Mock(side_effect=lambda path, _: np.full((2, 2, 3), float(str(path)), np.float32))
    cache = ImageCache(load, limit_bytes=100)  # one image has 48 bytes
    for name in ("1", "2", "3", "1", "2", "3"):
        assert cache(Path(name), None)[0, 0, 0] == float(name)
    assert [str(call.args[0]) for call in load.call_args_list] == ["1", "2", "3", "3"]
    assert cache(Path("1"), Path("2")) is not cache(Path("1"), None)
