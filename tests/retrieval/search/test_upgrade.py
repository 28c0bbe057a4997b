"""An index after an upgrade: what is embedded again, why, and what need not be."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from indexes.store.folder import IndexStore
from retrieval.data import preprocessing
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.fusion import pruner_of
from retrieval.model.stored import HALVES_OF, fingerprint
from retrieval.search.build.build_index import TAUGHT_AGAIN, build_index


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


def test_photos_that_are_prepared_otherwise_are_embedded_again_and_it_is_said(own, checkpoint, index, monkeypatch):
    build_index(own, checkpoint, index, quiet=True)
    monkeypatch.setattr(preprocessing, "PREPROCESSING_VERSION", preprocessing.PREPROCESSING_VERSION + 1)
    report = build_index(own, checkpoint, index, quiet=True)
    assert (report.embedded, report.remade) == (24, 0)
    assert report.reason.startswith("Every photo was embedded again: the model wants photos prepared in another way;")
    assert "the model is another one" not in report.reason


def taught_again(checkpoint, path, halves_of):
    """The model with a pruner that it had not, which says whose halves its own are."""
    torch.manual_seed(7)
    matcher = copy.deepcopy(checkpoint.matcher)
    config = dataclasses.replace(checkpoint.config.matcher, pruner_width=8)
    matcher.config, matcher.pruner = config, pruner_of(config)
    about = checkpoint.provenance | {HALVES_OF: halves_of}
    changed = dataclasses.replace(checkpoint.config, matcher=config)
    store_checkpoint(dataclasses.replace(checkpoint, matcher=matcher, config=changed, provenance=about), path)
    return load_checkpoint(path)


def test_a_model_whose_pruner_alone_was_taught_again_gives_old_halves_new_embeddings_and_says_so(
    own, checkpoint, index, embedded, tmp_path, monkeypatch
):
    build_index(own, checkpoint, index, quiet=True)
    halves = np.array(IndexStore(index).open().arrays["halves"])
    embedded.clear()
    other = taught_again(checkpoint, tmp_path / "other.safetensors", ["0" * 64, checkpoint.digest])
    from_photos = build_index(own, other, tmp_path / "whole", quiet=True)
    assert from_photos.embedded == 24
    embedded.clear()
    monkeypatch.setattr("retrieval.search.build.embed.decode_photo", None)  # whoever decodes one, fails
    report = build_index(own, other, index, quiet=True)
    assert (embedded, report.embedded, report.remade, report.reused, report.renamed) == ([], 0, 24, 24, 0)
    assert report.reason.startswith(TAUGHT_AGAIN)
    assert "24 with new embeddings of their old halves, 0 unchanged" in next(report.lines())
    made = IndexStore(index).open(expect=fingerprint(other))
    np.testing.assert_array_equal(made.arrays["halves"], halves)
    whole = IndexStore(tmp_path / "whole").open()
    np.testing.assert_allclose(made.embeddings[made.slots], whole.embeddings[whole.slots], atol=2e-3)  # of float16
    assert report.half_error == IndexStore(index).open(name="gen-000001").manifest.about["half_error"]
    assert build_index(own, other, index, quiet=True).written is False


@pytest.mark.parametrize("claimed", [None, "all", [], ["0" * 64]])
def test_halves_of_a_model_that_is_not_named_are_not_taken(own, checkpoint, index, tmp_path, claimed):
    build_index(own, checkpoint, index, quiet=True)
    report = build_index(own, taught_again(checkpoint, tmp_path / "o.safetensors", claimed), index, quiet=True)
    assert (report.embedded, report.remade) == (24, 0)
