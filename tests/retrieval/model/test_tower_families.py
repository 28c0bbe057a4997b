"""Towers of other libraries: tiny models with random weights, model_folders from a configuration alone."""

import dataclasses
import json
import shutil
import sys

import numpy as np
import pytest
import torch

from retrieval.errors import CheckpointError, ConfigError
from retrieval.model import export as exporting
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.config import Config, MatcherConfig
from retrieval.model.encode import encode_touches
from retrieval.model.onnx_encoder import OnnxEncoder
from retrieval.model.towers import architectures_of, build_tower
from retrieval.model.towers.weights import initialise_tower
from retrieval.search.build.build_index import build_index
from retrieval.search.query.searcher import Searcher
from retrieval.training.train import train
from tests.conftest import TINY

MEAN, STD = [0.5, 0.4, 0.3], [0.2, 0.25, 0.3]
WIDTHS = {
    ("dino", "pooled"): 16,
    ("dino", "stages"): 3 * 4 * 16,
    ("convnext", "pooled"): 16,
    ("convnext", "stages"): 120,
}
WIDTHS |= {("siglip", "pooled"): 16, ("siglip", "stages"): 3 * 2 * 16}


def models():
    import transformers

    layers = {"hidden_size": 16, "num_attention_heads": 2, "intermediate_size": 32}
    vision = {**layers, "num_hidden_layers": 2, "image_size": 32, "patch_size": 16}
    words = {"vocab_size": 8, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    return {
        "dino": transformers.Dinov2Config(**layers, num_hidden_layers=4, image_size=56, patch_size=14),
        "convnext": transformers.ConvNextConfig(hidden_sizes=[6, 8, 10, 16], depths=[1, 1, 1, 1]),
        "siglip": transformers.SiglipConfig(
            text_config={**layers, "num_hidden_layers": 1, **words}, vision_config=vision
        ),
    }


@pytest.fixture(scope="module")
def model_folders(tmp_path_factory):
    """Folders like those of the Hub, by the name of a model."""
    from transformers import AutoModel

    folders = {}
    for name, config in models().items():
        folders[name] = tmp_path_factory.mktemp("models") / name
        torch.manual_seed(0)
        AutoModel.from_config(config).save_pretrained(folders[name])
        (folders[name] / "preprocessor_config.json").write_text(json.dumps({"image_mean": MEAN, "image_std": STD}))
    return folders


def tower_of(folder, output="pooled"):
    name = f"transformers:{folder}"
    return build_tower(name, output, json.loads(json.dumps(architectures_of(name)))).eval()


@pytest.mark.parametrize(("model", "output"), WIDTHS)
def test_a_model_of_transformers_is_a_tower_for_images_of_any_size(model, output, model_folders):
    tower = tower_of(model_folders[model], output)
    assert (tower.mean.flatten().tolist(), tower.std.flatten().tolist()) == (
        pytest.approx(MEAN),
        pytest.approx(STD),
    )
    with torch.inference_mode():
        for side in (32, 64):
            features = tower(torch.rand(2, 3, side, side))
            assert features.shape == (2, tower.feature_count) == (2, WIDTHS[model, output])
            assert torch.isfinite(features).all()


def test_pooled_features_are_those_that_the_model_itself_pools(model_folders):
    from transformers import AutoModel

    tower, images = tower_of(model_folders["dino"]), torch.rand(2, 3, 56, 56)
    initialise_tower(tower, "imagenet")  # the published weights, here from the folder
    model = AutoModel.from_pretrained(model_folders["dino"]).eval()
    normalised = (images - torch.tensor(MEAN).view(1, 3, 1, 1)) / torch.tensor(STD).view(1, 3, 1, 1)
    with torch.inference_mode():
        torch.testing.assert_close(tower(images), model(normalised).pooler_output)


@pytest.mark.slow
def test_a_matcher_on_a_model_of_transformers_trains_exports_indexes_and_answers(
    model_folders, recording, catalogue, touch, tmp_path
):
    """The model concatenates a ViT and a ConvNeXt. Their folders are deleted after training."""
    folders = [shutil.copytree(model_folders[model], tmp_path / model) for model in ("dino", "convnext")]
    config = TINY.using(tower="+".join(f"transformers:{folder}" for folder in folders))
    config = dataclasses.replace(config, training=dataclasses.replace(config.training, init="imagenet"))
    trained = train(recording, tmp_path / "m.safetensors", config, quiet=True)
    first = tower_of(folders[0]).published_weights()
    weights = trained.matcher.touch_tower.parts[0].state_dict()
    assert any(not torch.equal(weights[name], first[name]) for name in first)
    for folder in folders:
        shutil.rmtree(folder)
    checkpoint = load_checkpoint(tmp_path / "m.safetensors")
    assert str(tmp_path) not in json.dumps(checkpoint.config.without_paths())
    (tmp_path / "m.onnx").write_bytes(exporting.touch_encoder_to_onnx(checkpoint))
    encoder = OnnxEncoder(tmp_path / "m.onnx", checkpoint.digest)
    touches = np.random.default_rng(0).random((3, 2, 32, 32, 3), dtype=np.float32)
    encoding, (partial, embedding, *_) = encode_touches(checkpoint.matcher, touches), encoder.encode(touches)
    # float32 in another order
    assert np.abs(partial - encoding.partial.numpy()).max() <= 1e-4 * float(encoding.partial.abs().max())
    np.testing.assert_allclose(embedding, encoding.embedding.numpy(), atol=1e-4)
    build_index(catalogue, checkpoint, tmp_path / "index", quiet=True)
    with Searcher.open(tmp_path / "index") as searcher:
        assert len(searcher.query([touch], none_prior=0.0).results) == 8


def test_a_model_or_output_that_transformers_lacks_is_one_clear_error(model_folders, tmp_path):
    with pytest.raises(ConfigError, match=r"transformers:.*nowhere must be a model of the Hub or in a folder"):
        Config().using(tower=f"transformers:{tmp_path / 'nowhere'}")
    with pytest.raises(ConfigError, match="has no 1000-way layer; set tower_output to pooled or stages"):
        tower_of(model_folders["dino"], "classes")
    (tmp_path / "nothing").mkdir()
    tower = tower_of(shutil.copytree(model_folders["dino"], tmp_path / "dino"))
    shutil.rmtree(tmp_path / "dino")
    with pytest.raises(CheckpointError, match="cannot be read"):
        initialise_tower(tower, "imagenet")


def test_a_checkpoint_that_names_a_model_without_its_architecture_downloads_nothing():
    with pytest.raises(ConfigError, match="the architecture of transformers:a/b is missing; set the tower with"):
        build_tower(MatcherConfig(tower="transformers:a/b").tower)


def test_without_the_package_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ConfigError, match=r"needs the package.*pip install .*transformers"):
        Config().using(tower="transformers:something")
