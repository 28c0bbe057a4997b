"""`retrieve identify` on the simulated rig: when it stops, what it refuses before a motion, and how it continues."""

import json

import pytest

from retrieval.commands.main import main
from retrieval.data.dataset import load_grasps
from retrieval.indexing.build import build_index
from retrieval.indexing.enrolled import remove_enrolled
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.gel_check import GelCheck
from retrieval.model.shipped import shipped_model
from robot.collection import CollectSettings, collect
from robot.recording.folder import read_recording
from robot.rig import load_rig

SEED = 41


@pytest.fixture(scope="module")
def index(tmp_path_factory):
    """An index of six simulated objects; their photos come from grasps of another seed of the planner."""
    folder = tmp_path_factory.mktemp("identify")
    rig = load_rig("sim", seed=SEED)
    collect(lambda: rig, folder / "recording", objects=6, seed=SEED, settings=CollectSettings(grasps=2))
    for grasp in load_grasps(folder / "recording"):
        photo = folder / "catalog" / grasp.object_id / grasp.photo.name
        photo.parent.mkdir(parents=True, exist_ok=True)
        photo.symlink_to(grasp.photo)
    build_index(folder / "catalog", load_checkpoint(shipped_model()), folder / "index")
    return folder / "index"


@pytest.fixture
def identify(index, tmp_path):
    def run(*options, out="run"):
        command = ["identify", "--rig", "sim", "--seed", str(SEED), "--index", str(index), "--out", str(tmp_path / out)]
        return main([*command, *map(str, options)])

    return run


def names_of(index):
    return sorted(folder.name for folder in (index.parent / "catalog").iterdir())


def test_it_stops_at_the_first_grasp_whose_answer_is_clear(identify, tmp_path, capsys):
    identify("--confidence", "0", "--json")
    assert len(read_recording(tmp_path / "run").grasps) == 1
    assert len(json.loads(capsys.readouterr().out)["query"]["touches"]) == 1


def test_an_unclear_answer_takes_all_grasps_and_continues_where_it_was_stopped(identify, tmp_path, capsys):
    identify("--confidence", "1", "--grasps", "2")
    whole = capsys.readouterr().err
    lines = (tmp_path / "run" / "metadata.jsonl").read_text().splitlines()
    assert "grasp 2 of at most 2" in whole
    # A killed run: the second grasp and all later ones are missing.
    attempts = tmp_path / "run" / "attempts.jsonl"
    last = next(row for row, line in enumerate(map(json.loads, attempts.read_text().splitlines())) if line["accepted"])
    attempts.write_text("".join(f"{line}\n" for line in attempts.read_text().splitlines()[: last + 1]))
    recorded = [line for line in lines if json.loads(line)["grasp_id"] in attempts.read_text()]
    (tmp_path / "run" / "metadata.jsonl").write_text("".join(f"{line}\n" for line in recorded))
    identify("--confidence", "1", "--grasps", "2")
    assert (tmp_path / "run" / "metadata.jsonl").read_text().splitlines() == lines
    assert capsys.readouterr().err == whole


def test_a_finished_run_is_refused_since_the_hand_may_hold_another_object(identify, tmp_path, capsys):
    identify("--confidence", "0")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    capsys.readouterr()
    assert identify("--confidence", "0") == 2
    refusal = capsys.readouterr().err.splitlines()[-1]
    assert "holds a finished run" in refusal
    assert "Give another --out" in refusal
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == before


def test_without_an_accepted_grasp_the_error_states_why_the_last_attempt_failed(index, tmp_path, capsys):
    rig = tmp_path / "high.toml"
    rig.write_text('rig = "sim"\n[grasp]\nfloor_mm = 500\n')
    assert main(["identify", "--rig", str(rig), "--index", str(index), "--out", str(tmp_path / "run")]) == 1
    error = capsys.readouterr().err
    assert "was accepted; the last attempt: the object is " in error
    assert "but the lowest height of the fingers is 500 mm (all attempts are in " in error


def test_a_first_grasp_with_a_foreign_image_does_not_end_the_run(identify, monkeypatch, capsys):
    shown = ["not a gel image", "contact"]
    monkeypatch.setattr(GelCheck, "classify", lambda check, readings, levels: shown[: len(readings)])
    assert identify("--confidence", "1", "--grasps", "2", "--json") in (0, 3)
    assert json.loads(capsys.readouterr().out)["query"]["grasps"] == shown


def test_an_expected_object_ends_with_a_decision_or_after_all_grasps(identify, index, capsys):
    code = identify("--expect", names_of(index)[0], "--far", "0.1", "--json")
    assert {0: "accept", 3: "reject", 6: "another grasp"}[code] == json.loads(capsys.readouterr().out)["decision"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--expect", "teapot"), "has no object 'teapot'"),
        (("--expect", "{object}", "--far", "1"), "1"),
        (("--expect", "{object}", "--enrol", "cup"), "--enrol adds one"),
        (("--far", "0.1"), "--far is the false-accept rate of --expect"),
        (("--object", "teapot"), "has no 'teapot'"),
    ],
)
def test_a_wrong_option_is_refused_in_one_line_before_the_rig_moves(
    identify, index, tmp_path, capsys, options, message
):
    assert identify(*(option.format(object=names_of(index)[0]) for option in options)) == 2
    refusal = capsys.readouterr().err.strip()
    assert message in refusal
    assert "\n" not in refusal
    assert not (tmp_path / "run" / "attempts.jsonl").exists() or not (tmp_path / "run" / "attempts.jsonl").read_text()


def test_a_model_for_one_finger_is_refused_by_a_rig_with_two_sensors(index, tmp_path, capsys):
    build_index(index.parent / "catalog", load_checkpoint(shipped_model(1)), tmp_path / "one-finger")
    assert main(["identify", "--index", str(tmp_path / "one-finger"), "--out", str(tmp_path / "run")]) == 2
    assert "takes 1 gel image(s) of a grasp, but the rig sim has 2 sensor(s)" in capsys.readouterr().err


def test_grasps_are_enrolled_once_also_by_a_run_that_was_stopped_before(identify, index, tmp_path, capsys, monkeypatch):
    options = ("--enrol", "my part", "--grasps", "2")
    with monkeypatch.context() as stopped:
        stopped.setattr("retrieval.search.searcher.Searcher.enrol", None)
        assert identify(*options) == 1
    assert identify(*options, "--json") == 0
    output = capsys.readouterr()
    assert json.loads(output.out) == {"object_id": "my part", "touches": 2, "added": 2}
    assert "enrolled 2 of 2 grasps as touches of my part" in output.err
    grasps = [grasp for grasp in read_recording(tmp_path / "run").grasps if grasp.grasped]
    table = json.loads((index / "enrolled" / "touches.json").read_text())
    assert [touch["opening_mm"] for touch in table["touches"]] == [grasp.opening_mm for grasp in grasps]
    assert identify(*options) == 2
    assert "enrolled already, for my part" in capsys.readouterr().err
    remove_enrolled(index, "my part")
