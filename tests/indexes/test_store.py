"""The store: reading back, changes of the catalogue, duplicates and removals."""

import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from indexes import KINDS, load_kind
from indexes.errors import CorruptIndex, MismatchedIndex, ParameterError, RowError, SelfRetrievalFailed, VectorError
from indexes.kinds.hnsw import HNSWParameters
from indexes.kinds.ivf import IVFPQParameters
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation

DIM = 8
FINGERPRINT = {"checkpoint": "abc", "preprocessing": "def"}
MORE = {"fingerprint": FINGERPRINT, "threads": 1}
EVERY_KIND = list(KINDS)
APPROXIMATE = [name for name in KINDS if not load_kind(name).exact]
EXACT = [name for name in KINDS if load_kind(name).exact]


def unit(count: int, dim: int = DIM, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def rows_of(ids, digest="1") -> list[dict]:
    return [{"id": name, "digest": digest} for name in ids]


def names(count: int, start: int = 0) -> list[str]:
    return [f"p{number:05d}" for number in range(start, start + count)]


def filled(path, count: int = 20, kind: str = "flat", **more) -> Generation:
    """A small index of `count` random vectors."""
    return IndexStore(path).write(rows_of(names(count)), unit(count), **MORE | {"kind": kind} | more)


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_a_written_index_is_read_back(tmp_path, kind):
    count = 650
    rows = [
        {"id": f"фото/{n}\u2028.jpg", "digest": str(n), "metadata": {"price": 0.1 + n, "tags": [None, True]}}
        for n in range(count)
    ]
    partials = np.random.default_rng(0).normal(size=(count, 6)).astype(np.float16)
    written = IndexStore(tmp_path / "a" / "index").write(
        rows,
        unit(count),
        {"partials": partials, "sizes": np.arange(count)},
        {"calibration": {"scale": 1.25}},
        fingerprint=FINGERPRINT,
        about={"checkpoint": "model.safetensors"},
        kind=kind,
        software="0.1.0",
        threads=1,
    )
    read = IndexStore(tmp_path / "a" / "index").open(expect=FINGERPRINT, threads=1)
    for generation in (written, read):
        assert generation.name == "gen-000001"
        assert generation.folder == tmp_path / "a" / "index" / "gen-000001"
        assert generation.rows == rows
        assert generation.count == count
        assert np.array_equal(generation.arrays["partials"], partials)
        assert np.array_equal(generation.arrays["sizes"], np.arange(count))
        assert isinstance(generation.arrays["partials"], np.memmap)
        assert generation.documents == {"calibration": {"scale": 1.25}}
        assert np.array_equal(generation.embeddings[generation.slots], unit(count))
        assert generation.row_number(rows[7]["id"]) == 7
    assert read.manifest == written.manifest
    for a, b in zip(written.search(unit(5, seed=1), 4), read.search(unit(5, seed=1), 4), strict=True):
        assert np.array_equal(a[0], b[0])
        assert np.array_equal(a[1], b[1])


def test_a_document_may_be_an_array(tmp_path):
    touches = np.arange(6, dtype=np.float16).reshape(2, 3)
    filled(tmp_path, documents={"touches": touches, "calibration": {}})
    read = IndexStore(tmp_path).open()
    np.testing.assert_array_equal(read.documents["touches"], touches)
    assert isinstance(read.documents["touches"], np.memmap)
    path = read.folder / "touches.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(CorruptIndex, match=r"touches\.npy: the SHA-256 differs"):
        IndexStore(tmp_path).open()


def test_an_empty_array_is_a_document_too(tmp_path):
    filled(tmp_path, documents={"touches": np.empty((0, 3), np.float32)})
    assert IndexStore(tmp_path).open().documents["touches"].shape == (0, 3)


def test_the_folder_has_the_documented_layout(tmp_path):
    filled(tmp_path, kind="hnsw", about={"catalogue": "mugs/"}, software="1.2", documents={"calibration": {}})
    assert (tmp_path / "CURRENT").read_text() == "gen-000001\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CURRENT", "LOCK", "gen-000001"]
    folder = tmp_path / "gen-000001"
    found = sorted(path.name for path in folder.iterdir())
    tables = ["embeddings.npy", "rows.jsonl", "table.npy"]
    assert found == sorted(["calibration.json", "manifest.json", "vectors.faiss", *tables])
    manifest = json.loads((folder / "manifest.json").read_text())
    counts = {"rows": 20, "slots": 20, "tombstones": 0, "built_slots": 20}
    must = {"format": 5, "generation": "gen-000001", "parent": None, "fingerprint": FINGERPRINT, "software": "1.2"}
    must |= {"about": {"catalogue": "mugs/"}, "kind": "hnsw", "metric": "inner_product", "dim": DIM, "counts": counts}
    assert {key: manifest[key] for key in must} == must
    assert manifest["recall"]["value"] == 1.0
    assert sorted(manifest["files"]) == [name for name in found if name != "manifest.json"]
    first = json.loads((folder / "rows.jsonl").read_text().splitlines()[0])
    assert first == {"id": "p00000", "digest": "1"}
    assert np.array_equal(np.load(folder / "embeddings.npy"), unit(20))


