"""Importer of Open-X-Tactile; test_importers.py tests the common behaviour."""

import json
import re
import shutil
import sys
import zipfile
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot.errors import ImporterError, RobotError
from robot.exporters import EXPORTERS
from robot.importers.open_x_tactile import import_open_x_tactile
from robot.importers.zarr_store import ZarrStore
from robot.recording.folder import read_recording
from tests import synthetic

pytest.importorskip("zarr")

from tests.miniatures import open_x_tactile

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    open_x_tactile.write(tmp_path / "src")
    return tmp_path / "src"


@pytest.fixture
def store(tmp_path):
    (tmp_path / "one").mkdir()
    open_x_tactile.write_store(tmp_path / "one/wipe.zarr", (4, 3))
    return tmp_path / "one/wipe.zarr"


def picture(recording, path):
    return cv2.imread(str(recording.folder / path))[..., ::-1]


def test_a_task_is_an_object_an_episode_a_sequence_and_an_area_a_finger(source, tmp_path):
    recording = import_open_x_tactile(source, tmp_path / "out")
    counts = {"insert_plug": 3, "wipe_board": 2}
    assert [grasp.object_id for grasp in recording.grasps] == [task for task, n in counts.items() for _ in range(n)]
    assert [grasp.sequence_id for grasp in recording.grasps][:2] == ["insert_plug-000000", "insert_plug-000001"]
    assert all(sorted(grasp.touches) == ["a", "b"] for grasp in recording.grasps)
    assert (recording.info["sensor"], recording.info["fingers"]) == ("GelSightMini", 2)


def test_the_touch_is_the_step_of_strongest_contact_and_the_first_step_is_the_no_contact_frame(source, tmp_path):
    recording = import_open_x_tactile(source, tmp_path / "out")
    steps = open_x_tactile.episode_steps(100, 5)  # the second episode of the first task
    grasp = recording.grasps[1]
    assert np.array_equal(picture(recording, grasp.photo), steps[0][0])
    for area, finger in enumerate("ab"):
        assert np.array_equal(picture(recording, grasp.touches[finger]), steps[open_x_tactile.PRESSED][1][area])
        assert np.array_equal(picture(recording, grasp.touches_before[finger]), steps[0][1][area])


def test_an_export_can_be_imported_again_without_loss(tmp_path):
    synthetic.write_recording(tmp_path / "r", synthetic.make_objects(3), 2)
    first = read_recording(tmp_path / "r")
    objects = sorted({grasp.object_id for grasp in first.grasps})
    parts = {"train": objects[:2], "validation": [], "test": objects[2:]}
    EXPORTERS.load("open-x-tactile")(first, tmp_path / "zarr", parts=parts)
    again = import_open_x_tactile(tmp_path / "zarr", tmp_path / "back")
    plain = ("grasp_id", "object_id", "sequence_id", "grasped", "force_n")
    before = {grasp.grasp_id: grasp for grasp in first.grasps}
    assert set(before) == {grasp.grasp_id for grasp in again.grasps}
    for grasp in again.grasps:
        old = before[grasp.grasp_id]
        assert [getattr(grasp, key) for key in plain] == [getattr(old, key) for key in plain]
        assert grasp.images().keys() == old.images().keys()
        for column, path in grasp.images().items():
            assert np.array_equal(picture(again, path), picture(first, old.images()[column]))
    split = json.loads((tmp_path / "back/splits/exported.json").read_text())
    assert {part: split[part] for part in parts} == parts
    assert (again.info["sensor"], again.info["source"]) == (first.info["sensor"], first.info["source"])


def test_a_camera_is_chosen_by_name_and_an_unknown_one_lists_the_known(store, tmp_path):
    with pytest.raises(
        ImporterError, match=r"has no data/camera_ego_rgb; set --option camera= to one of: camera_main_rgb"
    ):
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


def forge(store, name, **changes):
    metadata = json.loads((store / name / ".zarray").read_text())
    (store / name / ".zarray").write_text(json.dumps(metadata | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filters": [{"id": "pickle"}]}, "without filters"),
        ({"compressor": {"id": "pickle"}}, "without filters, with one of"),
        ({"dtype": "|O"}, "which this importer does not read"),
        ({"dtype": "<f8"}, "which this importer does not read"),
        ({"chunks": [10**6, 20, 30, 3]}, "too large"),
        ({"chunks": [0, 20, 30, 3]}, "has the invalid shape"),
        ({"shape": [7, 20, 30]}, "3 axes"),
        ({"shape": [-7, 20, 30, 3]}, "has the invalid shape"),
        ({"shape": "all"}, "must define shape, chunks and dtype"),
        ({"zarr_format": 3}, "must be zarr version 2"),
    ],
)
def test_the_metadata_of_an_array_is_checked_before_zarr_reads_it(store, tmp_path, changes, message):
    forge(store, "data/camera_main_rgb", **changes)
    with pytest.raises(ImporterError, match=message):
        import_open_x_tactile(store, tmp_path / "out")
    assert not (tmp_path / "out").exists()


