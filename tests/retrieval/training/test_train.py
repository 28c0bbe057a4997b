"""Training: shared images, losses, augmentation, bit-exact resumption, interruption, frozen parts, initial weights."""

import dataclasses
import json
import os
import shutil
import signal
from copy import deepcopy
from pathlib import Path
from pkgutil import resolve_name
from unittest.mock import Mock
from urllib.error import URLError

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from retrieval.data.dataset import Split, load_grasps, make_split
from retrieval.data.pairs import PairSampler
from retrieval.errors import BadInput, CheckpointError, ConfigError, DatasetError, JobInterrupted
from retrieval.model.checkpoint import load_checkpoint, read_tensors
from retrieval.model.encode import photo_features
from retrieval.model.losses.listwise import contrastive_loss, listwise_loss
from retrieval.model.losses.loss import Loss, match_loss
from retrieval.model.towers.tower import Tower
from retrieval.training import features as features_module
from retrieval.training.augmentation import augment_photos
from retrieval.training.batches import BatchImages, TrainedFeatures
from retrieval.training.initial_weights import build_matcher
from retrieval.training.loop import state_path
from retrieval.training.train import train
from retrieval.training.trainer import (
    Trainer,
    WeightedLosses,
    batch_loss,
    set_training_mode,
    shuffle_fingers,
    train_matcher,
)
from tests.conftest import TINY

CPU = torch.device("cpu")


class NormTower(Tower):
    """A tower whose running statistics change if it is ever in training mode."""

    def __init__(self, output):
        super().__init__(output)
        self.feature_count = 8
        self.layers = nn.Sequential(nn.Conv2d(3, 8, 3, stride=2), nn.BatchNorm2d(8))

    def _encode(self, images):
        return self.layers(images).mean((2, 3))


class Proxies(Loss):
    def __init__(self, embedding_dim, objects):
        super().__init__(embedding_dim, objects)
        self.proxies = nn.Embedding(objects, embedding_dim)

    def forward(self, batch):
        return functional.cross_entropy(batch.touch.embedding @ self.proxies.weight.T, batch.touch_objects)


OWN = TINY.using(losses={"contrastive": 0.5, Proxies: 0.5})
NORM = TINY.using(tower=NormTower)


def with_training(config, **changes):
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **changes))


def with_matcher(config, **changes):
    return dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, **changes))


WITH_ENCODER = with_matcher(with_training(TINY, distil_steps=4), candidate_width=8)


def load(source, batch, step=0):
    return next(iter(source.batches(None, [(step, batch)])))


def trainer_for(recording, out, config=TINY):
    grasps = load_grasps(recording)
    return Trainer(
        config,
        make_split(grasps, validation=0.25, test=0.2, seed=0),
        grasps,
        out,
        {"source": "test", "data_digest": ""},
    )


def same_weights(left, right):
    return all(torch.equal(left[name], right[name]) for name in left)


def stop_after(trainer, steps, stop=lambda: 1 / 0):
    """Run and stop like a power cut in the step after `steps`, when the state of that step is on disk."""
    loss = trainer.loss
    trainer.loss = lambda step, loaded: (stop() if step == steps else None, loss(step, loaded))[1]
    trainer.run()


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


# A batch and its loss --------------------------------------------------------------------------------------------


def test_each_distinct_image_is_loaded_and_passes_through_its_tower_once(recording, tmp_path):
    trainer = trainer_for(recording, tmp_path / "m.safetensors")
    batch = trainer.sampler.batch(0, 4)
    assert len(batch.labels) == 16  # pairs of 4 touches and at most 16 photos
    loaded = load(trainer.features, batch)
    assert (len(loaded.touches), len(loaded.photos)) == (4, len(set(batch.photos)))
    counts = []
    for tower in (trainer.matcher.touch_tower, trainer.matcher.photo_tower):
        tower.register_forward_hook(lambda _, images, __: counts.append(len(images[0])))
    trainer.loss(0, loaded)
    assert counts == [2 * 4, len(set(batch.photos))]
    first, again, next_step = (trainer.loss(step, loaded).item() for step in (0, 0, 1))
    assert first == again != next_step  # the dropout mask is that of the step


