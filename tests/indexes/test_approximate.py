"""Approximate kinds in cases where approximate search is known to fail."""

import faiss
import numpy as np
import pytest

from indexes import load_kind
from indexes.errors import ParameterError
from indexes.kinds.ivf import IVFFlatIndex, IVFParameters, IVFPQIndex, IVFPQParameters
from indexes.kinds.measure import recall_against_exact, sample_queries
from indexes.store.folder import IndexStore
from tests.indexes.test_store import APPROXIMATE


def unit(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def clustered(count: int, dim: int, centres: int, seed: int = 0) -> np.ndarray:
    """Vectors around a few directions, like embeddings of a few objects."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(centres, dim))[rng.integers(centres, size=count)]
    vectors = vectors + 0.5 * rng.normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def naive_wrong_hits(seed):
    """Fraction of wrong hits of plain HNSW over 200 copies of twenty vectors."""
    distinct = unit(20, 32, seed)
    faiss.omp_set_num_threads(1)  # the same graph every time
    naive = faiss.IndexHNSWFlat(32, 32, faiss.METRIC_INNER_PRODUCT)
    naive.add(np.tile(distinct, (200, 1)))
    return (naive.search(distinct, 20)[1] % 20 != np.arange(20)[:, None]).mean()


def test_a_thousand_copies_of_twenty_vectors_break_naive_hnsw_but_not_ours(tmp_path):
    # Which graphs fail depends on the version of FAISS, but some always do.
    assert max(naive_wrong_hits(seed) for seed in range(8)) > 0.02

    distinct = unit(20, 32)
    copies = np.tile(distinct, (1000, 1))
    rows = [{"id": f"{number:05d}"} for number in range(len(copies))]
    store = IndexStore(tmp_path / "index")
    ours = store.write(rows, copies, fingerprint={}, kind="hnsw", threads=1)
    assert (ours.count, ours.manifest.counts.slots) == (20_000, 20)
    for number, (hits, scores) in enumerate(ours.search(distinct, 1)):
        assert hits.tolist() == list(range(number, 20_000, 20))
        assert len(set(scores.tolist())) == 1


@pytest.mark.parametrize("kind", APPROXIMATE)
def test_approximate_kinds_find_most_of_the_best_in_clustered_data(kind):
    vectors = clustered(3000, 32, 60)
    index = load_kind(kind).build(vectors, threads=1)
    assert recall_against_exact(index, sample_queries(vectors, 100), 10) > 0.9


@pytest.mark.parametrize(
    ("kind", "setting"), [("hnsw", "ef_search"), ("ivf_flat", "probes"), ("ivf_sq8", "probes"), ("ivf_pq", "refine")]
)
def test_a_broader_search_finds_more(kind, setting):
    vectors = unit(2000, 32)
    index, queries = load_kind(kind).build(vectors, threads=1), sample_queries(vectors, 100)
    recalls = [recall_against_exact(index.with_settings(**{setting: value}), queries) for value in (1, 8, 64)]
    assert recalls[0] <= recalls[1] < recalls[2]


def test_visiting_every_list_is_exact():
    vectors = unit(1500, 24)
    index = IVFFlatIndex.build(vectors, IVFParameters(lists=20, probes=20))
    assert recall_against_exact(index, sample_queries(vectors, 50), 10) == 1.0


@pytest.mark.parametrize("count", [1, 10, 38, 39, 78, 500])
def test_few_points_train_few_lists_without_warnings(count, capfd):
    vectors = unit(count, 8)
    index = IVFFlatIndex.build(vectors, IVFParameters(lists=64))
    assert index.parameters.lists == max(1, count // 39)
    index.search(vectors, 1)
    assert capfd.readouterr() == ("", "")


def test_naive_faiss_warns_of_too_few_points(capfd):
    naive = faiss.IndexIVFFlat(faiss.IndexFlatIP(8), 8, 64, faiss.METRIC_INNER_PRODUCT)
    naive.train(unit(500, 8))
    assert "please provide at least 2496 training points" in capfd.readouterr().err


@pytest.mark.parametrize("count", [624, 700, 2500])
def test_codes_are_trained_without_a_warning(count, capfd):
    vectors = clustered(count, 16, 30)
    index = IVFPQIndex.build(vectors, threads=1)
    assert (index.search(vectors, 1)[1][:, 0] == np.arange(count)).mean() > 0.99
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("dim", "parts"), [(8, 8), (12, 6), (13, 1), (64, 8), (128, 16), (512, 64)])
def test_code_bytes_divide_the_vector(dim, parts):
    assert IVFPQIndex.resolve_parameters(IVFPQParameters(), 1000, dim).code_bytes == parts


def test_code_bytes_that_do_not_divide_the_size_raise():
    with pytest.raises(ParameterError, match="divide the vector size 16; got 5"):
        IVFPQIndex.build(unit(700, 16), IVFPQParameters(code_bytes=5))


def test_a_compressed_index_returns_exact_scores():
    vectors = clustered(1000, 16, 20)
    scores, slots = IVFPQIndex.build(vectors, threads=1).search(vectors[:5], 3)
    exact = np.einsum("qd,qkd->qk", vectors[:5].astype(np.float64), vectors[slots].astype(np.float64))
    np.testing.assert_allclose(scores, exact, rtol=0, atol=2e-7)  # grid of 2^-26 and one float32 rounding
