"""Candidates without scores: the same slots as those of a search, with few scored exactly."""

import numpy as np
import pytest

from indexes import KINDS, load_kind
from indexes.errors import VectorError
from indexes.kinds import faiss_index, flat
from indexes.store.folder import IndexStore
from tests.indexes.test_store import unit

N, D = 1500, 16
EXACT = [kind for kind in KINDS if load_kind(kind).exact]


@pytest.fixture(params=["numpy", "FAISS"], autouse=True)
def library(request, monkeypatch):
    """The library that scores vectors for `flat`: numpy in small indexes, FAISS in others."""
    monkeypatch.setattr(flat, "MAX_NUMPY_SCORES", 5 * N if request.param == "numpy" else 0)


@pytest.fixture(scope="module")
def crowded():
    """Vectors in tight groups: float32 sums in another order put neighbours on the wrong side of rank k."""
    rng = np.random.default_rng(4)
    vectors = unit(30, D, seed=4)[rng.integers(30, size=N)] + np.float32(1e-6) * rng.normal(size=(N, D)).astype(
        np.float32
    )
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", EXACT)
@pytest.mark.parametrize("k", [1, 7, 100, N - 1, N, 5 * N])
@pytest.mark.parametrize("live_fraction", [1.0, 0.5, 0.01, 0.0])
def test_candidates_of_an_exact_kind_equal_its_search_results(kind, k, live_fraction, crowded):
    index, queries = load_kind(kind).build(crowded, threads=1), unit(5, D, seed=6)
    live = None if live_fraction == 1.0 else np.random.default_rng(1).random(N) < live_fraction
    found = index.search(queries, k, live)[1]
    candidates = index.candidates(queries, k, live)
    assert [sorted(slots.tolist()) for slots in candidates] == [sorted(slots.tolist()) for slots in found]


@pytest.mark.parametrize("kind", sorted(set(KINDS) - set(EXACT)))
@pytest.mark.parametrize("k", [1, 20, 300, N])
def test_candidates_of_an_approximate_kind_are_enough_distinct_live_slots(kind, k):
    index, queries = load_kind(kind).build(unit(N, D, seed=3), threads=1), unit(5, D, seed=6)
    live = np.random.default_rng(1).random(N) < 0.6
    for mask in (None, live):
        count = N if mask is None else int(mask.sum())
        for query, slots in enumerate(index.candidates(queries, k, mask)):
            assert min(k, count) <= len(set(slots.tolist())) == len(slots)
            assert mask is None or mask[slots].all()
            found = index.search(queries[query : query + 1], min(k, 5), mask)[1][0]
            assert len(set(found.tolist()) & set(slots.tolist())) >= 0.6 * len(found)


def test_only_slots_near_rank_k_are_scored_again(monkeypatch):
    scored = []
    scores = faiss_index.grid_scores
    monkeypatch.setattr(
        faiss_index, "grid_scores", lambda query, table: scored.append(len(table)) or scores(query, table)
    )
    for kind, maximum in (("flat", 3), ("ivf_sq8", 0)):
        index, query = load_kind(kind).build(unit(N, D, seed=3), threads=1), unit(1, D, seed=6)
        scored.clear()
        index.candidates(query, 100)
        assert sum(scored) <= maximum
        index.search(query, 100)
        assert sum(scored) >= 100


def test_queries_are_checked_and_no_query_gives_no_candidates():
    index = load_kind("flat").build(unit(20, D, seed=3))
    assert index.candidates(np.empty((0, D), np.float32), 3) == []
    with pytest.raises(VectorError, match="query"):
        index.candidates(np.full((1, D), np.nan, np.float32), 3)


def test_candidates_of_a_generation_include_all_rows_of_their_slots(tmp_path):
    vectors = np.repeat(unit(40, D, seed=3), 2, axis=0)
    rows = [{"id": f"{number:03d}", "object_id": "o"} for number in range(80)]
    generation = IndexStore(tmp_path / "index").write(rows, vectors, fingerprint={})
    queries = unit(4, D, seed=6)
    found = [sorted(numbers.tolist()) for numbers, _ in generation.search(queries, 5)]
    assert [sorted(numbers.tolist()) for numbers in generation.candidates(queries, 5)] == found
    assert all(len(numbers) == 10 for numbers in found)
