"""Building an index of a folder of photos: embedding, reuse of codes, skipped files and the report."""

import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from _touch_retrieval.cache import Cache
from indexes.errors import LockedIndex, ParameterError, VectorError, WriteFailed
from indexes.store.folder import IndexStore
from retrieval.commands.main import main
from retrieval.data import preprocessing
from retrieval.data.catalogue import list_catalogue
from retrieval.errors import DatasetError, NumericalError
from retrieval.frontier.formats import STORED
from retrieval.indexing import codes
from retrieval.indexing.build import CACHE, build_index
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.encode import encode_photos
from retrieval.search.searcher import Searcher
from tests import synthetic

HOUR_NS = 3600 * 10**9
PROVENANCE = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


@pytest.fixture
def read(monkeypatch):
    """Paths of the files that were read, unordered."""
    paths, read_bytes = [], codes.read_bytes
    monkeypatch.setattr(codes, "read_bytes", lambda path: paths.append(path) or read_bytes(path))
    return paths


@pytest.fixture
def old_files(catalogue_copy):
    """The photos of the catalogue, which changed an hour ago."""
    photos = sorted(catalogue_copy.rglob("*.jpg"))
    for path in photos:
        os.utime(path, ns=(time.time_ns() - HOUR_NS,) * 2)
    return photos


def first_photo(catalogue_copy):
    return sorted(catalogue_copy.rglob("*.jpg"))[0]


def named(catalogue_copy, path):
    return path.relative_to(catalogue_copy).as_posix()


def other_picture(path, seed=77):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(synthetic._jpeg(synthetic.draw_photo(synthetic.make_object(seed), 1)))


def rows_of(index):
    return {row.path: row for row in IndexStore(index).open().rows}


def changed_model(checkpoint, path, by=0.5):
    """A checkpoint with other weights."""
    with torch.no_grad():
        checkpoint.matcher.head.out.bias += by
    store_checkpoint(Checkpoint(path, "", checkpoint.config, PROVENANCE, matcher=checkpoint.matcher), path)
    return load_checkpoint(path)


