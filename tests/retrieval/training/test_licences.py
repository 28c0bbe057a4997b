"""Licences of training data: checkpoint, model card and export repeat them."""

import dataclasses
import json
import shutil

import onnx
import pytest

from retrieval.data.dataset import DataLicence, recording_licence, stored_licences
from retrieval.model.card import checkpoint_licences
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.shipped import shipped_model
from retrieval.training.initial_weights import training_licences
from retrieval.training.trainer import train_matcher
from tests.conftest import TINY

TERMS = "name the authors"


@pytest.fixture(scope="module")
def licensed(recording, tmp_path_factory):
    folder = shutil.copytree(recording, tmp_path_factory.mktemp("licensed") / "recording")
    info = json.loads((folder / "recording.json").read_text())
    (folder / "recording.json").write_text(json.dumps(info | {"licence": "CC BY 4.0", "terms": TERMS}))
    return folder


@pytest.fixture(scope="module")
def trained(licensed, tmp_path_factory):
    return train_matcher(licensed, tmp_path_factory.mktemp("trained") / "m.safetensors", TINY)


def test_the_licences_of_a_training_are_those_of_all_its_data(recording, licensed, trained):
    own, stated = DataLicence(recording_licence(recording).source), recording_licence(licensed)
    assert (own.licence, str(stated)) == ("not stated", f"CC BY 4.0 ({TERMS})")
    settings = dataclasses.replace(TINY.training, init_touch="tower.safetensors")
    assert training_licences(recording, settings) == [own, DataLicence("tower.safetensors")]
    started = dataclasses.replace(settings, start=str(trained.path))  # the towers of the checkpoint replace the file
    assert training_licences(recording, started) == [own, stated]


def test_a_shipped_model_is_mit():
    assert [each.licence for each in checkpoint_licences(load_checkpoint(shipped_model()))] == ["MIT"]


def test_checkpoint_card_and_export_repeat_the_licences(trained):
    (licence,) = stored_licences(trained.provenance)
    assert (licence.licence, licence.terms) == ("CC BY 4.0", TERMS)
    card = trained.path.with_suffix(".md").read_text()
    assert f"* Licence of the data of {licence.source}: CC BY 4.0 ({TERMS})\n" in card
    exported = onnx.load_model_from_string(touch_encoder_to_onnx(trained))
    properties = {entry.key: entry.value for entry in exported.metadata_props}
    assert json.loads(properties["touch_retrieval.licences"]) == [dataclasses.asdict(licence)]
