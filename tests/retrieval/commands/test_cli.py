"""The command line as users meet it: the commands exactly as documented, exit codes, one-line errors, clean stdout."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from indexes import KINDS
from retrieval.commands.main import app, main
from retrieval.commands.options import Command
from retrieval.errors import BadInput
from retrieval.frontier import APPROXIMATIONS
from retrieval.methods import METHODS
from retrieval.search import defaults
from tests.meshes import box, sphere, stl


@pytest.fixture
def workplace(tmp_path, catalogue, touch, monkeypatch):
    """A folder with `catalog/`, `a.png` and `b.png`, as in the README, and the current one."""
    shutil.copytree(catalogue, tmp_path / "catalog")
    for name, path in zip(("a.png", "b.png"), touch, strict=True):
        shutil.copy(path, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_two_commands_work_exactly_as_written(workplace, capsys):
    """With nothing trained before: the shipped model serves, and the output says so.

    Drawn pictures are nothing that it knows, and that is said as well, in words and by the exit code.
    """
    assert main(["build-index", "catalog/"]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert f"model: {defaults.shipped_model()} (shipped; trained on the simulated rig" in said.err
    assert main(["query", "--gelsight", "a.png", "b.png"]) == 5
    said = capsys.readouterr()
    assert said.out == ""
    assert "trained on: simulated rig" in said.err
    assert said.err.splitlines()[-1].startswith("not a gel image: what was given for grasp 1 does not look like a gel")


@pytest.fixture
def built(workplace, model, capsys):
    """That folder with an index of its catalogue."""
    main(["build-index", "catalog/", "--model", str(model)])
    capsys.readouterr()
    return workplace


QUERY = ["query", "--gelsight", "a.png", "b.png"]
EVERY_OBJECT_IS_KNOWN = ("--none-prior", "0")
"""What a query is given where its verdict is not the point; the fixture's model can tell nothing apart."""


