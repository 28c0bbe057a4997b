"""Sharded indexes: a catalogue in several index folders gives the results of one folder."""

import dataclasses
import json
import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from indexes.errors import CorruptIndex, MismatchedIndex
from indexes.store.folder import IndexStore
from indexes.store.manifest import content_digest
from indexes.store.sharded import read_sharded_manifest, shard_number, write_sharded_manifest
from retrieval.errors import BadInput, RetrievalError
from retrieval.indexing.sharded import build_sharded
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.searcher import Searcher
from tests.retrieval.search.test_search import STEEP, give_posterior


@pytest.fixture(scope="module")
def divided(cluster):
    with Searcher.open(cluster) as opened:
        yield opened


def names(answer):
    return [(match.object_id, match.photo, match.metadata) for match in answer.results]


def numbers(answer):
    parts = [(match.logit, match.probability, match.probability_if_present) for match in answer.results]
    document = {"none": answer.none_probability, "unlisted": answer.unlisted_probability, **(answer.posterior or {})}
    return [*np.array(parts, float).ravel(), *(one for one in document.values() if isinstance(one, int | float))]


def same_answers(ours, theirs):
    """Check that rankings, photos and verdicts are equal, and numbers up to the rounding of float32 products."""
    assert (ours.verdict, ours.index["scored"]) == (theirs.verdict, theirs.index["scored"])
    assert names(ours) == names(theirs)
    assert numbers(ours) == pytest.approx(numbers(theirs), abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("posterior", ["the model's own", STEEP, None], ids=["own", "steep", "none"])
@pytest.mark.parametrize("count", [1, 3])
def test_with_all_photos_scored_answers_equal_those_of_one_folder(
    posterior, count, divided, searcher, grasps, monkeypatch
):
    if posterior != "the model's own":
        for one in (divided, searcher):
            give_posterior(monkeypatch, one, posterior)
    for own in grasps:
        same_answers(divided.query(own[:count], none_prior=0.3), searcher.query(own[:count], none_prior=0.3))


def rows_of(cluster):
    """{shard: its rows} of the shards in the manifest."""
    return {
        entry.folder: list(IndexStore(cluster / entry.folder).open(name=entry.generation).rows)
        for entry in read_sharded_manifest(cluster).shards
    }


def test_every_photo_is_only_in_the_shard_of_its_object(cluster, searcher):
    shards = rows_of(cluster)
    for folder, rows in shards.items():
        assert {shard_number(row.object_id, 4) for row in rows} == {int(folder.split("-")[1])}
    together = sorted((row for rows in shards.values() for row in rows), key=lambda row: row.path)
    assert together == sorted(searcher.generation.rows, key=lambda row: row.path)
    manifest = read_sharded_manifest(cluster)
    assert (manifest.photos, manifest.objects) == (24, 8)


@pytest.fixture
def catalogue_copy(catalogue, cluster, tmp_path):
    """Copies of the catalogue and of its sharded index."""
    shutil.copytree(catalogue, tmp_path / "catalog")
    shutil.copytree(cluster, tmp_path / "cluster")
    return tmp_path / "catalog", tmp_path / "cluster"


def test_a_rebuild_of_the_same_photos_embeds_nothing_and_switches_only_changed_shards(catalogue_copy, model, embedded):
    catalog, cluster = catalogue_copy
    build_sharded(catalog, load_checkpoint(model), cluster, 4)  # the catalogue has another path now
    before = read_sharded_manifest(cluster)
    again = build_sharded(catalog, load_checkpoint(model), cluster, 4)
    assert (again.written, again.embedded) == (False, 0)
    assert read_sharded_manifest(cluster) == before
    name = min(path.name for path in catalog.iterdir())
    shutil.copy(next(catalog.glob("*/2.jpg")), catalog / name / "new.jpg")
    changed = build_sharded(catalog, load_checkpoint(model), cluster, 4)
    after = read_sharded_manifest(cluster)
    assert (changed.written, changed.photos, changed.embedded) == (True, 25, 1)
    assert number(after) == number(before) + 1
    changed_shards = {one.folder for one, other in zip(after.shards, before.shards, strict=True) if one != other}
    assert changed_shards == {f"shard-{shard_number(name, 4):02d}-of-04"}
    assert embedded == ([1] if changed.embedded else [])


def number(manifest):
    return int(manifest.generation.split("-")[1])


def test_another_number_of_shards_gives_the_same_results(catalogue_copy, model, touch):
    catalog, cluster = catalogue_copy
    with Searcher.open(cluster) as searcher:
        expected = searcher.query(touch)
    report = build_sharded(catalog, load_checkpoint(model), cluster, 3)
    assert report.photos == 24
    with Searcher.open(cluster) as searcher:
        found = searcher.query(touch)
    assert names(found) == names(expected)
    assert sorted(path.name for path in cluster.glob("shard-*-of-04"))  # for current readers
    build_sharded(catalog, load_checkpoint(model), cluster, 3)
    assert not list(cluster.glob("shard-*-of-04"))


class Killed(Exception):
    pass


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_killed_between_shards_the_index_is_unchanged_and_the_next_build_embeds_the_rest(
    after, catalogue, model, tmp_path, embedded, monkeypatch
):
    from retrieval.indexing import sharded as module

    finished, build = [], module.build_shard

    def killed(job, checkpoint):
        if len(finished) == after:
            raise Killed
        finished.append(build(job, checkpoint))
        return finished[-1]

    monkeypatch.setattr(module, "build_shard", killed)
    with pytest.raises(Killed):
        build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4)
    assert not (tmp_path / "c" / "SHARDS.json").exists()
    (tmp_path / "c" / ".SHARDS.json.1.tmp").touch()  # of a build that was killed in its last step
    monkeypatch.setattr(module, "build_shard", build)
    done = sum(report.photos for report in finished)
    embedded.clear()
    report = build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4)
    assert (report.photos, sum(embedded)) == (24, 24 - done)
    assert not list((tmp_path / "c").glob(".SHARDS.json.*"))


