"""Resizing, background subtraction and their settings. Expected values come from hand or from two plain loops."""

import hashlib

import numpy as np
import pytest
from PIL import Image

from retrieval.data import preprocessing
from retrieval.data import resize as resizing
from retrieval.data.preprocessing import BACKGROUNDS, Preprocessing
from retrieval.data.resize import resize, to_float
from retrieval.errors import BadInput, ConfigError
from tests.retrieval.data.test_images import saved

ATOL = 2e-6  # float32 sums over at most a few dozen samples of 0..1


def area_by_loops(line, new):
    """Return the mean of `line` over each of `new` equal parts, by two plain loops over fractions of samples."""
    scale = len(line) / new
    out = []
    for target in range(new):
        total = 0.0
        for source in range(len(line)):
            overlap = min((target + 1) * scale, source + 1) - max(target * scale, source)
            total += max(overlap, 0.0) * float(line[source])
        out.append(total / scale)
    return out


def linear_by_loops(line, new):
    out = []
    for target in range(new):
        position = min(max((target + 0.5) * len(line) / new - 0.5, 0.0), len(line) - 1.0)
        left = int(position)
        right = min(left + 1, len(line) - 1)
        out.append(float(line[left]) * (1 - (position - left)) + float(line[right]) * (position - left))
    return out


SIZES = [(7, 3), (7, 6), (128, 127), (320, 128), (10, 1), (2, 1), (9, 3), (1, 4), (2, 3), (3, 7), (127, 128), (5, 128)]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("old", "new"), SIZES)
def test_an_axis_that_shrinks_is_averaged_over_areas_and_one_that_grows_is_interpolated(old, new, axis):
    line = np.random.default_rng(old).random(old).astype(np.float32)
    image = np.repeat(line[:, None, None] if axis == 0 else line[None, :, None], 3, axis=2)
    out = resize(image, (new, 1) if axis == 0 else (1, new))
    expected = (area_by_loops if new < old else linear_by_loops)(line, new)
    np.testing.assert_allclose(out[..., 1].ravel(), expected, atol=ATOL)


def test_one_axis_may_shrink_while_the_other_grows():
    image = np.random.default_rng(1).random((9, 2, 3)).astype(np.float32)
    columns = np.array([[area_by_loops(image[:, x, c], 4) for c in range(3)] for x in range(2)])
    expected = np.array([[linear_by_loops(columns[:, c, y], 5) for y in range(4)] for c in range(3)])
    np.testing.assert_allclose(resize(image, (4, 5)), expected.transpose(1, 2, 0), atol=ATOL)


def test_a_line_of_many_pixels_is_shrunk_before_it_is_grown():
    assert resize(np.ones((1, 1_000_000, 3), np.float32), (256, 256)).shape == (256, 256, 3)  # else 3 GB


@pytest.mark.parametrize("shape", [(3000, 200), (200, 3000)])
def test_a_picture_resized_in_bands_is_the_same_to_the_bit(shape, monkeypatch):
    samples = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    at_once = resize(samples, (90, 70))
    monkeypatch.setattr(resizing, "_BAND", 1 << 12)
    np.testing.assert_array_equal(resize(samples, (90, 70)), at_once)


def grey(level, size=(4, 4)):
    return to_float(np.full((*size, 3), level, np.uint8))


@pytest.mark.parametrize(
    ("policy", "touch", "reference", "expected"),
    [
        ("none", 51, 204, 0.2),
        ("difference", 51, 204, -0.6),
        ("difference+0.5", 51, 204, 0.0),
        ("difference+0.5", 204, 102, 0.9),
        ("difference+0.5", 255, 0, 1.0),
        ("abs", 51, 204, 0.6),
    ],
)
def test_every_policy_gives_values_computed_by_hand(policy, touch, reference, expected):
    """The reference may have another size, since it is subtracted after resizing."""
    settings, larger = Preprocessing(touch_px=4, background=policy), grey(reference, size=(8, 10))
    np.testing.assert_allclose(settings.touch(grey(touch), larger), expected, atol=1e-6)


@pytest.mark.parametrize("policy", sorted(set(BACKGROUNDS) - {"none"}))
def test_a_missing_reference_is_an_error_that_says_what_to_do(policy):
    with pytest.raises(ConfigError, match='give a reference, or set background = "none"'):
        Preprocessing(background=policy).touch(grey(1))


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4), np.float32), np.zeros((4, 4, 4), np.float32), np.zeros((4, 4, 3), np.uint8)]
)
def test_arrays_that_are_no_picture_in_float32_are_refused(image):
    for prepare in (Preprocessing().touch, Preprocessing().photo):
        with pytest.raises(BadInput, match="H x W x 3 float32"):
            prepare(image)
    with pytest.raises(BadInput, match="H x W x 3 float32"):
        Preprocessing(background="abs").touch(grey(1), image)


def test_photo_and_touch_have_the_papers_sizes_and_are_not_cropped(tmp_path):
    wide = np.zeros((240, 320, 3), np.uint8)
    wide[:, 300:] = 255  # a centre crop to a square would lose it
    (tmp_path / "w.png").write_bytes(saved(Image.fromarray(wide), "PNG"))
    photo = Preprocessing().load_photo(tmp_path / "w.png")
    touch = Preprocessing().load_touch(tmp_path / "w.png")
    assert photo.shape == (256, 256, 3)
    assert touch.shape == (128, 128, 3)
    np.testing.assert_allclose(touch.mean(), 20 / 320, atol=1e-5)


def test_noise_averages_out_before_its_sign_is_dropped():
    sign = np.where(np.indices((4, 4)).sum(axis=0) % 2, 1, -1)[..., None]
    noisy = (0.5 + 0.1 * sign * np.ones((4, 4, 3))).astype(np.float32)
    flat = np.full((4, 4, 3), 0.5, np.float32)
    np.testing.assert_allclose(Preprocessing(touch_px=2, background="abs").touch(noisy, flat), 0, atol=1e-6)
    naive = resize(np.abs(noisy - flat), (2, 2))
    np.testing.assert_allclose(naive, 0.1, atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {"views": ("whole", "whole")},
        {"views": ("macro",)},
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        Preprocessing(**change)


def test_the_digest_depends_on_the_settings_and_the_version_and_is_that_of_older_checkpoints(monkeypatch):
    """Checkpoints that were made before a setting existed have the digest of its default."""
    text = '{"background": "none", "photo_px": 256, "touch_px": 128, "version": 2}'
    assert Preprocessing(views=("whole",)).digest() == hashlib.sha256(text.encode()).hexdigest()
    changes = (
        {},
        {"touch_px": 64},
        {"background": "abs"},
        {"views": ("zoom",)},
        {"views": ("zoom", "crop")},
        {"reduced": True},
    )
    digests = {Preprocessing(**change).digest() for change in changes}
    monkeypatch.setattr(preprocessing, "PREPROCESSING_VERSION", 1)
    assert len(digests | {Preprocessing().digest()}) == 7
