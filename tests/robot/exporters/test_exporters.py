"""Exporters: their output is opened with the readers of other programs if these are installed."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from retrieval.commands.main import main
from robot.errors import ImporterError, RecordingError, StorageError, UnknownName
from robot.exporters import EXPORTERS
from robot.exporters.exporting import atomic_folder, letterbox, read_picture
from robot.importers import load_importer
from robot.recording.folder import RecordingWriter, read_recording

RNG = np.random.default_rng(0)


def smooth(height, width):
    """Return a picture with smooth colours, like a gel."""
    return cv2.resize(RNG.integers(40, 215, (4, 4, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Three objects with two grasps each: two fingers, before and during; the last photo has another size."""
    folder = tmp_path_factory.mktemp("source") / "recording"
    info = {
        "source": "synthetic",
        "sensor": "GelSight Mini",
        "licence": "CC0",
        "terms": "none",
        "background": "before each grasp",
    }
    with RecordingWriter(folder, info) as writer:
        for number in range(6):
            images = {"photo": smooth(30, 40) if number < 5 else smooth(48, 48)}
            for finger in "ab":
                images |= {f"touch_{finger}": smooth(24, 32), f"touch_{finger}_before": smooth(24, 32)}
            if number == 0:
                images["touch_a_after"] = images["touch_b_after"] = smooth(24, 32)
            fields = {"force_n": 2.5 + number, "pose": [1.0, 2.0, 3.0, 0.5]} if number else {}
            grasped = number != 3
            writer.append(f"g{number}", f"object {number // 2}", images, grasped=grasped, sequence_id="s", **fields)
    return read_recording(folder)


@pytest.fixture(params=EXPORTERS)
def name(request):
    needed = {"imagefolder": (), "lerobot": ("pyarrow", "av"), "open-x-tactile": ("zarr",)}
    for package in needed[request.param]:
        pytest.importorskip(package)
    return request.param


SPLIT = {"train": ("object 0",), "validation": (), "test": ("object 2",)}


def picture(recording, grasp, column):
    return read_picture(recording.folder / grasp.images()[column])


def rms(one, other):
    return float(np.sqrt(np.mean((one.astype(float) - other.astype(float)) ** 2)))


# Common behaviour -------------------------------------------------------------------------------------------


def test_an_unknown_format_lists_the_known_ones():
    with pytest.raises(UnknownName, match="format must be one of imagefolder, lerobot, open-x-tactile; got 'zarr'"):
        EXPORTERS.load("zarr")


def test_an_export_appears_when_it_is_complete_and_reports_progress(name, source, tmp_path):
    calls = []
    out = tmp_path / "out"

    def progress(done, total):
        calls.append((done, total, out.exists()))

    result = EXPORTERS.load(name)(source, out, progress=progress)
    assert calls == [(done, 6, False) for done in range(1, 7)]
    assert result.grasps == 6
    assert {path.name for path in tmp_path.iterdir()} == {"out"}