@pytest.mark.parametrize("kind", ["exact", "flat"])
def test_exact_kinds_have_no_structure_file(tmp_path, kind):
    assert not (filled(tmp_path, kind=kind).folder / "vectors.faiss").exists()


def test_approximate_kinds_state_their_measured_recall_and_settings(tmp_path):
    generation = filled(tmp_path, 300, "hnsw", parameters=HNSWParameters(ef_search=20))
    assert generation.manifest.recall["queries"] == 100
    assert 0.9 < generation.manifest.recall["value"] <= 1.0
    assert generation.manifest.parameters == {"neighbours": 32, "ef_construction": 80, "ef_search": 20}


def test_equal_vectors_are_stored_once_and_all_their_rows_are_found(tmp_path):
    vectors = np.array([[1, 0], [0, 1], [1, 0], [0.6, 0.8], [1, 0]], np.float32)
    generation = IndexStore(tmp_path).write(rows_of("ebdca"), vectors, fingerprint={})
    assert len(generation.embeddings) == 3
    rows, scores = generation.search(vectors[:1], 2)[0]
    assert [generation.rows[row]["id"] for row in rows] == ["a", "d", "e", "c"]
    np.testing.assert_allclose(scores, [1, 1, 1, 0.6], atol=2**-24)  # one rounding to float32


def test_ties_between_slots_are_ordered_by_row_id_for_any_order_of_writing(tmp_path):
    # Four vectors at right angles to the query; k = 2.
    axes = np.eye(6, dtype=np.float32)
    for turn, order in enumerate(([1, 2, 3, 4], [4, 3, 2, 1], [2, 4, 1, 3])):
        rows = rows_of([f"row{axis}" for axis in order])
        for kind in ("exact", "flat"):
            store = IndexStore(tmp_path / f"{turn}{kind}")
            found = store.write(rows, axes[order], fingerprint={}, kind=kind)
            ((hits, scores),) = found.search(axes[:1], 2)
            assert [found.rows[row]["id"] for row in hits] == ["row1", "row2"]
            assert scores.tolist() == [0, 0]


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_unchanged_rows_reuse_their_vectors(tmp_path, kind):
    store, count = IndexStore(tmp_path), 700
    partials = np.arange(count, dtype=np.float32)[:, None]
    first = store.write(rows_of(names(count)), unit(count), {"partials": partials}, kind=kind, **MORE)
    # p00000 goes, p00001 changes, "new" comes; the rest stays, in another order and with other metadata.
    unchanged = [row | {"price": 3} for row in rows_of(names(count - 2, start=2))][::-1]
    rows = [{"id": "new", "digest": "1"}, *unchanged, {"id": "p00001", "digest": "2"}]
    reuse = first.reusable({row["id"]: row["digest"] for row in rows})
    assert sorted(reuse) == names(count - 2, start=2)
    assert reuse["p00005"] == 5
    fresh, extra = unit(2, seed=9), np.array([[-1.0], [-2.0]], np.float32)
    second = store.write(rows, fresh, {"partials": extra}, kind=kind, parent=first, **MORE)
    assert second.manifest.parent == "gen-000001"
    assert second.rows == rows
    expected = np.concatenate([fresh[:1], unit(count)[2:][::-1], fresh[1:]])
    assert np.array_equal(second.embeddings[second.slots], expected)
    assert np.asarray(second.arrays["partials"])[:, 0].tolist() == [-1.0, *range(count - 1, 1, -1), -2.0]
    for place in (0, 5, count - 1):
        hits, scores = second.search(expected[place : place + 1], 1)[0]
        assert hits.tolist() == [place]
        assert scores[0] == pytest.approx(1, abs=1e-6)
    gone = unit(count)[:1]
    hits = second.search(gone, count)[0][0]
    assert sorted(hits.tolist()) == list(range(count))


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_removed_rows_leave_tombstones_until_more_than_a_tenth_is_removed(tmp_path, kind):
    store, count = IndexStore(tmp_path), 1000
    generation = filled(tmp_path, count, kind)
    for removed, slots, tombstones in [(50, 1000, 50), (100, 1000, 100), (101, 899, 0), (150, 899, 49)]:
        rows = rows_of(names(count - removed, start=removed))
        generation = store.write(rows, None, kind=kind, parent=generation, **MORE)
        counts = generation.manifest.counts
        assert (counts.rows, counts.slots, counts.tombstones) == (count - removed, slots, tombstones)
        # The removed vectors are the queries: their neighbours fill all ranks.
        for hits, _ in store.open(threads=1).search(unit(count)[:40], 15):
            assert len(hits) == 15
            assert {generation.rows[row]["id"] for row in hits} <= set(names(count - removed, start=removed))


