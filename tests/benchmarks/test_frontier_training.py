"""Number formats of training in the frontier: the default, and the row on a machine without bfloat16."""

import pytest
import torch

from benchmarks.frontier import training
from benchmarks.frontier.training import training_formats
from retrieval.frontier.sample import Sample, Scale
from retrieval.model.encode import has_fast_bfloat16

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
