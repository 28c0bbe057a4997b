"""The command line for users: commands as documented, exit codes, one-line errors, clean stdout."""

import json
import re
import shutil
import subprocess
import sys
from itertools import chain
from pathlib import Path

import pytest
import typer

from retrieval.commands.main import application, main
from retrieval.commands.options import Command
from retrieval.console.progress import Bar, show_progress
from retrieval.model.shipped import shipped_model
from tests import synthetic


@pytest.fixture
def workplace(tmp_path, catalogue, two_grasps, monkeypatch):
    """The current folder, with `catalog/`, `a.png` and `b.png` as in the README, and a second grasp."""
    shutil.copytree(catalogue, tmp_path / "catalog")
    for name, path in zip(("a.png", "b.png", "a2.png", "b2.png"), chain(*two_grasps), strict=True):
        shutil.copy(path, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_two_commands_of_the_readme_work(workplace, capsys):
    """Without a trained model the shipped model is used, and the output names it.

    It rejects synthetic pictures, and the verdict and the exit code state this.
    """
    assert main(["build-index", "catalog/"]) == 0
    output = capsys.readouterr()
    assert output.out == ""
    assert f"model: {shipped_model()} (shipped; trained on the simulated rig" in output.err
    assert main(["query", "--gelsight", "a.png", "b.png"]) == 5
    output = capsys.readouterr()
    assert output.out == ""
    assert "trained on: simulated rig" in output.err
    assert output.err.splitlines()[-1].startswith(
        "not a gel image: an image of grasp 1 does not look like the gels of the model"
    )


@pytest.fixture
def built(workplace, model, capsys):
    """The workplace with an index of its catalogue."""
    main(["build-index", "catalog/", "--model", str(model)])
    capsys.readouterr()
    return workplace


QUERY = ["query", "--gelsight", "a.png", "b.png"]
NO_UNKNOWN_OBJECTS = ("--none-prior", "0")
"""Options of queries whose verdict does not matter: the fixture's model cannot distinguish objects."""


def test_the_exit_code_distinguishes_none_of_these_from_a_match(built, capsys):
    assert main([*QUERY, "--none-prior", "0.999", "--json"]) == 3
    output = capsys.readouterr()
    document = json.loads(output.out)
    assert document["verdict"] == "none of these"
    assert document["none_probability"] > 0.99
    assert len(document["results"]) == 8
    assert output.err.splitlines()[-1].endswith(document["advice"])
    assert main([*QUERY, *NO_UNKNOWN_OBJECTS, "--json"]) == 0
    output = capsys.readouterr()
    document = json.loads(output.out)
    assert (document["verdict"], document["none_probability"]) == ("match", 0.0)
    best = document["results"][0]
    last = f"match: {best['object_id']}, probability {best['probability']:.2f}; none of these: 0.00"
    assert output.err.splitlines()[-1] == last


def test_json_is_the_only_thing_on_stdout(workplace, model, capsys):
    main(["build-index", "catalog/", "--model", str(model), "--json"])
    assert json.loads(capsys.readouterr().out)["photos"] == 24
    assert main(["build-index", "catalog/"]) == 0
    assert capsys.readouterr().err.startswith(f"model: {model} (the one that index was built with)\n")
    query = [*QUERY, "--gelsight", "a2.png", "b2.png", "--top", "3", "--json"]
    assert main([*query, *NO_UNKNOWN_OBJECTS]) == 0
    document = json.loads(capsys.readouterr().out)
    touches = [["a.png", "b.png"], ["a2.png", "b2.png"]]
    assert document["query"] == {"touches": touches, "grasps": ["contact", "contact"]}
    assert [match["rank"] for match in document["results"]] == [1, 2, 3]


def test_html_is_written_in_addition_to_the_table_over_pages_only(built, capsys):
    for _ in range(2):
        assert main([*QUERY, "--html", "out.html", *NO_UNKNOWN_OBJECTS]) == 0
    assert "data:image/jpeg;base64," in Path("out.html").read_text()
    assert "rank  object" in capsys.readouterr().out
    for name in ("a.png", "index/CURRENT"):
        before = Path(name).read_bytes()
        assert main([*QUERY, "--html", name]) == 2
        assert f"{name} must be named *.html" in capsys.readouterr().err
        assert Path(name).read_bytes() == before


WRONG_USE = {
    "no index": (QUERY, "run `retrieve build-index CATALOGUE` first"),
    "not an image": (["query", "--gelsight", "a.png", "text.png", "--index", "index"], "text.png"),
    "no catalogue": (["build-index", "nowhere/"], "nowhere"),
    "no model": (["build-index", "catalog/", "--model", "none.safetensors"], "there is no checkpoint"),
    "no recording": (["train", "catalog/", "--out", "m.safetensors"], "recording.json"),
    "no checkpoint": (["train", "nowhere", "--out", "m.txt"], "*.safetensors"),
    "unknown data set": (["import", "imagenet", "src", "--out", "out"], "billets"),
    "unknown rig": (["collect", "--rig", "sawyer", "--out", "rec"], "one of real, sim"),
    "no rig file": (["collect", "--rig", "rig.toml", "--out", "rec"], "rig.toml cannot be read"),
    "not an empty folder": (["collect", "--out", "catalog"], "catalog contains other files"),
    "bad split": (["check", "catalog", "--split", "text.png"], "not a JSON file"),
}


@pytest.mark.parametrize("case", sorted(WRONG_USE))
def test_wrong_use_is_one_line_on_stderr_and_exit_code_2(case, workplace, model, capsys):
    Path("text.png").write_text("this is no picture")
    arguments, words = WRONG_USE[case]
    if "--index" in arguments:
        main(["build-index", "catalog/", "--model", str(model)])
        capsys.readouterr()
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    last = output.err.splitlines()[-1]
    assert last.startswith(f"retrieve {arguments[0]}: ")
    assert words in last


def test_an_unexpected_error_has_a_traceback_only_with_debug(workplace, monkeypatch, capsys):
    monkeypatch.setattr("retrieval.search.searcher.Searcher.open", lambda path, model: 1 / 0)
    assert main([*QUERY, "--index", "index"]) == 1
    assert "unexpected ZeroDivisionError" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):
        main(["--debug", *QUERY, "--index", "index"])


