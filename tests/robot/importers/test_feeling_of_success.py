"""Importer of The Feeling of Success, with damaged HDF5 files; test_importers.py tests the common behaviour."""

import cv2
import h5py
import numpy as np
import pytest

from retrieval.data.dataset import load_attempts, load_grasps
from robot.errors import ImporterError
from robot.importers.feeling_of_success import import_feeling_of_success
from tests.miniatures import feeling_of_success, pixels

FIRST = "calandra_corl2017_000"


@pytest.fixture
def data(source):
    """Open /data of the first file for changes."""
    with h5py.File(source / f"{FIRST}.h5", "r+") as file:
        yield file["data"]


def rgb(path):
    return cv2.imread(str(path))[..., ::-1]


def test_grasps_are_in_the_order_of_their_numbers_with_their_pictures_and_failed_ones_are_marked(source, tmp_path):
    """Seeds divisible by 100 fail: 0, 100, 200 and 1000 among 0, 20, ... 220 and 1000. Training leaves them out.

    Consecutive grasps of one object are a sequence.
    """
    recording = import_feeling_of_success(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps][9:11] == [f"{FIRST}-i9", f"{FIRST}-i10"]
    grasp = recording.grasps[3]
    seeds = {"photo": 60, "touch_a": 66, "touch_b": 71, "touch_a_before": 65, "touch_b_after": 72}
    for column, seed in seeds.items():
        size = (18, 32) if column == "photo" else (32, 24)
        np.testing.assert_array_equal(rgb(tmp_path / "out" / grasp.images()[column]), pixels(seed, size))
    assert [grasp.sequence_id for grasp in recording.grasps] == ["soda_can-1"] * 10 + ["lemon-2"] * 2 + ["soda_can-3"]
    failed = [attempt.grasp_id for attempt in load_attempts(tmp_path / "out") if not attempt.held]
    assert failed == [f"{FIRST}-i0", f"{FIRST}-i5", f"{FIRST}-i10", "calandra_corl2017_001-i0"]
    assert len(load_grasps(tmp_path / "out")) == 9


def test_a_grasp_that_lacks_a_picture_a_name_or_a_valid_outcome_is_skipped(source, data, tmp_path):
    del data["i0"]["gelsightB_during"]
    del data["i1"].attrs["is_gripping"]
    for name, value in (("i2", "False"), ("i3", np.nan), ("i4", np.array([1, 0]))):
        data[name].attrs["is_gripping"] = value
    for number, value in enumerate([np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 4), np.uint8), 3], start=5):
        del data[f"i{number}"]["kinectA_rgb_before"]
        data[f"i{number}"]["kinectA_rgb_before"] = value
    data.file.close()
    assert import_feeling_of_success(source, tmp_path / "out").info["skipped"] == {
        "its gelsightB_during is missing": 1,
        "its object_name or is_gripping is missing": 4,
        "its kinectA_rgb_before is not a picture with 8-bit colours": 3,
    }


def test_a_file_of_another_version_is_skipped_and_refused_if_it_is_the_only_one(tmp_path):
    (tmp_path / "src").mkdir()
    with h5py.File(tmp_path / "src/2016-06-30.hdf5", "w") as file:
        file["GelSightA_image"] = np.zeros(4, np.uint8)
    with pytest.raises(ImporterError, match=r"no /data; it may be of another version, such as 2016-06-30\.hdf5"):
        import_feeling_of_success(tmp_path / "src", tmp_path / "out")


def test_compressed_pictures_are_read(tmp_path):
    (tmp_path / "src").mkdir()
    with h5py.File(tmp_path / "src/calandra_corl2017_000.h5", "w") as file:
        feeling_of_success.write_grasp(file.create_group("data"), "i0", 1, b"lemon", compression="gzip", shuffle=True)
    (grasp,) = import_feeling_of_success(tmp_path / "src", tmp_path / "out").grasps
    np.testing.assert_array_equal(rgb(tmp_path / "out" / grasp.photo), pixels(1, (18, 32)))