def test_shared_images_give_the_loss_and_the_gradients_of_one_pair_at_a_time(recording):
    """Without other losses and dropout the loss is exactly the paper's: the mean over single pairs."""
    config = with_matcher(with_training(TINY, weights={}, precision="float32"), dropout=0.0, standardise=False)
    sampler = PairSampler(load_grasps(recording), seed=0, positives=2, negatives=2, share_photos=True)
    source, gradients, losses = TrainedFeatures(config, CPU), [], []
    loaded = load(source, sampler.batch(0, 3))
    batch = loaded.batch
    for one_by_one in (False, True):
        torch.manual_seed(0)
        matcher = build_matcher(config)
        if one_by_one:
            pairs = zip(batch.touch_index, batch.photo_index, batch.labels, strict=True)
            parts = [
                match_loss(matcher(loaded.touches[touch][None], loaded.photos[photo][None]), torch.tensor([label]))
                for touch, photo, label in pairs
            ]
            loss = torch.stack(parts).mean()
        else:
            features = source.train_features(matcher, loaded)
            loss = batch_loss(matcher, WeightedLosses({}, matcher, 9), batch, *features)
        loss.backward()
        losses.append(loss.item())
        gradients.append({name: part.grad for name, part in matcher.named_parameters() if part.grad is not None})
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert gradients[0].keys() == gradients[1].keys()
    for name, one in gradients[0].items():  # float32 sums of 8 and 48 parts in another order
        assert float((one - gradients[1][name]).abs().max()) < 1e-5 * float(one.abs().max().clamp(min=1e-7)), name


def test_each_loss_is_added_with_its_weight(recording):
    config = with_matcher(with_training(TINY, weights={"contrastive": 0.3, "listwise": 0.7}), dropout=0.0)
    torch.manual_seed(0)
    matcher = build_matcher(with_training(config, precision="float32"))
    source = TrainedFeatures(config, CPU)
    loaded = load(source, PairSampler(load_grasps(recording), seed=0).batch(0, 3))
    features = [part.detach() for part in source.train_features(matcher, loaded)]
    matcher.eval()
    loss = batch_loss(matcher, WeightedLosses(config.training.weights, matcher, 9), loaded.batch, *features)
    touch, photo, batch = matcher.touch_encoding(features[0]), matcher.photo_encoding(features[1]), loaded.batch
    objects = torch.from_numpy(batch.touch_objects), torch.from_numpy(batch.photo_objects)
    logits = matcher.head(touch.partial[:, None], photo.partial[None])
    expected = match_loss(logits[batch.touch_index, batch.photo_index], torch.from_numpy(batch.labels))
    expected = expected + 0.3 * contrastive_loss(touch.embedding, photo.embedding, *objects, matcher.log_scale)
    assert loss.item() == pytest.approx((expected + 0.7 * listwise_loss(logits, *objects)).item(), rel=1e-6)


@pytest.mark.parametrize(
    ("negatives", "frozen", "shared"),
    [("auto", False, True), ("auto", True, False), ("dataset", False, False), ("batch", True, True)],
)
def test_negatives_come_from_the_batch_or_the_whole_set_as_configured(recording, tmp_path, negatives, frozen, shared):
    config = with_training(TINY, negatives=negatives, freeze_towers=frozen)
    assert trainer_for(recording, tmp_path / "m.safetensors", config).sampler.share_photos is shared


def test_an_error_in_a_worker_is_the_plain_error(recording):
    source = TrainedFeatures(with_training(TINY, workers=1), CPU)
    batch = PairSampler(load_grasps(recording), seed=0).batch(0, 2)
    missing = dataclasses.replace(batch.grasps[0], touches=(recording / "gone.png",) * 2)
    with pytest.raises(BadInput, match=r"gone\.png") as failed:
        load(source, dataclasses.replace(batch, grasps=[missing, *batch.grasps[1:]]))
    assert "Traceback" not in str(failed.value)


def test_fingers_are_shuffled_within_a_touch_by_the_seed():
    features = torch.arange(24.0).view(4, 6)  # four touches of two fingers with three features
    torch.manual_seed(3)
    shuffled = torch.cat([shuffle_fingers(features, fingers=2) for _ in range(50)])
    torch.manual_seed(3)
    assert torch.equal(shuffled[:4], shuffle_fingers(features, fingers=2))
    swapped = features.view(4, 2, 3).flip(1).flatten(1)
    same, other = ((shuffled == each.repeat(50, 1)).all(1) for each in (features, swapped))
    assert (same ^ other).all()
    assert 60 < int(other.sum()) < 140