def test_verbose_shows_short_steps_too(workplace, capsys):
    assert main(["--verbose", "build-index", "catalog/"]) == 0
    assert re.search(r"^embedding: \d+ photos in ", capsys.readouterr().err, re.MULTILINE)
    assert main(["build-index", "catalog/"]) == 0
    assert "embedding" not in capsys.readouterr().err


@pytest.mark.parametrize("is_shown", [False, True])
@pytest.mark.parametrize("words", [["build-index", "catalog/"], ["build-index", "absent/"]])
def test_after_a_command_python_shows_as_much_progress_as_before(words, is_shown, workplace):
    show_progress(is_shown)
    main(["--verbose", *words])
    assert (Bar.is_on, Bar.is_verbose) == (is_shown, False)


def numeric_options(command, words=()):
    """Yield the words of each command with a value for its required parameters, and each of its numeric options."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from numeric_options(inner, (*words, name))
    required = [parameter.opts[0] for parameter in command.params if parameter.required]
    given = [f"{name}=nowhere" if name.startswith("-") else "nowhere" for name in required]
    for option in command.params:
        if option.type.name.split()[0] in ("int", "float"):
            yield (*words, *given), option.opts[0]


@pytest.mark.parametrize(("words", "option"), list(numeric_options(typer.main.get_command(application()))))
def test_the_command_line_rejects_numbers_out_of_range(words, option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for value in ("-1", "1" * 31, f"-{'1' * 31}", "inf", "-inf", "nan", "1e400"):
        assert main([*words, f"{option}={value}"]) == 2
        output = capsys.readouterr()
        (line,) = output.err.splitlines()
        assert f"Invalid value for '{option}'" in line
        assert re.search(r"it must (be .*|fit into 64 bits), got|is not a valid int", line)
        assert output.out == ""
    assert not list(tmp_path.iterdir())


def test_a_folder_in_place_of_an_output_file_is_refused_before_the_work(built, capsys):
    Path("page.html").mkdir()
    assert main([*QUERY, "--html", "page.html"]) == 2
    assert "page.html is a folder. Name a file." in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        [*QUERY, "--html", "none/there/x.html"],
        ["export", "--out", "none/m.onnx"],
        ["rig", "calibrate", "points.csv", "--out", "none/hand_eye.json"],
    ],
)
def test_no_folder_is_created_for_an_output_file(words, built, capsys):
    assert main(words) == 2
    assert f"the folder {Path(words[-1]).parent} does not exist" in capsys.readouterr().err
    assert not Path("none").exists()


def test_an_index_is_not_written_among_the_photos(workplace, model, capsys):
    (workplace / "link").symlink_to("catalog")
    (workplace / "catalog" / "cup").mkdir(exist_ok=True)
    shutil.copy("a.png", workplace / "catalog" / "cup" / "deep.png")
    before = sorted(workplace.rglob("*"))
    for out in ("catalog", "catalog/../catalog", "catalog/cup", "link"):
        assert main(["build-index", "catalog", "--model", str(model), "--out", out]) == 2
        assert f"the index would be written among the photos in {Path(out)}" in capsys.readouterr().err
    assert sorted(workplace.rglob("*")) == before
    for _ in range(2):  # but into a new folder among them, and again
        assert main(["build-index", "catalog", "--model", str(model), "--out", "catalog/index", "--preview"]) == 0
        assert "views.png" in capsys.readouterr().err


WRONG_WORDS = {
    "no command": ([], "retrieve: Missing command"),
    "an unknown command": (["fetch"], "retrieve: No such command 'fetch'"),
    "an unknown option": (["check", "rec", "--quick"], "retrieve check: No such option: --quick"),
    "no touch": (["query", "--top", "3"], "retrieve query: Missing option '--gelsight'"),
    "a forgotten folder": (["collect", "--out", "--preview"], "retrieve collect: --out needs a value"),
    "forgotten files": (["query", "--gelsight", "--json"], "retrieve query: --gelsight needs a value"),
    "no task of rig": (["rig"], "retrieve rig: Missing command"),
}


@pytest.mark.parametrize("case", sorted(WRONG_WORDS))
def test_unparsable_arguments_are_one_line_on_stderr_and_exit_code_2(case, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = WRONG_WORDS[case]
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    (line,) = output.err.splitlines()
    assert words in line
    assert line.endswith("; see --help")


def test_an_option_of_several_values_takes_the_words_up_to_the_next_option(monkeypatch):
    calls = []
    monkeypatch.setattr(Command, "invoke", lambda self, context: calls.append(context.params))
    words = ["--gelsight", "a.png", "b.png", "--top", "3", "--gelsight", "a2.png", "b2.png", "--background", "n.png"]
    assert main(["query", *words]) == 0
    assert main(["query", "--gelsight=a.png", "--index", "-1"]) == 0
    assert main(["frontier", "--out", "o", "--only", "closing", "contact", "--json"]) == 0
    assert tuple(calls[0]["gelsight"]) == (("a.png", "b.png"), ("a2.png", "b2.png"))
    assert (calls[0]["background"], calls[0]["top"]) == (("n.png",), 3)
    assert (tuple(calls[1]["gelsight"]), calls[1]["index"]) == ((("a.png",),), "-1")
    assert (calls[2]["only"], calls[2]["json"]) == (("closing", "contact"), True)


def test_the_package_runs_the_command_line():
    command = [sys.executable, "-m", "retrieval", "train", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Usage: retrieve train ")


def test_check_prints_the_licence_and_exits_with_1_if_it_finds_errors(tmp_path, capsys):
    recording = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(3), 2)
    assert main(["check", str(recording)]) == 0
    assert "licence of the data: not stated" in capsys.readouterr().err.splitlines()
    about = recording / "recording.json"
    about.write_text(json.dumps(json.loads(about.read_text()) | {"licence": "CC BY 4.0", "terms": "name the authors"}))
    min((recording / "images").glob("*touch_a.png")).write_bytes(b"")
    assert main(["check", str(recording), "--json"]) == 1
    output = capsys.readouterr()
    document = json.loads(output.out)
    assert document["licence"]["licence"] == "CC BY 4.0"
    assert document["findings"][0]["kind"] == "broken"
    assert "licence of the data: CC BY 4.0 (name the authors)" in output.err.splitlines()
    assert "is not suitable for training" in output.err


COLLECT = ["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--grasps", "2"]
COLLECT += ["--seed", "3", "--out", "rec"]


def test_a_trained_gate_decides_which_grasps_are_accepted(workplace, capsys):
    more = ["--objects", "8", "--grasps", "4"]
    assert main([*COLLECT, *more]) == 0
    gate = ["train", "rec", "--task", "grasp-success", "--out", "gate.safetensors"]
    assert main([*gate, "--iterations", "3"]) == 0
    assert main([*COLLECT[:-1], "gated", "--gate", "gate.safetensors"]) in (0, 1)
    info = json.loads(Path("gated/recording.json").read_text())
    assert info["collection"]["gate"].startswith("learned, sha256 ")
    assert main([*COLLECT[:-1], "gated"]) == 2
    assert "was collected with gate 'learned" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["collect", "--out", "r", "--dry-run", "--preview"], "--preview has no effect with --dry-run"),
        (["serve", "--index", "i", "--no-history", "--history", "h"], "--history contradicts --no-history"),
        (["build-index", "catalog/", "--cluster"], "give --shards too"),
    ],
)
def test_an_option_that_would_be_ignored_is_wrong_use(words, message, workplace, capsys):
    before = set(workplace.iterdir())
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert set(workplace.iterdir()) == before


def test_a_reader_that_closes_the_pipe_early_causes_no_error_message():
    command = f"{sys.executable} -m retrieval import | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == ""
