"""The touch encoder as ONNX: the same numbers, no PyTorch in a query, and no stale file in use."""

import dataclasses
import shutil
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import numpy as np
import pytest
import torch
from packaging.requirements import Requirement

from indexes.store.folder import IndexStore
from retrieval.commands.main import main
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, NumericalError, RetrievalError
from retrieval.indexing.build import build_index
from retrieval.model import export as exporting
from retrieval.model import onnx_encoder
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.config import Config, MatcherConfig
from retrieval.model.encode import TorchEncoder, encode_touches, torch_photo_encoder, touch_features
from retrieval.model.export import choose_photo_encoder, export
from retrieval.model.fusion import GelHead, Matcher
from retrieval.model.onnx_encoder import OnnxEncoder
from retrieval.model.shipped import shipped_model
from retrieval.search.searcher import Searcher
from tests.project.test_imports import run_blocked
from tests.project.test_project import PROJECT

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

PROVENANCE = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}


@pytest.fixture
def model_copy(model, tmp_path):
    """A copy of the model, whose folder may get more files."""
    return Path(shutil.copy(model, tmp_path / "m.safetensors"))


@pytest.fixture
def index(model_copy, catalogue, tmp_path):
    build_index(catalogue, load_checkpoint(model_copy), tmp_path / "index")
    return tmp_path / "index"


def touches_of(count, fingers, px):
    return np.random.default_rng(3).random((count, fingers, px, px, 3), dtype=np.float32)


