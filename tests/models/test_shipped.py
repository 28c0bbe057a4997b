"""A small evaluation of the shipped checkpoint."""

import json

import pytest
import torch

from models import shipped
from retrieval.data.images import to_float
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.encode import touch_features
from retrieval.model.fusion_scorer import NOT_A_GEL
from retrieval.search import defaults
from robot.rig import load_rig


@pytest.mark.slow
def test_the_shipped_checkpoint_is_far_above_chance_on_unseen_objects(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "FITTED", 3)
    monkeypatch.setattr("retrieval.evaluation.evaluate.control_experiments", lambda *_: {})  # each trains a head
    assert shipped.main(["score", str(tmp_path), "--objects", "13", "--grasps", "2", "--jobs", "1"]) == 0
    measures = json.loads((tmp_path / "report" / "results.json").read_text())["methods"]["late_fusion"]["measures"]
    assert measures["topn_k5"]["objects"] == 7
    assert measures["topn_k5"]["value"][0] > 0.4  # chance 0.2


@pytest.mark.parametrize("fingers", defaults.SHIPPED)
def test_the_shipped_checkpoints_calibrate_reference_touches_with_and_without_photos(fingers):
    made = load_checkpoint(defaults.shipped_model(fingers))
    references = made.references
    assert references.objects == len(made.split.validation) == 99
    apart, equal = references.touch_only.log_ratio([-0.2, 0.9], 1)
    assert apart < 0 < equal  # a dissimilar touch is evidence against the object
    assert references.weight * references.with_photos.slope > 1


@pytest.mark.parametrize("fingers", defaults.SHIPPED)
def test_the_shipped_checkpoints_do_not_take_a_photo_for_a_gel_image(fingers):
    made, photos = load_checkpoint(defaults.shipped_model(fingers)), []
    with load_rig("sim", seed=990) as rig:
        for name in rig.object_ids(20):
            rig.prepare(name, 0)
            photos.append(made.config.preprocessing.touch(to_float(rig.camera.read(depth=False).colour)))
    features = touch_features(made.matcher, [[photo] * fingers for photo in photos])
    with torch.inference_mode():
        verdicts = made.gel_check.classify(made.matcher.gel_readings(features).numpy())
    assert verdicts.count(NOT_A_GEL) >= 17
