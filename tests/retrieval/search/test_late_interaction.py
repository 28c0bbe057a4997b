"""An index of a model with late interaction: what it stores, and that its answers are those of the whole network."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from indexes.store.folder import IndexStore
from retrieval.commands.main import main
from retrieval.errors import BadInput
from retrieval.indexing import candidates
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.model.posterior import Posterior
from retrieval.model.references import ReferenceCalibration
from retrieval.search.searcher import Searcher
from retrieval.training.calibration import checkpoint as calibration
from retrieval.training.calibration.checkpoint import calibrate_checkpoint
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.scores import score_grasps
from tests.conftest import TINY
from tests.reference_model import POSTERIOR, write_reference_model

CELLS = dataclasses.replace(TINY.matcher, tower_output="stages", cosine=True, cell_dim=4, touch_cells=2, photo_cells=3)
POOLED_POSTERIOR = Posterior(1.1, -0.4, 0.6, 40)
POOLED_REFERENCES = ReferenceCalibration(Posterior(7.0, -2.0, 0.5, 40), 4.0, Posterior(1.2, -1.0, 0.8, 40), 20, 40)


@pytest.fixture
def checkpoint(tmp_path):
    pooled = {"pooled_posterior": POOLED_POSTERIOR, "pooled_references": POOLED_REFERENCES}
    return write_reference_model(tmp_path / "cells.safetensors", matcher=CELLS, **pooled)


@pytest.fixture
def index(catalogue, checkpoint, tmp_path):
    build_index(catalogue, checkpoint, tmp_path / "index")
    return tmp_path / "index"


@pytest.fixture
def pooled_index(catalogue, checkpoint, tmp_path):
    build_index(catalogue, checkpoint, tmp_path / "pooled", cells=False)
    return tmp_path / "pooled"


def arrays_of(index):
    return IndexStore(index).open().arrays


@pytest.mark.parametrize("cells", [True, False])
def test_logits_of_an_index_equal_those_of_the_network_but_for_the_rounding(
    cells, index, pooled_index, checkpoint, catalogue, touches
):
    """Without cells, the pooled part of a photo's partial activation, and the posterior of pooled logits."""
    files, load, matcher = next(iter(touches.values()))[0], checkpoint.config.preprocessing, checkpoint.matcher
    gels = torch.from_numpy(np.stack([load.load_touch(file) for file in files])).permute(0, 3, 1, 2)[None]
    width = None if cells else CELLS.pooled_width
    with Searcher.open(index if cells else pooled_index) as searcher, torch.inference_mode():
        assert set(searcher.generation.arrays) == ({"partials", "cells"} if cells else {"partials"})
        assert searcher.posterior == (POSTERIOR if cells else POOLED_POSTERIOR)
        touch = matcher.touch_encoding(matcher.touch_features(gels)).partial[:, :width]
        found = searcher.shard._logits(searcher.encode(files).partials, np.arange(searcher.generation.count))
        for row, logit in zip(searcher.generation.rows, found, strict=True):
            photo = torch.from_numpy(load.load_photo(catalogue / row.path)).permute(2, 0, 1)[None]
            partial = matcher.photo_encoding(matcher.photo_features(photo)).partial[:, :width]
            assert float(logit) == pytest.approx(float(matcher.head(touch, partial)), abs=0.02)


def test_a_later_build_keeps_the_setting(pooled_index, index, catalogue, checkpoint):
    assert not build_index(catalogue, checkpoint, pooled_index).written
    report = build_index(catalogue, checkpoint, index)
    assert (report.written, report.cells, report.embedded) == (False, True, 0)


def test_cells_can_be_dropped_and_added_again(index, pooled_index, catalogue, checkpoint):
    assert build_index(catalogue, checkpoint, index, cells=False).written
    assert list(arrays_of(index)) == ["partials"]
    np.testing.assert_allclose(arrays_of(index)["partials"], arrays_of(pooled_index)["partials"], atol=2e-3)
    report = build_index(catalogue, checkpoint, index, cells=True)
    assert (report.written, report.embedded) == (True, 0)  # the generation before the previous one had cells
    assert set(arrays_of(index)) == {"partials", "cells"}


