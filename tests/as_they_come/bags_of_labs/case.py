"""Bags with and without their folder, pictures with alpha, and a number that cannot be, which costs no grasp."""

import shutil

import numpy as np
import pytest
from rosbags.rosbag2.reader import zstd

from robot.errors import ImporterError
from robot.importers.rosbag import import_rosbag
from tests.miniatures import rosbag


def content(encoding, effort=5.0, joint_m=0.001):
    """Yield the miniature with an encoding of gel a, and the gripper's numbers."""
    for time_ns, topic, short, fields in rosbag.messages():
        number = (time_ns - rosbag.START_NS) // rosbag.INTERVAL_NS
        if topic == rosbag.GEL_A:
            gel = rosbag.gel("a", number)[..., [2, 1, 0] if encoding.startswith("bgr") else [0, 1, 2]]
            fields = rosbag.image_fields(np.dstack([gel, np.full(gel.shape[:2], 128, np.uint8)]), encoding)
        elif topic == rosbag.GRIPPER:
            fields = {**fields, "effort": np.array([effort, 5.0]), "position": np.array([joint_m])}
        yield time_ns, topic, short, fields


def check(folder, get):
    get("no_fsync")
    source, expected = folder / "src", get("tmp_path") / "expected"
    source.mkdir()
    ros1, sqlite, mcap = (
        rosbag.write_bag(folder / name, content(encoding))
        for name, encoding in (("a.bag", "rgba8"), ("sqlite", "bgra8"), ("mcap", "rgba8"))
    )
    (database,), (log,) = sqlite.glob("*.db3"), mcap.glob("*.mcap")
    shutil.copy(ros1, source / "one.bag")
    shutil.copy(log, source / "two.mcap")
    (source / "empty metadata").mkdir()
    shutil.copy(database, source / "empty metadata/0.db3")
    (source / "empty metadata/metadata.yaml").write_text('rosbag2_bagfile_information:\n  storage_identifier: ""')
    (source / "notes.txt").write_text("no bag")
    (source / "zipped.db3.zstd").write_bytes(zstd.compress(database.read_bytes()))
    recording = import_rosbag(source, folder / "out")
    names = {"empty metadata", "one", "two"}
    assert {grasp.object_id for grasp in recording.grasps} == names
    (reason,) = recording.info["skipped"]
    assert "decompress it: zstd -d" in reason
    before = import_rosbag(rosbag.write_bag(folder / "plain.bag", rosbag.messages()), expected).grasps
    pictures = [(expected / grasp.touches["a"]).read_bytes() for grasp in before]
    assert [(folder / "out" / grasp.touches["a"]).read_bytes() for grasp in recording.grasps] == pictures * len(names)

    shutil.copy(database, folder / "left.db3")
    (folder / "left.db3-wal").write_bytes(b"messages")
    with pytest.raises(ImporterError, match=r"left.db3-wal; add them: sqlite3 left.db3"):
        import_rosbag(folder / "left.db3", folder / "refused")

    bag = rosbag.write_bag(folder / "infinite.bag", content("rgba8", np.inf, 0.05))
    recording = import_rosbag(bag, folder / "infinite", gripper=rosbag.GRIPPER)
    assert [(grasp.force_n, grasp.opening_mm) for grasp in recording.grasps] == [(None, 50.0)] * 2
    assert any("not finite, such as force_n" in line for line in recording.notes)