def test_a_removed_row_that_returns_reuses_its_slot(tmp_path):
    store, all_rows = IndexStore(tmp_path), rows_of(names(100))
    first = filled(tmp_path, 100, "hnsw")
    second = store.write(all_rows[1:], None, parent=first, kind="hnsw", **MORE)
    third = store.write(all_rows, unit(100)[:1], parent=second, kind="hnsw", **MORE)
    assert third.manifest.counts.tombstones == 0
    assert third.manifest.counts.slots == 100


def test_inverted_lists_are_trained_again_when_the_index_has_more_than_doubled(tmp_path):
    store, generation = IndexStore(tmp_path), filled(tmp_path, 400, "ivf_flat")
    for count, built in [(600, 400), (800, 400), (801, 801)]:
        fresh = unit(count)[generation.count :] if count < 801 else unit(1, seed=5)
        generation = store.write(rows_of(names(count)), fresh, kind="ivf_flat", parent=generation, **MORE)
        assert generation.manifest.counts.built_slots == built
    assert generation.manifest.parameters["lists"] == 801 // 39


def test_other_parameters_or_another_kind_rebuild_the_structure_from_stored_vectors(tmp_path):
    store, generation = IndexStore(tmp_path), filled(tmp_path, 700, "hnsw")
    rows = rows_of(names(699, start=1))
    turns = [("hnsw", HNSWParameters(neighbours=8)), *((kind, None) for kind in APPROXIMATE + EXACT), ("hnsw", None)]
    for kind, parameters in turns:
        generation = store.write(rows, None, kind=kind, parameters=parameters, parent=generation, **MORE)
        assert generation.manifest.kind == kind
        counts = generation.manifest.counts
        assert (counts.rows, counts.built_slots, counts.tombstones) == (699, 700, 1)
        generation.self_check(699)


def test_vectors_of_another_model_are_not_reused(tmp_path):
    first = filled(tmp_path)
    with pytest.raises(MismatchedIndex, match=r"'checkpoint': 'xyz'.*'checkpoint': 'abc'"):
        IndexStore(tmp_path).write(rows_of(names(20)), None, fingerprint={"checkpoint": "xyz"}, parent=first)
    other = IndexStore(tmp_path).write(
        rows_of(names(20), digest="2"), unit(20), fingerprint={"checkpoint": "xyz"}, parent=first
    )
    assert other.manifest.parent is None


def test_rows_without_a_digest_are_never_reused(tmp_path):
    rows = [{"id": "a"}, {"id": "b", "digest": "1"}]
    generation = IndexStore(tmp_path).write(rows, unit(2), fingerprint={})
    assert generation.reusable({"a": None, "b": None}) == {}
    assert generation.reusable({"a": "1", "b": "1", "c": "1"}) == {"b": 1}


