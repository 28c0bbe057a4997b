"""Collection with real drivers over emulated devices that fail at random."""

import cv2
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import DeviceError
from robot.recording.folder import read_recording
from tests.emulated_rig import HOLDING, emulated_rig
from tests.fake_video import own_threads


@pytest.mark.slow
def test_a_collection_among_faults_has_complete_grasps_and_never_leaves_the_jaws_closing(tmp_path):
    """After each stop it starts again, as a person would."""
    stops, tallies, faults = [], [], 0
    options = {"objects": [f"can-{number}" for number in range(5)], "seed": 2, "settings": CollectSettings(2)}
    while not tallies:
        with emulated_rig(2 + len(stops), rate=0.05) as rig:
            try:
                tallies = collect(lambda rig=rig: rig, tmp_path / "r", **options)
            except DeviceError as error:
                stops.append(str(error))
            assert not rig.shared.emulator.moves
            assert rig.shared.emulator.grasping != HOLDING
            faults += rig.shared.faults + rig.shared.line.counts.total()
    assert sum(tally.accepted for tally in tallies) == 10
    assert faults > 10
    grasps = read_recording(tmp_path / "r").grasps
    assert len(grasps) >= 10
    assert all(cv2.imread(str(tmp_path / "r" / path)) is not None for each in grasps for path in each.images().values())
    known = " failed 5 time(s), last: ", "the connection to the gripper at "  # the latter when the rig is closed
    assert not [stop for stop in stops if not any(part in stop for part in known)]
    assert own_threads() == []


def test_if_a_device_stays_disconnected_the_collection_stops_with_the_reason_and_the_jaws_open(tmp_path):
    with emulated_rig(1) as rig:
        real = rig.arm._move_to

        def lost(pose, speed_mm_s):
            if rig.shared.emulator.grasping == HOLDING:
                raise OSError(104, "Connection reset by peer")
            return real(pose, speed_mm_s)

        rig.arm._move_to = lost
        with pytest.raises(DeviceError, match=r"failed 5 time\(s\), last: emulated arm cannot move: Connection reset"):
            collect(lambda: rig, tmp_path / "r", objects=["can-0"], seed=1, settings=CollectSettings(2))
        assert not rig.shared.emulator.moves
        assert rig.shared.emulator.opening_mm == pytest.approx(110.0, abs=0.5)
        assert read_recording(tmp_path / "r").grasps == ()