def export_random_matcher(path, config, seed=0, *, gel_head=False):
    """Return a matcher with random weights, and its exported encoder."""
    torch.manual_seed(seed)
    matcher = Matcher(config.matcher)
    if gel_head:
        matcher.gel_head = GelHead(matcher.touch_tower.feature_count)
    for module in matcher.modules():
        if isinstance(module, torch.nn.BatchNorm2d | torch.nn.BatchNorm1d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    store_checkpoint(Checkpoint(path, "", config, PROVENANCE, matcher=matcher), path)
    checkpoint = load_checkpoint(path)
    path.with_suffix(".onnx").write_bytes(exporting.touch_encoder_to_onnx(checkpoint))
    return checkpoint.matcher, OnnxEncoder(path.with_suffix(".onnx"), checkpoint.digest)


MAKES = [
    {"tower": "mobilenet_v2", "tower_output": "stages"},
    {"tower_output": "classes", "fingers": 1, "standardise": False, "candidate_width": 0},
    {"tower_output": "stages", "cell_dim": 4, "touch_cells": 2, "cosine": True, "projection_hidden": 12},
]


@pytest.mark.parametrize("make", MAKES, ids=str)
def test_the_exported_encoder_gives_pytorchs_numbers_for_any_number_of_touches(make, tmp_path):
    plain = {"tower": "small", "tower_output": "pooled", "hidden": 24, "standardise": True, "embedding_dim": 8}
    config = Config(MatcherConfig(**plain | {"candidate_width": 8} | make), preprocessing=Preprocessing(touch_px=32))
    has_gel_head = config.matcher.tower == "small"
    matcher, encoder = export_random_matcher(tmp_path / "m.safetensors", config, gel_head=has_gel_head)
    for count in (1, 3):
        touches = touches_of(count, config.matcher.fingers, 32)
        encoding, (partial, embedding, readings, *_) = encode_touches(matcher, touches), encoder.encode(touches)
        # float32 in another order; random weights are worse conditioned than trained ones.
        assert np.abs(partial - encoding.partial.numpy()).max() <= 1e-4 * float(encoding.partial.abs().max())
        np.testing.assert_allclose(embedding, encoding.embedding.numpy(), atol=1e-4)
        assert (readings is None) == (not has_gel_head)
        if has_gel_head:
            with torch.inference_mode():
                expected = matcher.gel_readings(touch_features(matcher, touches)).numpy()
            assert expected.shape == (count, config.matcher.fingers, 2)
            for found in (readings, TorchEncoder(matcher).encode(touches).readings):
                np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_query_uses_the_export_next_to_the_model_and_ranks_the_same(model_copy, index, touch):
    by_torch = Searcher.open(index).query([touch])
    export(load_checkpoint(model_copy))
    by_onnx = Searcher.open(index).query([touch])
    assert [by_torch.index["encoder"], by_onnx.index["encoder"]] == ["torch", "onnx"]
    assert [match.object_id for match in by_onnx.results] == [match.object_id for match in by_torch.results]
    for ours, theirs in zip(by_onnx.results, by_torch.results, strict=True):
        assert ours.logit == pytest.approx(theirs.logit, abs=1e-4)


def test_a_stale_export_is_not_used_and_a_warning_is_logged(model_copy, index, touch, catalogue, tmp_path, caplog):
    export(load_checkpoint(model_copy))
    checkpoint = load_checkpoint(model_copy)
    store_checkpoint(dataclasses.replace(checkpoint, provenance=PROVENANCE), model_copy)
    build_index(catalogue, load_checkpoint(model_copy), tmp_path / "index")
    assert Searcher.open(index).query([touch]).index["encoder"] == "torch"
    assert "m.onnx is the export of another checkpoint" in caplog.text
    assert "run `retrieve export` again" in caplog.text


def test_pytorch_encodes_if_the_export_is_damaged_or_onnx_runtime_missing(model_copy, monkeypatch, caplog):
    checkpoint = load_checkpoint(model_copy)
    model_copy.with_suffix(".onnx").write_bytes(b"model" * 100)
    assert onnx_encoder.find_export(checkpoint) is None
    assert "cannot be opened by ONNX Runtime" in caplog.text
    monkeypatch.setattr(onnx_encoder, "find_spec", lambda name: None)
    assert onnx_encoder.find_export(checkpoint) is None


@pytest.mark.parametrize("part", ["partial activation", "embedding"])
def test_an_encoder_that_gives_a_nan_is_refused_with_the_touch_named(part, model_copy, index, two_grasps, monkeypatch):
    searcher = Searcher.open(index)
    encodings = searcher.encoder.encode(touches_of(2, 2, 32))
    (encodings.embeddings if part == "embedding" else encodings.partials)[1, 3] = np.nan
    monkeypatch.setattr(searcher.encoder, "encode", lambda touches: encodings)
    with pytest.raises(NumericalError, match=f"the {part} of touch 2 contains a NaN"):
        searcher.query(two_grasps)


def pictures(checkpoint, count=3):
    settings = checkpoint.config.preprocessing
    shape = (settings.photo_px, len(settings.views) * settings.photo_px, 3)
    return list(np.random.default_rng(0).random((count, *shape), dtype=np.float32))


def test_onnx_runtime_gives_the_partial_activations_and_embeddings_of_several_views():
    shipped = load_checkpoint(shipped_model())
    encoders = torch_photo_encoder(shipped.matcher), choose_photo_encoder(shipped)
    ours, theirs = (encode(pictures(shipped)) for encode in encoders)
    assert not np.array_equal(ours.partials, theirs.partials)  # another library
    assert np.abs(ours.partials - theirs.partials).max() <= exporting.TOLERANCE * np.abs(ours.partials).max()
    assert np.allclose(ours.embeddings, theirs.embeddings, atol=1e-4)


def test_pytorch_encodes_if_onnx_runtime_is_missing_or_wrong(model, monkeypatch, caplog):
    checkpoint = load_checkpoint(model)
    images = pictures(checkpoint)
    expected = torch_photo_encoder(checkpoint.matcher)(images).partials
    with monkeypatch.context() as patch:
        patch.setattr(exporting, "find_spec", lambda name: None)
        assert np.array_equal(choose_photo_encoder(checkpoint)(images).partials, expected)
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    assert np.array_equal(choose_photo_encoder(checkpoint)(images).partials, expected)
    assert "gives other partial activations" in caplog.text


def test_a_long_build_gives_the_same_index_with_either_encoder(catalogue, model, tmp_path, monkeypatch):
    checkpoint = load_checkpoint(model)
    build_index(catalogue, checkpoint, tmp_path / "torch")
    calls = []
    monkeypatch.setattr("retrieval.indexing.codes.MIN_PHOTOS_FOR_ONNX", 1)
    monkeypatch.setattr(
        "retrieval.indexing.codes.choose_photo_encoder",
        lambda made: calls.append(1) or choose_photo_encoder(made),
    )
    build_index(catalogue, checkpoint, tmp_path / "onnx")
    assert calls == [1]  # once per build
    ours, theirs = (IndexStore(tmp_path / name).open() for name in ("torch", "onnx"))
    assert [row.path for row in ours.rows] == [row.path for row in theirs.rows]
    partials = [np.asarray(each.arrays["partials"], np.float32) for each in (ours, theirs)]
    assert np.allclose(*partials, atol=2e-3 * np.abs(partials[0]).max())


def test_a_checkpoint_gets_an_export_in_the_cache_once_unless_one_is_next_to_it(model_copy, index, touch):
    checkpoint = load_checkpoint(model_copy)
    cached = onnx_encoder.cached_export_path(checkpoint.digest)
    assert exporting.export_to_cache(checkpoint) == cached
    assert Searcher.open(index).query([touch]).index["encoder"] == "onnx"
    assert exporting.export_to_cache(checkpoint) is None
    assert not model_copy.with_suffix(".onnx").exists()
    cached.unlink()
    export(checkpoint)
    assert exporting.export_to_cache(checkpoint) is None
    assert not cached.exists()


def test_without_a_cache_a_build_continues(model_copy, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    checkpoint = load_checkpoint(model_copy)
    assert exporting.export_to_cache(checkpoint) is None
    assert onnx_encoder.find_export(checkpoint) is None


def test_the_command_writes_the_export_next_to_the_checkpoint_or_to_the_requested_file(model_copy, tmp_path, capsys):
    assert main(["export", str(model_copy)]) == 0
    assert f"written: {model_copy.with_suffix('.onnx')}" in capsys.readouterr().err
    assert model_copy.with_suffix(".onnx").is_file()
    assert export(load_checkpoint(model_copy), tmp_path / "other.onnx") == tmp_path / "other.onnx"
    assert (tmp_path / "other.onnx").is_file()


def test_nothing_is_written_if_the_numbers_differ_or_a_package_is_missing(model_copy, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(RetrievalError, match="gives other numbers"):
        export(load_checkpoint(model_copy))
    assert sorted(path.suffix for path in model_copy.parent.iterdir()) == [".safetensors"]
    monkeypatch.setattr(exporting, "find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"pip install 'touch-retrieval\[onnx\]'"):
        export(load_checkpoint(model_copy))


def packages_of(names):
    """Return the names of packages and of all that they require."""
    found, left = set(), set(names)
    while left:
        name = left.pop().lower().replace("_", "-")
        if name not in found:
            found.add(name)
            needs = [Requirement(each) for each in requires(name) or []]
            left |= {need.name for need in needs if need.marker is None or need.marker.evaluate({"extra": ""})}
    return found


def test_a_query_by_onnx_needs_only_the_package_group_for_queries(model_copy, index, touch, tmp_path):
    """`pip install --group query` and the package without its dependencies suffice."""
    export(load_checkpoint(model_copy))
    group = {item.partition(">=")[0] for item in PROJECT["dependency-groups"]["query"]}
    allowed = packages_of(group) | {"touch-retrieval"}
    owners = packages_distributions().items()
    blocked = [module for module, names in owners if not allowed & {name.lower().replace("_", "-") for name in names}]
    arguments = ["query", "--gelsight", *map(str, touch), "--index", str(index), "--html", str(tmp_path / "q.html")]
    code = (
        f"import sys\nfrom retrieval.commands.main import main\nsys.exit(main({[*arguments, '--none-prior', '0']!r}))"
    )
    done = run_blocked(code, blocked)
    assert done.returncode == 0, done.stderr
    assert "Which object is in the hand?" in (tmp_path / "q.html").read_text()
