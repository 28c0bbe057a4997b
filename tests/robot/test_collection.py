"""Collection with a fake rig: recorded data, calls of devices, end conditions, and errors."""

import contextlib
import dataclasses
import functools
import json
import shutil

import cv2
import numpy as np
import pytest

from robot.collection import CollectSettings, Progress, collect
from robot.errors import DeviceError, RecordingError, RobotConfigError, UngraspableError
from robot.grasping.attempt import AttemptRunner
from robot.grasping.gates import ContactAreaGate, recorded_touches
from robot.grasping.planner import CylinderPlanner
from robot.grasping.settings import AttemptSettings, GraspSettings
from robot.readings import Pose
from robot.recording.attempt_log import read_attempts
from robot.recording.folder import RecordingWriter, read_recording
from robot.rig import GraspPlan, GraspPlanner, load_rig
from robot.sight.cylinder import CylinderFit
from robot.storage import file_content
from tests.fake_rig import FakeArm, FakeGripper, FakeRig, FakeSensor

pytestmark = pytest.mark.usefixtures("no_fsync")  # most of the time here; other tests cover crashes

NAMES = ("round-0", "thin-1", "round-2")


def run(
    out, names=NAMES, *, seed=3, rig_seed=None, faults=None, grasps=2, attempt=None, limit=None, rounds=False, **options
):
    """Collect with a fake rig and return the tallies by object."""
    make = functools.partial(FakeRig, seed if rig_seed is None else rig_seed, faults=faults)
    settings = CollectSettings(grasps, limit, attempt or AttemptSettings(), rounds)
    tallies = collect(make, out, objects=names, seed=seed, settings=settings, **options)
    return {each.object_id: each for each in tallies}


def files(folder):
    """Return the bytes of every file."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rows(folder):
    return [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]


def logged_attempts(folder):
    return read_attempts(folder, {row["grasp_id"] for row in rows(folder)})


def objects_of_accepted(folder):
    return [row["object_id"] for row in rows(folder) if row["grasped"]]


def test_a_gate_gets_the_recorded_frames_in_rgb():
    red, blue = np.full((4, 6, 3), (200, 10, 0), np.uint8), np.full((4, 6, 3), (0, 20, 190), np.uint8)
    files = {"touch_a": red, "touch_a_before": blue}
    images = {column: file_content(column, pixels)[0] for column, pixels in files.items()}
    touches = recorded_touches({"photo": b"no picture", **images})
    assert list(touches) == ["a"]
    np.testing.assert_array_equal(touches["a"].during, red)
    np.testing.assert_array_equal(touches["a"].before, blue)
    assert touches["a"].after is None


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recording of an undisturbed collection, which no test changes."""
    out = tmp_path_factory.mktemp("whole") / "r"
    run(out)
    return out


def test_every_object_gets_its_accepted_grasps_and_rejected_ones_are_recorded_too(tmp_path):
    tallies = run(tmp_path / "r", grasps=3)
    recording = read_recording(tmp_path / "r")
    for name in NAMES:
        grasps = [grasp for grasp in recording.grasps if grasp.object_id == name]
        assert sum(grasp.grasped for grasp in grasps) == tallies[name].accepted == 3
        assert len(grasps) <= tallies[name].attempts
        assert grasps[-1].grasped  # the last one was the last that was needed
    rejected = [grasp for grasp in recording.grasps if not grasp.grasped]
    assert rejected
    assert {grasp.outcome for grasp in rejected} <= {"missed", "slipped"}


def test_a_grasp_contains_every_measurement(whole):
    row = next(row for row in rows(whole) if row["grasped"])
    assert row["outcome"] == "held"
    assert row["grasp_id"] == row["sequence_id"] == f"round-0-{row['grasp_id'][-4:]}"
    assert 5 <= row["force_n"] <= 25
    assert 0 < row["opening_mm"] <= 80
    x, y, z, yaw = row["pose"]
    assert max(abs(x), abs(y)) < 30
    assert 10 <= z <= 140
    assert 0 <= yaw < np.pi
    fingers = [f"touch_{finger}{moment}" for finger in "ab" for moment in ("", "_before", "_after")]
    images = {column: row[f"{column}_file_name"] for column in ("photo", "depth", *fingers)}
    for column, path in images.items():
        assert path.endswith(".png" if column == "depth" else ".jpg")
        pixels = cv2.imread(str(whole / path), cv2.IMREAD_UNCHANGED)
        assert pixels.dtype == (np.uint16 if column == "depth" else np.uint8)
        assert pixels.shape[:2] == ((108, 128) if column in ("photo", "depth") else (24, 32))
    photo = cv2.imread(str(whole / row["photo_file_name"]))[..., ::-1]
    assert np.abs(np.median(photo.reshape(-1, 3), axis=0) - (150, 140, 120)).max() < 5  # the table's red, green, blue


