"""Training with a frozen stem: its maps are computed once, stored, and give the gradients of the whole tower."""

import dataclasses

import pytest
import torch

from retrieval.data.dataset import load_grasps, make_split
from retrieval.errors import ConfigError
from retrieval.model.fusion import Matcher
from retrieval.model.towers.mobilenet import MobileNetV2
from retrieval.training.batches import StemFeatures, TrainedFeatures
from retrieval.training.train import Trainer
from tests.conftest import TINY

CPU = torch.device("cpu")
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
    def new(config=CONFIG):
        grasps = load_grasps(recording)
        split = make_split(grasps, validation=0.25, test=0.2, seed=0)
        return Trainer(config, split, grasps, tmp_path / "m.safetensors", source="test")

    return new


def test_outputs_from_the_maps_of_the_stem_equal_those_from_images():
    torch.manual_seed(0)
    matcher = Matcher(CONFIG.matcher, views=2).eval()
    touches, photos = torch.rand(3, 2, 3, 32, 32), torch.rand(3, 3, 32, 64)
    with torch.inference_mode():
        touch = matcher.touch_features_of_stem(matcher.touch_stem(touches))
        photo = matcher.photo_features_of_stem(matcher.photo_stem(photos))
        torch.testing.assert_close(touch, matcher.touch_features(touches), rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(photo, matcher.photo_features(photos), rtol=1e-5, atol=1e-5)


def test_gradients_equal_those_of_whole_towers(new_trainer):
    trainer = new_trainer()
    # Statistics of random weights are extreme; with those of the batch, activations have ordinary sizes.
    trainer.matcher.eval()
    batch = trainer.sampler.batch(0, 4)
    found = []
    for source in (StemFeatures(CONFIG, CPU, trainer.matcher), TrainedFeatures(CONFIG, CPU)):
        trainer.features = source
        trainer.matcher.zero_grad()
        with source:
            trainer.loss(source.prepare(trainer.matcher, batch).result()).backward()
        found.append(
            {
                name: part.grad.clone()
                for name, part in trainer.matcher.named_parameters()
                if part.requires_grad and part.grad is not None
            }
        )
    stem, whole = found
    assert stem.keys() == whole.keys()
    assert "touch_tower.features.17.conv.2.weight" in stem
    assert "touch_tower.features.6.conv.2.weight" not in stem
    # Maps are rounded to float16, half a thousandth of each value; this moves some units across the kink of ReLU6.
    difference, total = (
        torch.cat([part.flatten() for part in parts])
        for parts in ([stem[name] - gradient for name, gradient in whole.items()], list(whole.values()))
    )
    assert float(difference.norm()) <= 0.02 * float(total.norm())


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


def test_the_stem_encodes_each_image_once(new_trainer, monkeypatch):
    counts = {"images": 0}
    stem = MobileNetV2.stem

    def counted(tower, images):
        counts["images"] += len(images)
        return stem(tower, images)

    monkeypatch.setattr(MobileNetV2, "stem", counted)
    trainer = new_trainer()
    trainer.run(quiet=True)
    grasps = [grasp for part in trainer.sampler.grasps for grasp in part] + trainer.validation.grasps
    photos = {grasp.photo for grasp in grasps}
    assert 0 < counts["images"] <= 2 * len(grasps) + 2 * len(photos)


def test_stored_maps_are_read_without_opening_an_image(new_trainer, tmp_path, monkeypatch):
    first, second = new_trainer(), new_trainer()
    grasps = first.sampler.grasps[0]
    first.features.fill_cache(tmp_path / "maps", grasps, quiet=True)
    monkeypatch.setattr("retrieval.data.preprocessing.read_rgb", None)  # a call would raise
    monkeypatch.setattr("retrieval.data.preprocessing.read_bytes", None)
    second.features.fill_cache(tmp_path / "maps", grasps, quiet=True)
    batch = first.sampler.batch(0, 2)
    batch = dataclasses.replace(batch, grasps=list(grasps[:1]), photos=[grasps[0].photo])
    maps = [trainer.features.prepare(trainer.matcher, batch).result() for trainer in (first, second)]
    assert maps[0].touches.dtype == torch.float16
    assert torch.equal(maps[0].touches, maps[1].touches)
    assert torch.equal(maps[0].photos, maps[1].photos)


def test_a_tower_without_a_stem_is_refused_by_name(new_trainer):
    config = dataclasses.replace(CONFIG, matcher=TINY.matcher)
    with pytest.raises(ConfigError, match="SmallTower has no stem to freeze; set freeze_stem = false"):
        new_trainer(config)
