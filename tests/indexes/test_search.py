"""Guarantees of a vector index, tested for every kind."""

import numpy as np
import pytest

import indexes
from indexes import load_kind
from indexes.errors import CorruptIndex, EngineError, ParameterError, VectorError
from indexes.kinds.exact import ExactIndex
from tests.oracle import disagreements

KINDS = list(indexes.KINDS)
EXACT = [name for name in KINDS if load_kind(name).exact]
COUNT, DIM = 700, 16


def unit(count: int, dim: int = DIM, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module", params=KINDS)
def built(request):
    return load_kind(request.param).build(unit(COUNT), threads=1)


@pytest.fixture(params=KINDS)
def kind(request):
    return load_kind(request.param)


@pytest.fixture(params=EXACT)
def exact_kind(request):
    return load_kind(request.param)


def test_the_error_for_an_unknown_kind_lists_the_known_kinds():
    with pytest.raises(ParameterError, match=r"exact, flat, ivf_flat, ivf_sq8, ivf_pq, hnsw; got 'annoy'"):
        load_kind("annoy")


def test_the_table_and_the_classes_agree_on_names():
    assert [load_kind(name).kind for name in indexes.KINDS] == list(indexes.KINDS)


def test_exact_search_agrees_with_two_plain_loops(exact_kind):
    vectors, queries = unit(60, seed=1), unit(9, seed=2)
    scores, slots = exact_kind.build(vectors).search(queries, 5)
    for query, got_scores, got_slots in zip(queries, scores, slots, strict=True):
        pairs = []
        for slot, vector in enumerate(vectors):
            total = 0.0
            for a, b in zip(query, vector, strict=True):
                total += float(a) * float(b)
            pairs.append((-total, slot))
        assert got_slots.tolist() == [slot for _, slot in sorted(pairs)[:5]]
        # The grid of 2^-26 and one rounding to float32.
        np.testing.assert_allclose(got_scores, [-total for total, _ in sorted(pairs)[:5]], rtol=0, atol=2e-7)


def test_every_kind_scores_exactly_and_exact_kinds_find_the_best(built):
    queries = unit(50, seed=3)
    scores, slots = built.search(queries, 10)
    assert scores.dtype == np.float32
    assert slots.dtype == np.int64
    assert scores.shape == slots.shape == (50, 10)
    truth = ExactIndex.build(built.vectors).search(queries, COUNT)
    exact_score = np.take_along_axis(truth[0], np.argsort(truth[1], axis=1), axis=1)
    assert np.array_equal(scores, np.take_along_axis(exact_score, slots, axis=1))
    assert (np.diff(scores, axis=1) <= 0).all()
    assert all(len(set(row)) == 10 for row in slots.tolist())
    if built.exact:
        assert np.array_equal(slots, truth[1][:, :10])
        assert disagreements(built.vectors, queries, scores, slots, 0.0) == []


def test_a_batch_gives_the_bits_of_single_queries(built):
    queries = unit(33, seed=4)
    scores, slots = built.search(queries, 7)
    for number in range(len(queries)):
        one = built.search(queries[number : number + 1], 7)
        assert np.array_equal(one[0][0], scores[number])
        assert np.array_equal(one[1][0], slots[number])


def test_the_number_of_threads_does_not_matter(built):
    queries, two = unit(40, seed=5), built.copy()
    two.threads = 2
    for a, b in zip(built.search(queries, 5), two.search(queries, 5), strict=True):
        assert np.array_equal(a, b)


def test_the_same_seed_gives_the_same_index(kind, tmp_path):
    for name in "ab":
        kind.build(unit(COUNT), seed=3, threads=1).save(tmp_path / name)
    if kind.structure_file:
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    else:
        assert list(tmp_path.iterdir()) == []


def test_more_results_than_vectors_gives_every_vector_once(built):
    scores, slots = built.search(unit(3, seed=6), COUNT + 50)
    assert scores.shape == (3, COUNT)
    assert np.isfinite(scores).all()
    assert all(sorted(row) == list(range(COUNT)) for row in slots.tolist())


def test_a_search_for_nearly_everything_has_no_padding(built):
    slots = built.search(unit(3, seed=6), COUNT - 1)[1]
    assert slots.min() >= 0
    assert all(len(set(row)) == COUNT - 1 for row in slots.tolist())


def test_naive_faiss_pads_with_minus_one_and_our_kinds_do_not():
    import faiss

    vectors, query = unit(COUNT), unit(1, seed=6)
    naive = faiss.IndexIVFFlat(faiss.IndexFlatIP(DIM), DIM, 17, faiss.METRIC_INNER_PRODUCT)
    naive.train(vectors)
    naive.add(vectors)
    assert -1 in naive.search(query, 200)[1]
    ours = load_kind("ivf_flat").build(vectors, indexes_parameters("ivf_flat", lists=17, probes=1))
    assert ours.search(query, 200)[1].min() >= 0


def indexes_parameters(kind: str, **values: int):
    return load_kind(kind).parameters_from(values)


def test_no_queries_give_no_results(built):
    scores, slots = built.search(np.empty((0, DIM), np.float32), 4)
    assert scores.shape == slots.shape == (0, 4)


@pytest.mark.parametrize("k", [0, -1, True, 2.0, "3"])
def test_an_invalid_number_of_results_raises(built, k):
    with pytest.raises(ParameterError, match="at least 1"):
        built.search(unit(1), k)


BAD_ROWS = {
    "nan": (np.nan, "NaN"),
    "infinite": (np.inf, "infinite"),
    "minus infinite": (-np.inf, "infinite"),
    "too long": (1.05, "got "),
}


@pytest.mark.parametrize("fault", [*BAD_ROWS, "zero", "too short"])
def test_the_error_for_a_row_that_is_not_a_unit_vector_has_its_name(kind, fault):
    vectors, names = unit(COUNT), [f"mug/{number}.jpg" for number in range(COUNT)]
    if fault in BAD_ROWS:
        vectors[5, 3] = BAD_ROWS[fault][0]
        words = BAD_ROWS[fault][1]
    else:
        vectors[5] *= 0.0 if fault == "zero" else 0.5
        words = "zero" if fault == "zero" else "got 0.5"
    with pytest.raises(VectorError, match=rf"row 'mug/5\.jpg': .*{words}") as caught:
        kind.build(vectors, names=names)
    assert caught.value.row == "mug/5.jpg"


def test_bad_rows_raise_when_added_and_as_queries(built):
    bad = unit(3)
    bad[1] = 0
    index = built.copy()
    with pytest.raises(VectorError, match=r"row 'b': .*zero"):
        index.add(bad, names=["a", "b", "c"])
    with pytest.raises(VectorError, match=r"query '1': .*zero"):
        index.search(bad, 2)
    assert index.count == COUNT


def test_norms_may_be_off_by_a_thousandth_and_no_more():
    vectors = unit(10)
    ExactIndex.build(vectors * np.float32(1.0009))
    with pytest.raises(VectorError, match="9 more"):
        ExactIndex.build(vectors * np.float32(1.0011))


def test_a_query_of_the_wrong_size_raises_a_clear_error_unlike_faiss(built):
    import faiss

    with pytest.raises(VectorError, match=r"16 components.*got 8"):
        built.search(unit(1, 8), 1)
    naive = faiss.IndexFlatIP(DIM)
    with pytest.raises(AssertionError) as caught:
        naive.search(unit(1, 8), 1)
    assert str(caught.value) == ""


@pytest.mark.parametrize(
    "vectors",
    [unit(3).astype(np.float64), unit(3)[0], unit(3).tolist(), np.empty((3, 0), np.float32)],
    ids=["float64", "one vector", "lists", "no components"],
)
def test_only_float32_tables_are_accepted(kind, vectors):
    with pytest.raises(VectorError, match=r"float32|at least one component"):
        kind.build(vectors)


def test_an_index_needs_a_vector(kind):
    with pytest.raises(VectorError, match="at least one vector"):
        kind.build(np.empty((0, 4), np.float32))


def test_ties_are_ordered_by_slot_also_at_the_last_rank(exact_kind):
    # Slots 10..49 have the same vector, so 40 slots tie for ranks 1 to 6.
    vectors = unit(300, seed=7)
    vectors[10:50] = vectors[10]
    scores, slots = exact_kind.build(vectors).search(vectors[10:11], 6)
    assert slots[0].tolist() == [10, 11, 12, 13, 14, 15]
    assert len(set(scores[0].tolist())) == 1


def test_ties_of_different_vectors_are_ordered_by_slot(exact_kind):
    # Every axis but the first is at right angles to the query: 15 scores of exactly 0.
    axes = np.eye(DIM, dtype=np.float32)[::-1].copy()
    scores, slots = exact_kind.build(axes).search(np.eye(DIM, dtype=np.float32)[:1], 4)
    assert slots[0].tolist() == [15, 0, 1, 2]
    assert scores[0].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_vectors_closer_than_rounding_are_ranked_correctly(exact_kind):
    # 500 vectors within 1e-6 of one another: float32 products cannot order them, so all must be scored exactly.
    base, spread = unit(1, seed=8).astype(np.float64), unit(500, seed=9).astype(np.float64)
    vectors = base + 1e-6 * spread
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    got = exact_kind.build(vectors).search(base.astype(np.float32), 20)
    must = ExactIndex.build(vectors).search(base.astype(np.float32), 500)
    assert np.array_equal(got[1][0], must[1][0, :20])


def test_slots_that_are_not_live_are_left_out_and_replaced(built):
    live = np.random.default_rng(0).random(COUNT) < 0.3
    queries = unit(20, seed=10)
    scores, slots = built.search(queries, 12, live)
    assert slots.shape == (20, 12)
    assert live[slots].all()
    if built.exact:
        live_only = ExactIndex.build(built.vectors[live]).search(queries, 12)
        assert np.array_equal(scores, live_only[0])
        assert np.array_equal(slots, np.flatnonzero(live)[live_only[1]])


def test_few_live_slots_are_all_found(built):
    live = np.zeros(COUNT, bool)
    live[[3, 600]] = True
    assert built.search(unit(4, seed=11), 5, live)[1].shape == (4, 2)
    assert built.search(unit(4, seed=11), 5, np.zeros(COUNT, bool))[1].shape == (4, 0)


@pytest.mark.parametrize("live", [np.ones(3, bool), np.ones(COUNT)])
def test_a_live_mask_of_another_shape_or_type_raises(built, live):
    with pytest.raises(ParameterError, match="live must be bool"):
        built.search(unit(1), 1, live)


def test_added_vectors_are_found_and_a_copy_does_not_change_the_original(built):
    fresh, grown = unit(30, seed=12), built.copy()
    grown.add(fresh)
    grown.add(np.empty((0, DIM), np.float32))
    assert (built.count, grown.count) == (COUNT, COUNT + 30)
    assert (grown.search(fresh, 1)[1][:, 0] == np.arange(COUNT, COUNT + 30)).all()
    assert built.search(fresh, 1)[1].max() < COUNT


def test_a_saved_index_loads_and_gives_the_same_results(built, tmp_path):
    path, queries = tmp_path / "x.faiss", unit(15, seed=13)
    saved = built.save(path)
    assert saved == path.exists() == built.structure_file
    loaded = type(built).load(path, built.vectors, built.parameters)
    for a, b in zip(built.search(queries, 6), loaded.search(queries, 6), strict=True):
        assert np.array_equal(a, b)


def test_a_structure_that_does_not_match_raises(built, tmp_path):
    if not built.structure_file:
        return
    path = tmp_path / "x.faiss"
    built.save(path)
    for vectors in (built.vectors[:-1], unit(COUNT, 8)):
        with pytest.raises(CorruptIndex, match="build the index again"):
            type(built).load(path, vectors, built.parameters)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CorruptIndex, match="FAISS cannot read it"):
        type(built).load(path, built.vectors, built.parameters)
    with pytest.raises(CorruptIndex, match="FAISS cannot read it"):
        type(built).load(tmp_path / "absent", built.vectors, built.parameters)
    with pytest.raises(ParameterError, match="needs a path"):
        type(built).load(None, built.vectors, built.parameters)


