"""Low-contact touches, which hardly press the gel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from retrieval.data.dataset import Grasp
from retrieval.errors import DatasetError
from retrieval.evaluation.low_contact import find_low_contact_touches, gel_change


def pressed(folder, name, levels, size=(6, 4)):
    """Write a grasp of two fingers whose images differ by these levels from no-contact frames in half the pixels."""
    touches, backgrounds = [], []
    for finger, level in zip("ab", levels, strict=True):
        before = np.full((*size, 3), 100, np.uint8)
        after = before.copy()
        after[: size[0] // 2] += np.uint8(level)
        for files, image, when in ((backgrounds, before, "before"), (touches, after, "contact")):
            files.append(folder / f"{name}-{finger}-{when}.png")
            Image.fromarray(image).save(files[-1])
    return Grasp(name, "mug", None, Path(f"{name}.jpg"), tuple(touches), tuple(backgrounds))


def test_gel_change_is_the_maximum_over_fingers(tmp_path):
    assert gel_change(pressed(tmp_path, "one", (4, 20))) == pytest.approx(10)
    assert gel_change(pressed(tmp_path, "other", (20, 4))) == pytest.approx(10)


def test_low_contact_touches_are_the_lowest_5_percent_and_at_least_one(tmp_path):
    grasps = [pressed(tmp_path, f"g{number}", (2 * (40 - number), 0)) for number in range(40)]
    found = find_low_contact_touches(grasps)
    assert found.gel_change == pytest.approx(2)
    assert np.flatnonzero(found.rows).tolist() == [38, 39]
    assert np.flatnonzero(find_low_contact_touches(grasps[:3]).rows).tolist() == [2]


def test_low_contact_needs_no_contact_frames(tmp_path):
    grasps = [pressed(tmp_path, "one", (4, 20)), replace(pressed(tmp_path, "two", (4, 20)), backgrounds=())]
    assert find_low_contact_touches(grasps) is None


def test_a_frame_of_another_size_is_refused(tmp_path):
    one, other = pressed(tmp_path, "one", (4, 20)), pressed(tmp_path, "two", (4, 20), size=(8, 4))
    with pytest.raises(DatasetError, match=r"must have the same size, got \(6, 4, 3\) and \(8, 4, 3\)"):
        gel_change(replace(one, backgrounds=other.backgrounds))
