"""`retrieve rig` and the dry run, as a user meets them."""

import json
import signal

import pytest

from retrieval.commands.main import main
from robot.drivers.discover import DiscoveredDevice


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_check_prints_a_line_for_each_device(capsys, monkeypatch):
    monkeypatch.setattr("robot.rig_check.MEASURE_S", 0.2)
    assert main(["rig", "check", "--rig", "tests.fake_rig:FakeRig"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [
        ["ok", device] for device in ("arm", "gripper", "gel", "gel", "camera", "skew")
    ]


def test_a_check_with_a_device_that_fails_leaves_with_1_and_names_it(capsys, monkeypatch):
    def missing(self):
        raise OSError(2, "No such file or directory")

    monkeypatch.setattr("tests.fake_rig.FakeCamera._connect", missing)
    assert main(["rig", "check", "--rig", "tests.fake_rig:FakeRig", "--json"]) == 1
    said = capsys.readouterr()
    rows = json.loads(said.out)["devices"]
    assert rows[4]["failure"] == "fake camera cannot be connected: No such file or directory"
    assert [row["failure"] for row in rows].count(None) == 5
    assert "1 of 6 checks failed" in said.err


def test_without_a_rig_what_is_connected_is_listed_as_lines_for_its_file(capsys, monkeypatch):
    found = [
        DiscoveredDevice("camera", "/dev/v4l/by-id/x", "GelSight Mini R0B", '[sensors.a]\ndriver = "gelsight_mini"')
    ]
    monkeypatch.setattr("robot.drivers.discover.discover", lambda: found)
    assert main(["rig", "check"]) == 0
    said = capsys.readouterr()
    assert said.out == '# camera: GelSight Mini R0B\n[sensors.a]\ndriver = "gelsight_mini"\n\n'
    assert "1 device(s) found" in said.err
    assert main(["rig", "check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["found"][0]["device"] == "/dev/v4l/by-id/x"
    monkeypatch.setattr("robot.drivers.discover.discover", list)
    assert main(["rig", "check"]) == 0
    assert capsys.readouterr().err == "no device was found\n"


POINTS = """camera_x_mm,camera_y_mm,camera_z_mm,rig_x_mm,rig_y_mm,rig_z_mm
0,0,800,0,0,0
100,0,800,100,0,0
0,100,800,0,-100,0
0,0,700,0,0,100
90,80,650,90,-80,150
20,90,600,20,-90,200
"""


def test_a_calibration_is_fitted_told_and_written(here, capsys):
    (here / "points.csv").write_text(POINTS)
    assert main(["rig", "calibrate", "points.csv"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("rigid: ")
    assert said[1].startswith("affine: ")
    assert said[-1] == "hand_eye.json: written from 6 points; name it as hand_eye under [camera]"
    rigid = json.loads((here / "hand_eye.json").read_text())["rigid"]
    assert [row[3] for row in rigid] == pytest.approx([0, 0, 800, 1], abs=1e-6)


def test_a_calibration_is_written_over_an_earlier_one_and_over_nothing_else(here, capsys):
    (here / "points.csv").write_text(POINTS)
    for _ in range(2):
        assert main(["rig", "calibrate", "points.csv"]) == 0
    (here / "photo.png").write_bytes(b"\x89PNG")
    assert main(["rig", "calibrate", "points.csv", "--out", "photo.png"]) == 2
    assert "photo.png is not a hand-eye calibration that this program wrote" in capsys.readouterr().err
    assert (here / "photo.png").read_bytes() == b"\x89PNG"


def test_a_calibration_by_which_no_arm_can_be_steered_is_not_written(here, capsys):
    lines = POINTS.splitlines()
    rows = [[float(value) for value in line.split(",")] for line in lines[1:]]
    in_metres = [",".join(map(str, [each / 1000 for each in row[:3]] + row[3:])) for row in rows]
    (here / "points.csv").write_text("\n".join([lines[0], *in_metres]))
    assert main(["rig", "calibrate", "points.csv"]) == 1
    said = capsys.readouterr().err
    assert "metre" in said
    assert "nothing was written" in said
    assert not (here / "hand_eye.json").exists()


def test_a_file_without_points_is_wrong_use(here, capsys):
    (here / "points.csv").write_text("a,b\n1,2\n")
    assert main(["rig", "calibrate", "points.csv"]) == 2
    assert "camera_x_mm" in capsys.readouterr().err
    assert not (here / "hand_eye.json").exists()


def test_a_dry_run_prints_motions_and_writes_nothing(here, capsys):
    assert main(["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--out", "rec", "--dry-run"]) == 0
    said = capsys.readouterr()
    assert said.out.count("jaws: close with") == 2
    assert "round-1: nothing was moved, nothing was recorded" in said.err
    assert not (here / "rec").exists()


def test_a_collection_that_is_told_to_end_opens_its_jaws_closes_its_rig_and_leaves_a_whole_recording(
    here, capsys, monkeypatch
):
    from tests.fake_rig import FakeGripper, FakeRig

    collect = ["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--grasps", "4"]
    collect += ["--seed", "3", "--out", "rec"]
    rigs, real_prepare, real_grasp = [], FakeRig.prepare, FakeGripper._grasp

    def ended(self, force_n, speed_mm_s):
        state = real_grasp(self, force_n, speed_mm_s)
        if self.world.calls.count("grasp") == 3:
            signal.raise_signal(signal.SIGTERM)
        return state

    monkeypatch.setattr(FakeGripper, "_grasp", ended)
    monkeypatch.setattr(FakeRig, "prepare", lambda self, *which: (rigs.append(self), real_prepare(self, *which))[1])
    before = signal.getsignal(signal.SIGTERM)
    assert main(collect) == 1
    assert capsys.readouterr().err.endswith("retrieve collect: stopped by SIGTERM\n")
    assert signal.getsignal(signal.SIGTERM) is before
    assert rigs[0].world.force is None
    assert not any(device.is_connected for device in rigs[0].devices)
    monkeypatch.setattr(FakeGripper, "_grasp", real_grasp)
    assert main(collect) == 0
