"""Training of the gel tower: presses of random surfaces, their changes, and the losses."""

import numpy as np
import pytest
import torch

from models import gel_tower
from models.random_surfaces import GRID, RandomSurface, presses
from retrieval.model.checkpoint import read_tensors
from retrieval.model.towers.tower import build_tower
from retrieval.model.towers.weights import gel_tower as packaged_gel_tower
from robot.sim.gel.sensor import draw_sensor


@pytest.mark.parametrize("seed", range(2))
def test_a_press_of_a_random_surface_changes_the_gel_image(seed):
    sensor, surface = draw_sensor(0, "a"), RandomSurface.draw(seed)
    gap = surface.gap_mm(np.random.default_rng(seed), 0.126)
    assert gap.shape == GRID
    assert gap.min() == 0  # it touches the pad at its highest point
    frame = sensor.background(1).astype(float)
    made = list(presses(surface, sensor, np.random.default_rng(0), 3))
    assert all(np.abs(picture - frame).mean() > 1 for picture in made)


def test_the_losses_are_lowest_for_alike_presses_and_for_imagenets_features_with_any_offset():
    training = gel_tower.GelTowerTraining.__new__(gel_tower.GelTowerTraining)
    training.projection = torch.nn.Identity()
    torch.manual_seed(0)
    surfaces = torch.randn(10, 64).repeat_interleave(2, 0) + 0.1 * torch.randn(20, 64)
    assert training.contrast(surfaces) < 0.05
    # 19 other presses, all as far away as each other.
    assert training.contrast(torch.randn(20, 4096)) == pytest.approx(np.log(19), abs=0.1)
    published = torch.randn(20, 8)
    assert gel_tower.distance(published + 3, published) == pytest.approx(0, abs=1e-6)
    assert gel_tower.distance(2 * published, published) > 0.3


@pytest.mark.slow
def test_a_training_writes_a_tower_that_loads(tmp_path, monkeypatch):
    for name, value in {"SURFACES": 4, "SURFACES_OF_STEP": 3, "LABELLED_OF_STEP": 4, "TOUCH_PX": 64}.items():
        monkeypatch.setattr(gel_tower, name, value)
    line = f"{tmp_path} --init {packaged_gel_tower()} --sensors 2 --labelled 12 --jobs 1 --steps 2"
    assert gel_tower.main(line.split()) == 0
    tower = build_tower("mobilenet_v2", "stages")
    tower.initialise(str(tmp_path / "gel-tower.safetensors"))
    before = read_tensors(packaged_gel_tower())[0]["features.10.conv.0.0.weight"]
    assert not torch.equal(tower.state_dict()["features.10.conv.0.0.weight"], before.float())
    assert "2 sensors" in (tmp_path / "gel-tower.md").read_text()


def test_the_packaged_tower_is_a_mobilenet_of_half_precision():
    tensors, header = read_tensors(packaged_gel_tower())
    assert (header["tower"], header["tower_output"]) == ("mobilenet_v2", "stages")
    assert {each.dtype for each in tensors.values()} == {torch.float16, torch.int64}
    assert packaged_gel_tower().stat().st_size < 12e6