def test_the_views_of_a_photo_are_flipped_together_left_to_right_and_stay_in_their_places():
    photos = torch.full((2, 3, 64, 128), 0.2)
    photos[:, :, :, :16] = 0.8  # left edge of the first view; the second view is dark
    turned = augment_photos(photos, 2, np.array([False, True]), np.random.default_rng(0))
    left, right = turned[..., :16].mean((1, 2, 3)), turned[..., 48:64].mean((1, 2, 3))
    assert left[0] > right[0] + 0.2
    assert right[1] > left[1] + 0.2
    second = turned[..., 64:]
    assert (second.amax((1, 2, 3)) - second.amin((1, 2, 3)) < 0.2).all()


@pytest.mark.parametrize("augment", [True, False])
def test_a_step_depends_on_its_number_alone_and_no_two_steps_show_the_same_augmented_images(recording, augment):
    source = TrainedFeatures(with_training(TINY, augment=augment), CPU)
    batch = PairSampler(load_grasps(recording), seed=0).batch(0, 4)
    first, again, next_step = (load(source, batch, step) for step in (3, 3, 4))
    assert torch.equal(first.touches, again.touches)
    assert torch.equal(first.photos, again.photos)
    assert torch.equal(first.touches, next_step.touches) is not augment


# A run that stops ------------------------------------------------------------------------------------------------


def test_a_resumed_training_gives_the_bits_of_an_uninterrupted_one_with_any_number_of_workers(recording, tmp_path):
    """Also of the parameters of a loss, which are trained and not stored in the checkpoint."""
    config, parts = with_training(OWN, augment=True, workers=0), tmp_path / "b.safetensors"
    whole = trainer_for(recording, tmp_path / "a.safetensors", config)
    first = deepcopy(whole.losses.state_dict())
    assert first["terms.1.proxies.weight"].shape == (len(whole.split.train), 16)
    whole.run()
    assert not same_weights(first, whole.losses.state_dict())
    with pytest.raises(ZeroDivisionError):
        stop_after(trainer_for(recording, parts, config), 3)
    with pytest.raises(CheckpointError, match=r"another config; .* delete the file"):
        trainer_for(recording, parts).run()
    resumed = trainer_for(recording, parts, with_training(config, workers=2))
    resumed.run()
    assert same_weights(whole.losses.state_dict(), resumed.losses.state_dict())
    assert same_weights(whole.matcher.state_dict(), resumed.matcher.state_dict())
    assert whole.out.read_bytes() == parts.read_bytes()
    assert not state_path(parts).exists()
    tensors, header = read_tensors(parts)
    assert not [name for name in tensors if "proxies" in name or "terms" in name]
    assert header["config"]["training"][f"{__name__}:Proxies_weight"] == 0.5
    assert load_checkpoint(parts).config.has_embeddings


@pytest.fixture(scope="module")
def whole(recording, tmp_path_factory):
    """The checkpoint of an uninterrupted run with a candidate encoder."""
    return trainer_for(recording, tmp_path_factory.mktemp("whole") / "m.safetensors", WITH_ENCODER).run()


def test_a_checkpoint_with_a_candidate_encoder_has_the_touches_of_validation_objects(whole, recording):
    assert whole.matcher.candidate_encoder is not None
    assert len(whole.queries) == len(whole.split.select(load_grasps(recording), "validation"))


@pytest.mark.parametrize(
    ("where", "stop"),
    [
        ("retrieval.training.distil.distillation_loss", interrupt),
        ("retrieval.training.trainer.calibrate_checkpoint", lambda: 1 / 0),
        ("pathlib.Path.unlink", interrupt),
    ],
)
def test_a_run_that_stopped_after_the_last_step_is_completed_without_another_step(
    where, stop, whole, recording, tmp_path, monkeypatch
):
    """A power cut or Ctrl-C comes before the checkpoint is written, or while its state still exists."""
    broken, real = trainer_for(recording, tmp_path / "b.safetensors", WITH_ENCODER), resolve_name(where)
    is_complete = real is Path.unlink

    def stopping(*given, **named):
        if not is_complete or given[0] == state_path(broken.out):
            stop()
        return real(*given, **named)

    with monkeypatch.context() as cut:
        cut.setattr(where, stopping)
        with pytest.raises((ZeroDivisionError, JobInterrupted)) as stopped:
            broken.run()
    if stop is interrupt:
        assert "run the same command to continue" in str(stopped.value)
    assert broken.out.exists() == is_complete
    resumed = trainer_for(recording, broken.out, WITH_ENCODER)
    resumed.loss = lambda *_: pytest.fail("made a step")
    resumed.run()
    assert whole.path.read_bytes() == broken.out.read_bytes()
    assert not state_path(broken.out).exists()


