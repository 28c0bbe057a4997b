"""`make demo` and the score of the shipped checkpoint, in small."""

import os
from pathlib import Path

from tests import demo


def test_the_demo_ends_with_a_table_and_a_page_and_a_second_run_makes_nothing_again(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    users = Path(os.environ["XDG_STATE_HOME"])
    monkeypatch.setenv("XDG_STATE_HOME", str(users))  # put back after the demo has set its own
    small = ["demo", "--objects", "14", "--iterations", "1"]
    assert demo.main(small) == 0
    said = capsys.readouterr()
    assert "Which object is in the hand?" in said.out
    assert "drawn test pictures" in said.err
    assert "data:image/jpeg;base64," in Path("demo/query.html").read_text()
    trained = Path("demo/model.safetensors").stat().st_mtime_ns
    assert list(users.iterdir()) == []
    assert demo.main(small) == 0
    assert "0 embedded, 60 unchanged" in capsys.readouterr().err
    assert Path("demo/model.safetensors").stat().st_mtime_ns == trained


def test_the_shipped_checkpoint_is_far_above_chance_on_objects_it_never_saw(capsys):
    assert demo.main(["score", "--objects", "13", "--grasps", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    first_guess = next(line for line in lines if line.startswith("| K=5"))
    assert float(first_guess.split("|")[2]) > 0.5
