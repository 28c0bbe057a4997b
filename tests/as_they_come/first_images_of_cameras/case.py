"""Black, dim or coloured first images of a camera are no no-contact frames: they are left out, counted, or refused."""

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers.episodes import episode_images
from robot.importers.physiclear import import_physiclear
from robot.importers.rosbag import import_rosbag
from tests.miniatures import physiclear, rosbag

BAD = {
    "black": lambda gel: np.zeros_like(gel),
    "dim": lambda gel: gel // 2,
    "a little dim": lambda gel: gel * 0.8,
    "blue": lambda gel: gel // [4, 2, 1] + [0, 0, 60],
    "green": lambda gel: np.full_like(gel, [0, 135, 0]),
    "white": lambda gel: np.full_like(gel, 255),
    "torn": lambda gel: np.where(np.arange(len(gel))[:, None, None] < len(gel) // 2, gel, [0, 135, 0]),
}


def bag(path, change, count):
    """Write the bag of the miniature whose first gel images, or those of finger b, are changed."""

    def messages():
        for time_ns, topic, short, fields in rosbag.messages():
            number = (time_ns - rosbag.START_NS) // rosbag.INTERVAL_NS
            if topic in (rosbag.GEL_A, rosbag.GEL_B) and number < count:
                fields = rosbag.image_fields(change(rosbag.gel(topic[-1], number)).astype(np.uint8), "rgb8")
            yield time_ns, topic, short, fields

    return rosbag.write_bag(path, messages())


def check(folder, get):
    get("no_fsync")
    for number, (name, change) in enumerate(BAD.items()):
        place, count = folder / name, 1 + 2 * (number % 2)
        place.mkdir()
        recording = import_rosbag(bag(place / "mug.bag", change, count), place / "out")
        assert len(recording.grasps) == 2, name
        assert recording.info["left_out"] == {f"mug{rosbag.GEL_A}": count, f"mug{rosbag.GEL_B}": count}
        assert any(f"{count} of mug{rosbag.GEL_A}" in note for note in recording.notes)

        rest = np.full((48, 64, 3), (90, 110, 130), np.uint8)
        pressed = cv2.circle(rest.copy(), (20, 20), 8, (200, 190, 180), -1)
        gels = [change(rest).astype(np.uint8)] * count + [rest + n % 3 for n in range(20)] + [pressed] * 20
        left_out = []
        images = episode_images(lambda gels=gels: ((gel, [gel]) for gel in gels), 1, left_out=left_out.append)
        assert np.array_equal(images["touch_a_before"](), rest)
        assert np.array_equal(images["touch_a"](), pressed)
        assert np.array_equal(images["photo"](), rest)
        assert left_out == [count]
    (folder / "videos").mkdir()
    frames = physiclear.presses(0, 0, 30)
    physiclear.write_video(folder / "videos/pen_0.mov", [np.zeros_like(frames[0])] * 2 + frames)
    recording = import_physiclear(folder / "videos", folder / "pens")
    before = cv2.imread(str(recording.folder / recording.grasps[0].touches_before["a"]))
    assert np.abs(before.astype(float) - frames[0]).mean() < 3  # the codec's loss
    assert recording.info["left_out"] == {"pen_0": 2}

    for name, change, count in (("blue", BAD["blue"], 15), ("contact", lambda gel: gel + 50, 10)):
        with pytest.raises(ImporterError, match=r"no-contact frame|without contact"):
            import_rosbag(bag(folder / f"{name}.bag", change, count), folder / "refused")