def test_the_recording_contains_times_from_its_beginning_and_the_settings_of_its_collection(whole):
    ends = [attempt.ended_s for attempt in logged_attempts(whole)]
    times = [row["time_s"] for row in rows(whole)]
    assert times == sorted(times)
    assert ends == sorted(ends)
    assert 0 < times[0] < ends[0]
    assert times[-1] < ends[-1]
    info = json.loads((whole / "recording.json").read_text())
    assert (info["source"], info["sensor"], info["rig"], info["seed"]) == ("fake rig", "fake gel", "fake", 3)
    assert info["background"] == "before each grasp"
    assert info["devices"]["fake gripper"] == {"stroke_mm": 110.0}
    assert info["collection"]["grasps"] == 2
    assert "rounds" not in info["collection"]  # object by object, the default
    assert info["collection"]["gate"].startswith("ContactAreaGate(")
    assert info["collection"]["attempt"]["grasp"]["force_n"] == [5.0, 25.0]
    assert objects_of_accepted(whole) == [name for name in NAMES for _ in range(2)]


@pytest.mark.parametrize("rounds", [False, True])
def test_an_object_that_cannot_be_grasped_ends_at_the_limit_of_attempts(tmp_path, rounds):
    names, options = ["wide-0", "none-1", "round-2"], {"grasps": 2, "rounds": rounds}
    tallies = run(tmp_path / "r", names, **options)
    assert [each.accepted for each in tallies.values()] == [0, 0, 2]
    assert tallies["wide-0"].attempts == tallies["none-1"].attempts == 4 * 2 + 10
    logged = logged_attempts(tmp_path / "r")
    assert all("wider than the stroke" in each.reason for each in logged if each.object_id == "wide-0")
    before = files(tmp_path / "r")
    run(tmp_path / "r", names, **options)  # it is not tried again
    assert files(tmp_path / "r") == before


def test_a_finished_collection_makes_no_attempt(whole):
    before = files(whole)
    rig = FakeRig(3)
    collect(lambda: rig, whole, objects=NAMES, seed=3, settings=CollectSettings(2))
    assert not any(call in ("arm", "grasp", "depth") for call in rig.shared.calls)
    assert files(whole) == before


def test_an_object_ends_early_when_its_accepted_grasps_are_enough(tmp_path):
    seen = []

    def is_enough(grasps):
        seen.append([grasp.grasp_id for grasp in grasps])
        return grasps[0].object_id == "thin-1" or len(grasps) == 3

    tallies = run(tmp_path, grasps=4, is_enough=is_enough)
    accepted = [row["grasp_id"] for row in rows(tmp_path) if row["grasped"]]
    assert [tallies[name].accepted for name in NAMES] == [3, 1, 3]
    assert seen == [accepted[:1], accepted[:2], accepted[:3], accepted[3:4], *(accepted[4 : 4 + n] for n in (1, 2, 3))]
    before = files(tmp_path)
    seen.clear()
    run(tmp_path, grasps=4, is_enough=is_enough)
    assert files(tmp_path) == before  # a continued collection decides in the same way, and makes no attempt
    assert [len(grasps) for grasps in seen] == [1, 2, 3, 1, 1, 2, 3]


def test_more_objects_may_be_added(tmp_path, whole):
    run(tmp_path / "r", NAMES[:1])
    run(tmp_path / "r", NAMES)
    assert files(tmp_path / "r") == files(whole)


def test_progress_is_reported_after_every_attempt(tmp_path):
    reports: list[Progress] = []
    run(tmp_path / "r", ["round-0", "wide-1"], grasps=2, limit=4, progress=reports.append)
    assert [each.attempts for each in reports] == list(range(len(reports)))
    last = reports[-1]
    assert (reports[0].grasps_done, reports[0].objects_done) == (0, 0)
    assert last == Progress(2, 2, grasps_target=4, grasps_done=4, accepted=2, attempts=last.attempts)
    assert str(last) == f"2 of 2 objects, {2 / last.attempts:.0%} of {last.attempts} attempts accepted"