def test_the_exit_code_tells_none_of_these_from_a_match(built, capsys):
    assert main([*QUERY, "--none-prior", "0.999", "--json"]) == 3
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["verdict"] == "none of these"
    assert document["none_probability"] > 0.99
    assert len(document["results"]) == 8
    best = document["results"][0]
    assert said.err.splitlines()[-1] == (
        f"none of these: the catalogue lacks the object with probability {document['none_probability']:.2f}; if it has "
        f"the object, this is {best['object_id']} with probability {best['probability_if_present']:.2f}. "
        f"{document['advice']}"
    )
    assert main([*QUERY, *EVERY_OBJECT_IS_KNOWN, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["verdict"], document["none_probability"]) == ("match", 0.0)
    best = document["results"][0]
    last = f"match: {best['object_id']}, probability {best['probability']:.2f}; none of these: 0.00"
    assert said.err.splitlines()[-1] == last


def test_a_prior_of_1_is_wrong_use(built, capsys):
    assert main([*QUERY, "--none-prior=1"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert 'the prior of "none of these" must be at least 0 and less than 1; got 1.0' in said.err


def test_an_index_built_elsewhere_is_found_again_from_where_it_was_built_only(workplace, model, capsys, monkeypatch):
    assert main(["build-index", "catalog/", "--model", str(model), "--out", "away/index"]) == 0
    assert main([*QUERY, *EVERY_OBJECT_IS_KNOWN]) == 0
    assert f"index: {workplace / 'away/index'} (the last one built from this folder)" in capsys.readouterr().err
    monkeypatch.chdir(workplace / "away" / "index")
    assert main(["query", "--gelsight", "../../a.png", "../../b.png"]) == 2
    assert "there is no index in this folder" in capsys.readouterr().err


def test_the_first_line_says_which_model_serves_and_a_training_elsewhere_changes_nothing(
    workplace, model, capsys, monkeypatch
):
    defaults.remember("model", model)
    (workplace / "elsewhere").mkdir()
    monkeypatch.chdir(workplace / "elsewhere")
    assert main(["build-index", "../catalog"]) == 0
    assert capsys.readouterr().err.startswith(f"model: {defaults.shipped_model()} (shipped; ")
    monkeypatch.chdir(workplace)
    assert main(["build-index", "catalog/"]) == 0
    assert capsys.readouterr().err.startswith(f"model: {model} (the last one trained in this folder)\n")


def test_a_built_index_is_built_again_with_its_own_model(workplace, model, capsys):
    assert main(["build-index", "catalog/", "--model", str(model)]) == 0
    capsys.readouterr()
    assert main(["build-index", "catalog/"]) == 0
    assert capsys.readouterr().err.startswith(f"model: {model} (the one that index was built with)\n")


def test_json_is_the_only_thing_on_stdout_and_has_the_documented_keys(workplace, model, capsys):
    main(["build-index", "catalog/", "--model", str(model), "--json"])
    assert json.loads(capsys.readouterr().out)["photos"] == 24
    query = [*QUERY, "--gelsight", "a.png", "b.png", "--top", "3", "--json"]
    assert main([*query, *EVERY_OBJECT_IS_KNOWN]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {
        *("query", "index", "timing_ms", "verdict", "none_probability", "posterior", "results"),
        *("more_grasps", "advice", "unlisted_probability", "information"),
    }
    touches = [["a.png", "b.png"], ["a.png", "b.png"]]
    assert document["query"] == {"touches": touches, "grasps": ["contact", "contact"]}
    assert set(document["posterior"]) == {
        *("formula", "slope", "offset", "dependence", "tests"),
        *("none_prior", "grasps", "objects", "scored_objects", "unscored_probability"),
    }
    assert set(document["timing_ms"]) == {"decode", "encode", "candidates", "rerank", "total"}
    assert [match["rank"] for match in document["results"]] == [1, 2, 3]
    probabilities = ("probability", "probability_if_present")
    assert set(document["results"][0]) == {"rank", "object_id", "logit", *probabilities, "photo", "metadata"}


def test_html_is_written_beside_the_table(built, capsys):
    assert main([*QUERY, "--html", "out.html", *EVERY_OBJECT_IS_KNOWN]) == 0
    assert "data:image/jpeg;base64," in Path("out.html").read_text()
    assert main([*QUERY, "--html", "out.html", *EVERY_OBJECT_IS_KNOWN]) == 0


@pytest.mark.parametrize("name", ["a.png", "index/CURRENT", "index/gen-000001/manifest.json", "own.html"])
def test_html_is_written_over_no_file_of_another_kind(built, capsys, name):
    Path("own.html").write_text("<!doctype html><title>mine</title>")
    before = Path(name).read_bytes()
    assert main([*QUERY, "--index", "index", "--html", name]) == 2
    assert f"{name} is not a page that this program wrote" in capsys.readouterr().err
    assert Path(name).read_bytes() == before


WRONG_USE = {
    "no index": (QUERY, "run `retrieve build-index CATALOGUE` first"),
    "one gel image": (
        ["query", "--gelsight", "a.png", "--index", "index"],
        "takes 2 gel image(s) for one touch; got 1",
    ),
    "no such image": (["query", "--gelsight", "a.png", "none.png", "--index", "index"], "none.png"),
    "not an image": (["query", "--gelsight", "a.png", "text.png", "--index", "index"], "text.png"),
    "no catalogue": (["build-index", "nowhere/"], "nowhere"),
    "no model": (["build-index", "catalog/", "--model", "none.safetensors"], "there is no checkpoint"),
    "unknown kind": (["build-index", "catalog/", "--kind", "tree"], "flat"),
    "no recording": (["train", "catalog/", "--out", "m.safetensors"], "recording.json"),
    "no preset": (["train", "catalog/", "--out", "m.safetensors", "--config", "huge"], "small"),
    "unknown data set": (["import", "imagenet", "src", "--out", "out"], "billets"),
    "unknown rig": (["collect", "--rig", "sawyer", "--out", "rec"], "one of real, sim"),
    "no rig file": (["collect", "--rig", "rig.toml", "--out", "rec"], "rig.toml cannot be read"),
    "no grasps": (["collect", "--grasps", "0", "--out", "rec"], "grasps"),
    "too many objects": (["collect", "--objects", "100001", "--out", "rec"], "at most 100000 objects"),
    "no such gate": (["collect", "--gate", "none.safetensors", "--out", "rec"], "none.safetensors"),
    "not an empty folder": (["collect", "--out", "catalog"], "catalog holds other files"),
    "nothing to check": (["check", "nowhere"], "nowhere"),
    "bad split": (["check", "catalog", "--split", "text.png"], "not a JSON file"),
    "no split file": (["check", "catalog", "--split", "none.json"], "none.json"),
}


@pytest.mark.parametrize("case", sorted(WRONG_USE))
def test_wrong_use_is_one_line_on_stderr_and_exit_code_2(case, workplace, model, capsys):
    Path("text.png").write_text("this is no picture")
    arguments, words = WRONG_USE[case]
    if "--index" in arguments:
        main(["build-index", "catalog/", "--model", str(model)])
        capsys.readouterr()
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    last = said.err.strip().splitlines()[-1]
    assert last.startswith(f"retrieve {arguments[0]}: ")
    assert words in last
    assert "Traceback" not in said.err


def test_an_unexpected_error_is_no_traceback_unless_debug_is_asked_for(workplace, monkeypatch, capsys):
    monkeypatch.setattr(defaults, "find_index", lambda given: 1 / 0)
    assert main(["query", "--gelsight", "a.png"]) == 1
    assert "unexpected ZeroDivisionError" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):
        main(["--debug", "query", "--gelsight", "a.png"])


def numeric_options():
    """Of every command: its words, what else it must be given, and each option that takes a number."""

    def walk(command, words):
        for name, inner in getattr(command, "commands", {}).items():
            yield from walk(inner, [*words, name])
        for each in getattr(command, "params", ()):
            if each.type.name.split()[0] in ("int", "float"):
                yield pytest.param(words, command, each, id=f"{' '.join(words)} {each.opts[0]}")

    return list(walk(typer.main.get_command(app), []))


def needed(command):
    """Words for what a command must be given: nothing is there, so that whatever is read first is refused too."""
    for each in command.params:
        if each.required:
            yield from [each.opts[0], "nowhere"] if each.opts[0].startswith("-") else ["nowhere"]


@pytest.mark.parametrize(("words", "command", "option"), numeric_options())
def test_no_number_outside_its_range_passes_the_command_line(words, command, option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    low, high = option.type.func.low, option.type.func.high
    wrong = [low - 1, high + 1, "1" * 31, f"-{'1' * 31}", "inf", "-inf", "nan", "1e400"]
    for value in wrong:
        assert main([*words, *needed(command), f"{option.opts[0]}={value}"]) == 2
        said = capsys.readouterr()
        (line,) = said.err.splitlines()
        assert f"Invalid value for '{option.opts[0]}'" in line
        assert line.endswith(
            (f"{value} is not from {low} to {high}; see --help", f"{value!r} is not a valid int; see --help")
        )
        assert said.out == ""
    assert not list(tmp_path.iterdir())


def test_the_test_above_finds_the_options_that_take_numbers():
    assert {"serve --deadline", "query --top", "benchmark real --seeds"} <= {one.id for one in numeric_options()}
    assert len(numeric_options()) > 30


def test_the_naive_range_of_a_library_admits_nan():
    assert not float("nan") < 0
    assert not float("nan") > 1


@pytest.mark.parametrize("length", [501, 5000])
def test_a_long_message_is_cut_in_its_middle_and_keeps_what_to_do(length, monkeypatch, capsys):
    def fail(given):
        raise BadInput("x" * length + "; do this")

    monkeypatch.setattr(defaults, "find_index", fail)
    assert main(["query", "--gelsight", "a.png"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert len(line) < 540
    assert line.startswith("retrieve query: xxx")
    assert line.endswith("x; do this")


@pytest.mark.parametrize(
    "words", [["import", "imagenet", "src", "--out", "o"], ["benchmark", "real", "empty", "--out", "report"]]
)
def test_an_error_is_one_line_where_much_could_be_listed(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert main(words) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


@pytest.mark.parametrize(
    "words",
    [
        [*QUERY, "--html", "none/there/x.html"],
        ["export", "--out", "none/m.onnx"],
        ["rig", "calibrate", "points.csv", "--out", "none/hand_eye.json"],
    ],
)
def test_no_folder_is_made_for_a_file_that_is_to_be_written(words, built, capsys):
    assert main(words) == 2
    assert f"there is no folder {Path(words[-1]).parent}; make it" in capsys.readouterr().err
    assert not Path("none").exists()


@pytest.mark.parametrize("out", ["catalog", "catalog/", "catalog/../catalog", "catalog/cup", "link"])
def test_an_index_is_not_written_among_the_photos(out, workplace, model, capsys):
    (workplace / "link").symlink_to("catalog")
    (workplace / "catalog" / "cup").mkdir(exist_ok=True)
    shutil.copy("a.png", workplace / "catalog" / "cup" / "deep.png")
    before = sorted(workplace.rglob("*"))
    assert main(["build-index", "catalog", "--model", str(model), "--out", out]) == 2
    assert f"the index would be written among the photos in {out}" in capsys.readouterr().err
    assert sorted(workplace.rglob("*")) == before


def test_an_index_may_lie_in_a_folder_of_its_own_in_the_catalogue(workplace, model, capsys, monkeypatch):
    monkeypatch.chdir("catalog")
    for photos in (24, 24):
        assert main(["build-index", ".", "--model", str(model), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["photos"] == photos
    assert main(["build-index", ".", "--model", str(model), "--preview"]) == 2
    assert "would be a photo of the catalogue" in capsys.readouterr().err


@pytest.mark.parametrize("task", ["match", "relief", "grasp-success"])
def test_a_checkpoint_of_another_name_is_refused_before_anything_is_read(task, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "nowhere", "--task", task, "--out", "m.txt"]) == 2
    assert "must be named *.safetensors, such as m.safetensors; got m.txt" in capsys.readouterr().err


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
def test_a_history_that_is_no_file_is_refused(make, built, capsys):
    Path("kept").mkdir()
    make("kept/history.sqlite")
    assert main(["serve", "--index", "index", "--history", "kept", "--port", "0"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"kept/history.sqlite must be the history of a service: is a (folder|pipe), not a", last)


def test_a_history_whose_folder_is_a_file_is_refused(built, capsys):
    assert main(["serve", "--index", "index", "--history", "a.png", "--port", "0"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("retrieve serve: the history must be a folder, but a.png is")


WRONG_WORDS = {
    "no command": ([], "retrieve: Missing command"),
    "an unknown command": (["fetch"], "retrieve: No such command 'fetch'"),
    "an unknown option": (["check", "rec", "--quick"], "retrieve check: No such option: --quick"),
    "an argument too many": (["check", "rec", "rec2"], "retrieve check: Got unexpected extra argument(s) (rec2)"),
    "none at all": (["check"], "retrieve check: Missing argument 'recording'"),
    "no touch": (["query", "--top", "3"], "retrieve query: Missing option '--gelsight'"),
    "no number": (["query", "--gelsight", "a.png", "--top", "few"], "retrieve query: Invalid value for '--top'"),
    "no choice": (["train", "rec", "--out", "m", "--task", "swim"], "is not one of 'match', 'relief', 'grasp-success'"),
    "a forgotten folder": (["collect", "--out", "--preview"], "retrieve collect: --out needs a value"),
    "forgotten files": (["query", "--gelsight", "--json"], "retrieve query: --gelsight needs a value"),
    "a forgotten word": (["rig", "check", "--rig"], "retrieve rig: --rig needs a value"),
    "no task": (["rig"], "retrieve rig: Missing command"),
}


@pytest.mark.parametrize("case", sorted(WRONG_WORDS))
def test_wrong_words_are_one_line_on_stderr_and_exit_code_2(case, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = WRONG_WORDS[case]
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert words in line
    assert line.startswith("retrieve")
    assert line.endswith("; see --help")
    assert not list(tmp_path.iterdir())


def test_an_option_of_several_values_takes_the_words_up_to_the_next_option(monkeypatch):
    given = []
    monkeypatch.setattr(Command, "invoke", lambda self, context: given.append(context.params))
    words = ["--gelsight", "a.png", "b.png", "--top", "3", "--gelsight", "a2.png", "b2.png", "--background", "n.png"]
    assert main(["query", *words]) == 0
    assert main(["query", "--gelsight=a.png", "--index", "-1"]) == 0
    assert main(["frontier", "--out", "o", "--only", "closing", "contact", "--quick"]) == 0
    assert tuple(given[0]["gelsight"]) == (("a.png", "b.png"), ("a2.png", "b2.png"))
    assert (given[0]["background"], given[0]["top"]) == (("n.png",), 3)
    assert (tuple(given[1]["gelsight"]), given[1]["index"]) == ((("a.png",),), "-1")
    assert (given[2]["only"], given[2]["quick"]) == (("closing", "contact"), True)


def test_the_package_is_the_command_line_too():
    asked = [sys.executable, "-m", "retrieval", "train", "--help"]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Usage: retrieve train ")


@pytest.mark.parametrize(
    ("command", "choices"),
    [
        ("train", ["match|relief|grasp-success"]),
        ("build-index", KINDS),
        ("evaluate", METHODS),
        ("frontier", APPROXIMATIONS),
    ],
)
def test_help_lists_what_there_is_to_choose_from(command, choices, capsys):
    assert main([command, "--help"]) == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    assert set(choices) <= {word.strip("<>") for word in words}


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("build", ["build-index"]),
        ("rig ca", ["calibrate"]),
        ("train rec --task g", ["grasp-success"]),
        ("query --gelsight a.png b.png --to", ["--top"]),
    ],
)
def test_a_shell_completes_commands_options_and_choices(words, completed):
    asked = {"COMP_WORDS": f"retrieve {words}", "COMP_CWORD": str(len(words.split()))}
    assert complete("complete_bash", **asked).split() == completed


def test_the_script_for_a_shell_names_the_program():
    assert "complete -o default -F _retrieve_completion retrieve" in complete("source_bash")


def complete(what, **asked):
    """What the program answers a shell."""
    environment = {**os.environ, "_RETRIEVE_COMPLETE": what, **asked}
    done = subprocess.run(
        [sys.executable, "-m", "retrieval"], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.parametrize("option", ["--show-completion", "--install-completion"])
def test_completion_is_shown_and_installed_for_a_named_shell(option, tmp_path):
    """As typer lets tests name the shell, which else is that of the process above."""
    environment = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1", "HOME": str(tmp_path)}
    asked = [sys.executable, "-m", "retrieval", option, "bash"]
    done = subprocess.run(asked, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    script = done.stdout if option == "--show-completion" else (tmp_path / ".bash_completions/retrieve.sh").read_text()
    assert "complete -o default -F _retrieve_completion retrieve" in script


def test_check_leaves_with_1_when_it_finds_errors(recording, tmp_path, capsys):
    assert main(["check", str(recording)]) == 0
    broken = tmp_path / "recording"
    shutil.copytree(recording, broken)
    next(iter(sorted((broken / "images").glob("*touch_a.png")))).write_bytes(b"")
    assert main(["check", str(broken), "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["findings"][0]["kind"] == "broken"
    assert "is not fit for training" in said.err


def test_the_whole_job_from_recording_to_ranking(recording, workplace, capsys):
    config = workplace / "tiny.toml"
    config.write_text(
        '[matcher]\ntower = "small"\ntower_output = "pooled"\nhidden = 16\nembedding_dim = 8\n'
        '[training]\ninit = "random"\niterations = 2\ntouches_per_batch = 2\nvalidation_fraction = 0.25\n'
    )
    assert main(["train", str(recording), "--out", "m.safetensors", "--config", "tiny.toml", "--seed", "3"]) == 0
    assert "kept step 2" in capsys.readouterr().err
    assert main(["build-index", "catalog"]) == 0
    assert f"model: {workplace / 'm.safetensors'} (the last one trained in this folder)" in capsys.readouterr().err
    assert main([*QUERY, "--json", *EVERY_OBJECT_IS_KNOWN]) == 0
    assert len(json.loads(capsys.readouterr().out)["results"]) == 8


COLLECT = ["collect", "--rig", "tests.fake_rig:FakeRig", "--objects", "2", "--grasps", "2"]
COLLECT += ["--seed", "3", "--out", "rec"]


def test_a_recording_is_collected_and_its_acceptance_printed(workplace, capsys):
    assert main(COLLECT) == 0
    said = capsys.readouterr()
    assert said.out == ""
    lines = said.err.splitlines()
    assert "accepted  of  held  missed  slipped  no_plan" in said.err
    assert any(line.startswith("round-0") for line in lines)
    assert lines[-1] == "rec: 4 accepted grasps of 2 objects"
    assert "2 of 2 objects" in said.err
    assert main(COLLECT) == 0  # nothing is left to do


def test_what_was_collected_with_other_options_is_not_gone_on_with(workplace, capsys):
    main(COLLECT)
    capsys.readouterr()
    assert main([*COLLECT, "--seed", "4"]) == 2
    assert "rec was collected with seed 3, not 4" in capsys.readouterr().err


def test_ctrl_c_while_collecting_says_how_to_go_on(workplace, capsys, monkeypatch):
    from tests.fake_rig import FakeGripper

    def interrupted(self, force_n, speed_mm_s):
        raise KeyboardInterrupt

    monkeypatch.setattr(FakeGripper, "_grasp", interrupted)
    assert main(COLLECT) == 1
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "what was collected is whole in rec; the same command goes on with it",
        "retrieve collect: stopped by Ctrl-C",
    ]
    monkeypatch.undo()


def test_the_preview_of_the_folder_one_stands_in_lies_beside_it(workplace, capsys, monkeypatch):
    """Path(".") has no name to which something could be added."""
    Path("rec").mkdir()
    monkeypatch.chdir("rec")
    assert main(["collect", "--objects", "1", "--grasps", "1", "--out", ".", "--preview"]) == 0
    assert Path("../rec-preview.png").is_file()


def test_collecting_nothing_is_a_failure_that_says_where_to_look(workplace, capsys, monkeypatch):
    monkeypatch.setattr("tests.fake_rig.FakeRig.object_ids", lambda self, count: ["wide-0"])
    assert main(COLLECT) == 1
    assert "no grasp was accepted; rec/attempts.jsonl says why" in capsys.readouterr().err


def test_meshes_that_cannot_be_grasped_are_named_and_the_others_are_collected(tmp_path, monkeypatch, capsys):
    pytest.importorskip("trimesh", reason="needs touch-retrieval[mesh]")
    pytest.importorskip("embreex", reason="needs touch-retrieval[mesh]")
    monkeypatch.chdir(tmp_path)
    Path("meshes").mkdir()
    Path("rig.toml").write_text('rig = "sim"\nmeshes = "meshes"\n')
    (globe, faces), collect = sphere(20), ["collect", "--rig", "rig.toml", "--grasps", "1", "--seed", "1"]
    stl(Path("meshes/a_globe.stl"), 80 * globe, faces)
    stl(Path("meshes/b_box.stl"), *box(60, 90, 120))
    stl(Path("meshes/c_box.stl"), *box(50, 70, 100))
    assert main([*collect, "--objects", "3", "--out", "rec"]) == 0
    lines = capsys.readouterr().err.splitlines()
    named = [line for line in lines if "skipped: wider than the gripper opens: 15" in line]
    assert [line.split("-")[0] for line in named] == ["mesh.a_globe"]
    assert lines[-1] == "rec: 2 accepted grasps of 2 objects, 1 skipped"
    assert main([*collect, "--objects", "1", "--out", "none"]) == 1
    assert capsys.readouterr().err.splitlines()[-1].endswith("no grasp was accepted; none/attempts.jsonl says why")


def test_a_gate_is_trained_and_decides_what_is_kept(workplace, capsys):
    more = ["--objects", "8", "--grasps", "4"]
    assert main([*COLLECT, *more]) == 0
    gate = ["train", "rec", "--task", "grasp-success", "--out", "gate.safetensors"]
    assert main([*gate, "--iterations", "3"]) == 0
    assert "accuracy" in capsys.readouterr().err
    assert main([*COLLECT[:-1], "gated", "--gate", "gate.safetensors"]) in (0, 1)
    info = json.loads(Path("gated/recording.json").read_text())
    assert info["collection"]["gate"].startswith("learned, sha256 ")
    assert main([*COLLECT[:-1], "gated"]) == 2
    assert "was collected with gate 'learned" in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--config", "paper"], ["--resume"], ["--split", "s.json"], ["--init", "random"]])
def test_a_gate_takes_no_option_of_matchers(option, workplace, capsys):
    assert main(["train", "rec", "--task", "grasp-success", "--out", "g.safetensors", *option]) == 2
    assert f"{option[0]} is of matchers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["collect", "--out", "r", "--dry-run", "--preview"], "--preview is of a collection; --dry-run moves and"),
        (["serve", "--index", "i", "--replicas", "2"], "--replicas is for shards that Ray holds; give --cluster too"),
        (["serve", "--index", "i", "--min-share", "0"], "--min-share is for shards that Ray holds"),
        (["serve", "--index", "i", "--no-history", "--history", "h"], "--history names where to keep what"),
        (["build-index", "catalog/", "--max-unreadable", "0.1"], "give --shards too"),
        (["build-index", "catalog/", "--cluster"], "give --shards too"),
    ],
)
def test_an_option_that_would_be_ignored_is_wrong_use(words, said, workplace, capsys):
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in workplace.iterdir()) == ["a.png", "b.png", "catalog"]


def test_a_reader_that_leaves_early_is_no_error_message(built):
    query = [sys.executable, "-m", "retrieval", *QUERY, "--index", "index"]
    done = subprocess.run(f"{' '.join(query)} | true", shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert "Broken pipe" not in done.stderr


def test_closed_streams_neither_stop_a_command_nor_dirty_stdout(built):
    """Python's print falls back to stdout where stderr is closed."""
    query = f"{sys.executable} -m retrieval query --gelsight a.png b.png --index index --json --none-prior 0"
    done = subprocess.run(f"{query} 2>&-", shell=True, capture_output=True, text=True, check=False)
    assert (done.returncode, len(json.loads(done.stdout)["results"])) == (0, 8)
    assert subprocess.run(f"{query} >&- 2>&-", shell=True, check=False).returncode == 0


def test_ctrl_c_that_comes_out_as_another_error_is_still_ctrl_c(monkeypatch, capsys):
    """Breaking off the import of numpy.linalg ends in a RecursionError."""

    def interrupted(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RecursionError from None

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("retrieval.data.check.recording.check_recording", interrupted)
    assert main(["check", "recording"]) == 1
    assert capsys.readouterr().err == "retrieve check: stopped by Ctrl-C\n"
    assert signal.getsignal(signal.SIGINT) is before