def check_same(one, other):
    """Check that two indexes have equal rows and codes, up to the order of sums in other batches."""
    one, other = IndexStore(one).open(), IndexStore(other).open()
    assert list(one.rows) == list(other.rows)
    np.testing.assert_array_equal(one.rows.objects, other.rows.objects)
    np.testing.assert_array_equal(one.rows.originals, other.rows.originals)
    # In another batch the tower adds in another order: 1e-5 in float32, then one step of float16.
    np.testing.assert_allclose(one.arrays["partials"], other.arrays["partials"], rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(one.embeddings, other.embeddings, atol=1e-5)


def test_a_first_build_embeds_every_photo_once_in_batches(catalogue_copy, checkpoint, index, embedded):
    report = build_index(catalogue_copy, checkpoint, index)
    assert sorted(embedded) == [8, 16]
    assert (report.photos, report.objects, report.embedded) == (24, 8, 24)
    assert report.skipped == []
    rows = IndexStore(index).open().rows
    assert [row.path for row in rows] == [photo.path for photo in list_catalogue(catalogue_copy).photos]


def test_a_rebuild_without_changes_writes_nothing_and_reports_it(catalogue_copy, checkpoint, index, embedded):
    assert build_index(catalogue_copy, checkpoint, index).written
    embedded.clear()
    (catalogue_copy / "note.txt").write_text("not a photo")
    (catalogue_copy / "broken.png").write_bytes(b"not a photo either")
    before = {path: path.stat().st_mtime_ns for path in index.glob("gen-*/*")}
    report = build_index(catalogue_copy, checkpoint, index)
    assert (embedded, report.embedded, report.generation) == ([], 0, "gen-000001")
    assert not report.written
    assert {path: path.stat().st_mtime_ns for path in index.glob("gen-*/*")} == before
    assert "nothing changed: the index stays as it is" in list(report.lines())
    assert (report.ignored, [item.path for item in report.skipped]) == (["note.txt"], ["broken.png"])


def test_another_kind_a_moved_catalogue_and_metadata_are_written_without_embedding(
    catalogue_copy, checkpoint, index, embedded
):
    build_index(catalogue_copy, checkpoint, index)
    embedded.clear()
    kind = "HNSW8;efSearch=32"
    assert build_index(catalogue_copy, checkpoint, index, kind=kind).written
    assert not build_index(catalogue_copy, checkpoint, index, kind=kind).written
    moved = catalogue_copy.rename(catalogue_copy.with_name("elsewhere"))
    assert build_index(moved, checkpoint, index, kind=kind).written
    assert Searcher.open(index).catalogue == moved
    name = first_photo(moved).parent.name
    (moved / "metadata.jsonl").write_text(json.dumps({"object_id": name, "price": 3}) + "\n")
    assert build_index(moved, checkpoint, index, kind=kind).written
    assert {row.object_id for row in rows_of(index).values() if row.metadata == {"price": 3}} == {name}
    assert embedded == []


@pytest.mark.parametrize("seed", range(2))
def test_after_any_changes_only_new_contents_are_embedded_and_the_index_equals_a_new_build(
    seed, catalogue_copy, checkpoint, index, tmp_path, embedded, old_files
):
    draw = random.Random(seed)
    build_index(catalogue_copy, checkpoint, index)
    for round_ in range(2):
        embedded.clear()
        photos = sorted(catalogue_copy.rglob("*.jpg"))
        removed, changed, moved = draw.sample(photos, 3)
        removed.unlink()
        other_picture(changed, seed=100 + round_)
        moved.rename(draw.choice(photos).with_name(f"moved-{round_}.jpg"))
        other_picture(catalogue_copy / draw.choice(["aaa", "mmm", "zzz"]) / f"{round_}.jpg", seed=200 + round_)
        report = build_index(catalogue_copy, checkpoint, index)
        assert (sum(embedded), report.embedded) == (2, 2)
        assert "2 embedded, 22 unchanged" in next(report.lines())
    build_index(catalogue_copy, checkpoint, tmp_path / "fresh")
    check_same(index, tmp_path / "fresh")


def test_photos_that_were_removed_or_damaged_are_dropped_and_listed(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index)
    photos = sorted(catalogue_copy.rglob("*.jpg"))
    photos[0].unlink()
    broken = {photos[1]: photos[1].read_bytes()[:500], photos[7]: b"", photos[8]: b"this is not an image"}
    for path, content in broken.items():
        path.write_bytes(content)
    shutil.rmtree(photos[-1].parent)
    report = build_index(catalogue_copy, checkpoint, index)
    assert (report.photos, report.objects, report.embedded) == (17, 7, 0)
    assert [item.path for item in report.skipped] == [named(catalogue_copy, path) for path in broken]
    assert all(item.reason for item in report.skipped)
    assert any("picture(s) left out: " in line for line in report.lines())
    assert set(rows_of(index)) == {named(catalogue_copy, path) for path in photos[:-3]} - {
        named(catalogue_copy, path) for path in (photos[0], *broken)
    }


def test_the_same_image_of_two_objects_is_embedded_once(catalogue_copy, checkpoint, index, embedded):
    original_photo = first_photo(catalogue_copy)
    folder = catalogue_copy / f"{original_photo.parent.name}-twin"
    folder.mkdir()
    shutil.copy(original_photo, folder / "1.jpg")
    assert build_index(catalogue_copy, checkpoint, index).photos == 25
    assert sum(embedded) == 24
    generation = IndexStore(index).open()
    twin, original = (generation.rows.find(named(catalogue_copy, path)) for path in (folder / "1.jpg", original_photo))
    assert generation.rows.originals[[twin, original]].tolist() == [min(twin, original)] * 2
    np.testing.assert_array_equal(generation.embeddings[twin], generation.embeddings[original])


def test_a_changed_model_embeds_everything_and_the_codes_of_two_generations_stay(
    catalogue_copy, checkpoint, index, embedded, tmp_path
):
    build_index(catalogue_copy, checkpoint, index)
    embedded.clear()
    report = build_index(catalogue_copy, changed_model(checkpoint, tmp_path / "b.safetensors"), index)
    assert (sum(embedded), report.embedded) == (24, 24)
    assert report.reason.startswith("The model changed")
    first = load_checkpoint(checkpoint.path)
    assert build_index(catalogue_copy, first, index).embedded == 0
    build_index(catalogue_copy, changed_model(first, tmp_path / "c.safetensors", by=1.0), index)
    build_index(catalogue_copy, load_checkpoint(checkpoint.path), index)
    # "c" and the first model made the last two generations
    assert build_index(catalogue_copy, load_checkpoint(tmp_path / "b.safetensors"), index).embedded == 24


def test_a_changed_preprocessing_embeds_all_photos_again(catalogue_copy, checkpoint, index, monkeypatch):
    build_index(catalogue_copy, checkpoint, index)
    monkeypatch.setattr(preprocessing, "PREPROCESSING_VERSION", preprocessing.PREPROCESSING_VERSION + 1)
    report = build_index(catalogue_copy, checkpoint, index)
    assert report.embedded == 24
    assert report.reason.startswith("The preprocessing of photos changed")


def test_a_damaged_index_is_written_anew_from_the_codes(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index)
    partials = index / "gen-000001" / "partials.npy"
    partials.write_bytes(partials.read_bytes()[:-1])
    report = build_index(catalogue_copy, checkpoint, index)
    assert (report.embedded, report.written) == (0, True)
    assert "is not usable" in report.reason
    assert Searcher.open(index).generation.count == 24


def test_only_files_with_another_size_or_time_are_read(catalogue_copy, checkpoint, index, read, old_files):
    first = build_index(catalogue_copy, checkpoint, index)
    assert (len(read), first.written) == (24, True)
    read.clear()
    again = build_index(catalogue_copy, checkpoint, index)
    assert (read, again.written) == ([], False)
    other_picture(old_files[3])
    old_files[7].touch()
    moved = old_files[11].rename(old_files[11].with_name("moved.jpg"))
    read.clear()
    report = build_index(catalogue_copy, checkpoint, index)
    assert sorted(read) == sorted([old_files[3], old_files[7], moved])
    assert report.embedded == 1


@pytest.mark.parametrize(("min_age_ns", "found"), [(codes.MIN_AGE_NS, 1), (-HOUR_NS, 0)])
def test_a_photo_written_in_the_tick_of_its_reading_is_read_again(
    catalogue_copy, checkpoint, index, monkeypatch, min_age_ns, found
):
    """Without the minimum age, the change would be missed: neither size nor time differs."""
    monkeypatch.setattr(codes, "MIN_AGE_NS", min_age_ns)
    photo = first_photo(catalogue_copy)
    content, tick = photo.read_bytes(), time.time_ns()
    for number, ending in enumerate((b"ab", b"cd")):
        photo.write_bytes(content + ending)
        os.utime(photo, ns=(tick, tick))
        report = build_index(catalogue_copy, checkpoint, index)
        assert report.embedded == (found if number else 24)


def test_without_the_cache_everything_is_read_and_embedded_again(catalogue_copy, checkpoint, index, read, old_files):
    build_index(catalogue_copy, checkpoint, index)
    (index / "codes" / "cache.sqlite").write_bytes(b"damaged")
    read.clear()
    report = build_index(catalogue_copy, checkpoint, index)
    assert (len(read), report.embedded, report.written) == (24, 24, False)


def test_a_damaged_code_fails_the_build_and_the_next_one_makes_it_again(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index)
    with sqlite3.connect(index / CACHE) as connection:
        connection.execute("UPDATE entries SET checksum = checksum + 1 WHERE key NOT LIKE 'files/%'")
    with pytest.raises(WriteFailed, match="build again"):
        build_index(catalogue_copy, checkpoint, index, kind="HNSW8")
    assert IndexStore(index).current() == "gen-000001"
    assert build_index(catalogue_copy, checkpoint, index, kind="HNSW8").embedded == 24


KILLED = """
import os, signal, sys, torch
from pathlib import Path
from retrieval.indexing import codes
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint

catalogue, model, index, fatal = sys.argv[1:]
torch.set_num_threads(1)
codes.BATCH, make, calls = 4, codes.torch_photo_encoder, []

def counting(matcher):
    encode = make(matcher)
    def counted(images):
        calls.append(1)
        if len(calls) == int(fatal):
            os.kill(os.getpid(), signal.SIGKILL)
        return encode(images)
    return counted

codes.torch_photo_encoder = counting
build_index(Path(catalogue), load_checkpoint(Path(model)), Path(index))
"""


def killed(catalogue, model, index, call):
    """Build in a process that is killed when it encodes batch number `call` of four photos."""
    arguments = [sys.executable, "-c", KILLED, *map(str, (catalogue, model, index, call))]
    done = subprocess.run(arguments, capture_output=True, timeout=300, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr


def test_killed_builds_leave_the_old_index_and_continue_even_if_photos_are_renamed_between_them(
    catalogue_copy, model, tmp_path, embedded
):
    index, checkpoint = tmp_path / "index", load_checkpoint(model)
    build_index(catalogue_copy, checkpoint, index)
    embedded.clear()
    for path in catalogue_copy.rglob("*.jpg"):
        path.write_bytes(path.read_bytes() + b"other content, the same image")
    before = rows_of(index)
    killed(catalogue_copy, model, index, 3)
    assert rows_of(index) == before
    for number, photo in enumerate(sorted(catalogue_copy.rglob("*.jpg"))):
        photo.rename(photo.with_name(f"again{number}.jpg"))
    killed(catalogue_copy, model, index, 3)
    report = build_index(catalogue_copy, checkpoint, index)
    assert 24 - 16 <= sum(embedded) <= 24 - 8  # at most the batch that is being stored is lost
    assert report.embedded == sum(embedded)
    assert list(index.glob("*.tmp-*")) == []
    build_index(catalogue_copy, checkpoint, tmp_path / "whole")
    check_same(index, tmp_path / "whole")


def test_ctrl_c_keeps_the_finished_embeddings_and_reports_it(
    catalogue_copy, model, tmp_path, embedded, monkeypatch, capsys
):
    index, keep = tmp_path / "index", Cache.add

    def interrupted(self, *arguments):
        keep(self, *arguments)
        os.kill(os.getpid(), signal.SIGINT)

    command = ["build-index", str(catalogue_copy), "--model", str(model), "--out", str(index)]
    with monkeypatch.context() as patch:
        patch.setattr(Cache, "add", interrupted)
        assert main(command) == 1
    assert f"stored in {index}; run the same command to continue" in capsys.readouterr().err
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["embedded"] <= 24 - 16


def test_a_catalogue_of_only_broken_photos_raises_and_the_old_index_stays(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index)
    for path in catalogue_copy.rglob("*.jpg"):
        path.write_bytes(b"broken")
    with pytest.raises(DatasetError, match=r"no photo in .*catalog can be read; the first: .*\.jpg: not a PNG"):
        build_index(catalogue_copy, checkpoint, index)
    assert len(rows_of(index)) == 24


BAD_NUMBERS = [
    ("photo_tower", float("nan")),
    ("photo_projection", float("inf")),
    ("head.photo_partial", float("nan")),
    ("head.photo_partial", 1e6),  # beyond float16
]


@pytest.mark.parametrize(("part", "value"), BAD_NUMBERS)
def test_a_nan_or_overflow_never_reaches_an_index(part, value, catalogue_copy, checkpoint, index):
    """A module outputs a bad number for the fourth photo: the error names the photo, and the old index stays."""
    build_index(catalogue_copy, checkpoint, index)
    for path in catalogue_copy.rglob("*.jpg"):
        path.write_bytes(path.read_bytes() + b"other content, the same image")

    def corrupt(module, inputs, output):
        return output.index_fill(0, torch.tensor([3]), value) if len(output) == 16 else output

    checkpoint.matcher.get_submodule(part).register_forward_hook(corrupt)
    with pytest.raises((NumericalError, VectorError), match=list_catalogue(catalogue_copy).photos[3].path):
        build_index(catalogue_copy, checkpoint, index)
    assert IndexStore(index).current() == "gen-000001"
    assert np.isfinite(IndexStore(index).open().arrays["partials"]).all()


@pytest.mark.parametrize("kind", ["tree", "HNSW1", "IVF4,SQ8;nprobes=2", "IVF4,Flat", "PQ4"])
def test_an_impossible_kind_raises_before_embedding(catalogue_copy, checkpoint, index, embedded, kind):
    with pytest.raises(ParameterError, match="flat"):
        build_index(catalogue_copy, checkpoint, index, kind=kind)
    assert embedded == []


def test_a_second_writer_raises(catalogue_copy, checkpoint, index, embedded):
    with IndexStore(index).lock(), pytest.raises(LockedIndex):
        build_index(catalogue_copy, checkpoint, index)
    assert embedded == []


def test_stored_partials_are_those_of_the_model_to_half_a_last_place_of_float16(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index)
    generation = IndexStore(index).open()
    images = [checkpoint.config.preprocessing.load_photo(catalogue_copy / row.path) for row in generation.rows]
    exact = encode_photos(checkpoint.matcher, images).partial.numpy()
    stored = np.asarray(generation.arrays["partials"])
    assert stored.dtype == STORED
    half_a_last_place = 2**-11 * np.abs(exact).max()
    assert np.abs(stored - exact).max() <= half_a_last_place + 1e-5  # in other batches of the tower
