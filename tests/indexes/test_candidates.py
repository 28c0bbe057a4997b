"""Candidates, where only which they are is wanted: those of a search, and few of them are scored."""

import numpy as np
import pytest

from indexes import KINDS, load_kind
from indexes.errors import VectorError
from indexes.kinds import faiss_index
from indexes.store.folder import IndexStore
from tests.indexes.test_store import unit

N, D = 1500, 16
EXACT = [kind for kind in KINDS if load_kind(kind).exact]


@pytest.fixture(scope="module")
def crowded():
    """Vectors in tight crowds: float32 sums of other orders put neighbours on the wrong side of a last place."""
    rng = np.random.default_rng(4)
    made = unit(30, D, seed=4)[rng.integers(30, size=N)] + np.float32(1e-6) * rng.normal(size=(N, D)).astype(np.float32)
    return made / np.linalg.norm(made, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", EXACT)
@pytest.mark.parametrize("k", [1, 7, 100, N - 1, N, 5 * N])
@pytest.mark.parametrize("share", [1.0, 0.5, 0.01, 0.0])
def test_an_exact_kind_names_what_it_finds(kind, k, share, crowded):
    index, queries = load_kind(kind).build(crowded, threads=1), unit(5, D, seed=6)
    live = None if share == 1.0 else np.random.default_rng(1).random(N) < share
    found = index.search(queries, k, live)[1]
    named = index.candidates(queries, k, live)
    assert [sorted(slots.tolist()) for slots in named] == [sorted(slots.tolist()) for slots in found]


@pytest.mark.parametrize("kind", sorted(set(KINDS) - set(EXACT)))
@pytest.mark.parametrize("k", [1, 20, 300, N])
def test_an_approximate_kind_names_as_many_live_slots_each_once(kind, k):
    index, queries = load_kind(kind).build(unit(N, D, seed=3), threads=1), unit(5, D, seed=6)
    live = np.random.default_rng(1).random(N) < 0.6
    for mask in (None, live):
        count = N if mask is None else int(mask.sum())
        for query, slots in enumerate(index.candidates(queries, k, mask)):
            assert min(k, count) <= len(set(slots.tolist())) == len(slots)
            assert mask is None or mask[slots].all()
            found = index.search(queries[query : query + 1], min(k, 5), mask)[1][0]
            assert len(set(found.tolist()) & set(slots.tolist())) >= 0.6 * len(found)


def test_only_the_last_places_are_scored_again(monkeypatch):
    scored = []
    scores = faiss_index.grid_scores
    monkeypatch.setattr(
        faiss_index, "grid_scores", lambda query, table: scored.append(len(table)) or scores(query, table)
    )
    for kind, most in (("flat", 3), ("ivf_sq8", 0)):
        index, query = load_kind(kind).build(unit(N, D, seed=3), threads=1), unit(1, D, seed=6)
        scored.clear()
        index.candidates(query, 100)
        assert sum(scored) <= most
        index.search(query, 100)
        assert sum(scored) >= 100


def test_queries_are_checked_and_none_gives_none():
    index = load_kind("flat").build(unit(20, D, seed=3))
    assert index.candidates(np.empty((0, D), np.float32), 3) == []
    with pytest.raises(VectorError, match="query"):
        index.candidates(np.full((1, D), np.nan, np.float32), 3)


def test_a_generation_names_all_rows_of_the_slots(tmp_path):
    vectors = np.repeat(unit(40, D, seed=3), 2, axis=0)
    rows = [{"id": f"{number:03d}", "object_id": "o"} for number in range(80)]
    generation = IndexStore(tmp_path / "index").write(rows, vectors, fingerprint={})
    queries = unit(4, D, seed=6)
    found = [sorted(numbers.tolist()) for numbers, _ in generation.search(queries, 5)]
    assert [sorted(numbers.tolist()) for numbers in generation.candidates(queries, 5)] == found
    assert all(len(numbers) == 10 for numbers in found)
