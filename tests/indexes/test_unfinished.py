"""What a build that was cut off leaves for the next one."""

import errno

import numpy as np
import pytest

from indexes.errors import WriteFailed
from indexes.store.unfinished import FOLDER, Unfinished

LAYOUTS = {"embedding": (np.dtype(np.float32), (3,)), "error": (np.dtype(np.float32), ())}
OF = {"checkpoint": "abc"}


def opened(index, of=None, layouts=LAYOUTS):
    return Unfinished(index, of or OF, layouts)


def made(*numbers):
    return {
        "embedding": np.array([[number, 0, -number] for number in numbers], np.float32),
        "error": np.array(numbers, np.float32),
    }


def kept(index, *numbers):
    with opened(index) as unfinished:
        unfinished.keep([f"digest {number}" for number in numbers], made(*numbers))


def found(index, *numbers, **how):
    with opened(index, **how) as unfinished:
        records = unfinished.find(f"digest {number}" for number in numbers)
    return {int(name.split()[1]): record["embedding"].tolist() for name, record in records.items()}


def records_file(index):
    return next((index / FOLDER).iterdir())


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


def test_a_file_cut_at_any_length_gives_its_whole_records_and_goes_on(tmp_path):
    kept(tmp_path, 1, 2, 3)
    path = records_file(tmp_path)
    whole, size = path.read_bytes(), path.stat().st_size // 3
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        assert set(found(tmp_path, 1, 2, 3)) == set(range(1, 1 + length // size))
        kept(tmp_path, 9)
        assert set(found(tmp_path, 1, 2, 3, 9)) == {*range(1, 1 + length // size), 9}


def test_a_record_with_any_bit_flipped_is_not_there(tmp_path):
    kept(tmp_path, 1, 2)
    path = records_file(tmp_path)
    whole = path.read_bytes()
    for place in range(len(whole) // 2):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        assert found(tmp_path, 1, 2) == {2: [2, 0, -2]}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_kept(tmp_path, bad):
    with opened(tmp_path) as unfinished:
        unfinished.keep(["digest 1", "digest 2"], made(1, bad))
    assert set(found(tmp_path, 1, 2)) == {1}


def test_clearing_takes_away_what_every_model_left(tmp_path):
    kept(tmp_path, 1)
    with opened(tmp_path, {"checkpoint": "other"}) as unfinished:
        unfinished.keep(["digest 2"], made(2))
        unfinished.clear()
        unfinished.clear()
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_is_named(tmp_path, monkeypatch):
    with opened(tmp_path) as unfinished:
        unfinished.keep(["digest 1"], made(1))

        class Full:
            def write(self, content):
                raise OSError(errno.ENOSPC, "No space left on device")

            def close(self):
                pass

        unfinished._handle.close()
        unfinished._handle = Full()
        with pytest.raises(WriteFailed, match=r"unfinished/.*\.records: the disk refused \(No space left"):
            unfinished.keep(["digest 2"], made(2))
        monkeypatch.setattr(Full, "write", lambda self, content: len(content) - 1)
        with pytest.raises(WriteFailed, match="the disk is full"):
            unfinished.keep(["digest 2"], made(2))
