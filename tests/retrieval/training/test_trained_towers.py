"""Training of towers: a frozen stem and augmentation."""

import numpy as np
import pytest
import torch

from retrieval.errors import ConfigError
from retrieval.training.augmentation import augment_photos, augment_touches
from tests.conftest import TINY
from tests.retrieval.training.test_train import load, trainer_for, with_matcher, with_training

FROZEN_STEM = with_training(TINY, freeze_stem=True, freeze_batch_norm=True, iterations=1)


def test_the_stem_does_not_change_and_the_other_layers_do(recording, tmp_path):
    config = with_matcher(
        FROZEN_STEM, tower="mobilenet_v2", tower_output="stages", cell_dim=4, touch_cells=2, photo_cells=2
    )
    trainer = trainer_for(recording, tmp_path / "m.safetensors", config)
    tower = trainer.matcher.touch_tower
    before = {name: tensor.clone() for name, tensor in tower.state_dict().items()}
    trainer.run(quiet=True)
    stem = {f"features.{name}" for name in tower.stem_layers().state_dict()}
    changed = {name for name, tensor in tower.state_dict().items() if not torch.equal(before[name], tensor)}
    assert stem
    assert not changed & stem
    assert "features.17.conv.2.weight" in changed


def test_a_tower_without_a_stem_is_refused_by_name(recording, tmp_path):
    with pytest.raises(ConfigError, match="SmallTower has no stem to freeze; set freeze_stem = false"):
        trainer_for(recording, tmp_path / "m.safetensors", FROZEN_STEM)


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


@pytest.mark.parametrize("augment", [True, False])
def test_a_step_depends_on_its_number_alone_and_no_two_steps_show_the_same_augmented_images(
    recording, tmp_path, augment
):
    trainer = trainer_for(recording, tmp_path / "m.safetensors", with_training(TINY, augment=augment))
    batch = trainer.sampler.batch(0, 4)
    first, again, next_step = (load(trainer.features, batch, step) for step in (3, 3, 4))
    assert torch.equal(first.touches, again.touches)
    assert torch.equal(first.photos, again.photos)
    assert torch.equal(first.touches, next_step.touches) is not augment