class OneRig(FakeRig):
    """A rig that exists once, like a real one, and whose devices read back slightly different values each time."""

    can_run_jobs = False
    times = 0

    def settings(self):
        OneRig.times += 1
        return super().settings() | {"fake gel a": {"exposure_ms": 10 + 0.1 * OneRig.times}}


def test_a_collection_continues_with_devices_that_read_back_other_values(tmp_path):
    def interrupted(now):
        if now.attempts == 1:
            raise KeyboardInterrupt

    arguments = {"objects": ["round-0"], "seed": 3, "settings": CollectSettings(2)}
    with pytest.raises(KeyboardInterrupt):
        collect(lambda: OneRig(3), tmp_path / "r", progress=interrupted, **arguments)
    collect(lambda: OneRig(3), tmp_path / "r", **arguments)
    assert sum(grasp.grasped for grasp in read_recording(tmp_path / "r").grasps) == 2
    assert OneRig.times == 2


@pytest.mark.parametrize("jobs", [1, 2])
def test_in_rounds_each_object_gets_one_accepted_grasp_and_then_the_next_round_begins(tmp_path, whole, jobs):
    """The grasps are those of the default order, because an attempt depends on seed, object and number only."""
    run(tmp_path / "r", rounds=True, jobs=jobs)
    assert objects_of_accepted(tmp_path / "r") == [*NAMES] * 2
    assert files(tmp_path / "r" / "images") == files(whole / "images")


def test_rounds_stopped_after_each_attempt_continue_to_the_same_bytes_and_another_order_is_refused(tmp_path):
    began = []

    def interrupted(now):
        began.append(now.attempts)
        if began.count(now.attempts) == 1 and now.attempts:
            raise KeyboardInterrupt

    run(tmp_path / "whole", grasps=3, rounds=True)
    for _ in range(100):
        with contextlib.suppress(KeyboardInterrupt):
            run(tmp_path / "r", grasps=3, rounds=True, progress=interrupted)
            break
    assert len(began) > 8
    assert files(tmp_path / "r") == files(tmp_path / "whole")
    with pytest.raises(RecordingError, match="was collected with rounds True, not False"):
        run(tmp_path / "r", grasps=3)
    assert files(tmp_path / "r") == files(tmp_path / "whole")


def test_a_second_session_adds_grasps_of_each_object_in_another_order_and_continues_after_a_stop(tmp_path):
    def interrupted(now):
        if now.attempts == 2:
            raise KeyboardInterrupt

    out = tmp_path / "r"
    run(out, session="monday")
    first = rows(out)
    with pytest.raises(KeyboardInterrupt):
        run(out, session="tuesday", grasps=1, progress=interrupted)
    tallies = run(out, session="tuesday", grasps=1, jobs=2)
    assert [each.accepted for each in tallies.values()] == [1, 1, 1]
    added = rows(out)[len(first) :]
    assert [{row["session"] for row in part} for part in (first, added)] == [{"monday"}, {"tuesday"}]
    orders = [list(dict.fromkeys(row["object_id"] for row in part)) for part in (first, added)]
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(NAMES)
    times = [row["time_s"] for row in first + added]
    assert times == sorted(times)
    whole = files(out)
    run(out, session="monday")  # complete
    for session, grasps in (("monday", 4), (None, 2)):
        with pytest.raises(RecordingError, match="its last attempts are of session 'tuesday'"):
            run(out, session=session, grasps=grasps)
    assert files(out) == whole


def test_a_session_of_the_file_of_a_simulated_rig_is_recorded_and_drifts_as_a_given_one(tmp_path):
    images = []
    for of_rig, given in (("", None), ("monday", None), ("", "monday")):
        rig, folder = functools.partial(load_rig, "sim", seed=3, session=of_rig), tmp_path / f"{of_rig}{given}"
        settings = CollectSettings(1, attempt=AttemptSettings(outputs=("before",)))
        collect(rig, folder, objects=1, seed=3, settings=settings, session=given)
        assert {row.get("session") for row in rows(folder)} == {of_rig or given}
        images.append(files(folder / "images"))
    plain, drifted, again = images
    assert drifted == again
    assert {name for name in plain if plain[name] == again[name]} == {name for name in plain if "photo" in name}


def attempted(rig, name="round-0", attempt=None):
    """Make one attempt and return it, with the calls of the devices."""
    with rig:
        result = AttemptRunner(rig, 3, attempt or AttemptSettings()).run(name, 0)
    return result, [call for call in rig.shared.calls if "." not in call]