NOT_JSON = {
    "NaN": {"id": "a", "price": float("nan")},
    "infinity": {"id": "a", "price": [float("inf")]},
    "numpy number": {"id": "a", "price": np.float32(1)},
    "tuple": {"id": "a", "sizes": (1, 2)},
    "number as key": {"id": "a", "sizes": {1: 2}},
    "no id": {"name": "a"},
    "empty id": {"id": ""},
    "number as id": {"id": 3},
}


@pytest.mark.parametrize("row", NOT_JSON.values(), ids=NOT_JSON.keys())
def test_rows_that_json_would_change_raise(tmp_path, row):
    with pytest.raises(RowError, match=r"row|slot"):
        IndexStore(tmp_path).write([row], unit(1), fingerprint={})
    assert not (tmp_path / "CURRENT").exists()


def test_file_names_of_unknown_encoding_are_preserved(tmp_path):
    name = b"mug\xff.jpg".decode(errors="surrogateescape")
    IndexStore(tmp_path).write([{"id": name}], unit(1), fingerprint={})
    assert IndexStore(tmp_path).open().rows == [{"id": name}]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"rows": []}, RowError, "at least one row"),
        ({"rows": rows_of("aab")}, RowError, "'a' occurs twice"),
        ({"embeddings": unit(2)}, VectorError, "each of the 3 new rows; got 2"),
        ({"embeddings": None}, VectorError, "each of the 3 new rows; got 0"),
        ({"embeddings": unit(3) * np.float32(2)}, VectorError, "row 'a': the norm must be 1"),
        ({"arrays": {"partials": np.zeros((2, 4))}}, RowError, "each of 3 new rows; got 2"),
        ({"arrays": {"partials": np.float16([[1], [np.inf], [2]])}}, RowError, "row 'b' has NaN or inf"),
        ({"arrays": {"partials": np.array([{}, 1, 2])}}, RowError, "array of numbers"),
        ({"arrays": {"partials": np.zeros((3, 0))}}, RowError, "at least one number"),
        ({"arrays": {"rows": np.zeros(3)}}, RowError, "lower-case words"),
        ({"arrays": {"../x": np.zeros(3)}}, RowError, "lower-case words"),
        ({"documents": {"manifest": {}}}, RowError, "lower-case words"),
        ({"documents": {"calibration": {"a": float("nan")}}}, RowError, "document 'calibration'"),
        ({"documents": {"touches": np.float16([1, np.nan])}}, RowError, "'touches': an array must contain finite"),
        ({"documents": {"touches": np.array([{}])}}, RowError, "'touches': an array must contain finite"),
        ({"documents": {"x": 1}, "arrays": {"x": np.zeros(3)}}, RowError, "must have different names"),
        ({"fingerprint": {"checkpoint": 3}}, RowError, "fingerprint must map text to text"),
        ({"about": {"a": float("inf")}}, RowError, "about must be JSON"),
        ({"documents": {"touches": np.array(1.0)}}, RowError, r"must have rows of numbers; got shape \(\)"),
        ({"documents": {"touches": np.zeros((3, 0))}}, RowError, "must have rows of numbers"),
        ({"seed": 2**31}, ParameterError, "seed must be a whole number from 0"),
        ({"threads": 10**10}, ParameterError, "threads must be a whole number from 1"),
        ({"keep": -3}, ParameterError, "keep must be a whole number of at least 0"),
        ({"self_check": -1}, ParameterError, "self_check must be a whole number of at least 0"),
        ({"kind": "annoy"}, ParameterError, "exact, flat"),
        ({"kind": "hnsw", "parameters": 3}, ParameterError, "hnsw takes HNSWParameters"),
        ({"kind": "ivf_pq"}, ParameterError, "624 or more"),
    ],
)
def test_bad_input_raises_a_clear_error_and_does_not_change_the_index(tmp_path, change, error, words):
    filled(tmp_path)
    good = {"rows": rows_of("abc"), "embeddings": unit(3), "fingerprint": FINGERPRINT}
    with pytest.raises(error, match=words):
        IndexStore(tmp_path).write(**good | change)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CURRENT", "LOCK", "gen-000001"]
    assert IndexStore(tmp_path).open().count == 20