WHOLE = st.integers(-(10**12), 10**12)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "shape": st.lists(WHOLE, max_size=5) | st.text(max_size=3),
            "chunks": st.lists(WHOLE, max_size=5) | st.none(),
            "dtype": st.sampled_from(["|u1", "<U9", "|O", "<M8[ns]", "|V3", [["a", "|u1"]], 3, ""]),
            "compressor": st.sampled_from([None, {"id": "zlib", "level": -99}, {"id": 3}, "blosc", {}]),
            "order": st.sampled_from(["C", "F", "X", 1]),
            "fill_value": st.none() | st.text(max_size=2) | WHOLE,
            "filters": st.none() | st.lists(st.just({"id": "vlen-utf8"}), max_size=1),
            "zarr_format": st.sampled_from([1, 2, 3, "2"]),
        },
    )
)
def test_an_array_with_any_metadata_is_read_or_refused(store, changes):
    before = (store / "data/camera_main_rgb/.zarray").read_text()
    try:
        forge(store, "data/camera_main_rgb", **changes)
        with suppress(RobotError):
            array = ZarrStore(store).array("data/camera_main_rgb", kind="u1")
            if array.shape:
                array.step(0)
    finally:
        (store / "data/camera_main_rgb/.zarray").write_text(before)


@pytest.mark.parametrize("ends", [[3, 3], [5, 4], [4, 99], [0, 4], [-1, 4]])
def test_episode_ends_that_do_not_increase_within_the_steps_are_refused(tmp_path, ends):
    (tmp_path / "src").mkdir()
    more = {"meta/episode_ends": np.array(ends, dtype=np.int64)}
    open_x_tactile.write_store(tmp_path / "src/wipe.zarr", (4, 3), **more)
    with pytest.raises(ImporterError, match="episode_ends must increase up to at most 7, the number of steps"):
        import_open_x_tactile(tmp_path / "src", tmp_path / "out")


def test_names_stored_as_bytes_become_text(tmp_path):
    (tmp_path / "src").mkdir()
    more = {"meta/object_id": np.array([b"mug", "n\u00e4gel".encode()]), "meta/outcome": np.array([b"held", b""])}
    open_x_tactile.write_store(tmp_path / "src/wipe.zarr", (4, 3), **more)
    recording = import_open_x_tactile(tmp_path / "src", tmp_path / "out")
    assert [(grasp.object_id, grasp.outcome) for grasp in recording.grasps] == [("mug", "held"), ("nägel", None)]


@pytest.mark.parametrize("key", ["force_n", "pose", "grasped"])
def test_numbers_stored_as_text_are_refused(tmp_path, key):
    (tmp_path / "src").mkdir()
    values = np.array([["1"], ["2"]] if key == "pose" else ["1", "2"])
    open_x_tactile.write_store(tmp_path / "src/wipe.zarr", (4, 3), **{f"meta/{key}": values})
    with pytest.raises(ImporterError, match=f"meta/{key} has type <U1"):
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


def test_a_zip_with_damaged_content_is_refused(store, tmp_path):
    path = Path(shutil.make_archive(str(tmp_path / "zip" / "wipe.zarr"), "zip", store))
    with zipfile.ZipFile(path) as archive:
        (info,) = [entry for entry in archive.infolist() if entry.filename == "meta/episode_ends/.zarray"]
    data = bytearray(path.read_bytes())
    start = info.header_offset + 30 + len(info.filename)
    data[start : start + info.compress_size] = b"\xff" * info.compress_size
    path.write_bytes(data)
    with pytest.raises(ImporterError, match="cannot be read"):
        import_open_x_tactile(path.parent, tmp_path / "out")


def test_errors_tell_to_unpack_a_tar_file_and_to_install_zarr(source, tmp_path, monkeypatch):
    (tmp_path / "tars").mkdir()
    (tmp_path / "tars/insert_plug.tar").write_bytes(b"tar")
    with pytest.raises(ImporterError, match=r"unpack insert_plug\.tar first"):
        import_open_x_tactile(tmp_path / "tars", tmp_path / "out")
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(
        ImporterError, match=r"needs zarr, which is missing; run pip install 'touch-retrieval\[importers\]'"
    ):
        import_open_x_tactile(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_zip_with_the_folder_itself_is_read(store, tmp_path):
    shutil.make_archive(str(tmp_path / "zip" / "wipe.zarr"), "zip", store.parent, store.name)
    assert len(import_open_x_tactile(tmp_path / "zip", tmp_path / "out").grasps) == 2
