"""An index of a model with late interaction: what it stores, and that its answers are those of the whole network."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.model.checkpoint import load_checkpoint, save_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import Posterior
from retrieval.search.build.build_index import build_index
from retrieval.search.query.searcher import Searcher
from tests.conftest import TINY

CELLS = dataclasses.replace(TINY.matcher, tower_output="stages", cosine=True, cell_dim=4, touch_cells=2, photo_cells=3)


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    config = Config(CELLS, TINY.training, TINY.preprocessing)
    provenance = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}
    path = tmp_path / "cells.safetensors"
    posterior = Posterior(0.9, -0.5, 0.7, 40)
    save_checkpoint(path, Matcher(CELLS).eval(), config, split=None, provenance=provenance, posterior=posterior)
    return load_checkpoint(path)


@pytest.fixture
def index(catalogue, checkpoint, tmp_path):
    build_index(catalogue, checkpoint, tmp_path / "index", quiet=True)
    return tmp_path / "index"


def test_a_photo_takes_two_bytes_for_each_pooled_number_and_one_for_each_number_of_a_cell(index):
    with Searcher.open(index) as searcher:
        arrays = searcher.generation.arrays
        assert (arrays["partials"].dtype, arrays["partials"].shape[1]) == (np.float16, CELLS.pooled_width)
        assert (arrays["cells"].dtype, arrays["cells"].shape[1]) == (np.int8, 3 * 3 * 4)
        assert 0 < searcher.generation.manifest.about["partial_error"] < 0.02


def test_logits_of_an_index_equal_those_of_the_network_but_for_the_rounding(index, checkpoint, catalogue, touches):
    files = next(iter(touches.values()))[0]
    load = checkpoint.config.preprocessing
    with Searcher.open(index) as searcher, torch.inference_mode():
        result = searcher.query(files, top=8)
        gels = torch.from_numpy(np.stack([load.load_touch(file) for file in files])).permute(0, 3, 1, 2)[None]
        matcher = checkpoint.matcher
        touch = matcher.touch_encoding(matcher.touch_features(gels)).partial
        for match in result.results:
            photo = torch.from_numpy(load.load_photo(catalogue / match.photo)).permute(2, 0, 1)[None]
            partial = matcher.photo_encoding(matcher.photo_features(photo)).partial
            exact = float(matcher.head(touch, partial))
            row = [at for at, row in enumerate(searcher.generation.rows) if row["path"] == match.photo]
            found = searcher.shard._logits(searcher.encode(files).partials, np.array(row))
            assert float(found[0]) == pytest.approx(exact, abs=0.02)


def test_a_second_build_embeds_no_photo_again(index, catalogue, checkpoint):
    report = build_index(catalogue, checkpoint, index, quiet=True)
    assert report.embedded == 0


def test_an_index_without_cells_is_refused_by_a_model_that_has_them(index, checkpoint):
    from indexes.errors import CorruptIndex
    from indexes.store.folder import IndexStore
    from retrieval.search.query.opening import folder_shard

    generation = IndexStore(index).open()
    del generation.arrays["cells"]
    with pytest.raises(CorruptIndex, match="cells must be int8"):
        folder_shard(generation, checkpoint)
