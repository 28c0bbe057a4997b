"""What a build that was cut off leaves for the next one."""

import sqlite3

import numpy as np
import pytest

from indexes.errors import WriteFailed
from indexes.store.unfinished import NAME, UnfinishedBuild

LAYOUTS = {"embedding": (np.dtype(np.float32), (3,)), "error": (np.dtype(np.float32), ())}
OF = {"checkpoint": "abc"}


def opened(index, of=None, layouts=LAYOUTS):
    return UnfinishedBuild(index, of or OF, layouts)


def made(*numbers):
    return {
        "embedding": np.array([[number, 0, -number] for number in numbers], np.float32),
        "error": np.array(numbers, np.float32),
    }


def kept(index, *numbers):
    with opened(index) as unfinished:
        unfinished.add([f"digest {number}" for number in numbers], made(*numbers))


def found(index, *numbers, **how):
    with opened(index, **how) as unfinished:
        records = unfinished.find(f"digest {number}" for number in numbers)
    return {int(name.split()[1]): record["embedding"].tolist() for name, record in records.items()}


def test_what_was_kept_is_found_by_its_digest_and_nothing_else_is(tmp_path):
    kept(tmp_path, 1, 2)
    kept(tmp_path, 3)
    assert found(tmp_path, 1, 3, 4) == {1: [1, 0, -1], 3: [3, 0, -3]}
    with opened(tmp_path) as unfinished:
        assert unfinished.find(["digest 2"])["digest 2"]["error"] == 2


def test_nothing_is_written_before_something_is_kept(tmp_path):
    assert found(tmp_path / "index", 1) == {}
    assert not (tmp_path / "index").exists()


def test_another_model_or_another_layout_finds_nothing(tmp_path):
    kept(tmp_path, 1)
    wider = {**LAYOUTS, "embedding": (np.dtype(np.float32), (4,))}
    assert found(tmp_path, 1, of={"checkpoint": "abd"}) == {}
    assert found(tmp_path, 1, layouts=wider) == {}


@pytest.mark.parametrize("harm", ["cut", "flipped"])
def test_of_a_damaged_file_only_whole_records_are_found_and_the_build_goes_on(tmp_path, harm):
    kept(tmp_path, 1, 2, 3)
    path, rng = tmp_path / NAME, np.random.default_rng(0)
    whole, must = path.read_bytes(), {number: [number, 0, -number] for number in (1, 2, 3, 9)}
    places = {*rng.integers(len(whole), size=100).tolist(), *range(120), *range(len(whole) - 250, len(whole))}
    for place in places:
        flipped = bytes([whole[place] ^ 4]) + whole[place + 1 :]
        path.write_bytes(whole[:place] + (b"" if harm == "cut" else flipped))
        assert found(tmp_path, 1, 2, 3).items() <= must.items()
        kept(tmp_path, 9)
        assert 9 in found(tmp_path, 1, 2, 3, 9).keys() <= must.keys()
        path.with_name(f"{NAME}-journal").unlink(missing_ok=True)


def test_a_record_that_does_not_fit_its_checksum_is_not_there(tmp_path):
    kept(tmp_path, 1, 2)
    with sqlite3.connect(tmp_path / NAME) as connection:
        connection.execute("UPDATE records SET arrays = zeroblob(16) WHERE digest = 'digest 1'")
    assert found(tmp_path, 1, 2) == {2: [2, 0, -2]}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_kept(tmp_path, bad):
    with opened(tmp_path) as unfinished:
        unfinished.add(["digest 1", "digest 2"], made(1, bad))
    assert set(found(tmp_path, 1, 2)) == {1}


def test_clearing_takes_away_what_every_model_left(tmp_path):
    kept(tmp_path, 1)
    with opened(tmp_path, {"checkpoint": "other"}) as unfinished:
        unfinished.add(["digest 2"], made(2))
        unfinished.clear()
        unfinished.clear()
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_is_named(tmp_path):
    with opened(tmp_path) as unfinished:
        unfinished.add(["digest 1"], made(1))
        unfinished._connection.execute("PRAGMA max_page_count = 2")  # as a full disk
        with pytest.raises(WriteFailed, match=r"unfinished\.sqlite: the disk refused \(database or disk is full"):
            unfinished.add([f"digest {number}" for number in range(1000)], made(*range(1000)))
    (tmp_path / "file").touch()
    with opened(tmp_path / "file") as unfinished, pytest.raises(WriteFailed, match="the disk refused"):
        unfinished.add(["digest 1"], made(1))
