"""The store: reading back, rows, and what is kept."""

import numpy as np
import pytest

from indexes.errors import CorruptIndex, ParameterError, RowError, VectorError
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.rows import Row
from tests.indexes.test_search import unit

DIM = 8
FINGERPRINT = {"checkpoint": "abc", "preprocessing": "def"}


def rows_of(paths) -> list[Row]:
    return [Row(path, path, path) for path in paths]


def names(count: int) -> list[str]:
    return [f"p{number:05d}" for number in range(count)]


def filled(path, count: int = 20, kind: str = "flat", arrays=None, **more) -> Generation:
    """A small index of `count` random vectors."""
    store, more = IndexStore(path), {"fingerprint": FINGERPRINT} | more
    store.discard_before(
        store.write(rows_of(names(count)), blocks(unit(count, DIM), arrays), kind=kind, **more).generation
    )
    return store.open()


def blocks(embeddings, arrays=None):
    return [{"embeddings": embeddings, **(arrays or {})}]


@pytest.mark.parametrize("kind", ["flat", "IVF4,SQ8;nprobe=2", "HNSW8"])
def test_a_written_index_is_read_back(tmp_path, kind):
    count = 200
    metadata = {"price": 0.1, "tags": [None, True, 2**70]}
    paths = sorted(f"фото/{number}\u2028.jpg" for number in range(count))
    rows = [Row(path, f"o{number % 7}", str(number % 150), metadata) for number, path in enumerate(paths)]
    partials = np.random.default_rng(0).normal(size=(count, 6)).astype(np.float16)
    store = IndexStore(tmp_path / "a" / "index")
    manifest = store.write(
        rows,
        blocks(unit(count, DIM), {"partials": partials, "sizes": np.arange(count)}),
        documents={"calibration": {"scale": 1.25}, "touches": partials[:3], "empty": partials[:0]},
        fingerprint=FINGERPRINT,
        about={"checkpoint": "model.safetensors"},
        kind=kind,
        software="0.1.0",
    )
    generation = store.open()
    assert generation.folder == tmp_path / "a" / "index" / "gen-000001"
    assert generation.manifest == manifest
    assert list(generation.rows) == rows
    assert np.array_equal(generation.arrays["partials"], partials)
    assert np.array_equal(generation.arrays["sizes"], np.arange(count))
    assert isinstance(generation.arrays["partials"], np.memmap)
    assert generation.documents["calibration"] == {"scale": 1.25}
    assert np.array_equal(generation.documents["touches"], partials[:3])
    assert generation.documents["empty"].shape == (0, 6)
    assert np.array_equal(generation.embeddings, unit(count, DIM))


def test_blocks_of_rows_give_the_same_files_as_one_and_are_measured_whole(tmp_path):
    vectors, partials = unit(50, DIM), np.arange(100).reshape(50, 2)
    one = filled(tmp_path / "one", 50, arrays={"partials": partials})
    parts = ({"embeddings": vectors[n : n + 7], "partials": partials[n : n + 7]} for n in range(0, 50, 7))

    def measure(index, arrays):
        assert isinstance(arrays["partials"], np.memmap)
        return {"sum": int(arrays["partials"].sum()), "vectors": index.count}

    manifest = IndexStore(tmp_path / "other").write(rows_of(names(50)), parts, about={"a": 1}, measure=measure)
    assert manifest.files == one.manifest.files
    assert manifest.about == {"a": 1, "sum": 4950, "vectors": 50}


def test_rows_and_objects_are_found_by_name(tmp_path):
    paths = ["a/1", "a/2", "a-b/1", "c", "é/1", "🍎/1"]
    rows = [Row(path, path.split("/")[0], path[-1]) for path in sorted(paths)]
    IndexStore(tmp_path).write(rows, blocks(unit(6, DIM)))
    found = IndexStore(tmp_path).open().rows
    assert [found.find(row.path) for row in rows] == list(range(6))
    assert [found.find(path) for path in ("", "a", "b/1", "zz", "🍏")] == [-1] * 5
    objects = sorted({row.object_id for row in rows})
    assert [found.object_name(number) for number in range(found.object_count)] == objects
    assert [found.find_object(name) for name in objects] == list(range(len(objects)))
    assert [found.find_object(name) for name in ("", "a/1", "b", "zz")] == [-1] * 4
    assert [objects[number] for number in found.objects] == [row.object_id for row in rows]
    digests = [row.digest for row in rows]
    assert found.originals.tolist() == [digests.index(digest) for digest in digests]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"rows": []}, RowError, "at least one row"),
        ({"rows": rows_of("ab")}, RowError, "every row needs an embedding|one entry for each"),
        ({"rows": rows_of("bac")}, RowError, "sorted by path, each once; 'a' follows 'b'"),
        ({"rows": rows_of("abb")}, RowError, "each once; 'b'"),
        ({"rows": [*rows_of("ab"), Row("c", "c", "c", {"name": "\udcff"})]}, RowError, "row 'c' must be JSON"),
        ({"embeddings": unit(3, DIM) * np.float32(2)}, VectorError, "'a'.*got 2"),
        ({"arrays": {"partials": np.ones((2, 3))}}, RowError, "one entry for each of 3 rows; got 2"),
        ({"arrays": {"partials": np.array([1, np.inf, 1])}}, RowError, "row 'b' has NaN or infinity"),
        ({"kind": "octree"}, ParameterError, "octree"),
    ],
)
def test_bad_input_raises_a_clear_error_and_does_not_change_the_index(tmp_path, change, error, words):
    filled(tmp_path)
    content = {"rows": rows_of("abc"), "embeddings": unit(3, DIM), "arrays": None, "kind": "flat"} | change
    with pytest.raises(error, match=words):
        IndexStore(tmp_path).write(
            content["rows"], blocks(content["embeddings"], content["arrays"]), kind=content["kind"]
        )
    assert IndexStore(tmp_path).open().count == 20
    assert not list(tmp_path.glob("*.tmp-*"))


def test_old_generations_are_deleted_except_the_last_two(tmp_path):
    for count in range(1, 6):
        filled(tmp_path, count)
    assert sorted(path.name for path in tmp_path.glob("gen-*")) == ["gen-000003", "gen-000004", "gen-000005"]


def test_a_reader_can_use_its_generation_after_a_writer_makes_four_more(tmp_path):
    filled(tmp_path, arrays={"partials": np.ones((20, 2))})
    generation = IndexStore(tmp_path).open()
    for _ in range(4):
        filled(tmp_path, 5)
    assert not generation.folder.exists()
    assert list(generation.rows) == rows_of(names(20))
    assert generation.index.search(unit(1, DIM), 3)[1].tolist()[0][0] == 0
    assert generation.arrays["partials"].sum() == 40


def test_a_row_that_cannot_be_read_is_corrupt(tmp_path):
    folder = filled(tmp_path).folder
    text = (folder / "rows.jsonl").read_bytes()
    (folder / "rows.jsonl").write_bytes(text.replace(b'"object_id":"p00003"', b'"object_ID":"p00003"'))
    with pytest.raises(CorruptIndex, match="row 3 of the index cannot be read"):
        list(IndexStore(tmp_path).open(verify=False).rows)
