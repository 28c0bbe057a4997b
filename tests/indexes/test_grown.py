"""Growth of an index: blocks, rows copied from the parent, tombstones, reused structures, equal vectors."""

import shutil

import numpy as np
import pytest

from indexes.errors import CorruptIndex, MismatchedIndex, ParameterError, RowError, VectorError
from indexes.store import equal
from indexes.store.arrays import ArrayFile
from indexes.store.equal import first_equal_rows
from indexes.store.folder import IndexStore
from indexes.store.rows import key_of
from indexes.store.tables import Block
from tests.indexes.test_store import APPROXIMATE, DIM, EVERY_KIND, FINGERPRINT, names, rows_of, unit


def block(start: int, stop: int, **more) -> Block:
    """Rows start to stop - 1, with their numbers as partial activations."""
    partials = np.arange(start, stop, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    rows = [row | more for row in rows_of(names(stop - start, start))]
    return Block(
        rows, unit(stop, seed=7)[start:stop] if start == 0 else unit(stop - start, seed=start), {"partials": partials}
    )


def grown(store, blocks, **more):
    return store.write_blocks(blocks, **{"fingerprint": FINGERPRINT, "threads": 1} | more)


def known(generation, start=0, stop=None) -> Block:
    """The generation's own rows, without new vectors or arrays."""
    return Block(generation.rows[start:stop])


# Growing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_a_grown_index_has_the_parents_rows_and_new_ones_and_does_not_change_the_parent(tmp_path, kind):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 1000)], kind=kind)
    before = {path.name: path.read_bytes() for path in first.folder.iterdir()}
    second = grown(store, [known(first), block(1000, 1010)], kind=kind, parent=first)
    assert second.manifest.parent == first.name
    assert {path.name: path.read_bytes() for path in first.folder.iterdir()} == before
    opened = store.open(threads=1)
    assert [row["id"] for row in opened.rows] == names(1010)
    assert opened.arrays["partials"][:, 0].tolist() == list(range(1010))
    assert np.array_equal(opened.embeddings[:1000], unit(1000, seed=7))
    assert [hits[0] for hits, _ in opened.search(unit(10, seed=1000), 1)] == list(range(1000, 1010))
    opened.self_check(1010)


def test_the_folder_of_a_generation_can_be_moved_by_itself(tmp_path):
    store = IndexStore(tmp_path / "here")
    first = grown(store, [block(0, 100)], kind="hnsw")
    second = grown(store, [known(first), block(100, 105)], kind="hnsw", parent=first)
    assert {path.stat().st_nlink for path in second.folder.iterdir()} == {1}
    shutil.copytree(second.folder, tmp_path / "there" / second.name)
    shutil.copy(tmp_path / "here" / "CURRENT", tmp_path / "there")
    shutil.rmtree(tmp_path / "here")
    moved = IndexStore(tmp_path / "there").open()
    assert moved.count == 105
    moved.self_check(105)


def test_blocks_and_a_single_write_give_the_same_files(tmp_path):
    whole, parts = (IndexStore(tmp_path / name) for name in "ab")
    rows = rows_of(names(300))
    partials = np.arange(900, dtype=np.float16).reshape(300, 3)
    whole.write(rows, unit(300), {"partials": partials}, fingerprint=FINGERPRINT, kind="hnsw", threads=1)
    blocks = (Block(rows[n : n + 7], unit(300)[n : n + 7], {"partials": partials[n : n + 7]}) for n in range(0, 300, 7))
    grown(parts, blocks, kind="hnsw")
    for path in (tmp_path / "a" / "gen-000001").iterdir():
        if path.name != "manifest.json":
            assert path.read_bytes() == (tmp_path / "b" / "gen-000001" / path.name).read_bytes()


def test_each_block_is_written_before_the_next_is_requested(tmp_path):
    sizes = []

    def blocks():
        for start in range(0, 5000, 1000):
            (folder,) = tmp_path.glob("gen-*")
            sizes.append((folder / "partials.npy").stat().st_size if start else 0)
            yield block(start, start + 1000)

    assert grown(IndexStore(tmp_path), blocks()).count == 5000
    assert all(bytes_there >= 12_000 * number - 2**13 for number, bytes_there in enumerate(sizes))


def test_slots_of_removed_rows_stay_until_more_than_a_tenth_has_no_row(tmp_path):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 1000)])
    second = grown(store, [Block(first.rows[100:][::-1])], parent=first)
    counts = second.manifest.counts
    assert (counts.rows, counts.slots, counts.tombstones) == (900, 1000, 100)
    assert len((second.folder / "rows.jsonl").read_text().splitlines()) == 900
    third = grown(store, [known(second, 0, 899)], parent=second)
    assert (third.manifest.counts.rows, third.manifest.counts.slots) == (899, 899)
    assert third.slots.tolist() == list(range(899))
    for generation in (second, third):
        assert [row["id"] for row in generation.rows] == names(900, 100)[::-1][: generation.count]
        assert generation.arrays["partials"][:2, 0].tolist() == [999, 998]
        assert generation.row_number("p00500") == 499
        generation.self_check(900)


