"""Unchanged folders are not listed again; added, removed and renamed files are still found."""

import os
import random
import sys
import time

import pytest

from indexes.store import stat_cache
from indexes.store.stat_cache import FOLDERS, FolderCache
from retrieval.data import folder_walk
from retrieval.data.folder_walk import FolderWalk
from retrieval.search.build.build_index import build_index

HOUR_NS = 3600 * 10**9


@pytest.fixture
def old_folders(monkeypatch):
    """No folder has changed for an hour, and all are on a disk."""
    now = time.time_ns
    monkeypatch.setattr(stat_cache.time, "time_ns", lambda: now() + HOUR_NS)
    monkeypatch.setattr(stat_cache.os, "major", lambda device: 8)
    monkeypatch.setattr(stat_cache.sys, "platform", "linux")


@pytest.fixture
def listed(monkeypatch):
    """Names of the folders that walks list, in order."""
    folders, scandir = [], os.scandir

    def record(folder):
        if sys._getframe(1).f_globals is vars(folder_walk):
            folders.append(os.path.basename(folder))
        return scandir(folder)

    monkeypatch.setattr(folder_walk.os, "scandir", record)
    return folders


@pytest.fixture
def shelf(tmp_path):
    """Three objects, one with photos in subfolders."""
    for name in ("cup/1.jpg", "cup/2.jpg", "mug/1.jpg", "pan/side/1.jpg", "pan/top/1.jpg"):
        path = tmp_path / "catalogue" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a photo")
    (tmp_path / "index").mkdir()
    return tmp_path / "catalogue"


def walked(folder, folder_cache=None):
    walk = FolderWalk(folder, folder_cache)
    walk.walk(str(folder), "")
    return walk.names, [item.path for item in walk.skipped]


def again(folder, known=True):
    """Return the files of a listing with the cache of earlier ones; they must equal those of a listing without."""
    time.sleep(0.02)  # more than a tick of the clock of folder times
    folder_cache = FolderCache(folder.parent / "index", known)
    found = walked(folder, folder_cache)
    folder_cache.write()
    assert found == walked(folder)
    return found[0]


@pytest.mark.usefixtures("old_folders")
def test_only_folders_with_subfolders_and_changed_folders_are_listed_again(shelf, listed):
    assert len(again(shelf)) == 5
    for change, expected in (
        (lambda: None, ["catalogue", "pan"]),
        (lambda: (shelf / "cup" / "3.jpg").write_text("new"), ["catalogue", "cup", "pan"]),
        (lambda: (shelf / "mug" / "1.jpg").unlink(), ["catalogue", "mug", "pan"]),
        (lambda: (shelf / "pan" / "top" / "1.jpg").rename(shelf / "cup" / "0.jpg"), ["cup", "top"]),
        (lambda: (shelf / "cup").rename(shelf / "bowl"), ["bowl"]),
        (lambda: (shelf / "mug" / "lid").mkdir(), ["mug", "lid"]),
        (lambda: (shelf / "mug").chmod(0o700), ["mug"]),
    ):
        change()
        listed.clear()
        again(shelf)
        first = listed[: listed.index("catalogue", 1)]  # the second, complete listing is for the comparison
        assert set(expected) | {"catalogue", "pan"} == set(first) - ({"lid"} if "lid" not in expected else set())


@pytest.mark.usefixtures("old_folders")
def test_every_folder_is_listed_if_the_cache_is_not_trusted_and_the_cache_is_rewritten(shelf, listed):
    again(shelf)
    listed.clear()
    again(shelf, known=False)
    assert sorted(listed[: len(listed) // 2]) == ["catalogue", "cup", "mug", "pan", "side", "top"]
    listed.clear()
    again(shelf)
    assert listed[:3] == ["catalogue", "pan", "catalogue"]


@pytest.mark.usefixtures("old_folders")
def test_folders_with_links_or_names_that_are_not_utf8_are_listed_every_time(shelf, tmp_path):
    target = tmp_path / "elsewhere"
    target.write_text("a file")
    (shelf / "cup" / "link").symlink_to(target)
    assert "cup/link" in again(shelf)
    target.unlink()
    target.mkdir()
    (target / "9.jpg").write_text("a photo")
    assert "cup/link/9.jpg" in again(shelf)  # although the folder of the link did not change
    try:
        os.mkdir(os.fsencode(shelf) + b"/odd")
        os.close(os.open(os.fsencode(shelf) + b"/odd/\xff.jpg", os.O_CREAT))
    except OSError:
        pytest.skip("this disk takes no such names")
    for _ in range(2):
        again(shelf)
    assert walked(shelf, FolderCache(tmp_path / "index"))[1] == ["odd/\\xff.jpg"]


@pytest.mark.usefixtures("old_folders")
@pytest.mark.parametrize("seed", range(6))
def test_a_cached_listing_equals_a_full_listing_after_any_change(shelf, seed):
    draw = random.Random(seed)
    for _ in range(8):
        for _ in range(draw.randrange(3)):
            files = [path for path in shelf.rglob("*") if not path.is_dir()]
            folders = [path for path in shelf.rglob("*") if path.is_dir() and not path.is_symlink()]
            place, name = draw.choice([shelf, *folders]), f"{draw.randrange(10**6)}.jpg"
            what = draw.choice(["file", "folder", "gone", "moved", "swapped", "hidden", "link"])
            if what == "folder":
                (place / name).mkdir()
            elif what == "link":
                (place / name).symlink_to(draw.choice([*files, *folders]))
            elif what in ("file", "hidden"):
                (place / ("." * (what == "hidden") + name)).write_text("a photo")
            elif files:
                path = draw.choice(files)
                path.rename(place / name) if what == "moved" else path.unlink()
                if what == "swapped":
                    path.mkdir()
        again(shelf)


def test_a_folder_that_changed_recently_or_is_not_on_a_disk_is_not_cached(shelf, monkeypatch):
    folder_cache = FolderCache(shelf.parent / "index")
    walked(shelf, folder_cache)
    folder_cache.write()
    assert not (shelf.parent / "index" / FOLDERS).exists()
    now = time.time_ns
    monkeypatch.setattr(stat_cache.time, "time_ns", lambda: now() + HOUR_NS)
    monkeypatch.setattr(stat_cache.os, "major", lambda device: 0)
    again(shelf)
    assert not (shelf.parent / "index" / FOLDERS).exists()


@pytest.mark.usefixtures("old_folders")
def test_a_build_finds_photos_that_were_added_to_or_removed_from_a_folder(catalogue_copy, checkpoint, tmp_path, listed):
    build_index(catalogue_copy, checkpoint, tmp_path / "index", quiet=True)
    assert (tmp_path / "index" / FOLDERS).is_file()
    first, second = sorted(path for path in catalogue_copy.iterdir() if path.is_dir())[:2]
    photo = sorted(first.iterdir())[0]
    photo.rename(second / "moved.jpg")
    time.sleep(0.02)
    listed.clear()
    report = build_index(catalogue_copy, checkpoint, tmp_path / "index", quiet=True)
    assert (report.photos, report.renamed, report.removed) == (24, 1, 1)
    assert set(listed) - {catalogue_copy.name} == {first.name, second.name}
