"""Settings: presets, refused values and the names in their messages, and the paper's numbers."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from retrieval.errors import ConfigError
from retrieval.model.config import Config, TrainingConfig, load_config, preset_names
from retrieval.model.fusion import Matcher
from retrieval.model.losses import LOSSES
from retrieval.model.towers import TOWER_SEPARATOR, TOWERS

TABLES = Config().to_dict()
"""Tables of a configuration: settings and their defaults."""


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_names_a_tower_that_exists(name):
    config = load_config(name)
    assert set(config.matcher.tower.split(TOWER_SEPARATOR)) <= set(TOWERS)
    assert Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_the_preset_paper_contains_the_papers_numbers():
    tables = load_config("paper").to_dict()
    papers = {  # the 1000 outputs of each network are concatenated
        "matcher": {"tower": "resnet50", "tower_output": "classes", "fingers": 2, "hidden": 1024, "standardise": False},
        "training": {
            "init": "imagenet",
            "iterations": 26_000,
            "touches_per_batch": 6,  # 48 pairs
            "positives_per_touch": 4,
            "negatives_per_touch": 4,
            "learning_rate": 1e-4,
            "schedule": "constant",
            "freeze_batch_norm": False,
            "freeze_towers": False,
            **{f"{loss}_weight": 0.0 for loss in LOSSES},
        },
        "preprocessing": {"touch_px": 128, "photo_px": 256, "background": "none"},
    }
    assert {table: {name: tables[table][name] for name in entries} for table, entries in papers.items()} == papers
    assert tables["matcher"]["dropout"] > 0
    assert round(98 * tables["training"]["test_fraction"]) == 18


def test_paper_exact_reverts_the_differences_that_are_revertible():
    paper, exact = load_config("paper"), load_config("paper-exact")
    training = dataclasses.replace(
        paper.training, validation_fraction=0.0, negatives="dataset", precision="float32", distil_steps=600
    )
    assert exact == dataclasses.replace(paper.without_candidate_encoder(), training=training)


def test_photos_may_have_another_tower_and_another_tower_for_both_replaces_it():
    config = load_config("linear")
    assert (config.matcher.tower, config.matcher.photo_tower) == ("mobilenet_v2+mobilenet_v2", "mobilenet_v2")
    with torch.device("meta"):
        matcher = Matcher(config.matcher)
    assert matcher.touch_tower.feature_count == 2 * matcher.photo_tower.feature_count
    assert config.using(losses={}).matcher.photo_tower == "mobilenet_v2"
    assert config.using(tower="small").matcher.photo_tower == ""


@pytest.mark.parametrize("name", ["huge", ".", "../paper"])
def test_an_unknown_name_lists_the_presets(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=rf"one of {', '.join(preset_names())} or a TOML file; there is no '.*'"):
        load_config(name)


@pytest.mark.parametrize("content", [b"[training\n", b"\xff\n"])
def test_a_file_that_is_not_toml_is_named(tmp_path, content):
    (tmp_path / "bad.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=r"bad\.toml is not valid TOML: "):
        load_config(str(tmp_path / "bad.toml"))


@pytest.mark.parametrize("table", TABLES)
def test_an_unknown_key_is_refused_with_the_known_ones(table):
    known = ", ".join(sorted({*TABLES[table], *(["workers"] if table == "training" else [])}))
    with pytest.raises(ConfigError, match=rf"{table} has no setting 'colour'; known settings: {known}"):
        Config.from_dict({table: {"colour": 1}})


REFUSED = [
    ("matcher", "fingers", 0),
    ("matcher", "dropout", math.nan),
    ("matcher", "tower_output", "other"),
    ("matcher", "candidate_linear", 3),  # without a cosine
    ("training", "learning_rate", 0.0),
    ("training", "contrastive_weight", -0.1),
    ("training", "precision", "other"),
    ("training", "validation_fraction", 1.0),
    ("training", "seed", 2**32),
    ("training", "seed", 2**63),
    ("preprocessing", "touch_px", 4097),
    ("preprocessing", "background", "x"),
]


@pytest.mark.parametrize(("table", "name", "value"), REFUSED)
def test_a_refused_value_is_named(table, name, value):
    with pytest.raises(ConfigError, match=name) as caught:
        Config.from_dict({table: {name: value}})
    assert str(value) in str(caught.value)


def test_settings_from_python_are_checked_and_converted_like_those_of_a_file():
    training = TrainingConfig(learning_rate=1, seed=np.int64(3), weights={"listwise": np.float64(0.5)})
    assert training == TrainingConfig.from_dict({"learning_rate": 1.0, "seed": 3, "listwise_weight": 0.5})
    assert [type(value) for value in (training.learning_rate, training.seed)] == [float, int]
    with pytest.raises(ConfigError, match=r"training\.listwise_weight must be a number, got '1'"):
        TrainingConfig(weights={"listwise": "1"})


def test_a_weight_of_an_unknown_loss_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="loss must be one of contrastive, listwise, pooled_listwise; got 'triplet'"):
        Config().using(losses={"triplet": 1.0})
    (tmp_path / "mine.toml").write_text("[training]\ntriplet_weight = 1.0\n")
    with pytest.raises(ConfigError, match="got 'triplet'"):
        load_config(str(tmp_path / "mine.toml"))


def test_a_checkpoint_is_usable_without_the_loss_that_trained_it():
    config = Config.from_dict({"training": {"triplet_weight": 1.0, "contrastive_weight": 0.5}})
    assert {name: weight for name, weight in config.training.weights.items() if weight} == {
        "contrastive": 0.5,
        "triplet": 1.0,
    }
    assert Config.from_dict(config.to_dict()) == config


def test_the_held_out_fractions_must_leave_objects_to_train_on():
    TrainingConfig(validation_fraction=0.5, test_fraction=0.49)
    with pytest.raises(ConfigError, match=r"leave objects to train on; got \(0\.5, 0\.5\)"):
        TrainingConfig(validation_fraction=0.5, test_fraction=0.5)
