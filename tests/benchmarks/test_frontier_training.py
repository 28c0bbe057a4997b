"""Number formats of training in the frontier: the default, and the row on a machine without bfloat16."""

import pytest
import torch
from torch import nn

from benchmarks.frontier import training
from benchmarks.frontier.training import _all_in_bfloat16, training_formats
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
def test_the_format_of_training_is_the_default_and_both_bfloat16_formats_have_a_small_error(sample):
    """The order of the two errors depends on the processor if the model is small."""
    (panel,) = training_formats(sample).panels
    exact, mixed, all_rounded = panel.points
    assert (exact.name, exact.error) == ("float32", 0)
    assert panel.default == mixed
    assert 0 < mixed.error < training.TOLERANCE
    assert 0 < all_rounded.error < training.TOLERANCE


def test_without_bfloat16_the_row_has_float32_alone_and_the_reason(sample, monkeypatch):
    monkeypatch.setattr(training, "has_fast_bfloat16", lambda device: False)
    row = training_formats(sample)
    (point,) = row.panels[0].points
    assert (point.name, point.is_default) == ("float32", True)
    assert "this processor multiplies no bfloat16" in row.text


def test_the_model_is_not_changed(sample, monkeypatch):
    before = {name: tensor.clone() for name, tensor in sample.checkpoint.matcher.state_dict().items()}
    monkeypatch.setattr(training, "has_fast_bfloat16", lambda device: False)
    training_formats(sample)
    matcher = sample.checkpoint.matcher
    assert not matcher.training
    assert all(torch.equal(tensor, before[name]) for name, tensor in matcher.state_dict().items())
    assert all(weight.grad is None for weight in matcher.parameters())


@needs_bfloat16
def test_all_layers_use_bfloat16_with_the_same_weights(sample):
    rounded = _all_in_bfloat16(sample.checkpoint.matcher)
    kinds = []
    for module in rounded.touch_tower.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(lambda module, inputs, result: kinds.append(result.dtype))
    with torch.autocast("cpu", torch.bfloat16), torch.inference_mode():
        rounded.touch_tower(torch.rand(2, 3, 32, 32))
    assert set(kinds) == {torch.bfloat16}
    assert len(kinds) == sum(isinstance(module, nn.Conv2d) for module in SmallTower("pooled").modules())
    pairs = zip(rounded.parameters(), sample.checkpoint.matcher.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