@pytest.mark.parametrize("k", [0, -1, True, 2.0, "2", None])
def test_a_search_for_an_invalid_number_of_results_raises(tmp_path, k):
    generation = filled(tmp_path)
    for search in (generation.search, generation.candidates):
        with pytest.raises(ParameterError, match="k, the number of results, must be a whole number of at least 1"):
            search(unit(1), k)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (None, r"the same arrays: partials float64 \(2,\); got none"),
        ({"partials": np.zeros((1, 2)), "more": np.zeros(1)}, r"got more float64 \(\), partials float64 \(2,\)"),
        ({"partials": np.zeros((1, 3))}, r"got partials float64 \(3,\)"),
        ({"partials": np.zeros((1, 2), np.float32)}, r"got partials float32 \(2,\)"),
    ],
)
def test_arrays_that_differ_from_the_parents_raise(tmp_path, arrays, words):
    parent = filled(tmp_path, arrays={"partials": np.zeros((20, 2))})
    with pytest.raises(RowError, match=words):
        IndexStore(tmp_path).write(rows_of(names(21)), unit(1, seed=3), arrays, fingerprint=FINGERPRINT, parent=parent)


def test_new_vectors_of_another_size_than_the_parents_raise(tmp_path):
    with pytest.raises(VectorError, match="must have 8 components"):
        IndexStore(tmp_path).write(rows_of(names(21)), unit(1, 5), fingerprint=FINGERPRINT, parent=filled(tmp_path))


def test_a_build_with_a_failed_self_check_never_becomes_current(tmp_path, monkeypatch):
    filled(tmp_path)

    def failing(self, sample=256, seed=0, since=0):
        raise SelfRetrievalFailed("2 of 20 rows are not found by their own vectors (p1, p2)", ["p1", "p2"])

    monkeypatch.setattr(Generation, "self_check", failing)
    with pytest.raises(SelfRetrievalFailed, match="p1, p2") as caught:
        filled(tmp_path, 10)
    assert caught.value.exit_code == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CURRENT", "LOCK", "gen-000001"]


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_the_self_check_passes_on_good_indexes_with_copies_and_near_copies(tmp_path, kind):
    vectors = unit(700)
    vectors[100:110] = vectors[100]
    vectors[200] = vectors[201] * np.float32(1.0005)  # scores above the true vector in its own search
    generation = IndexStore(tmp_path).write(
        rows_of(names(700)), vectors, fingerprint={}, kind=kind, threads=1, self_check=700
    )
    assert generation.self_check(700, seed=3) is None


def test_the_self_check_passes_if_codes_cannot_distinguish_near_copies(tmp_path):
    count, rng = 20_000, np.random.default_rng(0)
    vectors = unit(67, seed=1)[rng.integers(67, size=count)] + 1e-3 * rng.normal(size=(count, DIM))
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    coarse = IVFPQParameters(lists=10, probes=10, code_bytes=1, refine=2)
    more = {"fingerprint": {}, "kind": "ivf_pq", "parameters": coarse, "threads": 1, "self_check": 50}
    generation = IndexStore(tmp_path).write(rows_of(names(count)), vectors, **more)
    drawn = np.arange(0, count, 200)
    assert len(generation._rows_not_found(drawn, 1)) > 20 > len(generation._rows_not_found(drawn, 200)) == 0


def test_the_self_check_reports_the_rows_that_a_wrong_structure_loses(tmp_path):
    import faiss

    path = filled(tmp_path, 60, "ivf_flat").folder / "vectors.faiss"
    wrong = faiss.read_index(str(path))
    wrong.remove_ids(np.array([7, 9]))
    wrong.add_with_ids(-unit(60)[[7, 9]], np.array([7, 9]))
    faiss.write_index(wrong, str(path))
    opened = IndexStore(tmp_path).open(verify=False)
    with pytest.raises(SelfRetrievalFailed, match=r"2 of 60 rows .*p00007, p00009") as caught:
        opened.self_check()
    assert caught.value.ids == ["p00007", "p00009"]


