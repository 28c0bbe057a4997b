"""`retrieve demo` in small: the whole job, with files that a person can open; a second run makes nothing again."""

import os
from pathlib import Path

import pytest

from retrieval.commands.demo import PHOTOS, SEED, TOUCHES, example_object
from retrieval.commands.main import main
from robot.recording.folder import read_recording


@pytest.fixture(scope="module")
def finished_demo(tmp_path_factory):
    """Where a demo of four objects has run."""
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--objects", "4", "--jobs", "1", "--out", str(folder / "demo")]) == 0
    return folder / "demo"


def test_the_demo_ends_with_a_page_of_photos_and_gel_images(finished_demo):
    page = (finished_demo / "query.html").read_text()
    assert page.count("data:image/jpeg;base64,") >= 4 + 2 * TOUCHES
    assert (finished_demo / "recording-preview.png").stat().st_size > 10_000


def test_the_object_of_the_page_is_chosen_by_its_name_and_its_grasps_alone():
    grasps = {"mug": [1, 2, 3], "bowl": [1, 2], "cup": [1, 2, 3], "dish": [1, 2, 3]}
    assert example_object(grasps) == "cup"
    assert example_object({"mug": [1], "bowl": [1]}) == "bowl"


def test_no_grasp_gives_both_a_photo_and_a_touch(finished_demo):
    photos = {path.read_bytes() for path in (finished_demo / "catalog").rglob("*.jpg")}
    grasps = [grasp for grasp in read_recording(finished_demo / "recording").grasps if grasp.grasped]
    assert len(photos) == 4 * PHOTOS
    by_object = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(
            (finished_demo / "recording" / grasp.photo).read_bytes() in photos
        )
    assert list(by_object.values()) == [[True] * PHOTOS + [False] * TOUCHES] * 4


def test_a_second_demo_collects_and_embeds_nothing_again_and_leaves_the_users_defaults(finished_demo, capsys):
    lines = (finished_demo / "recording" / "metadata.jsonl").read_bytes()
    assert main(["demo", "--objects", "4", "--jobs", "1", "--out", str(finished_demo)]) == 0
    said = capsys.readouterr()
    assert (finished_demo / "recording" / "metadata.jsonl").read_bytes() == lines
    assert f"0 embedded, {4 * PHOTOS} unchanged" in said.err
    assert f"--seed {SEED}" in said.err
    assert "the true object comes first for" in said.err
    shown = min(path.name for path in (finished_demo / "catalog").iterdir())  # each has three grasps to query with
    assert f"in the hand: {shown}, which the model was never trained on" in said.err
    assert f"finger a: {shown}-" in (finished_demo / "query.html").read_text()
    assert "rank  object " in said.out
    assert not list(Path(os.environ["XDG_STATE_HOME"]).iterdir())


def test_a_demo_that_serves_opens_a_page_that_asks_its_index(finished_demo, capsys, monkeypatch):
    """Its rig can grasp what the index shows, and its objects are those of the human test."""
    served, opened = [], []

    def serve(app, started):
        served.append(app.state.service)
        started(1234)

    monkeypatch.setattr("retrieval.serve.server.serve", serve)
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert main(["demo", "--objects", "4", "--jobs", "1", "--out", str(finished_demo), "--serve"]) == 0
    assert opened == ["http://127.0.0.1:1234"]
    assert served[0].settings.index == finished_demo / "index"
    assert served[0].trials.folder == finished_demo / "recording"
    names = sorted(path.name for path in (finished_demo / "catalog").iterdir())
    felt = served[0].rig.grasp(names)
    assert felt.object_id in names
    assert [image[:4] for image in (*felt.touches, *felt.background)] == [b"\x89PNG"] * 4
    assert served[0].rig.sensors["a"]()[:2] == b"\xff\xd8"
    said = capsys.readouterr().err
    assert (
        f"$ retrieve serve --index {finished_demo / 'index'} --trials {finished_demo / 'recording'} --open-page" in said
    )


def test_a_command_that_is_used_wrongly_ends_the_demo_with_its_exit_code(tmp_path, capsys):
    (tmp_path / "recording").write_text("not a folder")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-2].startswith("$ retrieve collect --rig sim --objects 20 ")
    assert said[-1] == f"retrieve demo: a recording must be a folder, and {tmp_path / 'recording'} is a file"


def test_a_folder_of_other_files_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "must be a new folder or an earlier demo's; it holds thesis.tex" in capsys.readouterr().err
