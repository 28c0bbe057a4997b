"""Collection with real drivers over emulated devices that fail at random."""

import pytest

from robot.collection import CollectSettings, collect
from robot.errors import DeviceError
from robot.recording.folder import read_recording
from tests.emulated_rig import broken_images, collect_among_faults, emulated_rig
from tests.fake_video import own_threads


@pytest.mark.slow
@pytest.mark.parametrize("port", ["tcp", "pty"])
def test_a_collection_among_faults_has_complete_grasps_and_never_leaves_the_jaws_closing(tmp_path, port):
    found = collect_among_faults(tmp_path / "r", 10, rate=0.05, seed=2, port=port)
    assert found.grasps == 10
    assert (found.left_moving, found.left_holding) == (0, 0)
    assert sum(found.faults.values()) > 10
    assert broken_images(tmp_path / "r") == []
    assert len(read_recording(tmp_path / "r").grasps) >= 10
    assert all(" failed 5 time(s), last: " in stop for stop in found.stops)
    assert own_threads() == []


def test_if_a_device_stays_disconnected_the_collection_stops_with_the_reason_and_the_jaws_open(tmp_path):
    with emulated_rig(1) as rig:
        real = rig.arm._move_to

        def lost(pose, speed_mm_s):
            if rig.shared.emulator.grasping == 4:
                raise OSError(104, "Connection reset by peer")
            return real(pose, speed_mm_s)

        rig.arm._move_to = lost
        with pytest.raises(DeviceError, match=r"failed 5 time\(s\), last: emulated arm cannot move: Connection reset"):
            collect(lambda: rig, tmp_path / "r", objects=["can-0"], seed=1, settings=CollectSettings(2))
        assert not rig.shared.emulator.moves
        assert rig.shared.emulator.opening_mm == pytest.approx(110.0, abs=0.5)
        assert read_recording(tmp_path / "r").grasps == ()
