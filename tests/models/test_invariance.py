"""Training of towers towards what a start model knows from the images of its rig."""

import dataclasses

import pytest
import torch

from models.invariance import ANCHOR_WEIGHT, LABEL_SHARE, InvariantTrainer
from models.shipped import split_of
from retrieval.data.dataset import load_grasps
from retrieval.model.config import load_config


def test_only_towers_learn_from_labels_from_what_the_start_model_knows_and_from_its_features(recording, tmp_path):
    grasps, config = load_grasps(recording), load_config("tiny")
    config = dataclasses.replace(config, training=dataclasses.replace(config.training, freeze_towers=False))
    trainer = InvariantTrainer(config, split_of(grasps, []), grasps, tmp_path / "made", {}, references={})
    matcher, batch = trainer.matcher, trainer.sampler.batch(0, 4)
    (loaded,) = trainer.features.batches(matcher, [(0, batch)])
    features = trainer.features.train_features(matcher, loaded)
    touches, photos = matcher.touch_encoding(features[0]).partial, matcher.photo_encoding(features[1]).partial
    keys = [grasp.grasp_id for grasp in batch.grasps], batch.photos
    trainer.references = dict(zip((*keys[0], *keys[1]), torch.cat([touches, photos]).detach(), strict=True))

    logits = matcher.head.all_logits(touches, photos)
    is_own = torch.from_numpy(batch.touch_objects)[:, None] == torch.from_numpy(batch.photo_objects)
    expected = 0.0
    for scores, own in ((logits, is_own.float()), (logits.T, is_own.T.float())):
        targets = LABEL_SHARE * own / own.sum(1, keepdim=True) + (1 - LABEL_SHARE) * scores.softmax(1)
        expected -= (targets * scores.log_softmax(1)).sum(1).mean().item()
    loss = trainer.feature_loss(batch, *features)
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    learning = {name.split(".")[0] for name, weight in matcher.named_parameters() if weight.grad is not None}
    assert learning == {"touch_tower", "photo_tower"}

    # A rig's photos one deviation away from the photos, in every number: a distance of about 1.
    spread = photos.detach().std(0)
    trainer.references |= dict(zip(keys[1], photos.detach() + spread, strict=True))
    assert trainer.feature_loss(batch, *features).item() - expected > 0.9 * ANCHOR_WEIGHT
