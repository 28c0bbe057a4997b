"""Gel images with red and blue exchanged, or mirrored, are found if they are the minority of a recording."""

import cv2
import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.check.colour_layout import changed_layout
from tests import synthetic
from tests.data import touch_data
from tests.retrieval.data.test_check import Broken, remarks

CHANGES = {
    "red and blue exchanged": lambda image: image[..., ::-1],
    "left and right mirrored": lambda image: image[..., ::-1, :],
    "top and bottom mirrored": lambda image: image[..., ::-1, :, :],
}


def gels(count=20, seed=0):
    """Red is bright above, blue on the right; contact and noise have a tenth of this contrast."""
    down, right = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 8), indexing="ij")
    layout = np.stack([1 - 0.8 * down, np.full((6, 8), 0.4), 0.6 * right], axis=-1)
    return (layout + 0.05 * np.random.default_rng(seed).standard_normal((count, 6, 8, 3))).astype(np.float32)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("rows", [[3], [0, 1, 2, 3, 4], [4, 6, 8, 10, 12, 14, 16, 18, 19]])
def test_a_minority_of_changed_images_is_named_with_its_change(change, rows):
    images = gels()
    images[rows] = CHANGES[change](images[rows])
    found = changed_layout(images)
    assert (found.change, found.rows.tolist()) == (change, rows)


def test_unchanged_images_and_images_that_are_all_changed_give_nothing():
    assert changed_layout(gels()) is None
    assert changed_layout(gels()[..., ::-1]) is None


def test_if_half_of_the_images_are_changed_the_first_image_is_the_reference():
    images = gels()
    images[10:] = images[10:, :, :, ::-1]
    assert changed_layout(images).rows.tolist() == list(range(10, 20))
    assert changed_layout(images[::-1]).rows.tolist() == list(range(10, 20))


def test_red_and_blue_of_grey_images_cannot_be_checked():
    grey = np.repeat(gels()[..., :1], 3, axis=-1)
    noisy = (grey + 0.01 * np.random.default_rng(1).standard_normal(grey.shape)).astype(np.float32)
    assert changed_layout(grey) is None
    assert changed_layout(noisy) is None


def test_images_of_another_sensor_are_not_reported_as_changed():
    images = gels()
    images[:5] = 1 - images[:5]  # each difference of red and blue has the other sign, but no change makes them fit
    assert changed_layout(images) is None


def test_three_images_are_too_few():
    images = gels(3)
    images[0] = images[0, :, :, ::-1]
    assert changed_layout(images) is None


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8), 4)


@pytest.mark.parametrize("finger", "ab")
def test_grasps_with_exchanged_channels_are_a_warning(clean, tmp_path, finger):
    broken = Broken(clean, tmp_path / "r")
    for number in (1, 6, 7):
        for moment in ("", "_before"):
            path = broken.file(number, f"touch_{finger}{moment}")
            cv2.imwrite(str(path), cv2.imread(str(path))[..., ::-1])
    found = remarks(broken.folder)
    assert {(finding.severity, finding.kind, finding.grasps) for finding in found} == {
        ("warning", "colour-layout", broken.names((1, 6, 7)))
    }
    assert [finding.message.split(" looks")[0] for finding in found] == [
        f"touch of finger {finger}",
        f"no-contact frame of finger {finger}",
    ]


def test_touches_that_all_differ_from_their_no_contact_frames_are_named(clean, tmp_path):
    broken = Broken(clean, tmp_path / "r")
    for number in range(len(broken.rows)):
        path = broken.file(number, "touch_a")
        cv2.imwrite(str(path), cv2.imread(str(path))[..., ::-1])
    kinds = [finding for finding in remarks(broken.folder) if finding.kind == "colour-layout"]
    assert [finding.message.split(" looks")[0] for finding in kinds] == ["touch of finger a"]


def test_an_import_prints_the_warning_and_succeeds(tmp_path, capsys):
    layout = (255 * gels(8)).clip(0, 255).astype(np.uint8)
    for number, image in enumerate(layout):
        folder = tmp_path / "src" / f"mug-{number // 2}"
        folder.mkdir(parents=True, exist_ok=True)
        large = cv2.resize(image, (160, 120))
        cv2.imwrite(str(folder / f"touch_{number}.png"), large if number == 5 else large[..., ::-1])
        cv2.imwrite(str(folder / f"photo_{number}.png"), large // (number + 1))
    assert main(["import", "folder", str(tmp_path / "src"), "--out", str(tmp_path / "out")]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert len(lines) == 1
    assert (
        "touch of finger a looks as if it had red and blue exchanged, unlike the others, in 1 of 8 grasps" in lines[0]
    )


def test_real_touches_with_exchanged_channels_are_found_and_unchanged_ones_are_not():
    paths = sorted(touch_data("billets").glob("*/*_touch.png"))
    images = np.array([cv2.resize(cv2.imread(str(path)), (8, 6), interpolation=cv2.INTER_AREA) for path in paths]) / 255
    images = images[..., ::-1].astype(np.float32)
    assert changed_layout(images) is None
    images[40:50] = images[40:50, ..., ::-1]
    assert changed_layout(images).rows.tolist() == list(range(40, 50))
