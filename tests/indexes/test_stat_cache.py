"""Stat records of files, rows that are copied without parsing, and self checks of changed rows."""

import hashlib
import os
import random

import numpy as np
import pytest

from indexes.errors import MismatchedIndex, RowError
from indexes.kinds.vector_index import VectorIndex
from indexes.store import stat_cache
from indexes.store.folder import IndexStore
from indexes.store.rows import KeyIndex, are_distinct, keys_of
from indexes.store.stat_cache import FILES, FOLDERS, FolderCache, StatRecords
from indexes.store.tables import Block
from tests.indexes.test_store import unit

OF = {"checkpoint": "abc"}


def rows(numbers):
    return [{"id": f"{n:03d}", "object_id": f"o{n // 3}", "digest": f"d{n}", "metadata": {}} for n in numbers]


@pytest.fixture
def store(tmp_path):
    """An index of 40 rows with an array."""
    opened = IndexStore(tmp_path / "index")
    opened.write(
        rows(range(40)), unit(40), {"partials": np.arange(80, dtype=np.float16).reshape(40, 2)}, fingerprint=OF
    )
    return opened


def test_a_file_is_identified_by_its_whole_stat(tmp_path):
    ids, digests = keys_of(["a", "b", "c"]), keys_of(["1", "2", "3"])
    statuses = np.arange(12, dtype=np.uint64).reshape(3, 4) + np.uint64(2**64 - 20)
    StatRecords(tmp_path).write(ids, digests, statuses)
    cache = StatRecords(tmp_path)
    np.testing.assert_array_equal(cache.digests(ids, statuses), digests)
    for column in range(4):
        other = statuses.copy()
        other[1, column] += np.uint64(1)
        assert (cache.digests(ids, other) == b"").tolist() == [False, True, False]
    assert cache.digests(keys_of(["d"]), statuses[:1]).tolist() == [b""]


@pytest.mark.parametrize("name", [FILES, FOLDERS])
@pytest.mark.parametrize("harm", ["cut", "flipped", "empty", "longer", "forged", "folder"])
def test_a_damaged_stat_cache_is_an_empty_one(tmp_path, name, harm, monkeypatch):
    monkeypatch.setattr(stat_cache.sys, "platform", "linux")
    StatRecords(tmp_path).write(keys_of(["a"]), keys_of(["1"]), np.ones((1, 4), np.uint64))
    folders, status = FolderCache(tmp_path), (1, 1, 1, os.makedev(8, 1))
    folders.note("cup/", status, ["1.jpg", "2.jpg"])
    folders.write()
    assert FolderCache(tmp_path).names("cup/", status) == ["1.jpg", "2.jpg"]
    path = tmp_path / name
    content = path.read_bytes()
    flipped = content[:9] + bytes([content[9] ^ 1]) + content[10:]
    forged = b"\xc1" + hashlib.sha256(b"\xc1").digest()
    harmed = {"cut": content[:-7], "flipped": flipped, "empty": b"", "longer": content + b"x", "forged": forged}
    path.unlink()
    path.mkdir() if harm == "folder" else path.write_bytes(harmed[harm])
    assert len(StatRecords(tmp_path).records) == (name != FILES)
    assert (FolderCache(tmp_path).names("cup/", status) is None) == (name == FOLDERS)


def test_keys_with_a_common_prefix_are_distinguished():
    keys = np.array([b"8 bytes." + end for end in (b"a", b"b", b"c", b"b")] + [b"other", b""], "S16")
    requested = np.array([b"8 bytes.b", b"8 bytes.c", b"8 bytes.d", b"other", b"", b"none"], "S16")
    assert KeyIndex(keys).find(requested).tolist() == [1, 2, -1, 4, 5, -1]
    assert KeyIndex(keys).find(np.tile(requested, 5)).tolist() == [1, 2, -1, 4, 5, -1] * 5


@pytest.mark.parametrize("seed", range(20))
def test_keys_are_found_after_insertions_and_removals(seed):
    draw = random.Random(seed)
    names = [f"{number:04d}" for number in range(draw.choice([1, 2, 50, 300]))]
    other = list(names)
    for _ in range(draw.choice([0, 1, 5, 100])):
        place = draw.randrange(len(other) + 1)
        other[place : place + draw.randrange(3)] = draw.sample(["new", "0001", "0299"], draw.randrange(2))
    place_of = {name: place for place, name in enumerate(names)}
    found = KeyIndex(keys_of(names)).find(keys_of(other))
    assert found.tolist() == [place_of.get(name, -1) for name in other]


def test_keys_with_a_common_prefix_are_distinct():
    keys = np.array([b"8 bytes.a", b"8 bytes.b", b"other"], "S16")
    assert are_distinct(keys)
    assert not are_distinct(keys[[0, 1, 2, 1]])


def test_copied_rows_equal_written_rows(store, tmp_path):
    parent = store.open()
    new = Block(rows([50]), unit(1, seed=5), {"partials": np.ones((1, 2), np.float16)})
    copied = store.write_blocks([range(5), new, range(9, 40)], fingerprint=OF, parent=parent)
    other = IndexStore(tmp_path / "other")
    other.write(rows(range(40)), unit(40), {"partials": parent.arrays["partials"]}, fingerprint=OF)
    written = other.write_blocks(
        [Block(rows(range(5))), new, Block(rows(range(9, 40)))], fingerprint=OF, parent=other.open()
    )
    assert copied.rows.text.tobytes() == written.rows.text.tobytes()
    np.testing.assert_array_equal(copied.rows.table, written.rows.table)
    np.testing.assert_array_equal(copied.arrays["partials"], written.arrays["partials"])
    np.testing.assert_array_equal(copied.embeddings, written.embeddings)
    assert copied.manifest.parent == parent.name


def test_rows_are_copied_only_from_a_parent_with_the_same_fingerprint(store):
    with pytest.raises(RowError, match="copying rows needs a parent"):
        store.write_blocks([range(3)], fingerprint=OF)
    with pytest.raises(MismatchedIndex, match="same fingerprint"):
        store.write_blocks([range(3)], fingerprint={"checkpoint": "other"}, parent=store.open())
    with pytest.raises(RowError, match="occurs twice"):
        store.write_blocks([range(3), range(2, 5)], fingerprint=OF, parent=store.open())


def test_rows_that_the_parent_checked_are_checked_by_a_sample(store, monkeypatch):
    searched = []
    search = VectorIndex.search
    monkeypatch.setattr(VectorIndex, "search", lambda self, q, *how: searched.append(len(q)) or search(self, q, *how))
    new = Block(rows([50, 51]), unit(2, seed=5), {"partials": np.ones((2, 2), np.float16)})
    store.write_blocks([range(40), new], fingerprint=OF, parent=store.open(), self_check=32)
    assert searched == [2 + 32 // 16]
    store.write_blocks([range(40)], fingerprint=OF, parent=store.open(), self_check=32, kind="hnsw")
    assert searched[-1] == 32  # another structure


def test_line_ends_are_compared_without_parsing(store):
    found = store.open().rows
    assert found.lines_end_with(b'"metadata": {}}').all()
    assert found.lines_end_with(b'"d7", "metadata": {}}').nonzero()[0].tolist() == [7]
    assert not found.lines_end_with(b"x" * 1000).any()
