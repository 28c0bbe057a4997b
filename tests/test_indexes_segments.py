"""A million rows are not written again for a thousand: segments, what is shared, and when they are joined."""

import os
from pathlib import Path

import numpy as np
import pytest

from indexes.errors import CorruptIndex, MismatchedIndex, ParameterError, RowError, VectorError
from indexes.kinds import faiss_index
from indexes.kinds.stack import Stack, segments_kept, stacked
from indexes.store import plan
from indexes.store.files import ArrayFile
from indexes.store.folder import IndexStore
from indexes.store.plan import first_of_equals
from indexes.store.rows import key_of
from indexes.store.spool import Block, Kept
from tests.test_indexes_store import DIM, EVERY_KIND, FINGERPRINT, names, rows_of, unit


def block(start: int, stop: int, **more) -> Block:
    """Rows start to stop - 1, whose halves hold their numbers."""
    halves = np.arange(start, stop, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    rows = [row | more for row in rows_of(names(stop - start, start))]
    return Block(
        rows, unit(stop, seed=7)[start:stop] if start == 0 else unit(stop - start, seed=start), {"halves": halves}
    )


def grown(store, blocks, **more):
    return store.write_blocks(blocks, **{"fingerprint": FINGERPRINT, "threads": 1} | more)


def inodes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in folder.iterdir()}


def written_bytes(old: Path, new: Path) -> int:
    """Bytes of the files of `new` that are not files of `old`."""
    known = set(inodes(old).values())
    return sum(path.stat().st_size for path in new.iterdir() if path.stat().st_ino not in known)


# Segments ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_adding_a_few_rows_shares_every_file_of_the_many(tmp_path, kind):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 1000)], kind=kind)
    second = grown(store, [Kept(np.arange(1000)), block(1000, 1010)], kind=kind, parent=first)
    shared = {name for name, inode in inodes(second.folder).items() if inode == inodes(first.folder).get(name)}
    assert shared == set(inodes(first.folder)) - {"manifest.json"}
    assert written_bytes(first.folder, second.folder) < 10_000 < written_bytes(tmp_path, first.folder)
    assert second.manifest.segments == {"records": [1, 2], "vectors": [1, 2]}
    assert {name: second.manifest.files[name] for name in shared} == first.manifest.files
    opened = store.open(threads=1)
    assert [row["id"] for row in opened.rows] == names(1010)
    assert np.asarray(opened.arrays["halves"])[:, 0].tolist() == list(range(1010))
    assert np.array_equal(opened.embeddings[:1000], unit(1000, seed=7))
    assert [hits[0] for hits, _ in opened.search(unit(10, seed=1000), 1)] == list(range(1000, 1010))
    opened.self_check(1010)


def test_blocks_and_one_writing_give_the_same_files(tmp_path):
    whole, parts = (IndexStore(tmp_path / name) for name in "ab")
    rows = rows_of(names(300))
    halves = np.arange(900, dtype=np.float16).reshape(300, 3)
    whole.write(rows, unit(300), {"halves": halves}, fingerprint=FINGERPRINT, kind="hnsw", threads=1)
    blocks = (Block(rows[n : n + 7], unit(300)[n : n + 7], {"halves": halves[n : n + 7]}) for n in range(0, 300, 7))
    grown(parts, blocks, kind="hnsw")
    for path in (tmp_path / "a" / "gen-000001").iterdir():
        if path.name != "manifest.json":
            assert path.read_bytes() == (tmp_path / "b" / "gen-000001" / path.name).read_bytes()


def test_blocks_are_asked_for_one_at_a_time_and_on_the_disk_before_the_next(tmp_path):
    seen = []

    def blocks():
        for start in range(0, 5000, 1000):
            (folder,) = tmp_path.glob("gen-*")
            seen.append((folder / "halves.new").stat().st_size if start else 0)
            yield block(start, start + 1000)

    assert grown(IndexStore(tmp_path), blocks()).count == 5000
    assert all(bytes_there >= 12_000 * number - 2**13 for number, bytes_there in enumerate(seen))


@pytest.mark.parametrize(
    ("sizes", "fresh", "kept"),
    [
        ([], 5, 0),
        ([5], 0, 1),
        ([10], 3, 1),
        ([10], 10, 0),
        ([10, 3], 3, 1),
        ([10, 6, 3], 3, 0),
        ([100, 6, 3], 3, 1),
    ],
)
def test_a_new_segment_takes_in_those_no_larger_than_itself(sizes, fresh, kept):
    assert segments_kept(sizes, fresh) == kept


