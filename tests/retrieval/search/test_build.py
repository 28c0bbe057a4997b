"""Building an index of a folder of photos: embedding, reuse, skipped files and the report."""

import dataclasses
import json
import shutil
import time

import numpy as np
import pytest
import torch

from indexes.errors import LockedIndex, ParameterError, VectorError
from indexes.store.folder import IndexStore
from retrieval.data.catalogue import list_catalogue
from retrieval.errors import BadInput, DatasetError, NumericalError
from retrieval.model.checkpoint import load_checkpoint, save_checkpoint
from retrieval.model.encode import encode_photos, for_inference
from retrieval.model.fusion import Matcher
from retrieval.search.build import measuring, operating
from retrieval.search.build.build_index import build_index
from retrieval.search.build.embed import map_ahead
from retrieval.search.build.measuring import ExhaustiveBench, NeighbourBench
from retrieval.search.query.searcher import Searcher
from retrieval.version import __version__
from tests import synthetic


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


def first_photo(catalogue_copy):
    return sorted(catalogue_copy.rglob("*.jpg"))[0]


def other_picture(path, seed=77):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(synthetic._jpeg(synthetic.draw_photo(synthetic.make_object(seed), 1)))


def rows_of(index):
    return {row["id"]: row for row in IndexStore(index).open().rows}


def changed_model(checkpoint, path):
    """A checkpoint with other weights."""
    with torch.no_grad():
        checkpoint.matcher.head.out.bias += 0.5
    save_checkpoint(path, checkpoint.matcher, checkpoint.config, split=None, provenance=PROVENANCE)
    return load_checkpoint(path)


PROVENANCE = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}


# Embedding and reuse -------------------------------------------------------------------------------------------------


def test_a_first_build_embeds_every_photo_once_in_batches(catalogue_copy, checkpoint, index, embedded):
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert sorted(embedded) == [8, 16]
    assert (report.photos, report.objects, report.embedded, report.reused, report.removed) == (24, 8, 24, 0, 0)
    assert report.skipped == []
    rows = IndexStore(index).open().rows
    assert [row["id"] for row in rows] == [photo.path for photo in list_catalogue(catalogue_copy).photos]
    assert set(rows[0]) == {"id", "object_id", "path", "digest", "metadata"}


def test_a_rebuild_without_changes_writes_nothing_and_reports_it(catalogue_copy, checkpoint, index, embedded):
    first = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert first.written
    embedded.clear()
    (catalogue_copy / "note.txt").write_text("not a photo")
    (catalogue_copy / "broken.png").write_bytes(b"not a photo either")
    changing = {"LOCK", "files.stat", "folders.stat"}  # stat records are written when files are old enough
    before = {path: path.stat().st_mtime_ns for path in index.rglob("*") if path.name not in changing}
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (embedded, report.embedded, report.reused, report.generation) == ([], 0, 24, "gen-000001")
    assert (report.written, report.partial_error) == (False, first.partial_error)
    assert {path: path.stat().st_mtime_ns for path in index.rglob("*") if path.name not in changing} == before
    assert "nothing changed: the index stays as it is" in list(report.lines())
    assert (report.ignored, [item.path for item in report.skipped]) == (["note.txt"], ["broken.png"])


def test_new_requirements_or_a_moved_catalogue_are_written_without_embedding(
    catalogue_copy, checkpoint, index, embedded
):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    embedded.clear()
    assert build_index(catalogue_copy, checkpoint, index, kind="hnsw", quiet=True).written
    assert not build_index(catalogue_copy, checkpoint, index, kind="hnsw", quiet=True).written
    moved = catalogue_copy.rename(catalogue_copy.with_name("elsewhere"))
    assert build_index(moved, checkpoint, index, kind="hnsw", quiet=True).written
    assert Searcher.open(index).catalogue == moved
    assert embedded == []


