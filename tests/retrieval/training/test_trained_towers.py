"""Training of towers: a frozen stem and augmentation."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.errors import ConfigError
from retrieval.training.augmentation import augment_photos, augment_touches
from tests.conftest import TINY
from tests.retrieval.training.test_train import load, trainer_for, with_training

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


@pytest.fixture
def new_trainer(recording, tmp_path):
    return lambda config=CONFIG: trainer_for(recording, tmp_path / "m.safetensors", config)


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
    first, again, next_step = (load(trainer.features, batch, step) for step in (3, 3, 4))
    assert torch.equal(first.touches, again.touches)
    assert torch.equal(first.photos, again.photos)
    assert not torch.equal(first.touches, next_step.touches)
    plain = new_trainer()
    one, other = (load(plain.features, batch, step) for step in (3, 4))
    assert torch.equal(one.touches, other.touches)
