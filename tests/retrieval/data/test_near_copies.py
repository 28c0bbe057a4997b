"""Near copies by shape: distances computed by plain loops, and distorted copies."""

import cv2
import numpy as np
import pytest

from retrieval.data.check.near_copies import (
    PX,
    PictureSet,
    as_jpeg,
    brighter,
    flip_thumbnails,
    shapes,
    shifted,
    thumbnail,
)


def scene(seed, size=(120, 160)):
    """Return a gel of one tint, dark at its edges, with a soft random dent."""
    y, x = np.mgrid[-1 : 1 : size[0] * 1j, -1 : 1 : size[1] * 1j]
    dent = cv2.resize(np.random.default_rng(seed).normal(size=(5, 6)), size[::-1], interpolation=cv2.INTER_CUBIC)
    gel = 140 - 30 * (x * x + y * y) + 12 * dent
    return np.clip(gel, 0, 255)[..., None].repeat(3, axis=2).astype(np.float32) / 255


def pictures(images):
    return PictureSet([thumbnail(b"", image) for image in images], [f"object {row}" for row in range(len(images))])


def test_a_shape_ignores_a_constant_and_any_multiple_of_the_common_picture():
    rng = np.random.default_rng(0)
    grey, common = rng.normal(size=(2, PX**2)).astype(np.float32)
    plain = shapes(grey[None], common)
    np.testing.assert_allclose(shapes((3 * grey + 7 + 2 * common)[None], common), plain, atol=1e-5)  # float32
    assert float(np.linalg.norm(plain)) == pytest.approx(1, rel=1e-5)
    assert (shapes((5 + 2 * common)[None], common) == 0).all()


def test_a_flip_of_the_thumbnail_is_the_thumbnail_of_the_flip():
    image = scene(0)
    for rows, columns in ((1, -1), (-1, 1), (-1, -1)):
        turned = thumbnail(b"", np.ascontiguousarray(image[::rows, ::columns])).grey
        np.testing.assert_allclose(
            flip_thumbnails(thumbnail(b"", image).grey[None], (rows, columns))[0], turned, atol=0.05
        )


def test_the_nearest_picture_of_another_object_equals_that_of_plain_loops():
    images = [scene(seed) for seed in range(7)]
    all_of_them = pictures(images)
    unit = [shapes(one[None], all_of_them.common)[0] for one in all_of_them.greys]
    found = all_of_them.nearest(np.array([0, 3]), np.array([1, 2, 4, 5, 6]))
    for at, query in enumerate((0, 3)):
        turned = [
            shapes(flip_thumbnails(all_of_them.greys[[query]], flip), all_of_them.common)[0]
            for flip in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        ]
        distances = {row: min(1 - float(turn @ unit[row]) for turn in turned) for row in (1, 2, 4, 5, 6)}
        assert found.row[at] == min(distances, key=distances.get)
        assert found.distance[at] == pytest.approx(min(distances.values()), abs=1e-5)


@pytest.mark.parametrize("change", [as_jpeg, brighter, shifted, lambda gel: np.ascontiguousarray(gel[::-1])])
def test_a_distorted_copy_is_within_its_limit_and_no_other_picture_is(change):
    images = [scene(seed) for seed in range(9)]
    copy = change(np.rint(255 * images[2]).astype(np.uint8)).astype(np.float32) / 255
    found = pictures([*images, copy]).nearest(np.arange(10), np.arange(10))
    assert np.flatnonzero(found.copy).tolist() == [2, 9]
    assert found.row[[2, 9]].tolist() == [9, 2]
    assert found.checked.all()


def test_without_pictures_nothing_is_found():
    nothing = np.zeros(0, dtype=np.int64)
    assert len(pictures([]).nearest(nothing, nothing).row) == 0
    found = pictures([scene(0)]).nearest(np.array([0]), nothing)
    assert (found.distance.tolist(), found.checked.tolist(), found.copy.tolist()) == ([np.inf], [False], [False])