def test_old_generations_are_deleted_except_the_last_two(tmp_path):
    for _ in range(5):
        filled(tmp_path)
    assert sorted(path.name for path in tmp_path.glob("gen-*")) == ["gen-000003", "gen-000004", "gen-000005"]


def test_a_reader_can_use_its_generation_after_a_writer_makes_four_more(tmp_path):
    partials = np.arange(40, dtype=np.float32).reshape(20, 2)
    filled(tmp_path, arrays={"partials": partials}, kind="hnsw")
    reader = IndexStore(tmp_path).open()
    before = reader.search(unit(4, seed=2), 3)
    for turn in range(4):
        IndexStore(tmp_path).write(rows_of("ab"), unit(2, seed=turn), fingerprint=FINGERPRINT)
    assert not reader.folder.exists()
    assert np.array_equal(reader.arrays["partials"], partials)
    assert np.array_equal(reader.embeddings[reader.slots], unit(20))
    for a, b in zip(before, reader.search(unit(4, seed=2), 3), strict=True):
        assert np.array_equal(a[0], b[0])
    assert IndexStore(tmp_path).open().count == 2
    # Even a deleted generation can be the parent of the next one.
    again = IndexStore(tmp_path).write(reader.rows, None, parent=reader, kind="hnsw", **MORE)
    assert np.array_equal(again.arrays["partials"], partials)


CHANGES = st.lists(st.dictionaries(st.integers(0, 11), st.integers(0, 4), min_size=1), min_size=2, max_size=4)
"""Successive states of a catalogue: photo number -> content. Equal contents have equal vectors."""


@pytest.mark.parametrize("kind", ["exact", "flat", "hnsw", "ivf_flat"])
@settings(max_examples=8)
@given(states=CHANGES)
def test_any_sequence_of_changes_gives_the_result_of_a_new_build(tmp_path_factory, kind, states):
    folder, contents = tmp_path_factory.mktemp("index"), unit(5, seed=4)
    store, generation = IndexStore(folder / "grown"), None
    more = {"fingerprint": FINGERPRINT, "kind": kind, "threads": 1}
    for state in states:
        rows = [{"id": f"p{photo:02d}", "digest": str(content)} for photo, content in state.items()]
        known = generation.reusable({row["id"]: row["digest"] for row in rows}) if generation else {}
        fresh = np.array([contents[int(row["digest"])] for row in rows if row["id"] not in known])
        fresh = fresh.reshape(-1, DIM).astype(np.float32)
        partials = fresh[:, :2].astype(np.float16)
        generation = store.write(rows, fresh, {"partials": partials}, parent=generation, **more)
        whole = contents[[int(row["digest"]) for row in rows]]
        rebuilt = IndexStore(folder / "fresh").write(rows, whole, {"partials": whole[:, :2].astype(np.float16)}, **more)
        assert generation.rows == rebuilt.rows
        assert np.array_equal(generation.arrays["partials"], rebuilt.arrays["partials"])
        for k in (1, 2, 12):
            # Approximate kinds are exhaustive if k covers all slots.
            if k < 12 and kind not in ("exact", "flat"):
                continue
            for a, b in zip(generation.search(contents, k), rebuilt.search(contents, k), strict=True):
                assert np.array_equal(a[0], b[0])
                assert np.array_equal(a[1], b[1])


def test_importing_the_package_needs_only_numpy_and_a_faiss_kind_imports_faiss(tmp_path):
    program = """
import sys
for name in ("faiss", "torch", "cv2", "PIL", "scipy", "sklearn", "retrieval", "robot"):
    sys.modules[name] = None
import numpy as np
import indexes, indexes.errors, indexes.kinds.measure
from indexes.store.folder import IndexStore
store = IndexStore(sys.argv[1])
made = store.write([{"id": "a"}, {"id": "b"}], np.eye(2, dtype=np.float32), fingerprint={}, kind="exact")
assert store.open().search(np.eye(2, dtype=np.float32), 1)[1][0].tolist() == [1]
try:
    indexes.load_kind("hnsw")
except ImportError as error:
    assert "faiss" in str(error)
else:
    raise SystemExit("hnsw did not import faiss")
"""
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True, timeout=60)