def test_an_index_of_one_kind_is_not_loaded_as_another(tmp_path):
    index = load_kind("ivf_flat").build(unit(40))
    index.save(tmp_path / "x")
    hnsw = load_kind("hnsw")
    with pytest.raises(CorruptIndex, match=r"IndexHNSWFlat.*IndexIVFFlat"):
        hnsw.load(tmp_path / "x", index.vectors, hnsw.parameters_from({}))


def test_exceptions_of_faiss_become_our_error(tmp_path):
    with pytest.raises(EngineError, match="FAISS failed while writing"):
        load_kind("hnsw").build(unit(5)).save(tmp_path / "no" / "folder")


def test_settings_are_checked(kind):
    with pytest.raises(ParameterError, match=f"{kind.kind} has the settings .*; got colour"):
        kind.parameters_from({"colour": 3})
    for threads in (0, 1.5, True, 10**10):
        with pytest.raises(ParameterError, match="threads must be a whole number from 1 to 4096"):
            kind.build(unit(COUNT), threads=threads)
    for seed in (-1, 2**31, 1.5):
        with pytest.raises(ParameterError, match="a seed must be a whole number from 0 to 2147483647"):
            kind.build(unit(COUNT), seed=seed)
    for name in kind.parameters_type.__dataclass_fields__:
        for value in (0, -4, 2.5, True, "8"):
            with pytest.raises(ParameterError, match=f"{name} must be a whole number"):
                kind.parameters_from({name: value})


