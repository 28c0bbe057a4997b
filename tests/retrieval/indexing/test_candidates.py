"""The number of candidates, by agreement with exhaustive search."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import indexes
from indexes.store.folder import IndexStore
from retrieval.indexing import build as building
from retrieval.indexing import candidates as measuring
from retrieval.indexing.build import build_index
from retrieval.indexing.candidates import candidates_sentence, kept_measurement, measure_candidates
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.fusion import Matcher
from retrieval.model.fusion_scorer import FusionScorer
from tests.conftest import TINY
from tests.retrieval.indexing.test_build import PROVENANCE, other_picture

PHOTOS, TOUCHES = 70, 40


def checkpoint_of(candidate_width=8, queries=TOUCHES):
    """A matcher with random weights whose queries are random partial activations."""
    torch.manual_seed(0)
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, candidate_width=candidate_width))
    partials = np.random.default_rng(1).normal(size=(queries, config.matcher.partial_width)).astype(np.float16)
    matcher = Matcher(config.matcher).eval()
    return Checkpoint(Path("m"), "0" * 64, config, {}, matcher=matcher, queries=partials)


@pytest.fixture
def checkpoint():
    return checkpoint_of()


@pytest.fixture
def gallery(checkpoint):
    """Embeddings and partial activations of photos."""
    rng = np.random.default_rng(2)
    partials = rng.normal(size=(PHOTOS, checkpoint.config.matcher.partial_width)).astype(np.float16)
    with torch.inference_mode():
        embeddings = checkpoint.matcher.candidate_encoder.photo(torch.from_numpy(partials.astype(np.float32))).numpy()
    return embeddings, partials


@pytest.fixture(autouse=True)
def _first_step_of_four(monkeypatch):
    monkeypatch.setattr(measuring, "EXHAUSTIVE_LIMIT", 4)


def agreement(checkpoint, embeddings, partials, k):
    """By plain loops: fraction of touches whose best photo has fewer than k better embeddings."""
    found = 0
    for touch in torch.from_numpy(checkpoint.queries.astype(np.float32)):
        with torch.inference_mode():
            logits = [
                float(checkpoint.matcher.head(touch, torch.from_numpy(partial)))
                for partial in partials.astype(np.float32)
            ]
            query = checkpoint.matcher.candidate_encoder.touch(touch).numpy()
        best = embeddings[int(np.argmax(logits))]
        found += sum(row @ query > best @ query for row in embeddings) < k
    return found / len(checkpoint.queries)


@pytest.mark.parametrize("target", [0.3, 0.6, 0.99])
def test_the_smallest_k_with_the_agreement_is_used(checkpoint, gallery, monkeypatch, target):
    monkeypatch.setattr(measuring, "TARGET", target)
    record = measure_candidates(checkpoint, indexes.build(gallery[0]), gallery[1])
    by_loops = {k: agreement(checkpoint, *gallery, k) for k in (4, 8, 16, 32, 64, PHOTOS)}
    assert record["k"] == next(k for k, value in by_loops.items() if value >= target)
    assert record["top1_agreement"] == by_loops[record["k"]]
    assert record["interval"][0] <= record["top1_agreement"] <= record["interval"][1]
    assert (record["queries"], record["photos"]) == (TOUCHES, PHOTOS)
    assert min(record["ms"], record["exhaustive_ms"]) > 0


def test_an_index_that_finds_nothing_reranks_every_photo(checkpoint, gallery):
    class Blind(indexes.VectorIndex):
        def _search(self, queries, k):
            return np.zeros((len(queries), k), np.float32), np.full((len(queries), k), -1)

    record = measure_candidates(checkpoint, Blind.build(gallery[0], "blind"), gallery[1])
    assert (record["k"], record["top1_agreement"], record["ms"]) == (PHOTOS, 1.0, record["exhaustive_ms"])


def test_few_photos_are_all_scored_and_a_model_without_touches_measures_nothing(checkpoint, gallery, monkeypatch):
    monkeypatch.setattr(FusionScorer, "logits", None)
    few = measure_candidates(checkpoint, indexes.build(gallery[0][:4]), gallery[1][:4])
    assert (few["k"], few["queries"]) == (4, 0)
    assert candidates_sentence(few, 4) == "The fusion head scores all 4 photos."
    assert measure_candidates(checkpoint_of(queries=0), indexes.build(gallery[0]), gallery[1]) is None
    assert "stores no touches" in candidates_sentence(None, PHOTOS)


@pytest.mark.parametrize(
    ("photos", "encoded", "k"), [(1000, 0, 500), (1050, 60, 500), (940, 0, 500), (1101, 0, None), (1000, 101, None)]
)
def test_a_measurement_is_kept_until_a_tenth_of_the_photos_changed(photos, encoded, k):
    kept = kept_measurement({"k": 500, "queries": 40, "photos": 1000}, photos, encoded)
    assert (kept and kept["k"]) == k
    if k:  # one that scores every photo still does; without touches, nothing was measured
        assert kept_measurement({"k": 1000, "queries": 40, "photos": 1000}, photos, encoded)["k"] == photos
        assert kept_measurement({"k": 1000, "queries": 0, "photos": 1000}, photos, encoded) is None


def test_the_measurement_is_in_manifest_and_report_and_kept_by_small_changes(
    catalogue_copy, checkpoint, tmp_path, monkeypatch
):
    index, path = tmp_path / "index", tmp_path / "queried.safetensors"
    store_checkpoint(dataclasses.replace(checkpoint, provenance=PROVENANCE), path)
    queried, measured = load_checkpoint(path), []

    def counted(*arguments, **options):
        measured.append(arguments)
        return measure_candidates(*arguments, **options)

    monkeypatch.setattr(building, "measure_candidates", counted)
    report = build_index(catalogue_copy, queried, index)
    assert IndexStore(index).open().manifest.about["candidates"] == report.candidates
    assert "validation touches (95 % interval" in "\n".join(report.lines())
    other_picture(catalogue_copy / "newcomer" / "1.jpg", seed=78)
    assert build_index(catalogue_copy, queried, index).candidates["photos"] == 24
    recall = build_index(catalogue_copy, queried, index, kind="HNSW8").recall
    assert (recall["queries"], recall["how"]) == (TOUCHES, "measured on the given queries")
    assert [len(partials) for _, _, partials in measured] == [24, 25]  # another kind is measured again