def test_a_stopped_export_leaves_no_output_and_starts_again(name, source, tmp_path):
    def stop(done, total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        EXPORTERS.load(name)(source, tmp_path / "out", progress=stop)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out.part" / "old file").write_text("old")
    EXPORTERS.load(name)(source, tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == {"out"}
    assert not list((tmp_path / "out").rglob("old file"))


def test_a_folder_with_files_is_refused_and_an_empty_one_is_used(name, source, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(RecordingError, match="must be a new or an empty folder"):
        EXPORTERS.load(name)(source, tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"
    (tmp_path / "out" / "mine.txt").unlink()
    assert EXPORTERS.load(name)(source, tmp_path / "out").grasps == 6


def test_an_error_names_a_damaged_picture_and_nothing_is_written(name, source, tmp_path):
    shutil.copytree(source.folder, tmp_path / "r")
    recording = read_recording(tmp_path / "r")
    path = tmp_path / "r" / recording.grasps[4].touches["b"]
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(RecordingError, match=rf"{path.name} is missing, damaged or cut off; run `retrieve check`"):
        EXPORTERS.load(name)(recording, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_split_with_an_object_in_two_parts_or_with_other_objects_is_refused(name, source, tmp_path):
    with pytest.raises(RecordingError, match="has object 0 in two parts"):
        EXPORTERS.load(name)(source, tmp_path / "out", parts={"train": ["object 0"], "test": ["object 0"]})
    with pytest.raises(RecordingError, match="contains no object of the recording"):
        EXPORTERS.load(name)(source, tmp_path / "out", parts={"train": ["mug"]})


def test_an_error_names_the_extra_if_a_package_is_missing(source, tmp_path, monkeypatch):
    for package, to in (("pyarrow", "lerobot"), ("av", "lerobot"), ("zarr", "open-x-tactile")):
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, package, None)
            with pytest.raises(ImporterError, match=rf"needs {package}, .*pip install 'touch-retrieval\[importers\]'"):
                EXPORTERS.load(to)(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_grasps_with_different_fingers_are_refused_by_formats_with_steps(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "synthetic", "sensor": "gel"}) as writer:
        writer.append("1", "mug", {"photo": smooth(9, 9), "touch_a": smooth(9, 9)})
        writer.append("2", "mug", {"photo": smooth(9, 9), "touch_a": smooth(9, 9), "touch_b": smooth(9, 9)})
    for to in ("lerobot", "open-x-tactile"):
        with pytest.raises(RecordingError, match="must have the same fingers; 1 has a, 2 has a, b"):
            EXPORTERS.load(to)(read_recording(tmp_path / "r"), tmp_path / "out")
    assert EXPORTERS.load("imagefolder")(read_recording(tmp_path / "r"), tmp_path / "out").grasps == 2


# The folder ------------------------------------------------------------------------------------------------


def test_two_exports_to_one_folder_do_not_mix(tmp_path):
    second = atomic_folder(tmp_path / "out")
    with atomic_folder(tmp_path / "out"), pytest.raises(StorageError, match="being written by another process"):
        second.__enter__()
    assert (tmp_path / "out").is_dir()


def test_a_foreign_folder_with_the_temporary_name_is_not_changed(tmp_path):
    (tmp_path / "out.part").mkdir()
    (tmp_path / "out.part" / "mine.txt").write_text("mine")
    with (
        pytest.raises(RecordingError, match="already exists and is not from an export"),
        atomic_folder(tmp_path / "out"),
    ):
        pass
    assert (tmp_path / "out.part" / "mine.txt").read_text() == "mine"


def test_a_picture_is_scaled_into_the_middle():
    found = letterbox(np.full((10, 20, 3), 200, np.uint8), (40, 40))
    assert found.shape == (40, 40, 3)
    assert (found[10:30] == 200).all()
    assert not found[:10].any()
    assert not found[30:].any()


# imagefolder -----------------------------------------------------------------------------------------------


def test_datasets_opens_an_imagefolder_with_its_parts(source, tmp_path):
    datasets = pytest.importorskip("datasets")
    result = EXPORTERS.load("imagefolder")(source, tmp_path / "out", parts=SPLIT)
    found = datasets.load_dataset("imagefolder", data_dir=str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert {part: rows.num_rows for part, rows in found.items()} == {"train": 2, "test": 2}
    row, grasp = found["test"][1], source.grasps[5]
    assert (row["grasp_id"], row["object_id"], row["force_n"]) == ("g5", "object 2", 7.5)
    for column in ("photo", "touch_a", "touch_b", "touch_a_before"):
        assert np.array_equal(np.asarray(row[column]), picture(source, grasp, column))
    assert "touch_a_after" not in row
    assert any(note.startswith("left out touch_a_after, which some grasps do not have") for note in result.notes)


def test_datasets_opens_a_recording_directly(source, tmp_path):
    datasets = pytest.importorskip("datasets")
    lines = (
        (source.folder / "metadata.jsonl").read_text().splitlines()[1:]
    )  # the first line has pictures after the touch
    shutil.copytree(source.folder, tmp_path / "r")
    (tmp_path / "r/metadata.jsonl").write_text("\n".join(lines))
    found = datasets.load_dataset("imagefolder", data_dir=str(tmp_path / "r"), cache_dir=str(tmp_path / "cache"))
    assert found["train"].num_rows == 5
    EXPORTERS.load("imagefolder")(source, tmp_path / "out")
    found = datasets.load_dataset("imagefolder", data_dir=str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert found["train"]["force_n"] == [None, 3.5, 4.5, 5.5, 6.5, 7.5]


def test_an_imagefolder_copies_files_byte_for_byte_and_states_the_licence(source, tmp_path):
    EXPORTERS.load("imagefolder")(source, tmp_path / "out")
    name = source.grasps[2].photo
    assert (tmp_path / "out" / "train" / name).read_bytes() == (source.folder / name).read_bytes()
    assert "* licence: CC0" in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.parametrize(("name", "packages"), [("lerobot", ("av", "pyarrow.parquet")), ("open-x-tactile", ("zarr",))])
def test_an_export_that_is_imported_again_keeps_licence_and_terms(name, packages, source, tmp_path):
    for package in packages:
        pytest.importorskip(package)
    EXPORTERS.load(name)(source, tmp_path / "out")
    info = load_importer(name)(tmp_path / "out", tmp_path / "again").info
    assert (info["licence"], info["terms"]) == ("CC0", "none")


# open-x-tactile --------------------------------------------------------------------------------------------


def test_zarr_opens_an_open_x_tactile_export(source, tmp_path):
    zarr = pytest.importorskip("zarr")
    result = EXPORTERS.load("open-x-tactile")(source, tmp_path / "out")
    store = zarr.open_group(str(tmp_path / "out" / "grasps.zarr"), mode="r")
    assert store.metadata.zarr_format == 2
    assert store["meta/episode_ends"][:].tolist() == [2, 4, 6, 8, 10, 12]
    assert store["meta/episode_ends"].dtype == np.int64
    assert store["data/camera_main_rgb"].shape == (12, 30, 40, 3)
    assert store["data/right_tactile_data_0"].shape == (12, 2, 24, 32, 3)
    assert store["meta/moment"][:].tolist() == ["before", "during"]
    for number, grasp in enumerate(source.grasps):
        before, during = store["data/right_tactile_data_0"][2 * number : 2 * number + 2]
        assert np.array_equal(during[1], picture(source, grasp, "touch_b"))
        assert np.array_equal(before[0], picture(source, grasp, "touch_a_before"))
    assert store["data/right_tactile_sensor_0"][:].tolist() == ["GelSight Mini"]
    assert store["meta/object_id"][:].tolist()[::2] == ["object 0", "object 1", "object 2"]
    assert store["meta/grasped"][:].tolist() == [1, 1, 1, 0, 1, 1]
    assert np.isnan(store["meta/force_n"][0])
    assert store["meta/pose"][1].tolist() == [1.0, 2.0, 3.0, 0.5]
    assert result.notes == (
        "the frames after the touch are left out because some grasps do not have them",
        "photo: 1 grasp(s) had another size and were resized to 40 x 30 with black borders",
    )


def test_open_x_tactile_stores_a_split_as_ranges_of_episodes(source, tmp_path):
    zarr = pytest.importorskip("zarr")
    result = EXPORTERS.load("open-x-tactile")(source, tmp_path / "out", parts=SPLIT)
    store = zarr.open_group(str(tmp_path / "out" / "grasps.zarr"), mode="r")
    assert store.attrs["splits"] == {"train": [0, 2], "test": [2, 4]}
    assert store["meta/object_id"][:].tolist() == ["object 0"] * 2 + ["object 2"] * 2
    assert result.notes[0] == "left out 2 grasp(s) of objects that are not in the split"


# LeRobot ---------------------------------------------------------------------------------------------------


@pytest.fixture
def parquet():
    pytest.importorskip("av")
    return pytest.importorskip("pyarrow.parquet")


def rows(parquet, paths):
    return [row for path in sorted(paths) for row in parquet.read_table(path).to_pylist()]


def frames_of(path):
    import av

    with av.open(str(path)) as video:
        return [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]


def test_pyarrow_and_av_open_a_lerobot_data_set(source, tmp_path, parquet, monkeypatch):
    monkeypatch.setattr("robot.exporters.lerobot.EPISODES_A_FILE", 4)
    out = tmp_path / "out"
    EXPORTERS.load("lerobot")(source, out, parts={"train": ["object 0", "object 1"], "test": ["object 2"]})
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["fps"]) == ("v3.0", 6, 12, 1)
    assert info["splits"] == {"train": "0:4", "test": "4:6"}
    steps = rows(parquet, out.glob("data/*/*.parquet"))
    assert [row["index"] for row in steps] == list(range(12))
    assert [row["moment"] for row in steps] == [0, 1] * 6
    assert {name for name in info["features"] if "images" not in name} == set(steps[0])
    for episode in rows(parquet, out.glob("meta/episodes/*/*.parquet")):
        grasp = source.grasps[episode["episode_index"]]
        assert (episode["grasp_id"], episode["tasks"], episode["grasped"]) == (
            grasp.grasp_id,
            [grasp.object_id],
            grasp.grasped,
        )
        assert steps[episode["dataset_from_index"]]["episode_index"] == episode["episode_index"]
        for camera in ("touch_a", "touch_b"):
            key = f"observation.images.{camera}"
            numbers = {name: episode[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            frames = dict(frames_of(out / info["video_path"].format(video_key=key, **numbers)))
            start = episode[f"videos/{key}/from_timestamp"]
            assert rms(frames[start], picture(source, grasp, f"{camera}_before")) < 2.5
            assert rms(frames[start + 1], picture(source, grasp, camera)) < 2.5
    assert len(list(out.glob("videos/observation.images.photo/chunk-000/*.mp4"))) == 2


def test_lerobot_stats_are_those_of_the_pictures(source, tmp_path, parquet):
    EXPORTERS.load("lerobot")(source, tmp_path / "out")
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())["observation.images.touch_a"]
    pixels = np.concatenate(
        [picture(source, grasp, column) / 255 for grasp in source.grasps for column in ("touch_a", "touch_a_before")]
    ).reshape(-1, 3)
    assert np.allclose(np.array(stats["mean"]).ravel(), pixels.mean(axis=0))
    assert np.allclose(np.array(stats["std"]).ravel(), pixels.std(axis=0))
    assert (np.shape(stats["min"]), stats["count"]) == ((3, 1, 1), [len(pixels)])


def test_pandas_reads_the_tasks_as_lerobot_does(source, tmp_path, parquet):
    pandas = pytest.importorskip("pandas")
    EXPORTERS.load("lerobot")(source, tmp_path / "out")
    tasks = pandas.read_parquet(tmp_path / "out/meta/tasks.parquet")
    assert list(tasks.columns) == ["task_index"]
    assert int(tasks.loc["object 1"].task_index) == 1


# The command -----------------------------------------------------------------------------------------------


def test_the_command_writes_reports_left_out_grasps_and_refuses_a_second_run(source, tmp_path, capsys):
    options = ["export-recording", str(source.folder), "--to", "imagefolder", "--out", str(tmp_path / "out")]
    (tmp_path / "split.json").write_text(
        json.dumps({"seed": 0, **{part: list(objects) for part, objects in SPLIT.items()}})
    )
    assert main([*options, "--split", str(tmp_path / "split.json")]) == 0
    output = capsys.readouterr()
    assert output.out == ""
    assert "left out 2 grasp(s)" in output.err
    assert f"{tmp_path / 'out'}: 4 grasps as imagefolder" in output.err
    assert main(options) == 2
    assert "must be a new or an empty folder" in capsys.readouterr().err


def test_the_command_lists_the_formats(source, tmp_path, capsys):
    assert main(["export-recording", str(source.folder), "--to", "hdf5", "--out", str(tmp_path / "out")]) == 2
    assert "one of imagefolder, lerobot, open-x-tactile; got 'hdf5'" in capsys.readouterr().err
    assert not Path(tmp_path / "out").exists()