def test_the_command_takes_the_option(catalogue, checkpoint, tmp_path, capsys):
    command = ["build-index", str(catalogue), "--model", str(checkpoint.path), "--out", str(tmp_path / "made")]
    assert main([*command, "--no-cells"]) == 0
    assert "no cells are stored" in capsys.readouterr().err
    assert list(arrays_of(tmp_path / "made")) == ["partials"]


@pytest.mark.parametrize("cells", [True, False])
def test_a_model_without_cells_refuses_the_option(catalogue, tmp_path, cells):
    model = write_reference_model(tmp_path / "pooled.safetensors")
    with pytest.raises(BadInput, match="need a model with late interaction"):
        build_index(catalogue, model, tmp_path / "none", cells=cells)
    with pytest.raises(BadInput, match="need a model with late interaction"):
        build_sharded(catalogue, model, tmp_path / "none", 2, cells=cells)


def test_reference_touches_are_reused_with_the_calibration_of_pooled_logits(
    catalogue_with_touches, checkpoint, tmp_path, touches
):
    report = build_index(catalogue_with_touches, checkpoint, tmp_path / "index", cells=False)
    assert (report.references["touches"], report.references["encoded"]) == (8, 8)
    again = build_index(catalogue_with_touches, checkpoint, tmp_path / "index")
    assert (again.written, again.references["encoded"]) == (False, 0)
    generation = IndexStore(tmp_path / "index").open()
    assert generation.documents["touches"].shape[1] == CELLS.pooled_width
    with Searcher.open(tmp_path / "index") as searcher:
        posterior = searcher.query(next(iter(touches.values()))[0]).posterior
        assert posterior["references"]["calibration"] == dataclasses.asdict(POOLED_REFERENCES)


def test_the_pooled_posterior_is_fitted_on_the_logits_of_the_matcher_without_cells(checkpoint, monkeypatch):
    """Twelve touches of six objects, each of two photos: without cells, photo features end before those of cells."""
    matcher, pooled = checkpoint.matcher, checkpoint.matcher.without_cells()
    rng = torch.Generator().manual_seed(0)
    width = matcher.photo_tower.output_count + (matcher.views - 1) * matcher.photo_tower.feature_count
    photos = {Path(f"{at}.png"): torch.rand(width, generator=rng) for at in range(12)}
    touches = torch.rand(12, 2 * matcher.touch_tower.output_count, generator=rng)
    grasps = [
        SimpleNamespace(object_id=f"object {at // 2}", photo=photo, opening_mm=None) for at, photo in enumerate(photos)
    ]
    each, count = pooled.touch_tower.feature_count, pooled.pooled_counts[1]
    short = {photo: features[:count] for photo, features in photos.items()}
    short_touches = touches.reshape(12, 2, -1)[..., :each].reshape(12, -1)
    expected = score_grasps(pooled, grasps, short_touches, short)
    found = score_grasps(matcher, grasps, touches, photos).pooled
    np.testing.assert_allclose(found.logits, expected.logits, atol=1e-5)
    monkeypatch.setattr(calibration, "recorded_features", lambda *_, **__: (touches, photos))
    monkeypatch.setattr(calibration, "_sample_grasps", lambda some, *_: some)  # keeps their order
    made = calibrate_checkpoint(checkpoint, None, grasps, grasps)
    assert made.pooled_posterior.slope == pytest.approx(fit_posterior(expected).slope, rel=1e-3)
    assert made.posterior != made.pooled_posterior


@pytest.mark.parametrize("cells", [True, False])
def test_a_model_with_a_candidate_encoder_embeds_its_stored_touches(
    catalogue, checkpoint, tmp_path, cells, monkeypatch
):
    """Only their pooled part: the candidate encoder does not see cells."""
    monkeypatch.setattr(candidates, "EXHAUSTIVE_LIMIT", 4)
    queries = np.ones((3, CELLS.touch_partial_width), dtype=np.float16)
    sizes = dataclasses.replace(CELLS, candidate_width=8)
    model = write_reference_model(tmp_path / "encoder.safetensors", matcher=sizes, queries=queries)
    report = build_index(catalogue, model, tmp_path / "index", cells=cells)
    assert report.candidates["queries"] == 3
