"""Forged checkpoints, settings and indexes: well formed but unusable. Each gives a one-line error."""

import contextlib
import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from indexes.errors import CorruptIndex
from indexes.store.rows import Row
from retrieval.commands.main import main
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint import load_checkpoint, read_tensors, write_tensors
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.search.objects import listed_photo
from retrieval.training.gate import load_gate
from tests.retrieval.model.test_checkpoint import save

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@pytest.fixture
def saved(tmp_path):
    save(tmp_path / "m.safetensors")
    return tmp_path / "m.safetensors"


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A checkpoint like `saved`, for examples that write elsewhere."""
    path = tmp_path_factory.mktemp("template") / "m.safetensors"
    save(path)
    return path


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    part=st.sampled_from(["config", "split", "calibration", "provenance", "format", "software", "task"]),
    value=JSON,
)
def test_any_part_of_a_header_may_be_forged(template, part, value):
    forged = template.with_name("forged.safetensors")
    state, header = read_tensors(template)
    write_tensors(forged, state, header | {part: value})
    for read in (load_checkpoint, read_checkpoint_info, load_gate):
        with contextlib.suppress(BadInput):
            read(forged)


def test_a_checkpoint_that_is_not_a_regular_file_is_refused_without_being_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero", "."):
        for read in (load_checkpoint, read_checkpoint_info, load_gate):
            with pytest.raises(CheckpointError, match=r"not a regular file|is a folder, not a file"):
                read(tmp_path / name)


# Rows of an index -------------------------------------------------------------------------------------------


ROW = Row("mug/1.jpg", "mug", "0")


@pytest.mark.parametrize("path", ["../../etc/passwd", "mug/../../secret.png", "/etc/passwd", "a\0.png", ""])
def test_a_row_with_a_photo_outside_the_catalogue_is_refused(path):
    assert listed_photo(ROW).path == "mug/1.jpg"
    with pytest.raises(CorruptIndex):
        listed_photo(Row(path, "mug", "0"))


# Commands ---------------------------------------------------------------------------------------------------


def test_file_names_that_no_disk_accepts_give_a_one_line_error(tmp_path, capsys):
    name = "n" * 10_000
    commands = [
        ["check", name],
        ["check", str(tmp_path), "--split", name],
        ["query", "--gelsight", name, "--index", name],
        ["build-index", name],
        ["build-index", str(tmp_path), "--model", name],
        ["train", name, "--out", str(tmp_path / "m.safetensors")],
        ["train", str(tmp_path), "--out", name],
        ["evaluate", name, "--out", str(tmp_path / "report")],
        ["evaluate", str(tmp_path), "--out", name],
        ["import", "billets", name, "--out", name],
        ["rig", "calibrate", name],
        ["rig", "check", "--rig", f"{name}.toml"],
        ["collect", "--out", name],
        ["collect", "--out", str(tmp_path / "r"), "--gate", name],
        ["demo", "--out", name],
        ["frontier", "--out", name],
        ["export", name],
    ]
    for command in commands:
        code, lines = main(command), capsys.readouterr().err.splitlines()
        assert (code, [line for line in lines if "unexpected" in line]) == (2, []), command
        assert len(lines[-1]) < 540, command
