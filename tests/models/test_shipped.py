"""The making of the shipped checkpoints on a few objects, and a small evaluation of them."""

import argparse
import dataclasses
import json

import numpy as np
import pytest
import torch
import trimesh

from models import shipped
from models.labels import LabelHead
from models.pictures import METADATA, ObjectLabels, collect_pictures
from retrieval.data.resize import to_float
from retrieval.evaluation.protocols import recording
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.encode import touch_features
from retrieval.model.gel_check import NOT_A_GEL
from retrieval.model.shipped import SHIPPED, shipped_model
from robot.rig import load_rig


@pytest.mark.slow
def test_towers_and_cells_learn_varied_photos_meshes_and_other_sensors_for_both_checkpoints(tmp_path, monkeypatch):
    settings = {
        "PARTS": (shipped.Part("led", False, 1, 6), shipped.Part("led", True, 2, 3)),
        "CELL_PARTS": (shipped.Part("led", False, 1, 6), shipped.Part("led", True, 2, 3)),
        "OTHER_SENSORS": (shipped.Part("varied", False, 1, 6),),
        "CALIBRATED": {
            "validation": (shipped.Part("led", False, 3, 3, 3), shipped.Part("led", True, 4, 1, 3)),
            "varied_gels": (),
        },
    }
    for name, value in settings.items():
        monkeypatch.setattr(shipped, name, value)
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for number in range(4):
        trimesh.creation.box((30 + 5 * number, 40, 70)).export(meshes / f"{number}.stl")
    arguments = argparse.Namespace(folder=tmp_path / "made", meshes=meshes, jobs=1)
    assert (shipped.collect_training(arguments), shipped.collect_calibration(arguments)) == (0, 0)
    steps = {"iterations": 2, "validate_every": 2, "touches_per_batch": 4}
    towers = shipped.train_towers(tmp_path / "made", **steps)
    images = shipped.training_images(tmp_path / "made", shipped.PARTS)
    assert any(grasp.object_id.startswith("mesh") for grasp in images.grasps)
    assert {grasp.touches[0].parts[-3] for grasp in images.grasps} == {"1-led", "2-led", "1-varied"}
    assert sum("varied" in name for name in {grasp.photo.name for grasp in images.grasps}) == 27  # three of each object
    for grasp in images.grasps:  # the references are the rig's images of the same press and of the same object
        assert grasp.touches[0].name == images.rig_grasps[grasp.grasp_id].touches[0].name
        assert grasp.touches[0].parts[-3][0] == images.rig_grasps[grasp.grasp_id].touches[0].parts[-3][0]
        assert images.rig_photos[grasp.photo].name.startswith(grasp.object_id)
        assert images.rig_photos[grasp.photo].parts[-3].endswith("-led")
    weights = "features.13.conv.2.weight"
    for fingers in (1, 2):
        shipped_towers = load_checkpoint(shipped_model(fingers))
        before = shipped_towers.matcher.touch_tower.state_dict()[weights].clone()
        made = shipped.with_parts(shipped_towers, towers, shipped.TOWER_PARTS)
        assert made.config.matcher.fingers == fingers
        assert len(made.split.train) == 9
        after, trained = (each.matcher.touch_tower.state_dict()[weights] for each in (made, towers))
        assert torch.equal(after, trained)
        assert not torch.equal(after, before)
        given = {name: part.clone() for name, part in made.matcher.state_dict().items()}
        made = shipped.train_cells(made, tmp_path / "made", **steps)
        changed = {name for name, part in made.matcher.state_dict().items() if not torch.equal(part, given[name])}
        assert {name.partition(".")[0] for name in changed} == {"touch_cells", "photo_cells"}
        assert not any("norm" in name for name in changed)


def test_a_stopped_collection_of_pictures_continues(tmp_path):
    options = {"seed": 3, "jobs": 1}
    whole = collect_pictures("touch", tmp_path / "whole", objects=2, **options)
    assert {picture.before is None for picture in whole} == {False}
    collect_pictures("touch", tmp_path / "parts", objects=1, **options)
    metadata = tmp_path / "parts" / METADATA
    metadata.write_bytes(metadata.read_bytes()[:-9])  # as a crash leaves it
    again = collect_pictures("touch", tmp_path / "parts", objects=2, **options)
    assert [(each.object_id, each.labels) for each in again] == [(each.object_id, each.labels) for each in whole]
    assert [each.file.read_bytes() for each in again] == [each.file.read_bytes() for each in whole]


def test_an_untrained_head_guesses_alike_and_ignores_the_sizes_of_smooth_objects():
    rough, fine, smooth = (
        ObjectLabels(("grid", "box"), (4.0, 0.5, 1.0, 0.5)),
        ObjectLabels(("dots", "box"), (1.0, 0.1, 2.0, 1.0)),
        ObjectLabels(("smooth", "tube"), (1.0, 0.0, 1.0, 0.0)),
    )
    head = LabelHead(5, [rough, fine, smooth]).eval()
    guess = np.log(3) + np.log(2)  # cross-entropy of equal logits of three reliefs and of two shapes
    # Each size differs from the mean of the two rough objects by one standard deviation.
    assert head.loss(torch.randn(2, 5), [rough, fine]).item() == pytest.approx(guess + 1.0, rel=1e-4)
    assert head.loss(torch.randn(1, 5), [smooth]).item() == pytest.approx(guess, rel=1e-4)


@pytest.mark.slow
def test_the_shipped_checkpoint_is_far_above_chance_on_unseen_objects(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "FITTED", 3)
    without_controls = dataclasses.replace(recording.UNSEEN_OBJECTS, controls={})  # each trains a head
    monkeypatch.setattr(recording, "UNSEEN_OBJECTS", without_controls)
    assert shipped.main(["score", str(tmp_path), "--objects", "13", "--grasps", "2", "--jobs", "1"]) == 0
    results = json.loads((tmp_path / "report" / "results.json").read_text())
    measures = results["protocols"]["unseen-objects"]["rows"]["shipped model"]["measures"]
    assert measures["topn_k5"]["objects"] == 7
    assert measures["topn_k5"]["value"][0] > 0.4  # chance 0.2


@pytest.mark.parametrize("fingers", SHIPPED)
def test_the_shipped_checkpoints_calibrate_references_and_take_no_photo_for_a_gel_image(fingers):
    made, photos = load_checkpoint(shipped_model(fingers)), []
    references = made.references
    assert references.objects == 129  # 79 procedural ones and 50 meshes of the recordings that calibrate
    apart, equal = references.touch_only.log_ratio([-0.2, 0.9], 1)
    assert apart < 0 < equal  # a dissimilar touch is evidence against the object
    assert references.weight * references.with_photos.slope > 1
    same, other = made.opening.log_ratios([30.0], [30.2, 60.0], np.array([0, 1]))[0]
    assert other < -1 < 2 < same
    with load_rig("sim", seed=990) as rig:
        for name in rig.object_ids(5):
            rig.prepare(name, 0)
            photos.append(made.config.preprocessing.touch(to_float(rig.camera.read(depth=False).colour)))
    features = touch_features(made.matcher, [[photo] * fingers for photo in photos])
    with torch.inference_mode():
        verdicts = made.gel_check.classify(made.matcher.gel_readings(features).numpy())
    assert verdicts.count(NOT_A_GEL) >= 4
