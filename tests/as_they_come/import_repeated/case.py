"""An import is not continued with other options or changed files, and the error names what differs."""

import os

import pytest

from robot.errors import RecordingError
from robot.importers.folder import import_folder
from robot.importers.rosbag import import_rosbag
from tests.as_they_come import write_pictures
from tests.miniatures import rosbag


def check(folder, get):
    get("no_fsync")
    source, out = folder / "src", folder / "out"
    write_pictures(
        source, *(f"{name}/{kind}_{n}.png" for name in ("mug", "tin") for kind in ("touch", "photo") for n in "01")
    )
    before = import_folder(source, out).grasps
    for options, message in (
        ({"touch": "{object}/touch_{n}"}, r"touch '{object}/touch_\*', not '{object}/touch_{n}'"),
        ({"licence": "CC0"}, "licence 'not stated', not 'CC0'"),
        ({"sensor": "DIGIT"}, "sensor 'unknown', not 'DIGIT'"),
    ):
        with pytest.raises(RecordingError, match=message):
            import_folder(source, out, **options)
    os.utime(source / "mug/touch_0.png", (1, 1))  # copied to another disk
    write_pictures(source, "pen/touch_0.png", "pen/photo_0.png")
    assert import_folder(source.rename(folder / "moved"), out).grasps[: len(before)] == before
    source = folder / "moved"
    (source / "mug/touch_1.png").write_bytes((source / "tin/touch_0.png").read_bytes())
    (source / "tin/photo_1.png").unlink()
    with pytest.raises(RecordingError, match=r"mug/touch_1.png, which has changed; .*tin/photo_1.png, which is gone"):
        import_folder(source, out)
    bag = rosbag.write_bag(folder / "mug.bag", rosbag.messages())
    import_rosbag(bag, folder / "bags")
    with pytest.raises(RecordingError, match=r"contact 0.01, not 0.02; settle_s 0.2, not 0.3"):
        import_rosbag(bag, folder / "bags", contact=0.02, settle_s=0.3)
    with pytest.raises(RecordingError, match="fingers 2, not 1"):
        import_rosbag(bag, folder / "bags", touch_b="")