def test_a_thousand_additions_leave_few_segments_and_copy_a_row_few_times():
    sizes, copied = [1_000_000], 0
    for _ in range(1000):
        kept = segments_kept(sizes, 1000)
        copied += sum(sizes[kept:])
        sizes = [*sizes[:kept], 1000 + sum(sizes[kept:])]
        assert len(sizes) <= 11  # log2 of a thousand additions, and the first
    assert sum(sizes) == 2_000_000
    assert copied / 1_000_000 < 10.5


def test_small_additions_are_joined_and_the_rows_stay_as_they_are(tmp_path):
    store, generation = IndexStore(tmp_path), None
    for start in range(0, 100, 10):
        kept = [] if generation is None else [Kept(np.arange(start))]
        generation = grown(store, [*kept, block(start, start + 10)], parent=generation)
    assert generation.manifest.segments["records"] == [8, 10]  # 80 rows, and 20
    assert [row["id"] for row in generation.rows] == names(100)
    assert np.asarray(generation.arrays["halves"])[:, 0].tolist() == list(range(100))
    generation.self_check(100)


def test_where_files_cannot_have_two_names_they_are_copied(tmp_path, monkeypatch):
    first = grown(IndexStore(tmp_path), [block(0, 100)], kind="hnsw")

    def refused(*names, **options):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    second = grown(IndexStore(tmp_path), [Kept(np.arange(100)), block(100, 105)], kind="hnsw", parent=first)
    for name in ("rows-000001.jsonl", "halves-000001.npy", "embeddings-000001.npy", "vectors.faiss"):
        assert (second.folder / name).read_bytes() == (first.folder / name).read_bytes()
    assert IndexStore(tmp_path).open().count == 105


def test_a_file_put_in_the_place_of_the_parents_is_not_taken_for_it(tmp_path):
    first = grown(IndexStore(tmp_path), [block(0, 100)])
    path = first.folder / "halves-000001.npy"
    whole = path.read_bytes()
    path.unlink()
    path.write_bytes(bytes(len(whole)))
    second = grown(IndexStore(tmp_path), [Kept(np.arange(100)), block(100, 105)], parent=first)
    assert (second.folder / path.name).read_bytes() == whole
    assert IndexStore(tmp_path).open().count == 105


def test_damage_in_a_shared_file_is_found_by_both_generations(tmp_path):
    first = grown(IndexStore(tmp_path), [block(0, 100)])
    grown(IndexStore(tmp_path), [Kept(np.arange(100)), block(100, 105)], parent=first)
    path = first.folder / "halves-000001.npy"
    with path.open("r+b") as handle:
        handle.seek(300)
        handle.write(b"\xff")
    with pytest.raises(CorruptIndex, match=r"gen-000002/halves-000001\.npy: the SHA-256"):
        IndexStore(tmp_path).open()


def test_rows_that_go_leave_their_bytes_until_a_tenth_is_gone(tmp_path):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 1000)])
    second = grown(store, [Kept(np.arange(100, 1000)[::-1])], parent=first)
    assert (second.manifest.counts.records, second.manifest.counts.rows) == (1000, 900)
    assert written_bytes(first.folder, second.folder) < 8 * 1000 + 4000  # the order of the rows, and the manifest
    third = grown(store, [Kept(np.arange(899))], parent=second)
    assert (third.manifest.counts.records, third.manifest.counts.slots) == (899, 899)
    assert third.manifest.segments == {"records": [3], "vectors": [3]}
    for generation in (second, third):
        assert [row["id"] for row in generation.rows] == names(900, 100)[::-1][: generation.count]
        assert np.asarray(generation.arrays["halves"])[:2, 0].tolist() == [999, 998]
        assert generation.row_number("p00500") == 499
        generation.self_check(900)


def test_rows_with_other_metadata_keep_their_vectors_and_get_new_lines(tmp_path):
    store = IndexStore(tmp_path)
    first = grown(store, [block(0, 100)])
    rows = [row | ({"price": 3} if number < 5 else {}) for number, row in enumerate(first.rows)]
    second = store.write(rows, None, fingerprint=FINGERPRINT, parent=first)
    assert (second.manifest.counts.records, second.manifest.counts.slots) == (105, 100)
    assert (second.rows[4], second.rows[5]) == (rows[4], rows[5])
    assert np.array_equal(second.arrays["halves"], first.arrays["halves"])
    assert np.array_equal(second.slots, first.slots)


