"""Photos resized in machine code: bit by bit what numpy makes of them."""

import cv2
import numpy as np
import pytest

from retrieval.data.images import decode, decode_rgb
from retrieval.data.photo_resize import resize_photo
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resized, to_unit
from retrieval.data.views import VIEWS, find_object
from retrieval.search.build import embed
from retrieval.search.build.build_index import build_index
from tests.retrieval.data.test_views import photo

SIZES = [((64, 64), (16, 16)), ((61, 83), (20, 20)), ((83, 61), (20, 20)), ((20, 20), (31, 31)), ((9, 70), (30, 30))]


def drawn(shape, channels=3):
    return np.random.default_rng(0).integers(0, 256, (*shape, channels), dtype=np.uint8)


@pytest.mark.parametrize(("old", "new"), [*SIZES, ((1, 500), (3, 3)), ((16, 16), (16, 16)), ((16, 40), (16, 10))])
@pytest.mark.parametrize("channels", [1, 3])
def test_bits_are_those_of_numpy_for_pictures_of_8_bits_and_of_floats(old, new, channels):
    samples = drawn(old, channels)
    for image in (samples, to_unit(samples), to_unit(samples)[::-1, ::-1]):
        found = resize_photo(image, new)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, resized(image, new))


def test_to_divide_once_at_the_end_would_give_other_bits():
    samples = drawn((61, 61))
    assert (resized(samples.astype(np.float32), (20, 20)) / np.float32(255) != resized(samples, (20, 20))).any()


@pytest.mark.parametrize("reduced", [False, True])
def test_a_files_views_are_the_same_bits_by_both_and_those_of_its_picture(reduced):
    settings = Preprocessing(photo_px=48, views=tuple(VIEWS), reduced=reduced)
    image = np.rint(255 * photo(size=(400, 500))).astype(np.uint8)
    data = cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
    assert decode(data, "x").dtype == np.uint8
    expected = settings.photo_of(data, "x")
    np.testing.assert_array_equal(settings.photo_of(data, "x", resize_photo), expected)
    assert find_object(decode(data, "x"), resize_photo) == find_object(decode_rgb(data, "x"))
    if not reduced:
        np.testing.assert_array_equal(settings.photo(decode_rgb(data, "x")), expected)


def test_a_build_of_many_photos_holds_what_one_of_few_holds(own, checkpoint, tmp_path, monkeypatch):
    few = build_index(own, checkpoint, tmp_path / "few", quiet=True)
    used, real = [], resize_photo
    monkeypatch.setattr("retrieval.data.photo_resize.resize_photo", lambda *of: used.append(1) or real(*of))
    monkeypatch.setattr(embed, "MANY", 4)
    monkeypatch.setattr(embed, "fastest", embed.on_torch)
    many = build_index(own, checkpoint, tmp_path / "many", quiet=True)
    assert used
    assert (few.photos, few.embedded) == (many.photos, many.embedded)
    first, second = ((tmp_path / name / "gen-000001" / "halves.npy").read_bytes() for name in ("few", "many"))
    assert first == second