def test_killed_before_every_switch_the_old_generations_answer(catalogue_copy, model, touch, monkeypatch):
    """A shard gets a new photo in each turn, so its folder has many generations."""
    from retrieval.indexing import sharded as module

    catalog, cluster = catalogue_copy
    with Searcher.open(cluster) as searcher:
        expected = [match.photo for match in searcher.query(touch).results]

    def never(folder, manifest):
        raise Killed

    monkeypatch.setattr(module, "write_sharded_manifest", never)
    name = min(path.name for path in catalog.iterdir())
    for turn in range(4):
        shutil.copy(next(catalog.glob("*/2.jpg")), catalog / name / f"new-{turn}.jpg")
        with pytest.raises(Killed):
            build_sharded(catalog, load_checkpoint(model), cluster, 4)
        with Searcher.open(cluster) as searcher:
            assert [match.photo for match in searcher.query(touch).results] == expected
            assert searcher.manifest.photos == 24


def test_bad_photos_and_a_shard_without_a_readable_one_are_left_out_and_listed(catalogue_copy, model):
    catalog, cluster = catalogue_copy
    names = sorted(path.name for path in catalog.iterdir())
    gone = [name for name in names if shard_number(name, 4) == shard_number(names[0], 4)]
    bad = [*(photo for name in gone for photo in (catalog / name).iterdir())]
    bad.append(next((catalog / next(name for name in names if name not in gone)).iterdir()))
    for photo in bad:
        photo.write_bytes(b"not an image")
    report = build_sharded(catalog, load_checkpoint(model), cluster, 4)
    assert {item.path for item in report.skipped} == {photo.relative_to(catalog).as_posix() for photo in bad}
    assert report.without_photo == gone
    assert report.photos == read_sharded_manifest(cluster).photos == 24 - len(bad)


def test_an_invalid_number_of_shards_or_an_index_folder_raises(catalogue, model, index, tmp_path):
    for shards in (0, -1, 5000):
        with pytest.raises(BadInput, match="shards must be from 1 to 4096"):
            build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", shards)
    with pytest.raises(BadInput, match="is an index folder; give another folder"):
        build_sharded(catalogue, load_checkpoint(model), index, 2)


def test_a_failure_of_ray_ends_the_build_with_a_clear_error(catalogue, model, tmp_path, monkeypatch):
    building = pytest.importorskip("retrieval.cluster.building")

    def failing(*arguments, **options):
        raise KeyError("ObjectRef(00ff)")

    context = SimpleNamespace(get_current=SimpleNamespace)
    parts = SimpleNamespace(data=SimpleNamespace(DataContext=context, from_items=failing, ActorPoolStrategy=dict))
    monkeypatch.setattr(building, "ray_session", lambda: nullcontext(parts))
    monkeypatch.setattr(building, "ray_worker_pool", lambda ray: (1, {"num_gpus": 0}))
    with pytest.raises(RetrievalError, match=r"KeyError: .*same command again to continue"):
        build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, run=building.build_on_ray)


def test_a_missing_shard_or_the_generation_of_another_one_is_corrupt(catalogue_copy):
    _, cluster = catalogue_copy
    first, second = read_sharded_manifest(cluster).shards[:2]
    shutil.rmtree(cluster / first.folder / first.generation)
    with pytest.raises(CorruptIndex, match=f"{first.folder}/{first.generation}/.*build-index"):
        Searcher.open(cluster)
    shutil.copytree(cluster / second.folder / second.generation, cluster / first.folder / first.generation)
    with pytest.raises(CorruptIndex, match=r"is not the generation that .* lists"):
        Searcher.open(cluster)


def test_a_sharded_index_of_another_model_raises(catalogue_copy):
    _, cluster = catalogue_copy
    manifest = read_sharded_manifest(cluster)
    write_sharded_manifest(
        cluster, dataclasses.replace(manifest, fingerprint={**manifest.fingerprint, "preprocessing": "x"})
    )
    with pytest.raises(MismatchedIndex, match="made with preprocessing 'x'"):
        Searcher.open(cluster)


ENTRY = {"folder": "shard-00-of-01", "generation": "gen-000001", "sha256": "0" * 64, "photos": 1, "objects": 1}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shards", []),
        ("shards", [ENTRY | {"folder": "../elsewhere"}]),
        ("shards", [ENTRY | {"photos": -1}]),
        ("fingerprint", {"checkpoint": 1}),
        ("of", 0),
    ],
)
def test_a_forged_manifest_is_corrupt(field, value, catalogue_copy):
    """Software that alters the manifest can also write the right digest."""
    path = catalogue_copy[1] / "SHARDS.json"
    content = json.loads(path.read_text()) | {field: value}
    del content["sha256"]
    path.write_text(json.dumps(content | {"sha256": content_digest(content)}))
    with pytest.raises(CorruptIndex, match=rf"SHARDS\.{field}.* must be"):
        Searcher.open(catalogue_copy[1])
