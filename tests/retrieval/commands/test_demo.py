"""A small `retrieve demo`: the whole job and its output files; a second run repeats no work."""

import pytest

from retrieval.commands.demo import PHOTOS, SEED, TOUCHES
from retrieval.commands.main import main
from robot.recording.folder import read_recording


@pytest.fixture(scope="module")
def finished_demo(tmp_path_factory):
    """The folder of a finished demo with four objects."""
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--objects", "4", "--out", str(folder / "demo")]) == 0
    return folder / "demo"


def test_the_page_has_photos_and_gel_images_and_no_grasp_provides_both(finished_demo):
    assert (finished_demo / "query.html").read_text().count("data:image/jpeg;base64,") >= 4 + 2 * TOUCHES
    assert (finished_demo / "recording-preview.png").stat().st_size > 10_000
    photos = {path.read_bytes() for path in (finished_demo / "catalog").rglob("*.jpg")}
    grasps = [grasp for grasp in read_recording(finished_demo / "recording").grasps if grasp.grasped]
    assert len(photos) == 4 * PHOTOS
    by_object = {}
    for grasp in grasps:
        by_object.setdefault(grasp.object_id, []).append(
            (finished_demo / "recording" / grasp.photo).read_bytes() in photos
        )
    assert list(by_object.values()) == [[True] * PHOTOS + [False] * TOUCHES] * 4


def test_a_second_demo_collects_and_embeds_nothing_and_keeps_the_users_defaults(finished_demo, capsys):
    lines = (finished_demo / "recording" / "metadata.jsonl").read_bytes()
    assert main(["demo", "--objects", "4", "--out", str(finished_demo)]) == 0
    output = capsys.readouterr()
    assert (finished_demo / "recording" / "metadata.jsonl").read_bytes() == lines
    assert f"0 embedded, {4 * PHOTOS} unchanged" in output.err
    assert f"--seed {SEED}" in output.err
    assert "the true object comes first for" in output.err
    shown = min(path.name for path in (finished_demo / "catalog").iterdir())  # each object has three query grasps
    assert f"in the hand: {shown}. The model was not trained on it" in output.err
    assert f"finger a: {shown}-" in (finished_demo / "query.html").read_text()
    assert "rank  object " in output.out


def test_a_demo_with_serve_serves_its_index(finished_demo, capsys, monkeypatch):
    """Its rig can grasp the objects of the index."""
    served = []

    def serve(app, started):
        served.append(app.state.service)
        started(1234)

    monkeypatch.setattr("retrieval.serve.server.serve", serve)
    assert main(["demo", "--objects", "4", "--out", str(finished_demo), "--serve"]) == 0
    assert served[0].settings.index == finished_demo / "index"
    names = sorted(path.name for path in (finished_demo / "catalog").iterdir())
    grasp = served[0].rig.grasp(names)
    assert grasp.object_id in names
    assert [image[:4] for image in (*grasp.touches, *grasp.background)] == [b"\x89PNG"] * 4
    assert served[0].rig.sensors["a"]()[:2] == b"\xff\xd8"
    output = capsys.readouterr().err
    assert "listening on http://127.0.0.1:1234" in output
    assert f"$ retrieve serve --index {finished_demo / 'index'}\n" in output


def test_wrong_use_of_a_command_ends_the_demo_with_its_exit_code(tmp_path, capsys):
    (tmp_path / "recording").write_text("not a folder")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    output = capsys.readouterr().err.splitlines()
    assert output[-2].startswith("$ retrieve collect --rig sim --objects 20 ")
    assert output[-1] == f"retrieve demo: a recording must be a folder, and {tmp_path / 'recording'} is a file"


def test_a_folder_with_other_files_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "must be a new folder or that of an earlier demo, but it contains thesis.tex" in capsys.readouterr().err