def test_rows_with_new_metadata_reuse_their_vectors(tmp_path):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 100)])
    rows = [row | ({"price": 3} if number < 5 else {}) for number, row in enumerate(first.rows)]
    second = store.write(rows, None, fingerprint=FINGERPRINT, parent=first)
    assert second.manifest.counts.slots == 100
    assert (second.rows[4], second.rows[5]) == (rows[4], rows[5])
    assert np.array_equal(second.arrays["partials"], first.arrays["partials"])
    assert np.array_equal(second.slots, first.slots)


def test_rows_are_reused_only_from_a_parent_of_the_same_model_and_occur_once(tmp_path):
    first = grown(IndexStore(tmp_path), [block(0, 10)])
    with pytest.raises(MismatchedIndex):
        grown(IndexStore(tmp_path), [known(first)], parent=first, fingerprint={"checkpoint": "other"})
    with pytest.raises(VectorError, match="each of the 10 new rows; got 0"):
        grown(IndexStore(tmp_path), [known(first)])
    with pytest.raises(RowError, match="'p00001' occurs twice"):
        grown(IndexStore(tmp_path), [known(first), known(first, 1, 2)], parent=first)
    with pytest.raises(RowError, match="'p00009' occurs twice"):
        grown(IndexStore(tmp_path), [known(first), block(9, 12, digest="2")], parent=first)
    assert IndexStore(tmp_path).current() == "gen-000001"


@pytest.mark.parametrize(
    ("later", "error", "words"),
    [
        (Block(rows_of("x"), unit(1), {}), RowError, "must have the same arrays"),
        (Block(rows_of("x"), unit(1), {"partials": np.zeros((1, 2), np.float32)}), RowError, "same arrays"),
        (Block(rows_of("x"), unit(1, 5), {"partials": np.zeros((1, 3), np.float32)}), VectorError, "8 components"),
        (Block([], None), RowError, "at least one row"),
    ],
)
def test_blocks_that_do_not_match_earlier_ones_raise(tmp_path, later, error, words):
    with pytest.raises(error, match=words):
        grown(IndexStore(tmp_path), [block(0, 10), later])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["LOCK"]


# The structure ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", APPROXIMATE)
def test_new_vectors_are_added_to_a_copy_of_the_parents_structure_without_training(tmp_path, kind):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 900)], kind=kind)
    second = grown(store, [known(first), block(900, 950)], kind=kind, parent=first)
    counts = second.manifest.counts
    assert (counts.built_slots, counts.slots) == (900, 950)
    own = second.embeddings[-50:]
    assert all(hits[0] >= 900 and scores[0] > 0.999 for hits, scores in store.open().search(own, 1))
    first.self_check(900)


def test_growing_a_copy_does_not_change_the_original():
    from indexes.kinds.hnsw import HNSWIndex

    first = HNSWIndex.build(unit(100), threads=1)
    second = first.copy()
    second.add(unit(50, seed=2))
    assert [(each.count, each._structure.ntotal) for each in (first, second)] == [(100, 100), (150, 150)]


