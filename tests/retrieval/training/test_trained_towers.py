"""Training of towers: a frozen stem, augmentation, and the loss of predicting labels."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps, make_split
from retrieval.data.labelled_pictures import ObjectLabels, load_object_labels
from retrieval.errors import ConfigError, DatasetError
from retrieval.training.augmentation import augment_photos, augment_touches
from retrieval.training.labels import LabelHead, LabelLoss
from retrieval.training.train import Trainer, train
from tests.conftest import TINY

CONFIG = dataclasses.replace(
    TINY,
    matcher=dataclasses.replace(
        TINY.matcher, tower="mobilenet_v2", tower_output="stages", cell_dim=4, touch_cells=2, photo_cells=2
    ),
    training=dataclasses.replace(
        TINY.training,
        init="random",
        freeze_stem=True,
        freeze_batch_norm=True,
        precision="float32",
        iterations=2,
        validate_every=2,
    ),
    preprocessing=dataclasses.replace(TINY.preprocessing, touch_px=32, photo_px=32, views=("whole", "zoom")),
)
ROUGH = ObjectLabels(("grid", "box"), (4.0, 0.5, 1.0, 0.5))
FINE = ObjectLabels(("dots", "box"), (1.0, 0.1, 2.0, 1.0))
SMOOTH = ObjectLabels(("smooth", "tube"), (1.0, 0.0, 1.0, 0.0))


def with_training(config, **settings):
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **settings))


@pytest.fixture
def new_trainer(recording, tmp_path):
    def new(config=CONFIG, labels=None):
        grasps = load_grasps(recording)
        split = make_split(grasps, validation=0.25, test=0.2, seed=0)
        return Trainer(config, split, grasps, tmp_path / "m.safetensors", source="test", labels=labels)

    return new


@pytest.fixture
def labelled(recording, tmp_path):
    """Return a function that copies the recording, with labels of its objects, as the simulated rig writes them."""

    def make(labels):
        folder = shutil.copytree(recording, tmp_path / "labelled", dirs_exist_ok=True)
        info = json.loads((recording / "recording.json").read_text())
        (folder / "recording.json").write_text(json.dumps(info | {"objects": labels}))
        return folder

    return make


# The stem --------------------------------------------------------------------------------------------------------


def test_the_stem_does_not_change_and_the_other_layers_do(new_trainer):
    trainer = new_trainer()
    before = {name: tensor.clone() for name, tensor in trainer.matcher.touch_tower.state_dict().items()}
    trainer.run(quiet=True)
    after = trainer.matcher.touch_tower.state_dict()
    stem = {f"features.{name}" for name in trainer.matcher.touch_tower.stem_layers().state_dict()}
    changed = {name for name, tensor in after.items() if not torch.equal(before[name], tensor)}
    assert stem
    assert not changed & stem
    assert "features.17.conv.2.weight" in changed


def test_a_tower_without_a_stem_is_refused_by_name(new_trainer):
    config = dataclasses.replace(CONFIG, matcher=TINY.matcher)
    with pytest.raises(ConfigError, match="SmallTower has no stem to freeze; set freeze_stem = false"):
        new_trainer(config)


# Augmentation ----------------------------------------------------------------------------------------------------


def test_the_fingers_of_a_touch_are_flipped_together_top_to_bottom():
    touches = torch.zeros(2, 2, 3, 64, 64)
    touches[:, :, :, :16] = 1.0  # the top quarter is bright
    turned = augment_touches(touches, np.array([False, True]), np.random.default_rng(0))
    assert turned.shape == touches.shape
    top, bottom = turned[..., :16, :].mean((2, 3, 4)), turned[..., -16:, :].mean((2, 3, 4))
    assert (top[0] > bottom[0] + 0.3).all()
    assert (bottom[1] > top[1] + 0.3).all()


def test_the_views_of_a_photo_are_flipped_together_left_to_right_and_stay_in_their_places():
    photos = torch.full((2, 3, 64, 128), 0.2)
    photos[:, :, :, :16] = 0.8  # left edge of the first view; the second view is dark
    turned = augment_photos(photos, 2, np.array([False, True]), np.random.default_rng(0))
    assert turned.shape == photos.shape
    left, right = turned[..., :16].mean((1, 2, 3)), turned[..., 48:64].mean((1, 2, 3))
    assert left[0] > right[0] + 0.2
    assert right[1] > left[1] + 0.2
    second = turned[..., 64:]
    assert (second.amax((1, 2, 3)) - second.amin((1, 2, 3)) < 0.2).all()


def test_a_step_depends_on_its_number_alone_and_no_two_steps_show_the_same_images(new_trainer):
    trainer = new_trainer(with_training(CONFIG, augment=True))
    batch = trainer.sampler.batch(0, 4)
    with trainer.features as source:
        first, again, next_step = (source.prepare(trainer.matcher, batch, step).result() for step in (3, 3, 4))
    assert torch.equal(first.touches, again.touches)
    assert torch.equal(first.photos, again.photos)
    assert not torch.equal(first.touches, next_step.touches)
    plain = new_trainer()
    with plain.features as source:
        one, other = (source.prepare(plain.matcher, batch, step).result() for step in (3, 4))
    assert torch.equal(one.touches, other.touches)


# Labels ----------------------------------------------------------------------------------------------------------


def test_an_untrained_head_predicts_every_family_alike_and_the_mean_size():
    head = LabelHead(5, [ROUGH, FINE, SMOOTH]).eval()
    relief, shape, sizes = head(torch.randn(2, 5))
    assert head.families == [["dots", "grid", "smooth"], ["box", "tube"]]
    assert torch.equal(relief, torch.zeros(2, 3))
    assert torch.equal(shape, torch.zeros(2, 2))
    assert torch.equal(sizes, torch.zeros(2, 4))


def test_sizes_are_standardised_over_the_objects_with_a_relief_and_those_of_smooth_objects_are_left_out_of_the_loss():
    head = LabelHead(5, [ROUGH, FINE, SMOOTH]).eval()
    # Two values differ from their mean by one standard deviation, on either side.
    np.testing.assert_allclose(head.size_targets([ROUGH, FINE]).numpy(), [[1, 1, -1, -1], [-1, -1, 1, 1]], rtol=1e-4)
    guess = math.log(3) + math.log(2)  # cross-entropy of equal logits of three reliefs and of two shapes
    assert head.loss(torch.randn(2, 5), [ROUGH, FINE]).item() == pytest.approx(guess + 1.0, rel=1e-4)
    assert head.loss(torch.randn(1, 5), [SMOOTH]).item() == pytest.approx(guess, rel=1e-4)


def test_the_loss_of_labels_is_added_with_its_weight_and_reaches_both_towers(new_trainer, recording):
    objects = sorted({grasp.object_id for grasp in load_grasps(recording)})
    labels = {name: (ROUGH, FINE)[number % 2] for number, name in enumerate(objects)}
    found = []
    for weight in (0.0, 2.0):
        trainer = new_trainer(with_training(CONFIG, predict_labels=weight), labels)
        trainer.matcher.eval()  # statistics of random weights are extreme in training mode
        batch = trainer.sampler.batch(0, 4)
        with trainer.features as source:
            loaded = source.prepare(trainer.matcher, batch, 0).result()
            found.append(float(trainer.loss(loaded).detach()))
    touch, photo = trainer.features.train_features(trainer.matcher, loaded)
    assert isinstance(trainer.label_loss, LabelLoss)
    extra = trainer.label_loss(batch, touch, photo)
    assert found[1] - found[0] == pytest.approx(2.0 * math.log(2) * 2 + 4.0, rel=0.05)
    for head in (trainer.label_loss.touch, trainer.label_loss.photo):
        torch.nn.init.normal_(head.layers[-1].weight)
    trainer.label_loss(batch, touch, photo).backward()
    assert extra.item() > 0
    for tower in (trainer.matcher.touch_tower, trainer.matcher.photo_tower):
        assert float(tower.features[17].conv[2].weight.grad.abs().sum()) > 0


def test_labels_come_from_the_recording_and_an_object_without_them_is_named(labelled, recording, tmp_path):
    config = with_training(CONFIG, predict_labels=1.0)
    row = {"relief": "grid", "shape": "box", "pitch_mm": 2, "amplitude_mm": 0.2, "aspect": 1, "sharpness": 0.5}
    other = {**row, "relief": "dots", "pitch_mm": 3, "amplitude_mm": 0.3, "aspect": 2, "sharpness": 1.0}
    objects = sorted({grasp.object_id for grasp in load_grasps(recording)})
    with pytest.raises(DatasetError, match=r"needs the labels .*; \S+ has none: set predict_labels = 0"):
        train(labelled({}), tmp_path / "a.safetensors", config, quiet=True)
    folder = labelled({name: (row, other)[number % 2] for number, name in enumerate(objects)})
    assert load_object_labels(folder)[objects[0]] == ObjectLabels(("grid", "box"), (2.0, 0.2, 1.0, 0.5))
    assert train(folder, tmp_path / "b.safetensors", config, quiet=True).provenance["step"] == 2


def test_impossible_labels_are_refused_with_the_value(labelled):
    row = {"relief": "grid", "shape": "box", "pitch_mm": -2, "amplitude_mm": 1, "aspect": 1, "sharpness": 0.5}
    with pytest.raises(
        DatasetError, match=r"must hold the labels of each object; pitch .* got \(-2.0, 1.0, 1.0, 0.5\)"
    ):
        load_object_labels(labelled({"mug": row}))