@pytest.mark.parametrize(
    ("name", "value", "minimum"),
    [("neighbours", 1, 2), ("neighbours", 2**31, 2), ("ef_construction", 2**31, 1), ("ef_search", 2**31, 1)],
)
def test_settings_that_faiss_cannot_represent_raise(name, value, minimum):
    """With one link for each node, FAISS ends the process."""
    with pytest.raises(ParameterError, match=f"{name} must be a whole number of at least {minimum} and at most 2147"):
        load_kind("hnsw").parameters_from({name: value})


def test_the_broadest_search_can_still_fetch_more():
    """One slot in forty is live, so the first round finds too few."""
    vectors = unit(400)
    index = load_kind("hnsw").build(vectors).with_settings(ef_search=2**31 - 1)
    live = np.arange(400) % 40 == 7
    slots = index.search(vectors[:50], 2, live)[1]
    assert np.array_equal(slots, load_kind("exact").build(vectors).search(vectors[:50], 2, live)[1])


def test_parameters_of_another_kind_raise():
    with pytest.raises(ParameterError, match="flat takes Parameters; got int"):
        load_kind("flat").build(unit(5), 3)
    with pytest.raises(ParameterError, match="hnsw takes HNSWParameters; got IVFParameters"):
        load_kind("hnsw").build(unit(5), indexes_parameters("ivf_flat"))


def test_only_search_settings_change_without_a_build(built):
    with pytest.raises(ParameterError, match=f"{built.kind} can change"):
        built.with_settings(neighbours=3)
    for setting in built.search_settings:
        other = built.with_settings(**{setting: 3})
        assert other.settings()[setting] == 3
        assert built.settings()[setting] != 3


@pytest.mark.parametrize("count", [1, 2, 3])
def test_tiny_indexes_of_every_kind_without_codes_work(kind, count):
    if count < kind.min_vectors:
        with pytest.raises(ParameterError, match="624 or more vectors"):
            kind.build(unit(count))
        return
    vectors = unit(count)
    assert kind.build(vectors).search(vectors, 1)[1][:, 0].tolist() == list(range(count))