def test_a_structure_with_too_few_vectors_is_corrupt(tmp_path):
    from indexes.kinds.hnsw import HNSWIndex, HNSWParameters

    HNSWIndex.build(unit(100), threads=1).save(tmp_path / "x")
    assert HNSWIndex.load(tmp_path / "x", unit(100), HNSWParameters()).search(unit(1), 1)[1].tolist() == [[0]]
    with pytest.raises(CorruptIndex, match="build the index again"):
        HNSWIndex.load(tmp_path / "x", unit(101), HNSWParameters())


def test_codes_need_enough_vectors_to_be_trained():
    from indexes import load_kind

    for kind in ("ivf_sq8", "ivf_pq"):
        with pytest.raises(ParameterError, match="624 or more vectors"):
            load_kind(kind).build(unit(623))


def test_training_uses_a_bounded_number_of_vectors(monkeypatch):
    from indexes.kinds.ivf import IVFFlatIndex, IVFParameters

    monkeypatch.setattr("indexes.kinds.ivf.MAX_POINTS_PER_CENTRE", 39)
    index = IVFFlatIndex.build(unit(2000), IVFParameters(lists=4), threads=1)
    drawn = index._training()
    assert drawn.shape == (156, DIM)
    assert len(np.unique(drawn, axis=0)) == 156


# Ties -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["exact", "flat"])
def test_ties_at_rank_k_are_ordered_by_id_in_a_grown_index(tmp_path, kind):
    axes = np.eye(8, dtype=np.float32)
    store, generation = IndexStore(tmp_path), None
    for axis in (5, 3, 1, 2, 4):
        old = [] if generation is None else [known(generation)]
        fresh = Block(rows_of([f"row{axis}"]), axes[axis : axis + 1])
        generation = store.write_blocks([*old, fresh], fingerprint={}, kind=kind, parent=generation)
    for k in (1, 2, 3, 4, 5):
        ((hits, scores),) = generation.search(axes[:1], k)
        assert [generation.rows[hit]["id"] for hit in hits] == [f"row{axis}" for axis in range(1, k + 1)]
        assert scores.tolist() == [0.0] * k
    naive = generation.index.search(axes[:1], 2)[1][0]  # slots are ordered by age
    assert [generation.rows[slot]["id"] for slot in naive] == ["row5", "row3"]


# Files and keys ---------------------------------------------------------------------------------------------


def test_an_array_file_reads_back_with_its_number_of_rows(tmp_path):
    file = ArrayFile(tmp_path / "x.npy", np.float16, (3,))
    for count in (2, 0, 5):
        file.append(np.full((count, 3), count))
    file.close()
    read = np.load(tmp_path / "x.npy", mmap_mode="r")
    assert (read.dtype, read.shape) == (np.float16, (7, 3))
    assert read[:, 0].tolist() == [2, 2, 5, 5, 5, 5, 5]


def test_codes_of_rows_are_equal_for_equal_texts_and_count_up(tmp_path):
    rows = [row | {"object_id": name} for row, name in zip(rows_of(names(6)), "cabaac", strict=True)]
    generation = IndexStore(tmp_path).write(rows, unit(6), fingerprint={})
    assert generation.codes("object_id").tolist() == [0, 1, 2, 1, 1, 0]
    assert generation.codes("digest").tolist() == [0] * 6
    assert generation.codes("id").tolist() == list(range(6))
    assert key_of("a") != key_of("b")
    assert key_of(None) == b""


# Equal vectors ----------------------------------------------------------------------------------------------


def test_equal_vectors_match_two_plain_loops():
    vectors = unit(40)[np.random.default_rng(1).integers(40, size=200)]
    must = [min(other for other in range(200) if (vectors[other] == vector).all()) for vector in vectors]
    assert first_equal_rows(vectors).tolist() == must


def test_vectors_with_a_common_prefix_are_distinguished():
    vectors = np.zeros((5, equal.COMPARED_COMPONENTS + 4), np.float32)
    vectors[:, 0] = 1
    vectors[[1, 3], -1], vectors[4, -2] = 0.5, 0.5
    assert first_equal_rows(vectors).tolist() == [0, 1, 0, 1, 4]


def test_zero_and_minus_zero_differ():
    vectors = np.array([[1, 0], [1, -0.0], [1, 0]], np.float32)
    assert first_equal_rows(vectors).tolist() == [0, 1, 0]
