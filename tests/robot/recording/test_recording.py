"""The recording on disk: valid input of the reader, and output of the writer."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot.errors import RecordingError, StorageError
from robot.recording.folder import RecordingWriter, SharedImage, read_recording
from robot.recording.grasp import RecordedGrasp
from robot.recording.preview import TILE_PX, write_preview

INFO = {"source": "test", "sensor": "GelSight", "seed": 3}
ROW = {"grasp_id": "1", "object_id": "mug", "photo_file_name": "p.png", "touch_a_file_name": "a.png"}


def pixels(seed=0, height=4, width=5):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def pictures(seed=0):
    return {"photo": pixels(seed), "touch_a": pixels(seed + 1), "touch_b": pixels(seed + 2)}


def write(folder, *lines, info=None):
    """Write a recording with these lines, each a dict or raw text, and return its folder."""
    folder.mkdir(exist_ok=True)
    (folder / "recording.json").write_text(json.dumps({"schema_version": 1, **INFO} if info is None else info))
    text = "".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines)
    (folder / "metadata.jsonl").write_bytes(text.encode("utf-8", "surrogateescape"))
    return folder


def two_grasps(folder):
    with RecordingWriter(folder, INFO) as writer:
        writer.append("1", "mug", pictures(1), force_n=5)
        writer.append("2", "cup", pictures(2))
    return folder


def ids(folder):
    return [grasp.grasp_id for grasp in read_recording(folder).grasps]


def test_appended_grasps_are_read_back_and_a_line_has_the_documented_columns_without_missing_values(tmp_path):
    with RecordingWriter(tmp_path / "r", INFO) as writer:
        images = {**pictures(), "touch_a_before": pixels(7), "touch_b_after": pixels(8)}
        images["depth"] = np.array([[0, 1, 65535]], np.uint16)
        written = writer.append(
            "000001",
            "red mug",
            images,
            force_n=np.float32(7.5),
            opening_mm=31,
            pose=(*np.array([1.0, 2.0, 3.0]), 0.5),
            grasped=np.True_,
            outcome="slipped",
            sequence_id="take 3",
            session="tuesday",
            time_s=0.25,
        )
    recording = read_recording(tmp_path / "r")
    assert recording.grasps == (written,)
    assert recording.notes == ()
    assert written == RecordedGrasp(
        grasp_id="000001",
        object_id="red mug",
        photo="images/000001_photo.png",
        touches={"a": "images/000001_touch_a.png", "b": "images/000001_touch_b.png"},
        touches_before={"a": "images/000001_touch_a_before.png"},
        touches_after={"b": "images/000001_touch_b_after.png"},
        depth="images/000001_depth.png",
        force_n=7.5,
        opening_mm=31.0,
        pose=(1.0, 2.0, 3.0, 0.5),
        grasped=True,
        outcome="slipped",
        sequence_id="take 3",
        session="tuesday",
        time_s=0.25,
    )
    assert hash(written) == hash(recording.grasps[0])
    with RecordingWriter(tmp_path / "s", INFO) as writer:
        writer.append("1", "mug", {"photo": pixels(), "touch_a": pixels(), "touch_a_before": pixels()}, force_n=2)
    (line,) = (tmp_path / "s/metadata.jsonl").read_text().splitlines()
    images = {f"{column}_file_name": f"images/1_{column}.png" for column in ("photo", "touch_a", "touch_a_before")}
    assert json.loads(line) == {"grasp_id": "1", "object_id": "mug", "force_n": 2.0, **images}


def test_datasets_opens_a_recording(tmp_path):
    datasets = pytest.importorskip("datasets")
    two_grasps(tmp_path / "r")
    folders = {"data_dir": str(tmp_path / "r"), "cache_dir": str(tmp_path / "cache")}
    rows = datasets.load_dataset("imagefolder", split="train", **folders)
    assert rows["force_n"] == [5.0, None]
    np.testing.assert_array_equal(np.asarray(rows[1]["touch_b"]), pixels(4))


def test_a_recording_of_touches_only_is_opened_by_readers_datasets_and_the_preview(tmp_path):
    datasets = pytest.importorskip("datasets")
    with RecordingWriter(tmp_path / "r", INFO) as writer:
        grasp = writer.append("1", "mug", {"touch_a": pixels(1), "touch_a_before": pixels(2)})
    assert read_recording(tmp_path / "r").grasps == (grasp,)
    assert (grasp.photo, [*grasp.images()]) == (None, ["touch_a", "touch_a_before"])
    folders = {"data_dir": str(tmp_path / "r"), "cache_dir": str(tmp_path / "cache")}
    (row,) = datasets.load_dataset("imagefolder", split="train", **folders)
    np.testing.assert_array_equal(np.asarray(row["touch_a"]), pixels(1))
    sheet = cv2.imread(str(write_preview(tmp_path / "r", tmp_path / "sheet.png")))
    assert sheet.shape[1] == 2 * TILE_PX


def test_pixels_are_read_back_and_files_and_bytes_are_copied_unchanged(tmp_path):
    """Pixels are RGB, depth has 16 bits."""
    depth = np.array([[0, 256, 65535]], np.uint16)
    jpeg, png = (cv2.imencode(kind, pixels())[1] for kind in (".jpg", ".png"))
    (tmp_path / "x.data").write_bytes(jpeg.tobytes())
    with RecordingWriter(tmp_path / "r", INFO) as writer:
        writer.append("1", "mug", {"photo": pixels(1), "touch_a": pixels(2)[:, ::-1], "depth": depth})
        grasp = writer.append("2", "mug", {"photo": tmp_path / "x.data", "touch_a": png.tobytes()})
    stored = {path.name: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (tmp_path / "r/images").iterdir()}
    np.testing.assert_array_equal(stored["1_photo.png"][..., ::-1], pixels(1))
    np.testing.assert_array_equal(stored["1_touch_a.png"][..., ::-1], pixels(2)[:, ::-1])
    np.testing.assert_array_equal(stored["1_depth.png"], depth)
    assert grasp.images() == {"photo": "images/2_photo.jpg", "touch_a": "images/2_touch_a.png"}
    assert (tmp_path / "r" / grasp.photo).read_bytes() == jpeg.tobytes()
    assert (tmp_path / "r" / grasp.touches["a"]).read_bytes() == png.tobytes()


def test_recording_json_has_defaults_and_other_keys_that_a_writer_updates(tmp_path):
    with RecordingWriter(tmp_path, {**INFO, "licence": "MIT"}) as writer:
        writer.update_info(skipped={"it is dark": 2})
        with pytest.raises(RecordingError, match="must contain plain JSON"):
            writer.update_info(skipped={1j})
    info = read_recording(tmp_path).info
    assert (info["schema_version"], info["seed"], info["background"], info["licence"]) == (1, 3, "none", "MIT")
    assert (info["units"]["force_n"], info["skipped"]) == ("newton", {"it is dark": 2})
    assert {"source", "sensor", "rig", "software_version"} <= set(info)


def test_a_line_of_another_program_may_have_null_and_other_keys_and_end_without_a_newline(tmp_path):
    write(tmp_path, {**ROW, "force_n": None, "touch_b_file_name": None, "text": "a red mug"}, "", "  ")
    with open(tmp_path / "metadata.jsonl", "a") as file:
        file.write(json.dumps({**ROW, "grasp_id": "2"}))
    recording = read_recording(tmp_path)
    assert [grasp.grasp_id for grasp in recording.grasps] == ["1", "2"]
    assert recording.grasps[0].touches == {"a": "a.png"}
    assert recording.notes == ()


BAD_LINES = {
    "{": "must be one JSON object",
    "[]": "one JSON object",
    json.dumps({**ROW, "grasp_id": "0"}): "grasp_id must be unique, got '0' twice",
    json.dumps({**ROW, "object_id": None}): "object_id is missing",
    json.dumps({key: ROW[key] for key in ROW if key != "touch_a_file_name"}): "at least one touch",
    json.dumps({**ROW, "object_id": "mug\ud83d"}): "it must be",
    json.dumps({**ROW, "grasp_id": 5}): "grasp_id must be a text in quotes, got 5",
    json.dumps({**ROW, "force_n": "5"}): "force_n must be a number or nothing, got '5'",
    json.dumps({**ROW, "force_n": float("nan")}): "without NaN",
    json.dumps(ROW)[:-1] + ', "time_s": 1e999}': "Number out of range",
    json.dumps({**ROW, "outcome": "lost"}): "outcome must be one of",
    json.dumps({**ROW, "pose": [1, "2"]}): "pose[1] must be a number, got '2'",
    json.dumps({**ROW, "photo_file_name": "/etc/passwd"}): "must be a path inside",
    json.dumps({**ROW, "photo_file_name": "a/../../b.png"}): "must be a path inside",
    json.dumps({**ROW, "photo_file_name": "C:/x.png"}): "must be a path inside",
    json.dumps({**ROW, "photo_file_name": "..\\x.png"}): "must be a path inside",
    json.dumps({**ROW, "photo_file_name": "a\0.png"}): "must be a path inside",
}


@pytest.mark.parametrize("line", BAD_LINES, ids=range(len(BAD_LINES)))
def test_a_bad_line_is_named_by_its_number(tmp_path, line):
    write(tmp_path, {**ROW, "grasp_id": "0"}, line, {**ROW, "grasp_id": "2"})
    with pytest.raises(RecordingError, match=rf"metadata\.jsonl, line 2: .*{re.escape(BAD_LINES[line])}"):
        read_recording(tmp_path)


def test_an_incomplete_last_line_of_any_length_is_dropped_with_a_note(tmp_path):
    write(tmp_path, ROW)
    whole, line = (tmp_path / "metadata.jsonl").read_bytes(), json.dumps({**ROW, "grasp_id": "é"}).encode()
    for length in (1, 2, 20, len(line) - 3, len(line) - 1):  # also within the é
        (tmp_path / "metadata.jsonl").write_bytes(whole + line[:length])
        recording = read_recording(tmp_path)
        assert [grasp.grasp_id for grasp in recording.grasps] == ["1"]
        assert f"incomplete last line ({length} bytes)" in recording.notes[0]
    (tmp_path / "metadata.jsonl").write_bytes(whole + b"\0" * 512)  # some file systems leave this
    assert ids(tmp_path) == ["1"]


@pytest.mark.parametrize(
    "text", ["", "[1]", "{", '{"schema_version": 1}', '{"schema_version": 1, "source": 3}', '{"schema_version": 2}']
)
def test_a_bad_recording_json_is_an_error_that_names_it(tmp_path, text):
    (write(tmp_path, ROW) / "recording.json").write_text(text)
    with pytest.raises(RecordingError, match=r"recording\.json"):
        read_recording(tmp_path)


def test_the_error_for_another_folder_names_the_import_command(tmp_path):
    with pytest.raises(RecordingError, match="`retrieve import` writes recordings"):
        read_recording(tmp_path)
    (write(tmp_path / "r", ROW) / "metadata.jsonl").unlink()
    with pytest.raises(RecordingError, match=r"metadata\.jsonl cannot be read: No such file"):
        read_recording(tmp_path / "r")


def test_reading_opens_no_image_and_imports_no_opencv(tmp_path):
    code = "import sys; from robot.recording.folder import read_recording; read_recording(sys.argv[1]); "
    code += "assert not {'cv2', 'torch', 'scipy', 'retrieval'} & set(sys.modules)"
    recording = write(tmp_path, ROW)  # its images do not exist
    subprocess.run([sys.executable, "-c", code, str(recording)], check=True, cwd=Path(__file__).parents[3])


@pytest.mark.parametrize("cut", [-1, -30])
def test_a_writer_removes_an_incomplete_last_line_and_adds_a_newline_that_lacks(tmp_path, cut):
    path = two_grasps(tmp_path) / "metadata.jsonl"
    path.write_bytes(path.read_bytes()[:cut])
    with RecordingWriter(tmp_path, INFO) as writer:
        writer.append("3", "cup", pictures())
    assert ids(tmp_path) == (["1", "2", "3"] if cut == -1 else ["1", "3"])
    assert read_recording(tmp_path).notes == ()
    assert path.read_bytes().count(b"\n") == len(ids(tmp_path))


def test_a_recording_with_another_fixed_value_is_not_continued(tmp_path):
    two_grasps(tmp_path)
    for key, other in {"source": "other", "sensor": "other", "units": {"x": "y"}, "background": "other"}.items():
        with pytest.raises(RecordingError, match=f"was recorded with {key} .* give another folder"):
            RecordingWriter(tmp_path, {**INFO, key: other})
    assert ids(tmp_path) == ["1", "2"]


def test_a_second_writer_of_a_recording_and_a_second_grasp_of_one_id_are_refused(tmp_path):
    with RecordingWriter(tmp_path, INFO) as first, pytest.raises(StorageError, match="being written by another"):
        RecordingWriter(tmp_path, INFO)
    first.close()
    with RecordingWriter(tmp_path, INFO) as writer:
        writer.append("1", "mug", pictures())
        with pytest.raises(RecordingError, match="already contains grasp 1"):
            writer.append("1", "mug", pictures())
        with pytest.raises(RecordingError, match="force_n must be a finite number, got nan"):
            writer.append("2", "mug", pictures(), force_n=float("nan"))
    assert ids(tmp_path) == ["1"]


def test_a_folder_of_other_files_is_not_written_to(tmp_path):
    (two_grasps(tmp_path / "r") / "recording.json").unlink()
    with pytest.raises(RecordingError, match=r"has a metadata\.jsonl but no recording\.json"):
        RecordingWriter(tmp_path / "r", INFO)
    shutil.rmtree(tmp_path / "r")
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(RecordingError, match=r"contains other files, such as thesis\.tex"):
        RecordingWriter(tmp_path, INFO)
    with pytest.raises(RecordingError, match="is a file"):
        RecordingWriter(tmp_path / "thesis.tex", INFO)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("info", "reason"),
    [
        ({"source": "x"}, "sensor must be"),
        ({"sensor": "x"}, "source must be"),
        ({**INFO, "rig": object()}, "must contain plain JSON"),
        ({**INFO, "rig": float("nan")}, "must contain plain JSON"),
        ({**INFO, "schema_version": 2}, "schema_version"),
    ],
)
def test_bad_info_is_refused_before_a_folder_is_made(tmp_path, info, reason):
    with pytest.raises(RecordingError, match=reason):
        RecordingWriter(tmp_path / "r", info)
    assert not (tmp_path / "r").exists()


BAD_IMAGES = {
    "float": ({"photo": pixels() / 255, "touch_a": pixels()}, "photo must be H x W x 3 uint8 RGB"),
    "grey": ({"photo": pixels()[..., 0], "touch_a": pixels()}, "photo must be H x W x 3 uint8 RGB"),
    "no pixels": ({"photo": pixels(), "touch_a": np.zeros((0, 2, 3), np.uint8)}, "touch_a must be H x W"),
    "colour depth": ({**pictures(), "depth": pixels()}, "depth must be H x W uint16"),
    "gif": ({"photo": b"GIF89a", "touch_a": pixels()}, "its first bytes are b'GIF8'"),
    "no file": ({"photo": "/nowhere/x.png", "touch_a": pixels()}, "/nowhere/x.png cannot be read"),
    "unknown column": ({**pictures(), "foto": pixels()}, "unknown key 'foto_file_name'"),
}


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_bad_images_are_refused_before_anything_is_written(tmp_path, name):
    images, reason = BAD_IMAGES[name]
    with RecordingWriter(tmp_path, INFO) as writer, pytest.raises(RecordingError, match=reason):
        writer.append("1", "mug", images)
    assert list((tmp_path / "images").iterdir()) == []
    assert ids(tmp_path) == []


def test_a_shared_image_is_stored_once_and_later_ones_of_its_name_are_ignored(tmp_path):
    for number in (1, 2):  # the second writer continues the recording
        with RecordingWriter(tmp_path / "recording", INFO) as writer:
            rest = SharedImage("rest", pixels(10 * number))
            writer.append(str(number), "mug", {**pictures(), "touch_a_before": rest})
    grasps = read_recording(tmp_path / "recording").grasps
    assert {grasp.touches_before["a"] for grasp in grasps} == {"images/rest_shared.png"}
    stored = cv2.imread(str(tmp_path / "recording/images/rest_shared.png"))[..., ::-1]
    np.testing.assert_array_equal(stored, pixels(10))


@pytest.mark.parametrize("name", ["", "../x", ".hidden", "x" * 129, 5])
def test_a_grasp_id_and_the_name_of_a_shared_image_must_be_safe_in_a_file_name(tmp_path, name):
    with RecordingWriter(tmp_path, INFO) as writer:
        with pytest.raises(RecordingError, match="grasp_id must have"):
            writer.append(name, "mug", pictures())
        with pytest.raises(RecordingError, match="shared image"):
            writer.append("1", "mug", {**pictures(), "touch_a_before": SharedImage(name, pixels())})


@pytest.mark.parametrize("name", ["recording.json", "metadata.jsonl"])
def test_a_path_that_is_not_a_file_is_refused_without_being_read_or_written(tmp_path, name):
    write(tmp_path, ROW)
    path = tmp_path / name
    path.unlink()
    for make in (os.mkfifo, lambda there: os.symlink("/dev/zero", there), os.mkdir):
        make(path)
        with pytest.raises(RecordingError, match="not a regular file"):
            read_recording(tmp_path)
        with pytest.raises((RecordingError, StorageError)):
            RecordingWriter(tmp_path, INFO)
        path.rmdir() if path.is_dir() else path.unlink()
