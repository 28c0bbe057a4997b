"""The default index and checkpoint of a command."""

from pathlib import Path

import numpy as np
import pytest

from _touch_retrieval.files import file_digest
from indexes.store.folder import IndexStore
from indexes.store.rows import Row
from retrieval.commands.options import resolve_index
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.shipped import shipped_model
from retrieval.search import opening
from retrieval.search.opening import find_model


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_shipped_models_are_selected_by_their_number_of_fingers():
    assert find_model("shipped")[0] == shipped_model()
    assert find_model("shipped-one-finger")[0] == shipped_model(1)
    for fingers in (1, 2):
        assert read_checkpoint_info(shipped_model(fingers)).config.matcher.fingers == fingers
    with pytest.raises(BadInput, match="take touches of 1 or 2 gel images; got 3"):
        shipped_model(3)


def shipped_in(folder, monkeypatch):
    shipped = folder / "shipped.safetensors"
    shipped.write_bytes(b"shipped")
    monkeypatch.setattr(opening, "shipped_model", lambda fingers=2: shipped)
    return shipped


def index_built_with(model, folder):
    rows = [Row(name, name, name) for name in "ab"]
    about = {"checkpoint": str(model)}
    blocks = [{"embeddings": np.eye(2, dtype=np.float32)}]
    IndexStore(folder).write(rows, blocks, fingerprint={"checkpoint": file_digest(model)}, about=about)
    return folder


def test_an_index_in_the_folder_determines_the_model(tmp_path, monkeypatch):
    shipped = shipped_in(tmp_path, monkeypatch)
    own = tmp_path / "own.safetensors"
    own.write_bytes(b"own")
    index_built_with(own, tmp_path / "index")
    assert find_model(None) == (own, "the one that index was built with")
    assert find_model(None, Path("elsewhere"))[0] == shipped  # no index determines the model


def test_a_moved_model_of_an_index_is_found_by_its_content_or_raises(tmp_path, monkeypatch):
    shipped, gone = shipped_in(tmp_path, monkeypatch), tmp_path / "gone.safetensors"
    gone.write_bytes(b"shipped")
    index_built_with(gone, tmp_path / "index")
    gone.unlink()
    assert find_model(None)[0] == shipped
    shipped.write_bytes(b"another")
    with pytest.raises(CheckpointError, match=r"no longer at .*gone\.safetensors"):
        find_model(None)


def test_a_damaged_index_does_not_determine_the_model(tmp_path, monkeypatch):
    shipped = shipped_in(tmp_path, monkeypatch)
    index_built_with(shipped, tmp_path / "index")
    (tmp_path / "index" / "gen-000001" / "manifest.json").write_text("{")
    assert find_model(None)[1].startswith("shipped")


def test_the_index_in_this_folder_is_used(tmp_path, capsys):
    (tmp_path / "index").mkdir()
    with pytest.raises(BadInput, match=r"no index in this folder; run `retrieve build-index"):
        resolve_index(None)
    (tmp_path / "index" / "CURRENT").write_text("gen-000001")
    assert resolve_index(None) == Path("index")
    assert capsys.readouterr().err == "index: index (in this folder)\n"
