"""Number formats of training in the frontier: which is the default, and what a machine without bfloat16 leaves out."""

import pytest
import torch
from packaging.version import Version
from torch import nn

from benchmarks.frontier import training
from benchmarks.frontier.training import _with_no_layer_spared, training_formats
from retrieval.frontier.sample import Sample, Scale
from retrieval.model.encode import has_fast_bfloat16
from retrieval.model.towers.small import SmallTower

needs_bfloat16 = pytest.mark.skipif(
    not has_fast_bfloat16(torch.device("cpu")), reason="this processor multiplies no bfloat16"
)


@pytest.fixture(scope="module")
def sample(model, recording, tmp_path_factory):
    scale = Scale(repeats=1, quick=True)
    return Sample(model, lambda: recording, tmp_path_factory.mktemp("features"), scale, quiet=True)


@needs_bfloat16
@pytest.mark.skipif(
    Version(torch.__version__) < Version("2.7"), reason="of a model of a few weights this PyTorch rounds more, spared"
)
def test_a_training_s_own_format_is_the_default_and_less_is_turned_by_it_than_with_no_layer_spared(sample):
    (panel,) = training_formats(sample).panels
    whole, spared, all_rounded = panel.points
    assert (whole.name, whole.error) == ("float32", 0)
    assert panel.default == spared
    assert 0 < spared.error < all_rounded.error < 1


def test_where_a_processor_multiplies_no_bfloat16_float32_stands_alone_and_the_row_says_why(sample, monkeypatch):
    monkeypatch.setattr(training, "has_fast_bfloat16", lambda device: False)
    row = training_formats(sample)
    (point,) = row.panels[0].points
    assert (point.name, point.is_default) == ("float32", True)
    assert "this processor multiplies no bfloat16" in row.text


def test_the_model_is_left_as_it_was(sample, monkeypatch):
    before = {name: tensor.clone() for name, tensor in sample.checkpoint.matcher.state_dict().items()}
    monkeypatch.setattr(training, "has_fast_bfloat16", lambda device: False)
    training_formats(sample)
    matcher = sample.checkpoint.matcher
    assert not matcher.training
    assert all(torch.equal(tensor, before[name]) for name, tensor in matcher.state_dict().items())
    assert all(weight.grad is None for weight in matcher.parameters())


@needs_bfloat16
def test_no_layer_is_spared_and_the_weights_are_the_same_ones(sample):
    made = _with_no_layer_spared(sample.checkpoint.matcher)
    kinds = []
    for module in made.touch_tower.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(lambda module, given, result: kinds.append(result.dtype))
    with torch.autocast("cpu", torch.bfloat16), torch.inference_mode():
        made.touch_tower(torch.rand(2, 3, 32, 32))
    assert set(kinds) == {torch.bfloat16}
    assert len(kinds) == sum(isinstance(module, nn.Conv2d) for module in SmallTower("pooled").modules())
    pairs = zip(made.parameters(), sample.checkpoint.matcher.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