def test_after_ctrl_c_the_same_command_gives_the_bits_of_an_uninterrupted_run(whole, recording, tmp_path):
    trainer = trainer_for(recording, tmp_path / "m.safetensors", WITH_ENCODER)
    with pytest.raises(JobInterrupted, match=r"step 2 of .*run the same command to continue"):
        stop_after(trainer, 1, interrupt)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    trainer_for(recording, trainer.out, WITH_ENCODER).run()
    assert whole.path.read_bytes() == trainer.out.read_bytes()


# Frozen parts and rates ------------------------------------------------------------------------------------------


def test_frozen_towers_encode_each_image_once_and_do_not_change(recording, tmp_path, monkeypatch):
    counts = []
    monkeypatch.setattr(
        features_module,
        "photo_features",
        lambda matcher, photos: (counts.append(len(photos)), photo_features(matcher, photos))[1],
    )
    trainer = trainer_for(recording, tmp_path / "m.safetensors", with_training(NORM, freeze_towers=True))
    tower = trainer.matcher.photo_tower
    before = deepcopy(tower.state_dict())
    tower.register_forward_hook(lambda *_: pytest.fail("encoded a photo again"))
    trainer.run()
    assert same_weights(before, tower.state_dict())
    known = {photo for part in trainer.sampler.photos for photo in part} | set(trainer.validation.photos)
    assert sum(counts) == len(known)


def test_frozen_batch_norm_keeps_its_running_statistics():
    matcher, images = build_matcher(NORM), torch.rand(2, 3, 32, 32)
    norm = matcher.photo_tower.layers[1]
    for is_frozen in (True, False):
        set_training_mode(matcher, dataclasses.replace(NORM.training, freeze_batch_norm=is_frozen))
        before = norm.running_mean.clone()
        matcher.photo_tower(images)
        assert torch.equal(before, norm.running_mean) == is_frozen


def test_the_stem_does_not_change_and_the_other_layers_do(recording, tmp_path):
    config = with_training(TINY, freeze_stem=True, freeze_batch_norm=True, iterations=1)
    with pytest.raises(ConfigError, match="SmallTower has no stem to freeze; set freeze_stem = false"):
        trainer_for(recording, tmp_path / "m.safetensors", config)
    config = with_matcher(config, tower="mobilenet_v2", tower_output="stages", cell_dim=4, touch_cells=2, photo_cells=2)
    trainer = trainer_for(recording, tmp_path / "m.safetensors", config)
    tower = trainer.matcher.touch_tower
    before = deepcopy(tower.state_dict())
    trainer.run()
    changed = {name for name, tensor in tower.state_dict().items() if not torch.equal(before[name], tensor)}
    stem = {f"features.{name}" for name in tower.stem_layers().state_dict()}
    assert stem
    assert not changed & stem
    assert "features.17.conv.2.weight" in changed


def test_the_towers_learn_at_their_own_rate(recording, tmp_path):
    """Adam's first step moves each weight by its learning rate, whatever the gradient."""
    config = with_training(TINY, iterations=1, tower_rate=0.25)
    trainer = trainer_for(recording, tmp_path / "m.safetensors", config)
    before = deepcopy(trainer.matcher.state_dict())
    after = trainer.run().matcher.state_dict()
    for name, rate in (("touch_tower.stages.0.weight", 0.25), ("head.second.weight", 1.0)):
        moved = float((after[name] - before[name]).abs().max())
        assert moved == pytest.approx(rate * config.training.learning_rate, rel=0.01)


# What the recording and the settings decide ----------------------------------------------------------------------