def test_kept_rows_come_from_a_parent_made_by_the_same_model(tmp_path):
    first = grown(IndexStore(tmp_path), [block(0, 10)])
    with pytest.raises(RowError, match="only from a parent; got none"):
        grown(IndexStore(tmp_path), [Kept(np.arange(3))])
    with pytest.raises(MismatchedIndex):
        grown(IndexStore(tmp_path), [Kept(np.arange(3))], parent=first, fingerprint={"checkpoint": "other"})
    for outside in (-1, 10):
        with pytest.raises(RowError, match=rf"rows 0 to 9; got {outside} to {outside}"):
            grown(IndexStore(tmp_path), [Kept(np.array([outside]))], parent=first)
    with pytest.raises(RowError, match="'p00001' comes twice"):
        grown(IndexStore(tmp_path), [Kept(np.array([0, 1, 1]))], parent=first)
    with pytest.raises(RowError, match="'p00009' comes twice"):
        grown(IndexStore(tmp_path), [Kept(np.arange(10)), block(9, 12, digest="2")], parent=first)
    assert IndexStore(tmp_path).current() == "gen-000001"


@pytest.mark.parametrize(
    ("later", "error", "words"),
    [
        (Block(rows_of("x"), unit(1), {}), RowError, "every block must have the same arrays"),
        (Block(rows_of("x"), unit(1), {"halves": np.zeros((1, 2), np.float32)}), RowError, "every block"),
        (Block(rows_of("x"), unit(1, 5), {"halves": np.zeros((1, 3), np.float32)}), VectorError, "8 components"),
        (Block([], None), RowError, "at least one row"),
    ],
)
def test_blocks_that_do_not_fit_the_ones_before_are_refused(tmp_path, later, error, words):
    with pytest.raises(error, match=words):
        grown(IndexStore(tmp_path), [block(0, 10), later])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["LOCK"]


# The structure ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["hnsw", "ivf_flat", "ivf_sq8", "ivf_pq"])
def test_new_vectors_are_scanned_until_they_are_a_tenth_and_then_taken_into_the_structure(tmp_path, kind):
    store, count = IndexStore(tmp_path), 900
    generation = grown(store, [block(0, count)], kind=kind)
    for more, covered in [(50, 900), (50, 900), (1, 1001)]:
        before = generation
        generation = grown(store, [Kept(np.arange(count)), block(count, count + more)], kind=kind, parent=generation)
        count += more
        assert generation.manifest.counts.structure_slots == generation.index.covered == covered
        same = inodes(before.folder)["vectors.faiss"] == inodes(generation.folder)["vectors.faiss"]
        assert same == (covered == 900)
        own = np.asarray(generation.embeddings)[-more:]
        assert all(hits[0] >= count - more and scores[0] > 0.999 for hits, scores in store.open().search(own, 1))
        before.self_check(900)  # its structure is as it was


def test_growing_leaves_the_index_that_was_copied_as_it_was():
    from indexes.kinds.hnsw import HNSWIndex

    first = HNSWIndex.build(unit(100), threads=1)
    second = first.copy()
    second.add(unit(50, seed=2))
    assert (first.covered, second.covered) == (100, 150)
    assert not first.shares_structure(second)
    third = first.copy()
    third.add(unit(2, seed=2))
    assert third.shares_structure(first)
    assert (first.count, third.count, third.covered) == (100, 102, 100)


def test_a_structure_of_fewer_vectors_than_the_manifest_says_is_refused(tmp_path):
    from indexes.kinds.hnsw import HNSWIndex, HNSWParameters

    HNSWIndex.build(unit(100), threads=1).save(tmp_path / "x")
    loaded = HNSWIndex.load(tmp_path / "x", unit(110), HNSWParameters(), covered=100)
    assert loaded.search(unit(110)[105:106], 1)[1].tolist() == [[105]]
    with pytest.raises(CorruptIndex, match="build the index again"):
        HNSWIndex.load(tmp_path / "x", unit(110), HNSWParameters(), covered=101)


def test_codes_need_enough_vectors_to_be_trained():
    from indexes import load_kind

    for kind in ("ivf_sq8", "ivf_pq"):
        with pytest.raises(ParameterError, match="624 or more vectors"):
            load_kind(kind).build(unit(623))


