"""Commands and programs in README and docs/ run; tests/project/test_notebooks.py tests the notebooks."""

import ast
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib

import cv2
import pytest
import torch
import typer

from benchmarks.reference import COMMANDS
from benchmarks.reference import commands as commands_page
from retrieval import load_config
from retrieval.commands.main import main
from retrieval.model.towers.tower import build_tower
from retrieval.search.answer import EXIT_CODES, VERIFY_EXIT_CODES
from robot.rig import load_rig
from tests import real_data_sets, serving, synthetic
from tests.documents import PAGES, README, ROOT, RUN_TOGETHER, blocks, text_of
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.miniatures import physiclear, rosbag
from tests.project.test_project import pins
from tests.replay_rig import replay_file
from tests.retrieval.commands.test_rig import POINTS

SHORTER = {
    "demo": ["--objects", "4"],
    "collect": ["--objects", "8", "--grasps", "2", "--jobs", "1"],
    "rig": [],
    "import": [],
    "check": [],
    "train": ["--iterations", "2"],
    "build-index": [],
    "enrol": [],
    "query": [],
    "verify": [],
    "identify": ["--grasps", "2"],
    "export": [],
    "export-recording": [],
    "evaluate": ["--config", "tiny", "--seeds", "1", "--methods", "late_fusion,chance"],
    "frontier": ["--only", "partials", "--recording", "recording"],
    "serve": ["--port", "0"],
}
"""Options that make each command fast."""


def commands(*pages):
    """Return the lines of shell blocks as words, without comments."""
    lines = [line for block in blocks("sh", *pages) for line in block.replace("\\\n", " ").splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def of_program(name, *pages):
    return [words for words in commands(*pages) if words[0] == name]


@pytest.fixture
def home(tmp_path, recording, catalogue, model, monkeypatch):
    """A folder with all files that the commands name: catalog/, gel images, recording/, billets/, data/, pictures/,
    bags/, model.safetensors, rig.toml, gels.toml, mobilenet_v2.pth, models/shipped_*.toml."""
    shutil.copytree(recording, tmp_path / "recording")
    shutil.copytree(catalogue, tmp_path / "catalog")
    photos = min(folder for folder in catalogue.iterdir() if folder.is_dir())
    shutil.copytree(photos, tmp_path / "catalog" / "mug")
    shutil.copy(model, tmp_path / "model.safetensors")
    objects = synthetic.make_objects(1, seed=9)
    pairs = synthetic.write_queries(tmp_path / "drawn", objects, touches_per_object=2)[objects[0].object_id]
    for number, pair in enumerate(pairs):
        for finger, path in zip("ab", pair, strict=True):
            shutil.copy(path, tmp_path / f"{finger}{'' if number == 0 else number + 1}.png")
    photo = next((tmp_path / "catalog").rglob("*.jpg"))
    billets, pictures = ("billets/welded1/01_{}", "billets/welded1/02_{}"), ("pictures/mug/{}_1", "pictures/tin/{}_1")
    for name in (*billets, *pictures):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(pairs[0][0], tmp_path / f"{name.format('touch')}.png")
        shutil.copy(photo, tmp_path / f"{name.format('photo')}.jpg")
    (tmp_path / "pictures/monday").mkdir()
    for frame in ("touch", "rest"):
        shutil.copy(pairs[0][0], tmp_path / f"pictures/monday/001_bolt_{frame}.png")
    real_data_sets.write_billets(tmp_path / "data" / "billets")
    physiclear.write(tmp_path / "data" / "physiclear")
    rosbag.write(tmp_path / "bags")
    (tmp_path / "models").mkdir()
    for rig in (ROOT / "models").glob("shipped_*.toml"):
        shutil.copy(rig, tmp_path / "models")
    (tmp_path / "points.csv").write_text(POINTS)
    (tmp_path / "gels.toml").write_text('rig = "sim"\ngels = 2\n')
    (tmp_path / "grey.toml").write_text(next(block for block in blocks("toml") if "grey" in block))
    torch.save(build_tower("mobilenet_v2", "stages").state_dict(), tmp_path / "mobilenet_v2.pth")
    monkeypatch.chdir(tmp_path)
    with replay_file(EmulatedWSG50(object_mm=40.0, speed_up=50.0, referenced=True)) as rig:
        shutil.copy(rig, tmp_path)
        yield tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in RUN_TOGETHER if of_program("retrieve", page)], ids=lambda page: page.stem
)
def test_every_retrieve_command_of_a_page_runs_from_top_to_bottom(page, home):
    for line in of_program("retrieve", page):
        if line[1] == "serve":  # runs until SIGTERM
            with serving.command(*line[2:], *SHORTER["serve"], cwd=home) as (process, _, _):
                process.terminate()
                assert process.wait(60) == 0
            continue
        verdicts = {*EXIT_CODES.values(), *VERIFY_EXIT_CODES.values()}
        accepted = verdicts if line[1] in ("query", "verify", "identify") else {0}
        has_steps = line[1] != "train" or "--config" in line or "grasp-success" in line
        shorter = SHORTER[line[1]] if has_steps else []
        if line[1] == "train" and "paper" in line:
            shorter = [*shorter, "--init", "random"]  # without ImageNet's weights
        if line[1] == "evaluate" and {"--init", "--model"} & set(line):  # the preset tiny has other towers
            shorter = shorter[2:]
        assert main([*line[1:], *shorter]) in accepted, line


