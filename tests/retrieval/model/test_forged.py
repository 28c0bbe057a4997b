"""Forged rows of an index, and file names that no disk accepts: each gives a one-line error."""

import pytest

from indexes.errors import CorruptIndex
from indexes.store.rows import Row
from retrieval.commands.main import main
from retrieval.search.objects import listed_photo

ROW = Row("mug/1.jpg", "mug", "0")


@pytest.mark.parametrize("path", ["../../etc/passwd", "mug/../../secret.png", "/etc/passwd", "a\0.png", ""])
def test_a_row_with_a_photo_outside_the_catalogue_is_refused(path):
    assert listed_photo(ROW).path == "mug/1.jpg"
    with pytest.raises(CorruptIndex):
        listed_photo(Row(path, "mug", "0"))


def test_file_names_that_no_disk_accepts_give_a_one_line_error(tmp_path, capsys):
    name = "n" * 10_000
    commands = [
        ["check", name],
        ["query", "--gelsight", name, "--index", name],
        ["build-index", name],
        ["train", name, "--out", str(tmp_path / "m.safetensors")],
        ["evaluate", name, "--out", str(tmp_path / "report")],
        ["import", "billets", name, "--out", name],
        ["rig", "calibrate", name],
        ["rig", "check", "--rig", f"{name}.toml"],
        ["collect", "--out", name],
        ["demo", "--out", name],
        ["export", name],
    ]
    for command in commands:
        code, lines = main(command), capsys.readouterr().err.splitlines()
        assert (code, [line for line in lines if "unexpected" in line]) == (2, []), command
