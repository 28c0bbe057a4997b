"""`retrieve push` and `hf://` addresses, against a server that speaks the Hub's API; the real Hub is never asked."""

import dataclasses
import json
import sys

import pytest
from huggingface_hub import DatasetCard, ModelCard

from retrieval.commands.main import main
from retrieval.data.hub import local_file
from retrieval.errors import BadInput
from retrieval.model.card import model_card
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.shipped import SHIPPED, shipped_model
from robot.recording.folder import read_recording
from tests.fake_hub import TOKEN, Repository, fake_hub
from tests.reference_model import write_reference_model


@pytest.fixture(scope="module")
def hub():
    with fake_hub() as hub:
        yield hub


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    made = write_reference_model(tmp_path_factory.mktemp("model") / "m.safetensors")
    store_checkpoint(dataclasses.replace(made, provenance=made.provenance | {"metrics": {"auc": 0.87654}}), made.path)
    return load_checkpoint(made.path)


def test_a_pushed_model_is_private_and_is_read_by_its_address_and_from_the_cache(hub, checkpoint, tmp_path):
    name, out = "hf://me/model", tmp_path / "x.onnx"
    push, read = ["push", checkpoint.path, name], ["export", name, "--out", out]
    codes, output = hub.run(tmp_path, push, [*push, "--licence", "CC BY 4.0"], read)
    assert codes == [2, 0, 0]
    assert "states no single licence" in output
    stored = hub.repositories["models", "me/model"]
    assert (stored.is_private, sorted(stored.files)) == (True, ["README.md", "model.safetensors"])
    assert stored.files["model.safetensors"] == checkpoint.path.read_bytes()
    card = ModelCard(stored.files["README.md"].decode()).data
    assert (card.license, card.library_name, card.datasets) == ("cc-by-4.0", "touch-retrieval", ["a-test"])
    assert [(result.metric_type, result.metric_value) for result in card.eval_results] == [("auc", 0.8765)]
    read_files = {path for method, path in hub.requests if method in ("GET", "HEAD") and "/resolve/" in path}
    assert read_files == {"/me/model/resolve/main/model.safetensors"}
    assert hub.run(tmp_path, [*read[:2], "--out", tmp_path / "y.onnx"], HF_HUB_OFFLINE="1")[0] == [0]


@pytest.mark.slow
def test_what_cannot_be_read_or_written_is_one_line_without_the_token(hub, checkpoint, tmp_path):
    hub.repositories["models", "me/text"] = text = Repository(is_private=False)
    hub.repositories["models", "me/empty"] = Repository(is_private=False)
    hub.repositories["models", "me/secret"] = Repository(is_private=True)
    text.files["model.safetensors"] = b"no tensors"
    push = ["push", checkpoint.path, "--licence", "mit"]
    cases = {
        "not a readable .safetensors file": ["export", "hf://me/text"],
        "has no model.safetensors": ["export", "hf://me/empty"],
        "hf://me/none does not exist": ["export", "hf://me/none"],
        "no such branch, tag or commit": ["export", "hf://me/text@v2"],
        "must be hf://USER/NAME": ["export", "hf://me"],
        "leave @v2 out": [*push, "hf://me/text@v2"],
        "exists and is public": [*push, "hf://me/text"],
    }
    codes, output = hub.run(tmp_path, *cases.values())
    lines = [line for line in output.splitlines() if line.startswith("retrieve ")]
    assert codes == [2] * len(cases)
    assert [reason for reason, line in zip(cases, lines, strict=True) if reason not in line] == []
    stranger = hub.run(tmp_path, ["export", "hf://me/secret"], [*push, "hf://me/new"], token=None)
    assert (stranger[0], stranger[1].count("log in with `hf auth login`")) == ([2, 2], 2)
    offline = hub.run(tmp_path, ["export", "hf://me/secret"], [*push, "hf://me/new"], HF_HUB_OFFLINE="1")
    assert (offline[0], offline[1].count("the Hub cannot be reached")) == ([1, 1], 2)
    assert TOKEN not in output + stranger[1] + offline[1]


def test_a_pushed_recording_is_a_data_set_with_a_licence_that_datasets_opens(hub, recording, tmp_path, capsys):
    datasets = pytest.importorskip("datasets")
    old = hub.repositories["datasets", "me/grasps"] = Repository(is_private=False)
    old.files["images/old.png"] = b"of an earlier push"
    push = ["push", recording, "hf://me/grasps", "--public"]
    codes, output = hub.run(tmp_path, push, [*push, "--licence", "ours"])
    assert codes == [2, 0], output
    grasps = read_recording(recording).grasps
    assert set(old.files) == {
        *("README.md", "recording.json", "metadata.jsonl"),
        *(file for grasp in grasps for file in grasp.images().values()),
    }
    assert json.loads(old.files["recording.json"])["licence"] == "ours"
    card = DatasetCard(old.files["README.md"].decode()).data
    assert (card.license, card.license_name) == ("other", "ours")
    for name, content in old.files.items():
        (tmp_path / "got" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "got" / name).write_bytes(content)
    rows = datasets.load_dataset(str(tmp_path / "got"), split="train", cache_dir=str(tmp_path / "cache"))
    assert sorted(rows["grasp_id"]) == sorted(grasp.grasp_id for grasp in grasps)
    assert rows[0]["touch_a"].size
    assert main(["push", str(tmp_path / "got"), "hf://me/again", "--licence", "mit"]) == 2
    assert "states the licence ours" in capsys.readouterr().err


def test_the_cards_of_the_shipped_models_are_current_and_the_hub_reads_them_whole():
    for fingers in SHIPPED:
        shipped = load_checkpoint(shipped_model(fingers))
        text = shipped.path.with_suffix(".md").read_text()
        assert text == model_card(shipped.path.name, shipped, shipped.split)
        data = ModelCard(text).data
        assert len(data.eval_results) == len(shipped.provenance["metrics"])
        assert (data.license, data.datasets) == ("mit", ["simulated-rigs"])
    tower = ModelCard.load(shipped_model().with_name("gel-tower.md")).data
    assert (tower.license, tower.library_name) == ("mit", "touch-retrieval")


def test_without_its_package_an_address_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(BadInput, match=r"pip install 'touch-retrieval\[hub\]'"):
        local_file("hf://me/model")
