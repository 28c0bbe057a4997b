"""Unchanged files are not read again, and every change is detected."""

import os
import random
import time

import numpy as np
import pytest

from indexes.store.folder import IndexStore
from indexes.store.stat_cache import FILES, StatRecords
from retrieval.data.catalogue import list_catalogue, read_photo
from retrieval.search.build import embed, stat_cache
from retrieval.search.build.build_index import NO_STAT_CACHE, build_index
from retrieval.search.sharding.build_sharded import build_sharded
from tests.retrieval.search.test_build import first_photo, other_picture, rows_of

HOUR_NS = 3600 * 10**9


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


@pytest.fixture
def an_hour_later(monkeypatch):
    """Make all files an hour old for builds."""
    now = time.time_ns
    monkeypatch.setattr(stat_cache.time, "time_ns", lambda: now() + HOUR_NS)


@pytest.fixture
def read(monkeypatch):
    """Paths of the files that were read, unordered."""
    paths = []

    def noted(catalogue, photo):
        paths.append(photo.path)
        return read_photo(catalogue, photo)

    monkeypatch.setattr(embed, "read_photo", noted)
    return paths


def named(catalogue_copy, path):
    return path.relative_to(catalogue_copy).as_posix()


# What is read ----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("an_hour_later")
def test_an_unchanged_catalogue_is_not_read_again_without_verify(catalogue_copy, checkpoint, index, read):
    first = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (len(read), first.unread, "--verify" in "\n".join(first.lines())) == (24, 0, False)
    read.clear()
    again = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (read, again.unread, again.written) == ([], 24, False)
    assert any("24 photos were not read, because size, times and inode" in line for line in again.lines())
    assert build_index(catalogue_copy, checkpoint, index, verify=True, quiet=True).unread == 0
    assert len(read) == 24


@pytest.mark.usefixtures("an_hour_later")
def test_only_files_with_a_changed_stat_are_read(catalogue_copy, checkpoint, index, read):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    photos = sorted(catalogue_copy.rglob("*.jpg"))
    other_picture(photos[3])
    photos[7].touch()
    photos[9].chmod(0o600)  # changes a time, but not the content
    moved = photos[11].rename(photos[11].with_name("moved.jpg"))
    read.clear()
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert sorted(read) == sorted(named(catalogue_copy, path) for path in (photos[3], photos[7], photos[9], moved))
    assert (report.embedded, report.renamed, report.unread) == (1, 1, 20)
    read.clear()
    assert not build_index(catalogue_copy, checkpoint, index, quiet=True).written
    assert read == []


@pytest.mark.usefixtures("an_hour_later")
def test_a_new_image_with_the_same_size_and_mtime_is_detected_by_its_ctime(catalogue_copy, checkpoint, index):
    photo = first_photo(catalogue_copy)
    content = photo.read_bytes()
    photo.write_bytes(content + b"ab")
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    before = photo.stat()
    photo.write_bytes(content + b"cd")
    os.utime(photo, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (photo.stat().st_size, photo.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).embedded == 1


@pytest.mark.usefixtures("an_hour_later")
def test_another_model_or_another_index_reads_all_files(catalogue_copy, checkpoint, index, read, tmp_path):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert build_index(catalogue_copy, checkpoint, tmp_path / "other", quiet=True).unread == 0
    assert len(read) == 48


@pytest.mark.usefixtures("an_hour_later")
def test_shards_have_their_own_stat_caches(catalogue_copy, checkpoint, tmp_path, read):
    build_sharded(catalogue_copy, checkpoint, tmp_path / "cluster", 2, quiet=True)
    read.clear()
    other_picture(catalogue_copy / "newcomer" / "1.jpg")
    report = build_sharded(catalogue_copy, checkpoint, tmp_path / "cluster", 2, quiet=True)
    assert (read, report.unread, report.embedded) == (["newcomer/1.jpg"], 24, 1)
    assert build_sharded(catalogue_copy, checkpoint, tmp_path / "cluster", 2, verify=True, quiet=True).unread == 0


# Changes within one clock tick -----------------------------------------------------------------------------------


def written_within_a_tick(catalogue_copy, checkpoint, index, monkeypatch):
    """Build, change a photo within the same tick of the disk's clock, and build again."""
    photo, stat = first_photo(catalogue_copy), os.stat
    content = photo.read_bytes()
    photo.write_bytes(content + b"ab")
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    before = photo.stat()
    photo.write_bytes(content + b"cd")

    def frozen(path, **how):
        return before if path == named(catalogue_copy, photo) else stat(path, **how)

    monkeypatch.setattr(stat_cache.os, "stat", frozen)
    return build_index(catalogue_copy, checkpoint, index, quiet=True)


def test_a_photo_written_in_the_tick_of_its_reading_is_read_again(catalogue_copy, checkpoint, index, monkeypatch):
    for path in catalogue_copy.rglob("*.jpg"):
        path.touch()
    assert written_within_a_tick(catalogue_copy, checkpoint, index, monkeypatch).embedded == 1


def test_trusting_every_stat_would_miss_the_change(catalogue_copy, checkpoint, index, monkeypatch):
    monkeypatch.setattr(stat_cache, "MIN_AGE_NS", -HOUR_NS)
    assert written_within_a_tick(catalogue_copy, checkpoint, index, monkeypatch).embedded == 0


@pytest.mark.usefixtures("an_hour_later")
def test_times_before_1970_and_in_the_future_are_handled(catalogue_copy, checkpoint, index, read):
    old, new = sorted(catalogue_copy.rglob("*.jpg"))[:2]
    os.utime(old, ns=(-5 * 10**9, -5 * 10**9))
    os.utime(new, ns=(time.time_ns() + 5 * HOUR_NS,) * 2)
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    read.clear()
    assert not build_index(catalogue_copy, checkpoint, index, quiet=True).written
    assert read == [named(catalogue_copy, new)]


# Stat records ----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("an_hour_later")
def test_an_index_without_stat_records_is_read_completely_once_and_reported(catalogue_copy, checkpoint, index, read):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    (index / FILES).unlink()
    read.clear()
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (len(read), report.embedded, report.written) == (24, 0, False)
    assert report.reason.startswith(NO_STAT_CACHE)
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).unread == 24


