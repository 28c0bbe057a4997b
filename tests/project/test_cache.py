"""The cache of results: found by the digest of all inputs, complete or missing, and cleaned up."""

import subprocess
import sys

import numpy as np
import pytest

from _touch_retrieval.cache import Cache, cache_key

ENTRIES = {cache_key("a", number): bytes([number]) * 5000 for number in range(20)}
KEYS = list(ENTRIES)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "folder" / "cache.sqlite"


@pytest.fixture
def filled(path):
    with Cache(path) as cache:
        cache.add(ENTRIES)
    return path


def test_what_is_not_kept_is_deleted_and_gives_its_room_back(filled):
    before = filled.stat().st_size
    with Cache(filled) as cache:
        cache.keep([KEYS[1], KEYS[2], KEYS[1], "a/none"])
        assert cache.keys("a") == {KEYS[1], KEYS[2]}
    assert filled.stat().st_size < before / 2


def test_a_killed_process_leaves_what_it_had_added(path):
    code = (
        "import os, pathlib, sys; from _touch_retrieval.cache import Cache\n"
        "cache = Cache(pathlib.Path(sys.argv[1]))\n"
        "for name in ('x/1', 'x/2'): cache.add({name: name.encode()})\n"
        "os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(path)], timeout=60, check=False).returncode == -9
    with Cache(path) as cache:
        assert [cache.get("x/1"), cache.get("x/2")] == [b"x/1", b"x/2"]


@pytest.mark.parametrize("content", [b"not a database", b"SQLite format 3\0" + bytes(5000)])
def test_a_file_that_is_no_cache_is_replaced(path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    with Cache(path) as cache:
        assert cache.keys("a") == set()
        cache.add(ENTRIES)
        assert cache.keys("a") == set(KEYS)


def test_a_flipped_bit_gives_no_wrong_entry(filled):
    """Each entry is the one that was stored, missing, or one error that says what to delete."""
    whole, rng, lost, errors = filled.read_bytes(), np.random.default_rng(0), 0, []
    for place in rng.integers(100, len(whole), size=30).tolist():
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        filled.write_bytes(bytes(damaged))
        try:
            with Cache(filled) as cache:
                for key in cache.keys("a") & ENTRIES.keys():
                    content = cache.get(key)
                    assert content in (None, ENTRIES[key])
                    lost += content is None
                    assert (key in cache.keys("a")) == (content is not None)
        except OSError as error:
            errors.append(error.strerror)
    assert lost
    assert all("delete this file" in error for error in errors)


def test_a_cache_that_cannot_be_written_is_an_error_that_names_it(path):
    path.mkdir(parents=True)
    with pytest.raises(OSError, match="cannot be read or written") as caught:
        Cache(path)
    assert caught.value.filename == str(path)
