"""An index after an upgrade: what is embedded again, what is reused, and the reported reason."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from indexes.store.folder import IndexStore
from retrieval.data import preprocessing
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.checkpoint_info import PARTIALS_FROM, fingerprint
from retrieval.model.fusion import candidate_encoder_of
from retrieval.search.build.build_index import CANDIDATE_ENCODER_CHANGED, build_index


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


def test_a_changed_preprocessing_embeds_all_photos_again_and_is_reported(
    catalogue_copy, checkpoint, index, monkeypatch
):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    monkeypatch.setattr(preprocessing, "PREPROCESSING_VERSION", preprocessing.PREPROCESSING_VERSION + 1)
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (report.embedded, report.re_embedded) == (24, 0)
    assert report.reason.startswith("Every photo was embedded again: the preprocessing of photos changed;")
    assert "the model changed" not in report.reason


def with_new_candidate_encoder(checkpoint, path, partials_from):
    """The model with a new candidate encoder, and with digests of models that give the same partial activations."""
    torch.manual_seed(7)
    matcher = copy.deepcopy(checkpoint.matcher)
    config = dataclasses.replace(checkpoint.config.matcher, candidate_width=8)
    matcher.config, matcher.candidate_encoder = config, candidate_encoder_of(config)
    about = checkpoint.provenance | {PARTIALS_FROM: partials_from}
    changed = dataclasses.replace(checkpoint.config, matcher=config)
    store_checkpoint(dataclasses.replace(checkpoint, matcher=matcher, config=changed, provenance=about), path)
    return load_checkpoint(path)


def test_a_new_candidate_encoder_alone_re_embeds_stored_partials(
    catalogue_copy, checkpoint, index, embedded, tmp_path, monkeypatch
):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    partials = np.array(IndexStore(index).open().arrays["partials"])
    embedded.clear()
    other = with_new_candidate_encoder(checkpoint, tmp_path / "other.safetensors", ["0" * 64, checkpoint.digest])
    from_photos = build_index(catalogue_copy, other, tmp_path / "whole", quiet=True)
    assert from_photos.embedded == 24
    embedded.clear()
    monkeypatch.setattr("retrieval.search.build.embed.decode_photo", None)  # decoding a photo would fail
    report = build_index(catalogue_copy, other, index, quiet=True)
    assert (embedded, report.embedded, report.re_embedded, report.reused, report.renamed) == ([], 0, 24, 24, 0)
    assert report.reason.startswith(CANDIDATE_ENCODER_CHANGED)
    assert "24 with recomputed embeddings, 0 unchanged" in next(report.lines())
    rebuilt = IndexStore(index).open(expect=fingerprint(other))
    np.testing.assert_array_equal(rebuilt.arrays["partials"], partials)
    whole = IndexStore(tmp_path / "whole").open()
    np.testing.assert_allclose(
        rebuilt.embeddings[rebuilt.slots], whole.embeddings[whole.slots], atol=2e-3
    )  # rounding to float16
    assert report.partial_error == IndexStore(index).open(name="gen-000001").manifest.about["partial_error"]
    assert build_index(catalogue_copy, other, index, quiet=True).written is False


@pytest.mark.parametrize("claimed", [None, "all", [], ["0" * 64]])
def test_partials_of_an_unnamed_model_are_not_reused(catalogue_copy, checkpoint, index, tmp_path, claimed):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    report = build_index(
        catalogue_copy, with_new_candidate_encoder(checkpoint, tmp_path / "o.safetensors", claimed), index, quiet=True
    )
    assert (report.embedded, report.re_embedded) == (24, 0)
