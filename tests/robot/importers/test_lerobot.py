"""Importer of LeRobot data sets; test_importers.py tests the common behaviour."""

import json
import shutil
import tracemalloc
from zlib import crc32

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from robot.errors import ImporterError
from robot.importers.episodes import episode_images
from robot.importers.lerobot import import_lerobot
from tests.miniatures import encoded, lerobot, pixels
from tests.miniatures.lerobot import RIGHT


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The data set, which no test changes."""
    folder = tmp_path_factory.mktemp("lerobot") / "src"
    lerobot.write(folder)
    return folder


@pytest.fixture
def source(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "src")


def picture(recording, path):
    return cv2.imread(str(recording.folder / path)).astype(float)


def rms(one, other):
    return float(np.sqrt(np.mean((one - other) ** 2)))


def test_an_episode_is_a_sequence_with_its_own_pictures_its_task_the_object_and_gel_cameras_the_fingers(
    whole, tmp_path, monkeypatch
):
    """A video contains several episodes, and its frames depend on each other. It is opened once: opening it for each
    of 100,000 episodes fragmented the heap and took half of the time.
    """
    av_open, paths = av.open, []
    monkeypatch.setattr(av, "open", lambda path: paths.append(path) or av_open(path))
    recording = import_lerobot(whole, tmp_path / "out")
    assert sorted(paths) == sorted(str(path) for path in whole.glob("videos/*/*/*.mp4"))
    assert [(grasp.object_id, grasp.sequence_id) for grasp in recording.grasps] == [
        (lerobot.TASKS[episode % 2], f"episode-{episode}") for episode in range(4)
    ]
    assert all(sorted(grasp.touches) == ["a", "b"] for grasp in recording.grasps)
    assert recording.info["rig"] == "so100"
    assert recording.info["sensor"] == "observation.images.left_tactile, observation.images.right_tactile"
    for episode, grasp in enumerate(recording.grasps):
        first, pressed = (lerobot.pictures(episode, step) for step in (0, lerobot.PRESSED))
        expected = {
            grasp.photo: (first[lerobot.WRIST], 4),  # a video is not lossless
            grasp.touches["a"]: (pressed[lerobot.LEFT], 4),
            grasp.touches_before["a"]: (first[lerobot.LEFT], 4),
            grasp.touches["b"]: (pressed[RIGHT], 0),
            grasp.touches_before["b"]: (first[RIGHT], 0),
        }
        for path, (seed, tolerance) in expected.items():
            assert rms(picture(recording, path), pixels(seed, lerobot.SIZE).astype(float)) <= tolerance


def test_cameras_are_chosen_by_name_and_unknown_ones_list_the_known(whole, tmp_path):
    assert import_lerobot(whole, tmp_path / "one", touch=lerobot.LEFT, photo=lerobot.WRIST).info["fingers"] == 1
    for options in ({"touch": "left"}, {"photo": "front"}):
        with pytest.raises(ImporterError, match=r"from: observation\.images\.wrist, observation"):
            import_lerobot(whole, tmp_path / "out", **options)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.1"}, "must have LeRobot version 3, got v2.1; convert it with lerobot"),
        ({"video_path": "/etc/{video_key:999999999}"}, "must have the paths data/"),
        ({"fps": 0}, r"\$\.fps"),
        ({"features": {}}, "from: none"),
        ({"features": {"../touch": {"dtype": "video"}, "photo": {"dtype": "video"}}}, "no camera name that is a path"),
    ],
)
def test_info_json_is_checked(source, tmp_path, changes, message):
    path = source / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ImporterError, match=message):
        import_lerobot(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def rewrite(path, change):
    """Replace each row of a Parquet file by change(number, row)."""
    rows = pq.read_table(path).to_pylist()
    pq.write_table(pa.Table.from_pylist([change(number, row) for number, row in enumerate(rows)]), path)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"length": None}, "no length"),
        ({"data/chunk_index": None, f"videos/{lerobot.LEFT}/chunk_index": None}, "does not name the file"),
        ({f"videos/{lerobot.LEFT}/from_timestamp": None}, "its video is missing"),
    ],
)
def test_a_damaged_row_costs_its_episode(source, tmp_path, row, message):
    rewrite(
        source / "meta/episodes/chunk-000/file-000.parquet",
        lambda number, old: old | (row if number == 1 else {}),
    )
    recording = import_lerobot(source, tmp_path / "out")
    assert len(recording.grasps) == 3
    (reason,) = recording.info["skipped"]
    assert message in reason


def of_size(height, width):
    return lambda number: encoded(".png", number, (height + number % 2, width))


def of_absurd_size(number):
    png = bytearray(encoded(".png", number))
    png[16:24] = 2 * (10**5).to_bytes(4, "big")
    png[29:33] = crc32(png[12:29]).to_bytes(4, "big")
    return bytes(png)


@pytest.mark.parametrize(
    ("picture", "message"), [(of_size(20, 30), "differ in size"), (of_absurd_size, "cannot be decoded")]
)
def test_unusable_stored_pictures_cost_their_episode(source, tmp_path, picture, message):
    rewrite(
        source / "data/chunk-000/file-000.parquet",
        lambda number, row: (
            row | ({RIGHT: {"bytes": picture(number), "path": None}} if row["episode_index"] == 1 else {})
        ),
    )
    (reason,) = import_lerobot(source, tmp_path / "out").info["skipped"]
    assert message in reason


def steps(count, pressed):
    for number in range(count):
        gel = np.full((300, 400, 3), 200 if number == pressed else 100 + number % 3, np.uint8)
        yield np.full((300, 400, 3), 50 + number, np.uint8), [gel]


def test_steps_of_a_long_episode_are_read_one_by_one():
    episode = episode_images(lambda: steps(100, 64), 1)
    tracemalloc.start()
    try:
        images = {column: source() for column, source in episode.items()}
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert images["touch_a"][0, 0, 0] == 200
    assert (images["touch_a_before"][0, 0, 0], images["photo"][0, 0, 0]) == (100, 50)
    assert peak < 20 * 360_000  # a picture has 360,000 bytes, the episode 200 pictures


@pytest.mark.parametrize(
    ("count", "moments", "message"),
    [
        (0, None, "its episode is empty"),
        (1, None, "differs from the first"),
        (1, ["before", "during"], "only 1 of 2 steps"),
    ],
)
def test_an_episode_without_a_touch_is_an_error(count, moments, message):
    images = episode_images(lambda: steps(count, 9), 1, moments)
    with pytest.raises(ImporterError, match=message):
        images["photo"]()