def test_training_looks_at_a_bounded_number_of_vectors(monkeypatch):
    from indexes.kinds.ivf import IVFFlatIndex, IVFParameters

    monkeypatch.setattr("indexes.kinds.ivf.MOST_POINTS_PER_CENTRE", 39)
    index = IVFFlatIndex.build(unit(2000), IVFParameters(lists=4), threads=1)
    drawn = index._training()
    assert drawn.shape == (156, DIM)
    assert len(np.unique(drawn, axis=0)) == 156


# Ties -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["exact", "flat"])
def test_ties_at_the_last_place_go_by_id_in_an_index_that_has_grown(tmp_path, kind):
    axes = np.eye(8, dtype=np.float32)
    store, generation = IndexStore(tmp_path), None
    for axis in (5, 3, 1, 2, 4):
        kept = [] if generation is None else [Kept(np.arange(generation.count))]
        fresh = Block(rows_of([f"row{axis}"]), axes[axis : axis + 1])
        generation = store.write_blocks([*kept, fresh], fingerprint={}, kind=kind, parent=generation)
    for k in (1, 2, 3, 4, 5):
        ((hits, scores),) = generation.search(axes[:1], k)
        assert [generation.rows[hit]["id"] for hit in hits] == [f"row{axis}" for axis in range(1, k + 1)]
        assert scores.tolist() == [0.0] * k
    naive = generation.index.search(axes[:1], 2)[1][0]  # slots go by age
    assert [generation.rows[slot]["id"] for slot in naive] == ["row5", "row3"]


# Parts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [None, [4, 0, 9, 3, 3]], ids=["as they lie", "in an order"])
@pytest.mark.parametrize("cuts", [[], [3], [1, 4, 9]])
def test_a_stack_reads_as_one_array(cuts, order):
    whole = np.arange(20).reshape(10, 2)
    must = whole if order is None else whole[order]
    table = Stack(np.split(whole, cuts), None if order is None else np.array(order))
    assert (len(table), table.shape, table.ndim, table.dtype) == (len(must), must.shape, 2, must.dtype)
    assert np.array_equal(table, must)
    picks = [
        0,
        -1,
        np.int64(2),
        slice(1, 4),
        slice(None),
        slice(4, 1),
        slice(None, None, -2),
        [3, 0, -2],
        [],
        must[:, 0] > 5,
    ]
    for pick in [*picks, slice(len(must), None), np.array([[0, 1], [2, 3]])]:
        chosen = np.asarray(pick, np.int64) if isinstance(pick, list) else pick
        assert np.array_equal(table[chosen], must[chosen]), pick
    for outside in (len(must), -len(must) - 1):
        with pytest.raises(IndexError):
            table[outside]
        with pytest.raises(IndexError):
            table[[outside]]


def test_a_slice_within_one_part_is_a_view_of_it():
    whole = np.arange(20).reshape(10, 2)
    table = Stack([whole[:6], whole[6:]])
    assert np.shares_memory(table[1:6], whole)
    assert not np.shares_memory(table[1:7], whole)
    assert stacked([whole]) is whole


def test_an_array_file_reads_back_and_counts_its_rows_at_the_end(tmp_path):
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


def test_equal_vectors_are_found_as_two_plain_loops_find_them():
    vectors = unit(40)[np.random.default_rng(1).integers(40, size=200)]
    must = [min(other for other in range(200) if (vectors[other] == vector).all()) for vector in vectors]
    assert first_of_equals(vectors).tolist() == must


def test_vectors_of_equal_hash_and_other_bytes_are_told_apart(monkeypatch):
    vectors = unit(5)[[0, 1, 0, 2, 1, 3, 2, 2]]
    real = plan._hashes
    monkeypatch.setattr(plan, "_hashes", lambda table, seed=0: real(table, seed) % (2 if seed < 3 else 2**63))
    assert first_of_equals(vectors).tolist() == [0, 1, 0, 3, 1, 5, 3, 3]


def test_zero_and_minus_zero_are_other_bytes():
    vectors = np.array([[1, 0], [1, -0.0], [1, 0]], np.float32)
    assert first_of_equals(vectors).tolist() == [0, 1, 0]


def test_the_share_that_is_scanned_is_small():
    assert faiss_index.MOST_SCANNED <= 0.1
