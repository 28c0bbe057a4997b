"""The encoder of a long build: ONNX Runtime with the partial activations of PyTorch."""

import numpy as np
import pytest
from retrieval.model.photo_encoder import choose_photo_encoder, torch_photo_encoder

from indexes.store.folder import IndexStore
from retrieval.indexing.build import build_index
from retrieval.model import photo_encoder
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.shipped import shipped_model


def pictures(checkpoint, count=3):
    settings = checkpoint.config.preprocessing
    shape = (settings.photo_px, len(settings.views) * settings.photo_px, 3)
    return list(np.random.default_rng(0).random((count, *shape), dtype=np.float32))


def test_onnx_runtime_gives_the_partial_activations_and_embeddings_of_several_views():
    pytest.importorskip("onnxruntime")
    shipped = load_checkpoint(shipped_model())
    ours, theirs = (make(shipped)(pictures(shipped)) for make in (torch_photo_encoder, choose_photo_encoder))
    assert not np.array_equal(ours.partial, theirs.partial)  # another library
    assert np.abs(ours.partial - theirs.partial).max() <= photo_encoder.TOLERANCE * np.abs(ours.partial).max()
    assert np.allclose(ours.embedding, theirs.embedding, atol=1e-4)


def test_pytorch_encodes_if_onnx_runtime_is_missing_or_wrong(model, monkeypatch, caplog):
    checkpoint = load_checkpoint(model)
    images = pictures(checkpoint)
    expected = torch_photo_encoder(checkpoint)(images).partial
    with monkeypatch.context() as patch:
        patch.setattr(photo_encoder, "find_spec", lambda name: None)
        assert np.array_equal(choose_photo_encoder(checkpoint)(images).partial, expected)
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(photo_encoder, "TOLERANCE", -1.0)
    assert np.array_equal(choose_photo_encoder(checkpoint)(images).partial, expected)
    assert "gives other partial activations" in caplog.text


def test_a_long_build_gives_the_same_index_with_either_encoder(catalogue, model, tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    checkpoint = load_checkpoint(model)
    build_index(catalogue, checkpoint, tmp_path / "torch", quiet=True)
    calls = []
    monkeypatch.setattr("retrieval.indexing.codes.MIN_PHOTOS_FOR_ONNX", 1)
    monkeypatch.setattr(
        "retrieval.indexing.codes.choose_photo_encoder",
        lambda made: calls.append(1) or choose_photo_encoder(made),
    )
    build_index(catalogue, checkpoint, tmp_path / "onnx", quiet=True)
    assert calls == [1]  # once per build
    ours, theirs = (IndexStore(tmp_path / name).open() for name in ("torch", "onnx"))
    assert [row.path for row in ours.rows] == [row.path for row in theirs.rows]
    partials = [np.asarray(each.arrays["partials"], np.float32) for each in (ours, theirs)]
    assert np.allclose(*partials, atol=2e-3 * np.abs(partials[0]).max())
