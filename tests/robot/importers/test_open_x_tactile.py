"""Importer of Open-X-Tactile; test_importers.py tests the common behaviour."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers.open_x_tactile import import_open_x_tactile
from tests.miniatures import open_x_tactile


@pytest.fixture
def store(tmp_path):
    (tmp_path / "one").mkdir()
    open_x_tactile.write_store(tmp_path / "one/wipe.zarr", (4, 3))
    return tmp_path / "one/wipe.zarr"


def picture(recording, path):
    return cv2.imread(str(recording.folder / path))[..., ::-1]


def test_a_task_is_an_object_an_episode_a_sequence_and_its_strongest_contact_the_touch(tmp_path):
    """The first step of an episode is the no-contact frame; an area is a finger."""
    open_x_tactile.write(tmp_path / "src")
    recording = import_open_x_tactile(tmp_path / "src", tmp_path / "out")
    counts = {"insert_plug": 3, "wipe_board": 2}
    assert [grasp.object_id for grasp in recording.grasps] == [task for task, n in counts.items() for _ in range(n)]
    assert [grasp.sequence_id for grasp in recording.grasps][:2] == ["insert_plug-000000", "insert_plug-000001"]
    assert all(sorted(grasp.touches) == ["a", "b"] for grasp in recording.grasps)
    assert (recording.info["sensor"], recording.info["fingers"]) == ("GelSightMini", 2)
    steps = open_x_tactile.episode_steps(100, 5)  # the second episode of the first task
    grasp = recording.grasps[1]
    assert np.array_equal(picture(recording, grasp.photo), steps[0][0])
    for area, finger in enumerate("ab"):
        assert np.array_equal(picture(recording, grasp.touches[finger]), steps[open_x_tactile.PRESSED][1][area])
        assert np.array_equal(picture(recording, grasp.touches_before[finger]), steps[0][1][area])


def test_a_camera_is_chosen_by_name_and_an_unknown_one_lists_the_known(store, tmp_path):
    with pytest.raises(ImporterError, match=r"set --option camera= to one of: camera_main_rgb"):
        import_open_x_tactile(store.parent, tmp_path / "out", camera="camera_ego_rgb")
    assert len(import_open_x_tactile(store, tmp_path / "out", camera="camera_main_rgb").grasps) == 2


def test_a_missing_chunk_costs_its_episode_and_is_not_a_black_picture(store, tmp_path):
    (store / "data/camera_main_rgb/4.0.0.0").unlink()  # the first step of the second episode
    recording = import_open_x_tactile(store, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps] == ["wipe-000000"]
    assert recording.info["skipped"] == {"a chunk of wipe.zarr/data/camera_main_rgb is missing": 1}


def test_an_episode_without_contact_is_not_a_grasp(store, tmp_path):
    for path in (store / "data/right_tactile_data_0").glob("[456].*"):
        path.write_bytes((store / "data/right_tactile_data_0/4.0.0.0.0").read_bytes())
    assert import_open_x_tactile(store, tmp_path / "out").info["skipped"] == {
        "no gel image of its episode differs from the first": 1
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filters": [{"id": "pickle"}]}, "without filters"),
        ({"compressor": {"id": "pickle"}}, "without filters, with a codec of"),
        ({"dtype": "|O"}, "cannot be opened"),
        ({"dtype": "<f8"}, "must have type uint8"),
        ({"chunks": [10**6, 20, 30, 3]}, "too large"),
        ({"chunks": [0, 20, 30, 3]}, "or empty"),
        ({"shape": [7, 20, 30], "chunks": [1, 20, 30]}, "3 axes"),
        ({"shape": "all"}, "cannot be opened"),
        ({"zarr_format": 3}, "must be zarr version 2"),
    ],
)
def test_the_metadata_of_an_array_is_checked_before_zarr_reads_it(store, tmp_path, changes, message):
    path = store / "data/camera_main_rgb/.zarray"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ImporterError, match=message):
        import_open_x_tactile(store, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("ends", [[3, 3], [4, 99], [0, 4]])
def test_episode_ends_that_do_not_increase_within_the_steps_are_refused(tmp_path, ends):
    (tmp_path / "src").mkdir()
    more = {"meta/episode_ends": np.array(ends, dtype=np.int64)}
    open_x_tactile.write_store(tmp_path / "src/wipe.zarr", (4, 3), **more)
    with pytest.raises(ImporterError, match="episode_ends must increase up to at most 7, the number of steps"):
        import_open_x_tactile(tmp_path / "src", tmp_path / "out")


@pytest.mark.parametrize(("offset", "value"), [(6, 1), (8, 99)])
def test_a_zip_with_encryption_or_an_unknown_compression_is_refused(store, tmp_path, offset, value):
    """Byte 6 of a file header is the encryption flag, byte 8 the compression method."""
    path = Path(shutil.make_archive(str(tmp_path / "zip" / "wipe.zarr"), "zip", store))
    data = bytearray(path.read_bytes())
    for head, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        for found in re.finditer(re.escape(head), bytes(data)):
            data[found.start() + offset + shift] = value
    path.write_bytes(data)
    with pytest.raises(ImporterError, match=r"cannot be (read|opened)"):
        import_open_x_tactile(path.parent, tmp_path / "out")


def test_a_zip_with_the_folder_itself_is_read(store, tmp_path):
    shutil.make_archive(str(tmp_path / "zip" / "wipe.zarr"), "zip", store.parent, store.name)
    assert len(import_open_x_tactile(tmp_path / "zip", tmp_path / "out").grasps) == 2