def test_a_rebuild_embeds_only_changed_and_new_photos(catalogue_copy, checkpoint, index, embedded):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    before = IndexStore(index).open()
    embedded.clear()
    changed = first_photo(catalogue_copy)
    other_picture(changed)
    other_picture(catalogue_copy / "newcomer" / "1.jpg", seed=78)
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert embedded == [2]
    assert (report.photos, report.embedded, report.reused, report.removed) == (25, 2, 23, 0)
    after = IndexStore(index).open()
    name = changed.relative_to(catalogue_copy).as_posix()
    for row_id in [row["id"] for row in before.rows]:
        old, new = (part.arrays["partials"][part.row_number(row_id)] for part in (before, after))
        assert np.array_equal(old, new) == (row_id != name)


def test_a_rebuild_equals_a_new_build(catalogue_copy, checkpoint, index, tmp_path):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    other_picture(first_photo(catalogue_copy))
    shutil.rmtree(sorted(catalogue_copy.iterdir())[3])
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    build_index(catalogue_copy, checkpoint, tmp_path / "fresh", quiet=True)
    again, fresh = (IndexStore(path).open() for path in (index, tmp_path / "fresh"))
    assert again.rows == fresh.rows
    # In another batch the tower adds in another order: 1e-5 in float32, then one step of float16.
    np.testing.assert_allclose(again.arrays["partials"], fresh.arrays["partials"], rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(again.embeddings[again.slots], fresh.embeddings[fresh.slots], atol=1e-5)


def test_photos_that_were_removed_or_damaged_are_dropped_and_counted(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    first_photo(catalogue_copy).unlink()
    broken = first_photo(catalogue_copy)
    broken.write_bytes(broken.read_bytes()[:500])
    shutil.rmtree(sorted(catalogue_copy.iterdir())[-1])
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (report.photos, report.objects, report.embedded, report.removed) == (19, 7, 0, 5)
    assert [item.path for item in report.skipped] == [broken.relative_to(catalogue_copy).as_posix()]
    broken.unlink()
    assert set(rows_of(index)) == {
        path.relative_to(catalogue_copy).as_posix() for path in catalogue_copy.rglob("*.jpg")
    }


def test_a_renamed_photo_is_a_new_photo_that_is_not_embedded_again(catalogue_copy, checkpoint, index, embedded):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    before = IndexStore(index).open()
    embedded.clear()
    photo = first_photo(catalogue_copy)
    moved = photo.rename(sorted(catalogue_copy.iterdir())[1] / "moved.jpg")
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert embedded == []
    assert (report.photos, report.embedded, report.reused, report.renamed, report.removed) == (24, 0, 24, 1, 1)
    assert "24 unchanged (1 renamed), 1 removed" in next(report.lines())
    after = IndexStore(index).open()
    old, new = (
        part.row_number(path.relative_to(catalogue_copy).as_posix()) for part, path in ((before, photo), (after, moved))
    )
    assert after.rows[new]["object_id"] == moved.parent.name
    np.testing.assert_array_equal(after.arrays["partials"][new], before.arrays["partials"][old])
    np.testing.assert_array_equal(after.embeddings[after.slots[new]], before.embeddings[before.slots[old]])
    assert report.partial_error == before.manifest.about["partial_error"]


def test_the_same_image_of_two_objects_gives_two_rows_with_one_vector(catalogue_copy, checkpoint, index):
    """They are encoded in one batch: on some processors the last bits depend on the place in a batch."""
    original_photo = first_photo(catalogue_copy)
    folder = catalogue_copy / f"{original_photo.parent.name}-twin"
    folder.mkdir()
    shutil.copy(original_photo, folder / "1.jpg")
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).photos == 25
    generation = IndexStore(index).open()
    twin, original = (
        generation.row_number(path.relative_to(catalogue_copy).as_posix())
        for path in (folder / "1.jpg", original_photo)
    )
    assert generation.slots[twin] == generation.slots[original]
    assert len(generation.embeddings) == 24


def test_new_metadata_changes_the_rows_without_embedding(catalogue_copy, checkpoint, index, embedded):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    embedded.clear()
    name = first_photo(catalogue_copy).parent.name
    (catalogue_copy / "metadata.jsonl").write_text(json.dumps({"object_id": name, "price": 3}) + "\n")
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).reused == 24
    assert embedded == []
    assert {row["object_id"] for row in rows_of(index).values() if row["metadata"] == {"price": 3}} == {name}


