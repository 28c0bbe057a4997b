"""Kinds of index: results, checks of input, refusals, and a class of a user."""

import faiss
import numpy as np
import pytest

import indexes
from indexes.errors import CorruptIndex, ParameterError, VectorError
from indexes.kinds import faiss_index
from indexes.kinds.vector_index import VectorIndex, score_tolerance
from tests import plugins
from tests.oracle import disagreements

N, D = 1000, 16
APPROXIMATE = ["IVF16,Flat;nprobe=4", "IVF16,SQ8;nprobe=4", "HNSW16;efSearch=32", "IVF8,PQ4x4,RFlat"]
KINDS = ["flat", *APPROXIMATE]
TOLERANCE = score_tolerance(D)


def unit(count: int, dim: int = D, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


QUERIES = unit(12, seed=1)


@pytest.fixture(scope="module", params=KINDS)
def built(request):
    return indexes.build(unit(N), request.param)


@pytest.fixture(params=["numpy", "FAISS"])
def flat(request, monkeypatch):
    """Exact search by numpy, as in small indexes, and by FAISS."""
    monkeypatch.setattr(faiss_index, "MAX_NUMPY_SCORES", 10**9 if request.param == "numpy" else 0)
    return indexes.build(unit(N))


@pytest.mark.parametrize("k", [1, 10, N - 1, N, 5 * N])
def test_exact_search_agrees_with_the_oracle(flat, k):
    scores, rows = flat.search(QUERIES, k)
    assert scores.shape == (len(QUERIES), min(k, N))
    assert disagreements(flat.vectors, QUERIES, scores, rows, TOLERANCE) == []
    assert [one.tolist() for one in flat.candidates(QUERIES, k)] == rows.tolist()


def test_scores_do_not_depend_on_the_batch_or_the_threads(built):
    scores, rows = built.search(QUERIES, 10)
    for number, query in enumerate(QUERIES):
        single = built.search(query[None], 10)[0][0]
        np.testing.assert_allclose(single, scores[number], atol=TOLERANCE)
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(3 if before == 1 else 1)
    np.testing.assert_allclose(built.search(QUERIES, 10)[0], scores, atol=TOLERANCE)
    faiss.omp_set_num_threads(before)
    assert (np.diff(scores, axis=1) <= 0).all()
    assert rows.min() >= 0


def test_ties_are_ordered_by_row(flat):
    vectors = np.repeat(unit(1), 600, axis=0)
    index = indexes.build(vectors)
    assert index.search(vectors[:1], 7)[1].tolist() == [list(range(7))]


@pytest.mark.parametrize("k", [N, 5 * N])
def test_a_search_for_everything_is_exact_in_every_kind(built, k):
    scores, rows = built.search(QUERIES, k)
    assert disagreements(built.vectors, QUERIES, scores, rows, TOLERANCE) == []


def test_rows_that_an_approximate_kind_misses_are_minus_one_and_no_candidates():
    index = indexes.build(unit(N), "IVF16,Flat;nprobe=1")
    scores, rows = index.search(QUERIES, N // 2)
    assert (rows == -1).any()
    assert (scores[rows == -1] == -np.inf).all()
    found = [set(one.tolist()) for one in index.candidates(QUERIES, N // 2)]
    assert found == [set(row[row >= 0].tolist()) for row in rows]


def test_a_search_setting_trades_time_for_recall():
    index = indexes.build(unit(N), "IVF16,Flat;nprobe=1")
    recalls = [indexes.recall_against_exact(index.with_settings(f"nprobe={n}"), QUERIES) for n in (1, 4, 16)]
    assert recalls == sorted(recalls)
    assert recalls[0] < recalls[2] == 1.0
    assert indexes.recall_against_exact(index, QUERIES) == recalls[0]


def test_a_saved_index_loads_and_gives_the_same_results(built, tmp_path):
    built.save(tmp_path / "x")
    loaded = indexes.load_kind(built.kind).load(tmp_path / "x", built.vectors, built.kind)
    for mine, other in zip(loaded.search(QUERIES, 7), built.search(QUERIES, 7), strict=True):
        np.testing.assert_array_equal(mine, other)
    if not built.exact:
        with pytest.raises(CorruptIndex, match="must have"):
            indexes.load_kind(built.kind).load(tmp_path / "x", built.vectors[:-1], built.kind)
        (tmp_path / "x").write_bytes(b"not a structure")
        with pytest.raises(CorruptIndex, match="FAISS cannot read it"):
            indexes.load_kind(built.kind).load(tmp_path / "x", built.vectors, built.kind)


@pytest.mark.parametrize("k", [0, -1, True, 2.0, "3"])
def test_an_invalid_number_of_results_raises(built, k):
    with pytest.raises(ParameterError, match="number of results"):
        built.search(QUERIES, k)


@pytest.mark.parametrize("vectors", [unit(3).astype(float), unit(3)[0], unit(3)[:, :0], unit(3).tolist(), None])
def test_only_float32_tables_are_accepted(vectors):
    with pytest.raises(VectorError, match="float32 of shape"):
        indexes.build(vectors)


def test_an_index_needs_a_vector_and_queries_of_its_size():
    with pytest.raises(VectorError, match="at least one vector"):
        indexes.build(unit(0))
    with pytest.raises(VectorError, match=r"must have 16 components.*another model"):
        indexes.build(unit(3)).search(unit(1, dim=8), 1)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("octree", "could not parse"),
        ("HNSW1", "at least 2 neighbours"),
        ("IVF8,Flat;probes=2", "probes"),
        ("nowhere:Nothing", "cannot be imported"),
    ],
)
def test_an_unknown_kind_or_setting_is_one_error_that_names_it(kind, words):
    with pytest.raises(ParameterError, match=words):
        indexes.build(unit(N), kind)


@pytest.mark.parametrize(("kind", "needed"), [("IVF32,Flat", 1248), ("IVF4,PQ8", 9984), ("PQ8", 9984), ("PQ8x5", 1248)])
def test_too_few_vectors_for_a_kind_are_refused_with_the_needed_number(kind, needed):
    with pytest.raises(ParameterError, match=rf"needs at least {needed} photos .*got {N}"):
        indexes.build(unit(N), kind)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_tiny_indexes_work(count):
    for kind in ("flat", "HNSW8"):
        assert indexes.build(unit(count), kind).search(unit(count), 2)[1][:, 0].tolist() == list(range(count))


class Backwards(VectorIndex):
    """Finds the last k rows."""

    def _search(self, queries, k):
        rows = np.tile(np.arange(self.count - k, self.count), (len(queries), 1))
        return np.take_along_axis(queries @ self.vectors.T, rows, axis=1), rows


def test_a_users_own_class_is_a_kind(tmp_path, monkeypatch):
    name = f"{__name__}:Backwards"
    assert indexes.kind_name(Backwards) == indexes.kind_name(name) == name
    for kind in (Backwards, name):
        index = indexes.build(unit(N), kind)
        assert (index.kind, index.exact, sorted(index.search(QUERIES[:1], 2)[1][0])) == (name, False, [998, 999])
    plugins.install(tmp_path, monkeypatch, indexes={"backwards": name})
    assert indexes.build(unit(N), "backwards").kind == "backwards"
    assert indexes.kind_name(Backwards) == "backwards"
    store = indexes.IndexStore(tmp_path / "index")
    rows = [indexes.Row(f"{number:02}", "mug", str(number)) for number in range(40)]
    assert store.write(rows, [{"embeddings": unit(40)}], kind="backwards").recall["value"] < 1
    assert type(store.open().index) is Backwards