def test_only_files_older_than_the_minimum_age_are_recorded(catalogue_copy, checkpoint, index):
    for path in catalogue_copy.rglob("*.jpg"):
        path.touch()
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert len(StatRecords(index).records) == 0


# Rows that are copied unchanged ----------------------------------------------------------------------------------


@pytest.mark.usefixtures("an_hour_later")
@pytest.mark.parametrize("seed", range(4))
def test_after_any_changes_the_index_equals_a_new_build(seed, catalogue_copy, checkpoint, index, tmp_path, monkeypatch):
    monkeypatch.setattr(stat_cache, "MIN_RUN", 2)
    draw = random.Random(seed)
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    for round_ in range(3):
        photos = sorted(catalogue_copy.rglob("*.jpg"))
        removed, changed, moved = draw.sample(photos, 3)
        removed.unlink()
        other_picture(changed, seed=100 + round_)
        moved.rename(draw.choice(photos).with_name(f"moved-{round_}.jpg"))
        other_picture(catalogue_copy / draw.choice(["aaa", "mmm", "zzz"]) / f"{round_}.jpg", seed=200 + round_)
        (catalogue_copy / "metadata.jsonl").write_text(
            f'{{"object_id": "{draw.choice(photos).parent.name}", "price": {round_}}}\n'
        )
        report = build_index(catalogue_copy, checkpoint, index, quiet=True)
        assert report.unread > 0
    build_index(catalogue_copy, checkpoint, tmp_path / "fresh", quiet=True)
    again, fresh = (IndexStore(path).open() for path in (index, tmp_path / "fresh"))
    assert [again.rows.line(n) for n in range(again.count)] == [fresh.rows.line(n) for n in range(fresh.count)]
    assert again.rows.find([row["id"] for row in fresh.rows]).tolist() == list(range(fresh.count))
    for name in ("id", "digest", "object_id"):
        np.testing.assert_array_equal(again.rows.keys(name), fresh.rows.keys(name))
    # In another batch the tower adds in another order: 1e-5 in float32, then one step of float16.
    np.testing.assert_allclose(again.arrays["partials"], fresh.arrays["partials"], rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(again.embeddings[again.slots], fresh.embeddings[fresh.slots], atol=1e-5)


@pytest.mark.usefixtures("an_hour_later")
def test_new_metadata_is_written_without_reading_photos(catalogue_copy, checkpoint, index, read, monkeypatch):
    monkeypatch.setattr(stat_cache, "MIN_RUN", 2)
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    name = first_photo(catalogue_copy).parent.name
    read.clear()
    for words in ('"price": 1', '"price": 2', '"price": 2, "metadata": {}', '"metadata": {}'):
        (catalogue_copy / "metadata.jsonl").write_text(f'{{"object_id": "{name}", {words}}}\n')
        assert build_index(catalogue_copy, checkpoint, index, quiet=True).written
        documents = [repr(row["metadata"]) for row in rows_of(index).values() if row["object_id"] == name]
        assert len(set(documents)) == 1
    (catalogue_copy / "metadata.jsonl").unlink()
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).written
    assert all(row["metadata"] == {} for row in rows_of(index).values())
    assert read == []


@pytest.mark.usefixtures("an_hour_later")
def test_a_run_ends_where_rows_are_not_consecutive(catalogue_copy, checkpoint, index, monkeypatch):
    monkeypatch.setattr(stat_cache, "MIN_RUN", 5)
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    photos = sorted(catalogue_copy.rglob("*.jpg"))
    photos[10].unlink()
    other_picture(photos[20])
    catalogue, parent = list_catalogue(catalogue_copy), IndexStore(index).open()
    known = stat_cache.StatCache(catalogue, index).known(parent)
    assert known.tolist() == [*range(10), *range(11, 20), -1, 21, 22, 23]
    assert list(stat_cache.unchanged_runs(catalogue.photos, known, parent)) == [slice(0, 10), slice(10, 19)]
    assert list(stat_cache.unchanged_runs(catalogue.photos, known, None)) == []


@pytest.mark.usefixtures("an_hour_later")
def test_a_new_first_photo_does_not_end_a_run(catalogue_copy, checkpoint, index, monkeypatch):
    monkeypatch.setattr(stat_cache, "MIN_RUN", 5)
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    other_picture(catalogue_copy / "aaa" / "0.jpg")
    catalogue, parent = list_catalogue(catalogue_copy), IndexStore(index).open()
    known = stat_cache.StatCache(catalogue, index).known(parent)
    assert known.tolist() == [-1, *range(24)]
    assert list(stat_cache.unchanged_runs(catalogue.photos, known, parent)) == [slice(1, 25)]
