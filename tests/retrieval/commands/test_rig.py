"""`retrieve rig` and the dry run, for users."""

import json
import signal

import pytest

from retrieval.commands.main import main


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_check_prints_a_line_for_each_device_and_exits_with_1_if_one_fails(capsys, monkeypatch):
    def missing(self):
        raise OSError(2, "No such file or directory")

    monkeypatch.setattr("robot.rig_check.MEASURE_S", 0.2)
    assert main(["rig", "check", "--rig", "tests.fake_rig:FakeRig"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [
        ["ok", device] for device in ("arm", "gripper", "gel", "gel", "camera", "skew")
    ]
    monkeypatch.setattr("tests.fake_rig.FakeCamera._connect", missing)
    assert main(["rig", "check", "--rig", "tests.fake_rig:FakeRig"]) == 1
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines()] == ["ok", "ok", "ok", "ok", "FAIL", "ok"]
    assert "fake camera cannot be connected: No such file or directory" in output.out
    assert "1 of 6 checks failed" in output.err


def test_a_check_without_a_rig_and_without_devices_finds_none(capsys, monkeypatch):
    monkeypatch.setattr("robot.drivers.discover.find_cameras", list)
    assert main(["rig", "check"]) == 0
    assert capsys.readouterr().err == "no camera was found\n"


POINTS = """camera_x_mm,camera_y_mm,camera_z_mm,rig_x_mm,rig_y_mm,rig_z_mm
0,0,800,0,0,0
100,0,800,100,0,0
0,100,800,0,-100,0
0,0,700,0,0,100
90,80,650,90,-80,150
20,90,600,20,-90,200
"""


def test_a_calibration_is_fitted_printed_and_written_over_an_earlier_one_and_no_photo(here, capsys):
    (here / "points.csv").write_text(POINTS)
    (here / "hand_eye.json").write_text("earlier")
    assert main(["rig", "calibrate", "points.csv"]) == 0
    output = capsys.readouterr().err.splitlines()
    assert output[0] == "residuals: mean 0.0 mm, maximum 0.0 mm"
    assert output[-1] == "hand_eye.json: fitted to 6 points; set hand_eye to this file under [camera]"
    rigid = json.loads((here / "hand_eye.json").read_text())["rigid"]
    assert [row[3] for row in rigid] == pytest.approx([0, 0, 800, 1], abs=1e-6)
    (here / "photo.png").write_bytes(b"\x89PNG")
    assert main(["rig", "calibrate", "points.csv", "--out", "photo.png"]) == 2
    assert "photo.png must be named *.json" in capsys.readouterr().err
    assert (here / "photo.png").read_bytes() == b"\x89PNG"


def test_points_without_a_calibration_are_refused_with_the_reason(here, capsys):
    (here / "points.csv").write_text("a,b\n1,2\n")
    assert main(["rig", "calibrate", "points.csv"]) == 2
    assert "camera_x_mm" in capsys.readouterr().err
    assert not (here / "hand_eye.json").exists()


def test_a_dry_run_prints_motions_and_writes_nothing(here, capsys):
    assert main(["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--out", "rec", "--dry-run"]) == 0
    output = capsys.readouterr()
    assert output.out.count("jaws: close with") == 2
    assert "round-1: nothing moved, nothing was recorded" in output.err
    assert not (here / "rec").exists()


def test_a_collection_ended_by_sigterm_opens_its_jaws_closes_its_rig_and_leaves_a_complete_recording(
    here, capsys, monkeypatch
):
    from tests.fake_rig import FakeGripper, FakeRig

    collect = ["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--grasps", "4"]
    collect += ["--seed", "3", "--out", "rec"]
    rigs, real_prepare, real_grasp = [], FakeRig.prepare, FakeGripper._grasp

    def interrupted_grasp(self, force_n, speed_mm_s):
        state = real_grasp(self, force_n, speed_mm_s)
        if self.shared.calls.count("grasp") == 3:
            signal.raise_signal(signal.SIGTERM)
        return state

    monkeypatch.setattr(FakeGripper, "_grasp", interrupted_grasp)
    monkeypatch.setattr(FakeRig, "prepare", lambda self, *attempt: (rigs.append(self), real_prepare(self, *attempt))[1])
    before = signal.getsignal(signal.SIGTERM)
    assert main(collect) == 1
    assert capsys.readouterr().err.endswith("run the same command to continue.\n")
    assert signal.getsignal(signal.SIGTERM) is before
    assert rigs[0].shared.force is None
    assert not any(device.is_connected for device in rigs[0].devices)
    monkeypatch.setattr(FakeGripper, "_grasp", real_grasp)
    assert main(collect) == 0