def test_the_order_of_the_calls_of_an_attempt_and_only_recorded_outputs_are_read(monkeypatch):
    _, calls = attempted(FakeRig(3))
    gels = ["gel a", "gel b"]
    start, close, up = ["open", "arm", "arm", "depth", "arm", "open", "arm"], ["grasp"], ["arm"]
    assert calls == [*start, *gels, *close, *gels, *up, *gels, "arm", "arm", "open", "arm"]
    for outputs, count in [((), 1), (("after",), 2)]:
        assert attempted(FakeRig(3), attempt=AttemptSettings(outputs=outputs))[1].count("gel a") == count
    result, calls = attempted(FakeRig(3), "wide-0")  # without a plan nothing moves but home
    assert (result.outcome, result.images) == ("no_plan", {})
    assert calls == ["open", "arm", "arm", "depth"]
    monkeypatch.setattr(FakeArm, "is_manual", True)  # a person is not asked to rise first
    assert attempted(FakeRig(3))[1][:3] == ["open", "arm", "depth"]


@pytest.fixture
def moves(monkeypatch):
    """The motions of the fake arm: each pose before it and its goal."""
    found, real = [], FakeArm._move_to

    def recorded(self, pose, speed_mm_s):
        found.append((self.shared.pose, pose))
        return real(self, pose, speed_mm_s)

    monkeypatch.setattr(FakeArm, "_move_to", recorded)
    return found


@pytest.mark.parametrize("faults", [{}, {"grasp": {1}}, {"gel a": {3}}, {"open": {3}}])
def test_a_motion_that_begins_low_is_vertical(faults, moves):
    """On a slant, open jaws would hit the object that was just put down."""
    with FakeRig(3, faults=faults) as rig:
        attempter = AttemptRunner(rig, 3, AttemptSettings())
        for number in range(3):
            attempter.run("round-0", number)
        low = [(here, there) for here, there in moves if here.z_mm < rig.shared.solid.height + 10]
    assert len(low) >= 3
    assert all((here.x_mm, here.y_mm, here.yaw_rad) == (there.x_mm, there.y_mm, there.yaw_rad) for here, there in low)


def test_an_arm_that_reports_a_height_below_the_workspace_still_rises_straight(moves):
    """A pose is measured: after a grasp at the lowest height it may lie a little below it."""
    rig = FakeRig(3)
    rig.shared.pose = low = dataclasses.replace(rig.shared.pose, z_mm=rig.arm.workspace.lower[2] - 0.01)
    attempted(rig)
    assert moves[0] == (low, dataclasses.replace(low, z_mm=rig.arm.workspace.upper[2]))


class Approaching(CylinderPlanner):
    """Plans an upright grasp with a way of its own to it."""

    def plan(self, rig, image, settings, rng):
        plan = super().plan(rig, image, settings, rng)
        return dataclasses.replace(plan, approach=(plan.above,))


def test_the_open_hand_leaves_an_object_that_was_put_elsewhere_straight_up(moves):
    """On the way back to the approach, the jaws would hit the object between them."""
    with FakeRig(3) as rig:
        rig.planner = Approaching()
        runner = AttemptRunner(rig, 3, AttemptSettings())
        while runner.run("round-0", len(moves)).outcome != "held":
            pass
    here, there = moves[-1]
    assert (here.x_mm, here.y_mm) == (there.x_mm, there.y_mm)
    assert there.z_mm > here.z_mm


def test_with_a_given_place_no_depth_is_read_and_the_object_is_put_back_there():
    rig = FakeRig(3)
    rig.prepare("round-0", 0)
    solid = rig.shared.solid
    round_fit = (solid.x, solid.y, solid.height, solid.radius, "given", (solid.radius, solid.radius))
    rig.object_fit = CylinderFit(*round_fit)
    attempt, calls = attempted(rig, attempt=AttemptSettings(outputs=("before",)))
    assert attempt.fit["method"] == "given"
    assert "camera" in calls
    assert "depth" not in calls
    put, (x_mm, y_mm, _, yaw_rad) = rig.shared.pose, attempt.fields["pose"]
    assert (put.x_mm, put.y_mm, put.yaw_rad) == (x_mm, y_mm, yaw_rad)


class Picky(CylinderPlanner):
    """Rejects thin objects as ungraspable."""

    def plan(self, rig, image, settings, rng):
        if rig.shared.solid.radius < 10:
            raise UngraspableError("too thin")
        return super().plan(rig, image, settings, rng)


def picky_rig():
    rig = FakeRig(3)
    rig.planner = Picky()
    return rig


