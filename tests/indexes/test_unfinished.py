"""Codes that an interrupted build stores for the next one."""

import sqlite3

import numpy as np
import pytest

from indexes.errors import WriteFailed
from indexes.store.unfinished import NAME, UnfinishedBuild

LAYOUTS = {"embedding": (np.dtype(np.float32), (3,)), "error": (np.dtype(np.float32), ())}
OF = {"checkpoint": "abc"}


def opened(index, of=None, layouts=LAYOUTS):
    return UnfinishedBuild(index, of or OF, layouts)


def arrays_of(*numbers):
    return {
        "embedding": np.array([[number, 0, -number] for number in numbers], np.float32),
        "error": np.array(numbers, np.float32),
    }


def store(index, *numbers):
    with opened(index) as unfinished:
        unfinished.add([f"digest {number}" for number in numbers], arrays_of(*numbers))


def found(index, *numbers, **how):
    with opened(index, **how) as unfinished:
        records = unfinished.find(f"digest {number}" for number in numbers)
    return {int(name.split()[1]): record["embedding"].tolist() for name, record in records.items()}


def test_stored_records_are_found_by_digest_and_no_others(tmp_path):
    store(tmp_path, 1, 2)
    store(tmp_path, 3)
    assert found(tmp_path, 1, 3, 4) == {1: [1, 0, -1], 3: [3, 0, -3]}
    with opened(tmp_path) as unfinished:
        assert unfinished.find(["digest 2"])["digest 2"]["error"] == 2


def test_no_file_is_written_before_the_first_record(tmp_path):
    assert found(tmp_path / "index", 1) == {}
    assert not (tmp_path / "index").exists()


def test_another_model_or_another_layout_finds_nothing(tmp_path):
    store(tmp_path, 1)
    wider = {**LAYOUTS, "embedding": (np.dtype(np.float32), (4,))}
    assert found(tmp_path, 1, of={"checkpoint": "abd"}) == {}
    assert found(tmp_path, 1, layouts=wider) == {}


@pytest.mark.parametrize("harm", ["cut", "flipped"])
def test_a_damaged_file_gives_only_intact_records_and_accepts_new_ones(tmp_path, harm):
    store(tmp_path, 1, 2, 3)
    path, rng = tmp_path / NAME, np.random.default_rng(0)
    whole, must = path.read_bytes(), {number: [number, 0, -number] for number in (1, 2, 3, 9)}
    places = {*rng.integers(len(whole), size=100).tolist(), *range(120), *range(len(whole) - 250, len(whole))}
    for place in places:
        flipped = bytes([whole[place] ^ 4]) + whole[place + 1 :]
        path.write_bytes(whole[:place] + (b"" if harm == "cut" else flipped))
        assert found(tmp_path, 1, 2, 3).items() <= must.items()
        store(tmp_path, 9)
        assert 9 in found(tmp_path, 1, 2, 3, 9).keys() <= must.keys()
        path.with_name(f"{NAME}-journal").unlink(missing_ok=True)


def test_a_record_with_a_wrong_checksum_is_not_found(tmp_path):
    store(tmp_path, 1, 2)
    with sqlite3.connect(tmp_path / NAME) as connection:
        connection.execute("UPDATE records SET arrays = zeroblob(16) WHERE digest = 'digest 1'")
    assert found(tmp_path, 1, 2) == {2: [2, 0, -2]}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_records_that_are_not_finite_are_not_stored(tmp_path, bad):
    with opened(tmp_path) as unfinished:
        unfinished.add(["digest 1", "digest 2"], arrays_of(1, bad))
    assert set(found(tmp_path, 1, 2)) == {1}


def test_clearing_deletes_the_records_of_all_models(tmp_path):
    store(tmp_path, 1)
    with opened(tmp_path, {"checkpoint": "other"}) as unfinished:
        unfinished.add(["digest 2"], arrays_of(2))
        unfinished.clear()
        unfinished.clear()
    assert list(tmp_path.iterdir()) == []


def test_a_failing_disk_raises_an_error_with_the_file(tmp_path):
    with opened(tmp_path) as unfinished:
        unfinished.add(["digest 1"], arrays_of(1))
        unfinished._connection.execute("PRAGMA max_page_count = 2")  # as a full disk
        with pytest.raises(WriteFailed, match=r"unfinished\.sqlite: writing failed \(database or disk is full"):
            unfinished.add([f"digest {number}" for number in range(1000)], arrays_of(*range(1000)))
    (tmp_path / "file").touch()
    with opened(tmp_path / "file") as unfinished, pytest.raises(WriteFailed, match="writing failed"):
        unfinished.add(["digest 1"], arrays_of(1))
