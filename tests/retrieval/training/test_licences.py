"""Licences of training data: checkpoint, model card and export repeat them."""

import dataclasses
import json
import shutil

import onnx
import pytest

from retrieval.data.dataset import DataLicence, recording_licence, stored_licences
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.shipped import shipped_model
from retrieval.training.adapt import adapt
from retrieval.training.initial_weights import checkpoint_licences, training_licences
from retrieval.training.train import train
from tests.conftest import TINY

TERMS = "name the authors"
SETTINGS = TINY.training


@pytest.fixture
def licensed(recording, tmp_path):
    """A function that copies the recording and states a licence in it."""

    def copy(licence, terms=TERMS):
        folder = tmp_path / f"recording {licence}"
        shutil.copytree(recording, folder)
        info = json.loads((folder / "recording.json").read_text())
        (folder / "recording.json").write_text(json.dumps(info | {"licence": licence, "terms": terms}))
        return folder

    return copy


def test_a_recording_without_a_licence_is_not_stated(recording, licensed):
    assert recording_licence(recording).licence == "not stated"
    assert str(recording_licence(licensed("MIT"))) == f"MIT ({TERMS})"


def test_the_licences_of_a_training_are_those_of_all_its_data(recording, licensed, tmp_path):
    start = tmp_path / "start.safetensors"
    train(licensed("CC BY 4.0"), start, TINY, quiet=True)
    settings = dataclasses.replace(SETTINGS, init_touch="tower.safetensors")
    own = DataLicence(recording_licence(recording).source)
    assert training_licences(recording, settings) == [own, DataLicence("tower.safetensors")]
    started = dataclasses.replace(settings, start=str(start))  # the towers of the checkpoint replace the file
    assert training_licences(recording, started) == [own, DataLicence(own.source, "CC BY 4.0", TERMS)]


def test_a_shipped_model_is_mit_and_an_older_checkpoint_not_stated(model, tmp_path):
    shipped = load_checkpoint(shipped_model())
    assert [each.licence for each in checkpoint_licences(shipped)] == ["MIT"]
    older = dataclasses.replace(shipped, path=tmp_path / "own.safetensors", provenance={"source": "a rig"})
    assert checkpoint_licences(older) == [DataLicence("a rig")]


def test_checkpoint_card_and_export_repeat_the_licences(licensed, tmp_path):
    folder, out = licensed("CC BY 4.0"), tmp_path / "m.safetensors"
    checkpoint = train(folder, out, TINY, quiet=True)
    (licence,) = stored_licences(checkpoint.provenance)
    assert (licence.licence, licence.terms) == ("CC BY 4.0", TERMS)
    card = out.with_suffix(".md").read_text()
    assert f"* Licence of the data of {licence.source}: CC BY 4.0 ({TERMS})\n" in card
    exported = onnx.load_model_from_string(touch_encoder_to_onnx(checkpoint))
    properties = {entry.key: entry.value for entry in exported.metadata_props}
    assert json.loads(properties["touch_retrieval.licences"]) == [dataclasses.asdict(licence)]


def test_an_adapted_model_lists_the_licences_of_both_data(licensed, model, tmp_path):
    out = tmp_path / "own.safetensors"
    adapt(licensed("CC BY 4.0"), out, load_checkpoint(model), init="none", quiet=True)
    licences = stored_licences(load_checkpoint(out).provenance)
    assert [each.licence for each in licences] == ["not stated", "CC BY 4.0"]
