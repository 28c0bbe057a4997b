"""Export to LeRobot: the output is opened with pyarrow, PyAV and pandas, as LeRobot does."""

import json
import shutil
from dataclasses import replace

import av
import cv2
import numpy as np
import pandas
import pytest
from pyarrow import parquet

from retrieval.commands.main import main
from robot.errors import RecordingError
from robot.export_lerobot import export_lerobot
from robot.importers.lerobot import import_lerobot
from robot.recording.folder import RecordingWriter, read_recording

RNG = np.random.default_rng(0)


def smooth(height, width):
    """Return a picture with smooth colours, like a gel."""
    return cv2.resize(RNG.integers(40, 215, (4, 4, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Three objects with two grasps each: two fingers, before and during; the last photo has another size."""
    folder = tmp_path_factory.mktemp("source") / "recording"
    info = {"source": "synthetic", "sensor": "GelSight Mini", "licence": "CC0", "terms": "none"}
    with RecordingWriter(folder, info) as writer:
        for number in range(6):
            images = {"photo": smooth(30, 40) if number < 5 else smooth(48, 48)}
            for finger in "ab":
                images |= {f"touch_{finger}": smooth(24, 32), f"touch_{finger}_before": smooth(24, 32)}
            if number == 0:
                images["touch_a_after"] = images["touch_b_after"] = smooth(24, 32)
            fields = {"force_n": 2.5 + number, "pose": [1.0, 2.0, 3.0, 0.5]} if number else {}
            fields |= {"grasped": number != 3, "sequence_id": "s", "session": f"day {number % 2}"}
            writer.append(f"g{number}", f"object {number // 2}", images, **fields)
    return read_recording(folder)


def picture(recording, grasp, column):
    return cv2.imread(str(recording.folder / grasp.images()[column]))[..., ::-1]


def rms(one, other):
    return float(np.sqrt(np.mean((one.astype(float) - other.astype(float)) ** 2)))


@pytest.fixture(scope="module")
def exported(source, tmp_path_factory):
    """The folder of an export by the command, which no test changes."""
    out = tmp_path_factory.mktemp("export") / "out"
    assert main(["export-recording", str(source.folder), "--out", str(out)]) == 0
    return out


def test_an_export_appears_when_it_is_complete_and_a_stopped_one_leaves_nothing(source, tmp_path):
    calls, out = [], tmp_path / "out"
    out.mkdir()

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_lerobot(source, out, stop)
    assert [path.name for path in tmp_path.rglob("*")] == ["out"]
    notes = export_lerobot(source, out, lambda *counts: calls.append((*counts, any(out.iterdir()))))
    assert calls == [(done, 6, False) for done in range(1, 7)]
    assert notes == ("the frames after the touch are left out because some grasps do not have them",)
    first = replace(source.grasps[0], photo=None)
    (_, note) = export_lerobot(replace(source, grasps=(first, *source.grasps[1:])), tmp_path / "without")
    assert note == "the photos are left out because some grasps do not have them"


def test_an_error_names_a_damaged_picture_and_nothing_is_written(source, tmp_path):
    shutil.copytree(source.folder, tmp_path / "r")
    recording = read_recording(tmp_path / "r")
    path = tmp_path / "r" / recording.grasps[4].touches["b"]
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(RecordingError, match=rf"{path.name} is missing, damaged or cut off; run `retrieve check`"):
        export_lerobot(recording, tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == {"r"}


def test_grasps_with_different_fingers_are_refused(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "synthetic", "sensor": "gel"}) as writer:
        writer.append("1", "mug", dict.fromkeys(("photo", "touch_a"), smooth(9, 9)))
        writer.append("2", "mug", dict.fromkeys(("photo", "touch_a", "touch_b"), smooth(9, 9)))
    with pytest.raises(RecordingError, match="must have the same fingers; 1 has a, 2 has a, b"):
        export_lerobot(read_recording(tmp_path / "r"), tmp_path / "out")


def rows(paths):
    return [row for path in sorted(paths) for row in parquet.read_table(path).to_pylist()]


def frames_of(path):
    with av.open(str(path)) as video:
        return [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]


def test_pyarrow_and_av_open_a_lerobot_data_set_and_pandas_its_tasks(source, exported):
    out = exported
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    assert list(tasks.columns) == ["task_index"]
    assert int(tasks.loc["object 1"].task_index) == 1
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["fps"]) == ("v3.0", 6, 12, 1)
    steps = rows(out.glob("data/*/*.parquet"))
    assert [row["index"] for row in steps] == list(range(12))
    assert [row["moment"] for row in steps] == [0, 1] * 6
    assert {name for name in info["features"] if "images" not in name} == set(steps[0])
    for episode in rows(out.glob("meta/episodes/*/*.parquet")):
        grasp = source.grasps[episode["episode_index"]]
        facts = [episode[key] for key in ("grasp_id", "tasks", "grasped")]
        assert facts == [grasp.grasp_id, [grasp.object_id], grasp.grasped]
        assert steps[episode["dataset_from_index"]]["episode_index"] == episode["episode_index"]
        for camera in ("touch_a", "touch_b"):
            key = f"observation.images.{camera}"
            numbers = {name: episode[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            frames = dict(frames_of(out / info["video_path"].format(video_key=key, **numbers)))
            start = episode[f"videos/{key}/from_timestamp"]
            assert rms(frames[start], picture(source, grasp, f"{camera}_before")) < 2.5
            assert rms(frames[start + 1], picture(source, grasp, camera)) < 2.5


def test_lerobot_stats_are_those_of_the_pictures(source, exported):
    stats = json.loads((exported / "meta/stats.json").read_text())["observation.images.touch_a"]
    pixels = np.concatenate(
        [picture(source, grasp, column) / 255 for grasp in source.grasps for column in ("touch_a", "touch_a_before")]
    ).reshape(-1, 3)
    assert np.allclose(np.array(stats["mean"]).ravel(), pixels.mean(axis=0))
    assert np.allclose(np.array(stats["std"]).ravel(), pixels.std(axis=0))
    assert (np.shape(stats["min"]), stats["count"]) == ((3, 1, 1), [len(pixels)])


def test_a_photo_of_another_size_is_scaled_into_the_middle_of_black(exported):
    (video,) = exported.glob("videos/observation.images.photo/*/*.mp4")
    frame = frames_of(video)[-1][1].astype(int)  # 48 x 48 pixels became 30 x 30 of 30 x 40
    assert max(frame[:, :4].max(), frame[:, 36:].max()) < 16
    assert frame[:, 6:34].min() > 20


def test_an_export_can_be_imported_again(source, exported, tmp_path):
    again = import_lerobot(exported, tmp_path / "back")
    plain = ("grasp_id", "object_id", "sequence_id", "session", "grasped", "force_n", "pose")
    assert len(again.grasps) == len(source.grasps)
    for grasp, old in zip(again.grasps, source.grasps, strict=True):
        assert [getattr(grasp, key) for key in plain] == [getattr(old, key) for key in plain]
        assert grasp.images().keys() == {"photo", *(f"touch_{at}" for at in ("a", "a_before", "b", "b_before"))}
        for column in ("touch_a", "touch_b_before"):
            assert rms(picture(again, grasp, column), picture(source, old, column)) < 3
    for key in ("source", "sensor", "licence", "terms"):
        assert again.info[key] == source.info[key]


def test_the_command_reports_and_refuses_a_second_run(source, tmp_path, capsys):
    options = ["export-recording", str(source.folder), "--out", str(tmp_path / "out")]
    assert main(options) == 0
    output = capsys.readouterr().err
    assert "frames after the touch are left out" in output
    assert f"{tmp_path / 'out'}: 6 grasps" in output
    assert main(options) == 2
    assert "must be a new or an empty folder" in capsys.readouterr().err