def test_shell_and_program_blocks_are_in_pages_that_are_tested():
    assert {line[0] for line in commands()} == {"make", "retrieve", "python", "pip"}
    assert {line[1] for line in of_program("retrieve")} == set(SHORTER)
    assert {page.stem for page in PAGES if blocks("python", page)} == {"README", "reference", "extending"}


def test_the_toml_blocks_define_a_rig_or_a_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "points.csv").write_text(POINTS)
    assert main(["rig", "calibrate", "points.csv"]) == 0
    kinds = []
    for number, block in enumerate(blocks("toml")):
        (tmp_path / f"{number}.toml").write_text(block)
        if "training" in tomllib.loads(block):
            load_config(str(tmp_path / f"{number}.toml"))
            continue
        rig = load_rig(str(tmp_path / f"{number}.toml"), seed=0)
        assert len(rig.object_ids(1)) == 1
        kinds.append(tomllib.loads(block)["rig"])
    assert sorted(kinds) == ["real", "sim", "sim"]


def test_the_make_commands_exist():
    for line in of_program("make"):
        dry = subprocess.run(["make", "-n", *line[1:]], cwd=ROOT, capture_output=True, check=False)
        assert dry.returncode == 0, line


@pytest.mark.slow
def test_every_python_command_exists(monkeypatch):
    for module in sorted({line[line.index("-m") + 1] for line in of_program("python")}):
        monkeypatch.setattr(sys, "argv", [module, "--help"])
        for loaded in (module, f"{module}.__main__"):  # perhaps by another test; runpy warns of it
            monkeypatch.delitem(sys.modules, loaded, raising=False)
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(module, run_name="__main__")
        assert not ended.value.code, module


@pytest.mark.skipif(
    typer.__version__ != pins("constraints.txt")["typer"], reason="versions of typer format help differently"
)
def test_the_page_of_commands_contains_their_help(monkeypatch, capsys):
    assert text_of(COMMANDS) == commands_page(), "run `python -m benchmarks.reference`"
    monkeypatch.setenv("COLUMNS", "100")
    for words in re.findall("^## retrieve ?(.*)$", text_of(COMMANDS), re.M):
        assert main([*words.split(), "--help"]) == 0
        assert capsys.readouterr().out.strip() in text_of(COMMANDS)
    assert set(SHORTER) <= set(re.findall(r"^## retrieve (\S+)$", text_of(COMMANDS), re.M))


class FakeGel:
    """A camera with two pictures (BGR) of the gel in turn; its driver buffers black images while the program waits."""

    def __init__(self, device):
        finger = device.removeprefix("/dev/gel-")
        self.pictures = [cv2.imread(f"{finger}{number}.png") for number in ("", 2)]
        self.buffered, self.is_stale = 0, True

    def wait(self):
        self.buffered, self.pictures = 4, self.pictures[::-1]

    def grab(self):
        self.is_stale, self.buffered = self.buffered > 0, max(self.buffered - 1, 0)
        return True

    def retrieve(self):
        return True, self.pictures[1] * 0 if self.is_stale else self.pictures[1]


def run_program_of_readme(keys, monkeypatch):
    opened = []

    def open_camera(device):
        opened.append(FakeGel(device))
        return opened[-1]

    def wait_for_key(prompt):
        for gel in opened:
            gel.wait()
        return next(keys)

    (program,) = blocks("python", README)
    monkeypatch.setattr(cv2, "VideoCapture", open_camera)
    monkeypatch.setattr("builtins.input", wait_for_key)
    exec(compile(program, "README.md", "exec"), {})


def test_the_program_of_the_readme_gives_the_same_answers_as_the_command(home, model, monkeypatch, capsys):
    """Two grasps of one object; the images of each are newer than the key press."""
    assert main(["build-index", "catalog", "--out", "demo/index", "--model", str(model)]) == 0
    capsys.readouterr()
    run_program_of_readme(iter(["", "", "q"]), monkeypatch)
    output = capsys.readouterr().out.splitlines()
    first, second = ["--gelsight", "a.png", "b.png"], ["--gelsight", "a2.png", "b2.png"]
    for grasps, line in zip((first, first + second), output, strict=True):
        main(["query", *grasps, "--index", "demo/index", "--json"])
        document = json.loads(capsys.readouterr().out)
        verdict, _, ranking = line.partition(" [")
        assert verdict == document["verdict"]
        for result, (object_id, probability) in zip(document["results"], ast.literal_eval(f"[{ranking}"), strict=False):
            assert object_id == result["object_id"]
            assert probability == pytest.approx(result["probability"], abs=1e-4)