@pytest.mark.parametrize(("jobs", "rounds"), [(1, False), (2, True)])
def test_an_ungraspable_object_is_skipped_at_once_and_the_others_are_collected(tmp_path, jobs, rounds):
    options = {"objects": NAMES, "seed": 3, "settings": CollectSettings(2, rounds=rounds)}
    tallies = collect(picky_rig, tmp_path / "r", jobs=jobs, **options)
    assert [(each.accepted, each.skipped) for each in tallies] == [(2, None), (0, "too thin"), (2, None)]
    assert [each.reason for each in logged_attempts(tmp_path / "r") if each.object_id == "thin-1"] == ["too thin"]
    before = files(tmp_path / "r")
    info = json.loads(before["recording.json"])
    assert info["skipped_objects"] == {"thin-1": "too thin"}
    (tmp_path / "r" / "recording.json").write_text(json.dumps(info | {"skipped_objects": {}}))
    collect(picky_rig, tmp_path / "r", **options)  # as after a crash between both writes
    assert files(tmp_path / "r") == before


class Blind(GraspPlanner):
    """Plans without depth."""

    needs_depth = False

    def plan(self, rig, image, settings, rng):
        assert image.depth_m is None
        pose, above = (Pose(rig.shared.solid.x, rig.shared.solid.y, z_mm, 0.5) for z_mm in (40.0, 250.0))
        return GraspPlan(pose, above, rig.gripper.stroke_mm, 12.0, fit={"method": "none"})


def test_no_depth_is_read_for_a_planner_that_needs_none_and_only_requested_outputs_are_recorded():
    rig = FakeRig(3)
    rig.planner = Blind()
    attempt, calls = attempted(rig, attempt=AttemptSettings(outputs=("before",)))
    assert "depth" not in calls
    assert attempt.images.keys() == {"photo", "touch_a", "touch_b", "touch_a_before", "touch_b_before"}
    assert (attempt.fields["force_n"], attempt.fit) == (12.0, {"method": "none"})


def test_a_gate_without_its_frames_raises(tmp_path):
    with pytest.raises(RobotConfigError, match="requires no-contact frames"):
        run(tmp_path / "r", attempt=AttemptSettings(outputs=("depth",)))


def test_any_gate_decides_which_grasps_are_accepted(tmp_path):
    calls = []

    def picky(touches):
        calls.append(sorted(touches))
        frames = touches["a"]
        assert frames.before.shape == frames.during.shape == frames.after.shape == (24, 32, 3)
        return 0.75 if len(calls) % 3 == 0 else 0.25

    tallies = run(tmp_path / "r", ["round-0"], grasps=2, gate=picky, gate_name="picky")
    assert calls == [["a", "b"]] * 6
    assert tallies["round-0"].accepted == 2
    assert [attempt.score for attempt in logged_attempts(tmp_path / "r")] == [0.25, 0.25, 0.75] * 2


@pytest.mark.parametrize("device", ["arm", "depth", "gel a", "gel b", "grasp", "open"])
def test_an_attempt_is_repeated_after_a_device_failure_and_the_recording_is_the_same(tmp_path, whole, device):
    run(tmp_path / "s", faults={device: {2, 5}})
    assert files(tmp_path / "s") == files(whole)


@pytest.mark.parametrize("device", ["arm", "depth", "gel b", "grasp"])
def test_a_device_that_fails_too_often_ends_the_collection_with_the_jaws_open_until_it_is_repaired(
    tmp_path, whole, device
):
    rig = FakeRig(3, faults={device: set(range(4, 100))})
    with pytest.raises(DeviceError, match=rf"failed 3 time\(s\), last: the fake {device} fails on purpose"):
        collect(lambda: rig, tmp_path / "r", objects=NAMES, seed=3, settings=CollectSettings(2))
    assert rig.shared.force is None
    assert not any(each.is_connected for each in rig.devices)
    run(tmp_path / "r")
    assert files(tmp_path / "r") == files(whole)


def test_a_gripper_that_never_stops_moving_is_a_fault(monkeypatch):
    monkeypatch.setattr("tests.fake_rig.FakeRigState.status", lambda self: "idle" if self.force is None else "moving")
    with pytest.raises(DeviceError, match="must report holding, no_part or part_lost after a lift, got moving"):
        attempted(FakeRig(3))


def test_a_frozen_gel_is_a_fault_and_not_a_recording(monkeypatch):
    """A frozen stream would return the no-contact frame as the frame of the grasp."""
    real, first = FakeSensor._read, {}
    monkeypatch.setattr(FakeSensor, "_read", lambda self: first.setdefault(self.finger, real(self)))
    with pytest.raises(DeviceError, match="is the stream frozen"):
        attempted(FakeRig(3))