def test_a_changed_model_embeds_everything_and_reports_it(catalogue_copy, checkpoint, index, embedded, tmp_path):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    embedded.clear()
    other = changed_model(checkpoint, tmp_path / "other.safetensors")
    report = build_index(catalogue_copy, other, index, quiet=True)
    assert (sum(embedded), report.embedded, report.reused) == (24, 24, 0)
    assert report.reason.startswith(
        f"Every photo was embedded again: the model changed; the index was written by version {__version__}."
    )


def test_a_damaged_index_is_rebuilt_and_reported(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    partials = index / "gen-000001" / "partials.npy"
    partials.write_bytes(partials.read_bytes()[:-1])
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert report.embedded == 24
    assert "not usable, so every photo was embedded again" in report.reason
    assert Searcher.open(index).generation.count == 24


# Unusable input ------------------------------------------------------------------------------------------------------


def test_broken_photos_are_skipped_and_listed(catalogue_copy, checkpoint, index):
    photos = sorted(catalogue_copy.rglob("*.jpg"))
    photos[0].write_bytes(b"")
    photos[7].write_bytes(photos[7].read_bytes()[:900])
    photos[23].write_bytes(b"this is not an image")
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (report.photos, report.embedded) == (21, 21)
    assert [item.path for item in report.skipped] == [
        photos[n].relative_to(catalogue_copy).as_posix() for n in (0, 7, 23)
    ]
    assert all(item.reason for item in report.skipped)
    text = "\n".join(report.lines())
    assert "3 photo(s) skipped:" in text
    assert f"  {report.skipped[1].path}: damaged or truncated" in text
    assert len(json.loads(json.dumps(report.to_dict()))["skipped"]) == 3


def test_long_lists_are_truncated_in_text_and_complete_in_json(catalogue_copy, checkpoint, index):
    for number in range(30):
        (catalogue_copy / f"broken{number:02}.png").write_bytes(b"x")
        (catalogue_copy / f"note{number:02}.txt").write_text("x")
    (catalogue_copy / "metadata.jsonl").write_text('{"object_id": "nobody", "price": 3}\n')
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    lines = list(report.lines())
    assert "  metadata.jsonl names nobody, which is not in the catalogue" in lines
    assert "  and 10 more (--json lists them all)" in lines
    assert len(lines) < 42
    assert len(report.to_dict()["skipped"]) == len(report.to_dict()["ignored"]) == 30


def test_a_catalogue_of_only_broken_photos_raises_and_the_old_index_stays(catalogue_copy, checkpoint, index):
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    for path in catalogue_copy.rglob("*.jpg"):
        path.write_bytes(b"broken")
    with pytest.raises(DatasetError, match=r"no photo in .*catalog can be read; the first: .*1\.jpg: not a PNG"):
        build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert len(rows_of(index)) == 24


BAD_NUMBERS = [
    ("photo_tower", float("nan")),
    ("photo_tower", float("inf")),
    ("photo_projection", float("nan")),
    ("photo_projection", float("inf")),
    ("head.photo_partial", float("nan")),
    ("head.photo_partial", 1e6),  # beyond float16
]


@pytest.mark.parametrize(("part", "value"), BAD_NUMBERS)
def test_a_nan_or_overflow_never_reaches_an_index(part, value, catalogue_copy, checkpoint, index):
    """A module outputs a bad number for the fourth photo: the error names the photo, and the old index stays."""
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    for path in catalogue_copy.rglob("*.jpg"):
        path.write_bytes(path.read_bytes() + b"other content, the same image")

    def corrupt(module, inputs, output):
        return output.index_fill(0, torch.tensor([3]), value) if len(output) == 16 else output

    for_inference(checkpoint.matcher).get_submodule(part).register_forward_hook(corrupt)
    with pytest.raises((NumericalError, VectorError), match=list_catalogue(catalogue_copy).photos[3].path):
        build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert IndexStore(index).current() == "gen-000001"
    assert np.isfinite(IndexStore(index).open().arrays["partials"]).all()


def test_invalid_requirements_raise_before_embedding(catalogue_copy, checkpoint, index, embedded):
    with pytest.raises(ParameterError, match="flat"):
        build_index(catalogue_copy, checkpoint, index, kind="tree", quiet=True)
    with pytest.raises(ParameterError, match="ivf_pq needs 624 or more vectors to train its codes; got 24"):
        build_index(catalogue_copy, checkpoint, index, kind="ivf_pq", quiet=True)
    for recall in (0, -0.1, 1.01, float("nan")):
        with pytest.raises(BadInput, match="minimum recall must be above 0"):
            build_index(catalogue_copy, checkpoint, index, min_recall=recall, quiet=True)
    for budget in (0, -1, float("nan")):
        with pytest.raises(BadInput, match="must be more than 0 ms"):
            build_index(catalogue_copy, checkpoint, index, max_ms=budget, quiet=True)
    assert embedded == []


def test_a_second_writer_raises(catalogue_copy, checkpoint, index, embedded):
    with IndexStore(index).lock(), pytest.raises(LockedIndex):
        build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert embedded == []


# The report ----------------------------------------------------------------------------------------------------------


def test_the_error_of_float16_partials_is_reported_and_small(catalogue_copy, checkpoint, index):
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    generation = IndexStore(index).open()
    load = checkpoint.config.preprocessing.load_photo
    exact = encode_photos(
        checkpoint.matcher, [load(catalogue_copy / row["path"]) for row in generation.rows]
    ).partial.numpy()
    stored = np.asarray(generation.arrays["partials"])
    assert stored.dtype == np.float16
    error = float(np.abs(stored - exact).max())
    assert report.partial_error == pytest.approx(error, abs=1e-5)  # in other batches of the tower
    assert 0 < report.partial_error <= 2**-11 * np.abs(exact).max()  # half a step of 11 bits
    assert generation.manifest.about["partial_error"] == report.partial_error
    assert f"error of at most {report.partial_error:.2g}" in "\n".join(report.lines())


def test_exact_search_is_the_default_and_vectors_are_measured_only_for_a_time_bound(
    catalogue_copy, checkpoint, index, monkeypatch
):
    measured = []
    monkeypatch.setattr(
        operating, "NeighbourBench", lambda vectors: measured.append(len(vectors)) or NeighbourBench(vectors)
    )
    assert build_index(catalogue_copy, checkpoint, index, quiet=True).kind == "flat"
    assert measured == []
    report = build_index(catalogue_copy, checkpoint, index, max_ms=1e-9, quiet=True)
    assert (measured, report.candidates) == ([24], None)
    assert "is slower than 1e-09 ms. No measured setting meets all requirements." in report.reason
    assert "stores no touches to measure candidates with, so recall is that of nearest neighbours" in report.reason
    assert "hnsw" in "\n".join(build_index(catalogue_copy, checkpoint, index, kind="hnsw", quiet=True).lines())
    assert Searcher.open(index).generation.manifest.kind == "hnsw"


def test_few_photos_are_all_scored_without_a_measurement(catalogue_copy, queried, index, monkeypatch):
    monkeypatch.setattr(operating, "ExhaustiveBench", None)
    report = build_index(catalogue_copy, queried, index, quiet=True)
    assert (report.candidates["k"], report.candidates["queries"]) == (24, 0)
    assert "candidate search: flat. The fusion head scores all 24 photos." in list(report.lines())


@pytest.fixture
def queried(checkpoint, tmp_path):
    """A checkpoint with a candidate encoder, and touches to measure with."""
    config = dataclasses.replace(
        checkpoint.config, matcher=dataclasses.replace(checkpoint.config.matcher, candidate_width=8)
    )
    torch.manual_seed(3)
    matcher = Matcher(config.matcher)
    matcher.load_state_dict(checkpoint.matcher.state_dict(), strict=False)
    partials = np.random.default_rng(3).normal(size=(30, config.matcher.hidden)).astype(np.float16)
    path = tmp_path / "queried.safetensors"
    save_checkpoint(path, matcher, config, split=None, provenance=PROVENANCE, queries=partials)
    return load_checkpoint(path)


def test_the_measured_operating_point_is_in_manifest_and_report(catalogue_copy, queried, index, monkeypatch):
    monkeypatch.setattr(measuring, "EXHAUSTIVE_LIMIT", 4)
    report = build_index(catalogue_copy, queried, index, min_recall=0.5, quiet=True)
    record = IndexStore(index).open().manifest.about["candidates"]
    assert record == report.candidates
    assert (record["queries"], record["photos"], record["requirements"]["min_recall"]) == (30, 24, 0.5)
    assert record["top1_agreement"] >= 0.5
    assert "validation touches (95 % interval" in "\n".join(report.lines())


def test_new_and_old_photos_are_measured_together_after_enough_changes(catalogue_copy, queried, index, monkeypatch):
    monkeypatch.setattr(measuring, "EXHAUSTIVE_LIMIT", 4)
    benches = []
    monkeypatch.setattr(
        operating, "ExhaustiveBench", lambda *made, **how: benches.append(made[1:]) or ExhaustiveBench(*made, **how)
    )
    build_index(catalogue_copy, queried, index, quiet=True)
    other_picture(catalogue_copy / "newcomer" / "1.jpg", seed=78)
    assert build_index(catalogue_copy, queried, index, quiet=True).candidates["changed"] == 1
    other_picture(catalogue_copy / "newcomer" / "2.jpg", seed=79)
    other_picture(catalogue_copy / "newcomer" / "3.jpg", seed=80)
    assert build_index(catalogue_copy, queried, index, quiet=True).candidates["photos"] == 27
    assert [len(partials) for *_, partials in benches] == [24, 27]
    generation, (vectors, slots, partials) = IndexStore(index).open(), benches[1]
    np.testing.assert_array_equal(partials[:], generation.arrays["partials"][:])
    np.testing.assert_array_equal(vectors[slots], generation.embeddings[generation.slots])


def test_recall_is_measured_with_touches_if_the_checkpoint_stores_some(
    catalogue_copy, checkpoint, queried, index, tmp_path
):
    build_index(catalogue_copy, queried, index, kind="hnsw", quiet=True)
    build_index(catalogue_copy, checkpoint, tmp_path / "other", kind="hnsw", quiet=True)
    with_touches, without = (IndexStore(path).open().manifest.recall for path in (index, tmp_path / "other"))
    assert (with_touches["queries"], with_touches["how"]) == (30, "measured on the given queries")
    assert without["how"] == "measured on displaced vectors of the index"


# Threads that read and decode ----------------------------------------------------------------------------------------


def test_map_ahead_preserves_the_order_and_stays_within_its_window():
    taken = []

    def items():
        for number in range(40):
            taken.append(number)
            yield number

    def slow(number):
        time.sleep(0.002 if number % 7 == 0 else 0)
        return number

    for place, number in enumerate(map_ahead(slow, items(), threads=3, window=5)):
        assert number == place
        assert len(taken) <= place + 5


def test_an_error_on_a_thread_is_raised_in_place_of_its_item():
    def fail(number):
        return 1 / (number - 3)

    results = map_ahead(fail, range(9), threads=2, window=4)
    assert [next(results) for _ in range(3)] == [-1 / 3, -1 / 2, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)
