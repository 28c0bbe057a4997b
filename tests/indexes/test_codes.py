"""The cache of codes: found by model and content, complete or missing, and digests of unchanged files."""

import numpy as np
import pytest

from indexes.errors import WriteFailed
from indexes.store.codes import CodeCache, FileStatus

CODES = {f"digest {number}": bytes([number]) * 5000 for number in range(20)}


def test_codes_are_found_by_model_and_digest(tmp_path):
    with CodeCache(tmp_path) as cache:
        cache.add("a", CODES)
        cache.add("b", {"digest 1": b"other"})
    with CodeCache(tmp_path) as cache:
        assert cache.known("a") == CODES.keys()
        assert cache.known("b") == {"digest 1"}
        assert cache.known("c") == set()
        assert cache.read("a", ["digest 3", "digest 1"]) == [CODES["digest 3"], CODES["digest 1"]]
        assert cache.read("b", ["digest 1"]) == [b"other"]


def test_only_files_with_the_same_size_and_time_are_unchanged(tmp_path):
    status = {f"{name}.jpg": FileStatus(10 + number, 10**18 + number) for number, name in enumerate("aäbz")}
    with CodeCache(tmp_path) as cache:
        cache.note_files((path, one, f"digest of {path}") for path, one in status.items())
    with CodeCache(tmp_path) as cache:
        assert cache.unchanged(status) == {path: f"digest of {path}" for path in status}
        other = {
            "a.jpg": FileStatus(10, 1),
            "b.jpg": FileStatus(9, status["b.jpg"].mtime_ns),
            "c.jpg": FileStatus(1, 1),
        }
        assert cache.unchanged(status | other) == {path: f"digest of {path}" for path in ("z.jpg", "ä.jpg")}
        assert cache.unchanged({}) == {}


def test_what_is_not_kept_is_deleted_and_gives_its_room_back(tmp_path):
    with CodeCache(tmp_path) as cache:
        cache.add("a", CODES)
        cache.add("b", CODES)
        cache.note_files((path, FileStatus(1, 1), "digest") for path in "xyz")
        before = cache.path.stat().st_size
        cache.keep(["a"], ["digest 1", "digest 2", "no digest"], ["x"])
        assert cache.known("a") == {"digest 1", "digest 2"}
        assert cache.known("b") == set()
        assert cache.unchanged(dict.fromkeys("xyz", FileStatus(1, 1))) == {"x": "digest"}
        assert cache.path.stat().st_size < before / 2


@pytest.mark.parametrize("content", [b"", b"not a database", b"SQLite format 3\0" + bytes(5000)])
def test_a_file_that_is_no_cache_is_replaced(tmp_path, content):
    (tmp_path / "codes").mkdir()
    (tmp_path / "codes" / "cache.sqlite").write_bytes(content)
    with CodeCache(tmp_path) as cache:
        assert cache.known("a") == set()
        cache.add("a", CODES)
        assert cache.known("a") == CODES.keys()


def test_a_flipped_bit_gives_no_wrong_code(tmp_path):
    """Each read gives the code that was stored, or one error; after it the next build encodes the photo again."""
    with CodeCache(tmp_path) as cache:
        cache.add("a", CODES)
        path = cache.path
    whole, rng, errors = path.read_bytes(), np.random.default_rng(0), 0
    for place in rng.integers(100, len(whole), size=60).tolist():
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        try:
            with CodeCache(tmp_path) as cache:
                for digest in sorted(cache.known("a") & CODES.keys()):
                    assert cache.read("a", [digest]) == [CODES[digest]]
        except WriteFailed:
            errors += 1
    assert errors


def test_a_damaged_code_is_deleted_so_the_next_build_makes_it_again(tmp_path):
    with CodeCache(tmp_path) as cache:
        cache.add("a", CODES)
        path = cache.path
    path.write_bytes(path.read_bytes().replace(CODES["digest 7"][:100], bytes(100)))
    with CodeCache(tmp_path) as cache:
        with pytest.raises(WriteFailed, match="damaged and is deleted; build again"):
            cache.read("a", CODES)
        assert cache.known("a") == CODES.keys() - {"digest 7"}


def test_a_cache_that_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "codes").write_text("a file in place of the folder")
    with pytest.raises(WriteFailed, match="cannot be opened"):
        CodeCache(tmp_path)