def test_the_first_error_is_reported_even_if_the_jaws_cannot_be_opened(tmp_path):
    with pytest.raises(DeviceError, match="last: the fake grasp fails on purpose"):
        run(tmp_path / "r", faults={"grasp": set(range(1, 9)), "open": {3, 4, 7, 8, 11, 12}})


def test_ctrl_c_during_an_attempt_leaves_open_jaws_a_closed_rig_and_a_complete_recording(tmp_path, whole, monkeypatch):
    rig, real = FakeRig(3), FakeGripper._grasp

    def interrupted(self, force_n, speed_mm_s):
        state = real(self, force_n, speed_mm_s)
        if self.shared.calls.count("grasp") == 3:
            raise KeyboardInterrupt
        return state

    with monkeypatch.context() as patched:
        patched.setattr(FakeGripper, "_grasp", interrupted)
        with pytest.raises(KeyboardInterrupt):
            collect(lambda: rig, tmp_path / "r", objects=NAMES, seed=3, settings=CollectSettings(2))
    assert rig.shared.force is None
    assert not any(device.is_connected for device in rig.devices)
    assert len(rows(tmp_path / "r")) == 2
    run(tmp_path / "r")
    assert files(tmp_path / "r") == files(whole)


OTHER_SETTINGS = {
    "another seed": ({"seed": 4}, "was collected with seed 3, not 4"),
    "another limit": ({"limit": 5}, "was collected with most attempts 18, not 5"),
    "other forces": (
        {"attempt": AttemptSettings(grasp=GraspSettings(force_n=(5, 30)))},
        r"with attempt\.grasp\.force n \[5\.0, 25\.0\], not \[5\.0, 30\.0\]",
    ),
    "another version": ({"version": "0.0.1"}, r"was collected with software version '0\.0\.1', not"),
    "another gate": ({"gate": ContactAreaGate(20.0)}, "was collected with gate 'ContactAreaGate"),
    "other objects": ({"names": ["round-9"]}, "was collected with other objects"),
    "fewer objects": ({"names": ["round-0"]}, "was collected with other objects"),
}


@pytest.mark.parametrize("case", OTHER_SETTINGS)
def test_a_recording_with_other_settings_is_refused_and_not_changed(tmp_path, whole, case):
    shutil.copytree(whole, tmp_path / "r")
    options, message = OTHER_SETTINGS[case]
    options = dict(options)
    if version := options.pop("version", None):
        info = json.loads((tmp_path / "r/recording.json").read_text())
        (tmp_path / "r/recording.json").write_text(json.dumps({**info, "software_version": version}))
    before = files(tmp_path / "r")
    with pytest.raises(RecordingError, match=message):
        run(tmp_path / "r", **options)
    assert files(tmp_path / "r") == before


def test_a_recording_that_no_rig_collected_and_a_lost_log_are_refused(tmp_path, whole):
    RecordingWriter(tmp_path / "s", {"source": "fake rig", "sensor": "fake gel"}).close()
    with pytest.raises(RecordingError, match="was not collected by a rig"):
        run(tmp_path / "s")
    shutil.copytree(whole, tmp_path / "r")
    (tmp_path / "r" / "attempts.jsonl").unlink()
    with pytest.raises(RecordingError, match=r"attempts\.jsonl lacks grasp round-0-0000"):
        run(tmp_path / "r")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jobs": 0}, "jobs must be a whole number >= 1"),
        ({"grasps": 0}, ">= 1"),
        ({"limit": 0}, ">= 1"),
        ({"attempt": AttemptSettings(grasp=GraspSettings(force_n=(1.0, 2.0)))}, "force_n must be within 5 to 80 N"),
        *(({"names": ["round-0", name]}, "an object's name must be") for name in ("", " ", "a\nb", "caf\udce9")),
    ],
)
def test_settings_out_of_range_are_refused_before_a_folder_is_made(tmp_path, options, message):
    with pytest.raises((RobotConfigError, RecordingError), match=message):
        run(tmp_path / "r", **options)
    assert not (tmp_path / "r").exists()


def test_a_real_rig_cannot_run_in_several_jobs(tmp_path):
    with pytest.raises(RobotConfigError, match=r"OneRig can run in one process only, so jobs must be 1, got 2"):
        collect(OneRig, tmp_path / "r", objects=["round-0"], seed=3, jobs=2)
