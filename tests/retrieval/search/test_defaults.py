"""The default model and index of a command."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from _touch_retrieval.files import file_digest
from indexes.store.folder import IndexStore
from indexes.store.rows import Row
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.search import defaults

AT_IMPORT = defaults._state_file()


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def nothing_shipped(tmp_path, monkeypatch):
    monkeypatch.setattr(defaults, "shipped_model", lambda: tmp_path / "none.safetensors")


def state_file():
    return Path(os.environ["XDG_STATE_HOME"]) / "touch-retrieval" / "last.json"


def an_index(folder):
    folder.mkdir(parents=True)
    (folder / "CURRENT").write_text("gen-000001")
    return folder


def test_a_file_in_place_of_an_index_raises(tmp_path):
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(BadInput, match=r"model\.safetensors is a file; an index is a folder"):
        defaults.find_index(str(tmp_path / "model.safetensors"))


def test_shipped_models_are_selected_by_their_number_of_fingers():
    assert defaults.find_model("shipped")[0] == defaults.shipped_model()
    assert defaults.find_model("shipped-one-finger")[0] == defaults.shipped_model(1)
    for fingers in (1, 2):
        assert read_checkpoint_info(defaults.shipped_model(fingers)).config.matcher.fingers == fingers
    with pytest.raises(BadInput, match="take touches of 1 or 2 gel images; got 3"):
        defaults.shipped_model(3)


def shipped_in(folder, monkeypatch):
    shipped = folder / "shipped.safetensors"
    shipped.write_bytes(b"shipped")
    monkeypatch.setattr(defaults, "shipped_model", lambda: shipped)
    return shipped


def index_built_with(model, folder):
    rows = [Row(name, name, name) for name in "ab"]
    about = {"checkpoint": str(model)}
    IndexStore(folder).write(
        rows, np.eye(2, dtype=np.float32), fingerprint={"checkpoint": file_digest(model)}, about=about
    )
    return folder


def test_the_last_model_trained_from_this_folder_is_used_while_it_exists(tmp_path, monkeypatch):
    shipped, last = shipped_in(tmp_path, monkeypatch), tmp_path / "last.safetensors"
    last.touch()
    assert defaults.find_model(None)[0] == shipped
    assert "train your own" in defaults.find_model(None)[1]
    defaults.remember("model", Path("last.safetensors"))
    assert defaults.find_model(None) == (last, "the last one trained in this folder")
    last.unlink()
    assert defaults.find_model(None)[0] == shipped


def test_models_and_indexes_of_another_folder_are_never_used(tmp_path, monkeypatch):
    shipped, model = shipped_in(tmp_path, monkeypatch), tmp_path / "m.safetensors"
    model.touch()
    defaults.remember("model", model)
    defaults.remember("index", an_index(tmp_path / "built"))
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    assert defaults.find_model(None)[0] == shipped
    with pytest.raises(BadInput, match="no index in this folder and none was built from it"):
        defaults.find_index(None)
    defaults.remember("model", shipped)  # a training in another folder does not change the first one
    monkeypatch.chdir(tmp_path)
    assert defaults.find_model(None) == (model, "the last one trained in this folder")
    assert defaults.find_index(None)[0] == tmp_path / "built"


def test_an_index_in_the_folder_determines_the_model(tmp_path, monkeypatch):
    shipped_in(tmp_path, monkeypatch)
    own, newer = tmp_path / "own.safetensors", tmp_path / "newer.safetensors"
    own.write_bytes(b"own")
    newer.write_bytes(b"newer")
    index_built_with(own, tmp_path / "index")
    assert defaults.find_model(None) == (own, "the one that index was built with")
    defaults.remember("model", newer)
    assert defaults.find_model(None) == (
        own,
        f"the one that index was built with; {newer} was trained in this folder too: use --model to select it",
    )
    assert defaults.find_model(None, Path("elsewhere"))[0] == newer  # no index determines the model


def test_a_moved_model_of_an_index_is_found_by_its_content_or_raises(tmp_path, monkeypatch):
    shipped, gone = shipped_in(tmp_path, monkeypatch), tmp_path / "gone.safetensors"
    gone.write_bytes(b"shipped")
    index_built_with(gone, tmp_path / "index")
    gone.unlink()
    assert defaults.find_model(None)[0] == shipped
    shipped.write_bytes(b"another")
    with pytest.raises(CheckpointError, match=r"no longer at .*gone\.safetensors; name it with --model"):
        defaults.find_model(None)


def test_a_damaged_index_does_not_determine_the_model(tmp_path, monkeypatch):
    shipped = shipped_in(tmp_path, monkeypatch)
    index_built_with(shipped, tmp_path / "index")
    (tmp_path / "index" / "gen-000001" / "manifest.json").write_text("{")
    assert defaults.find_model(None)[1].startswith("shipped")


def test_an_index_in_this_folder_precedes_the_last_one(tmp_path):
    (tmp_path / "index").mkdir()
    (tmp_path / "other").mkdir()
    defaults.remember("index", tmp_path / "other")
    with pytest.raises(BadInput, match=r"in this folder and none was built from it; run `retrieve build-index"):
        defaults.find_index(None)
    last = an_index(tmp_path / "elsewhere" / "index")
    defaults.remember("index", last)
    assert defaults.find_index(None) == (last, "the last one built from this folder")
    (tmp_path / "index" / "CURRENT").write_text("gen-000001")
    assert defaults.find_index(None) == (Path("index"), "in this folder")


def test_absolute_paths_are_remembered_separately_for_each_kind(tmp_path, monkeypatch):
    defaults.remember("model", Path("a.safetensors"))
    defaults.remember("index", Path("index"))
    defaults.remember("model", Path("b.safetensors"))
    expected = {str(tmp_path): {"index": str(tmp_path / "index"), "model": str(tmp_path / "b.safetensors")}}
    assert json.loads(state_file().read_text()) == expected
    assert os.listdir(state_file().parent) == ["last.json"]


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"3", b"null", b"\xff", b'{"model": 3}', b'{"model": "/none"}'])
@pytest.mark.usefixtures("nothing_shipped")
def test_an_invalid_state_file_is_ignored_and_replaced(content, tmp_path):
    state_file().parent.mkdir(parents=True)
    state_file().write_bytes(content)
    with pytest.raises(CheckpointError):
        defaults.find_model(None)
    with pytest.raises(BadInput):
        defaults.find_index(None)
    index = an_index(tmp_path / "built")
    defaults.remember("index", index)
    assert defaults.find_index(None)[0] == index


def test_commands_work_without_a_writable_state_file(tmp_path, monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    (tmp_path / "file").touch()
    monkeypatch.setattr(Path, "home", homeless)
    for place in (str(tmp_path / "file"), ""):
        monkeypatch.setenv("XDG_STATE_HOME", place)
        defaults.remember("index", tmp_path)
        with pytest.raises(BadInput, match="no index in this folder"):
            defaults.find_index(None)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    defaults.remember("model", tmp_path / "m.safetensors")
    assert (tmp_path / "home" / ".local" / "state" / "touch-retrieval" / "last.json").is_file()