def test_without_validation_objects_the_checkpoint_is_the_last_step_without_a_posterior(recording, tmp_path):
    config = with_training(TINY, validation_fraction=0.0, iterations=4, validate_every=3)
    made = train_matcher(recording, tmp_path / "m.safetensors", config)
    assert made.split.validation == ()
    assert len(made.split.train) + len(made.split.test) == 12
    assert (made.provenance["step"], made.posterior) == (4, None)
    assert made.config.matcher.fingers == 2  # as recorded


def test_a_background_policy_needs_no_contact_frames(recording, tmp_path):
    preprocessing, grasp = dataclasses.replace(TINY.preprocessing, background="difference"), load_grasps(recording)[0]
    images = BatchImages(preprocessing)
    with pytest.raises(DatasetError, match="no-contact frame for each finger"):
        images.touch(dataclasses.replace(grasp, backgrounds=()))
    expected = [preprocessing.load_touch(*files) for files in zip(grasp.touches, grasp.backgrounds, strict=True)]
    np.testing.assert_array_equal(images.touch(grasp), expected)
    config = with_training(dataclasses.replace(TINY, preprocessing=preprocessing), iterations=1)
    train_matcher(recording, tmp_path / "m.safetensors", config)


def test_bfloat16_is_refused_where_it_would_be_emulated(recording, tmp_path, monkeypatch):
    monkeypatch.setattr("retrieval.model.encode.has_fast_bfloat16", lambda device: False)
    with pytest.raises(ConfigError, match="bfloat16 needs hardware"):
        train_matcher(recording, tmp_path / "m.safetensors", with_training(TINY, precision="bfloat16"))


def test_a_split_that_leaks_is_refused(recording, tmp_path):
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    leaking = Split(0, tuple(names[:6]), tuple(names[5:9]), ())
    with pytest.raises(DatasetError, match="shares 1 object"):
        train_matcher(recording, tmp_path / "m.safetensors", TINY, split=leaking)


def test_a_checkpoint_that_cannot_be_written_is_an_error_before_the_first_step(recording, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(Trainer, "loss", lambda *_: pytest.fail("trained"))
    for name, message in (("", "must be a file"), ("file/model.safetensors", "cannot be written")):
        with pytest.raises(CheckpointError, match=message):
            train_matcher(recording, tmp_path / name, TINY)


def test_without_the_download_a_training_from_published_weights_is_refused(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", Mock(side_effect=URLError("no route to host")))
    config = with_training(TINY.using(tower="resnet18"), init="imagenet")
    with pytest.raises(CheckpointError, match=r"resnet18-f37072fd\.pth elsewhere, and name the file with --init"):
        train_matcher(recording, tmp_path / "m.safetensors", config)


def test_a_checkpoint_names_the_unusual_camera_of_its_photos(recording, tmp_path):
    own = shutil.copytree(recording, tmp_path / "own")
    info = json.loads((own / "recording.json").read_text())
    config = with_training(TINY, iterations=1)
    config = dataclasses.replace(config, preprocessing=dataclasses.replace(config.preprocessing, views=("zoom",)))
    cameras = []
    for stated in ({}, {"field_mm": 320, "roll_deg": 90}):
        (own / "recording.json").write_text(json.dumps(info | stated))
        made = train_matcher(own, tmp_path / f"{len(stated)}.safetensors", config)
        cameras.append(made.provenance.get("camera"))
    assert cameras == [None, [320, 90]]


def test_training_continues_from_the_towers_and_the_head_of_a_checkpoint(model):
    """The initial weights that the checkpoint replaces are not read, so they need not be there."""
    started = build_matcher(with_training(TINY, start=str(model), init="missing.safetensors")).state_dict()
    assert same_weights(started, load_checkpoint(model).matcher.state_dict())


def test_a_checkpoint_with_other_towers_cannot_start_a_training(model):
    """Otherwise the towers would keep random weights, if the other layers have the same sizes."""
    with pytest.raises(CheckpointError, match=r"no touch_tower\.\S+ of shape .*; use its config"):
        build_matcher(with_training(with_matcher(TINY, tower="resnet18"), start=str(model)))


def test_a_callback_is_told_of_each_step_of_a_training(recording, tmp_path):
    told = {}
    train(recording, tmp_path / "m.safetensors", with_training(TINY, iterations=2), on_step=told.__setitem__)
    assert list(told) == [0, 1, 2]
    assert {"loss", "learning_rate", "validation_auc"} <= told[2].keys()
