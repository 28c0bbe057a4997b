"""What is searched may be one index folder, or several that are one catalogue: answers are the same."""

import dataclasses
import json
import math
import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from indexes.errors import CorruptIndex, MismatchedIndex, UnsupportedFormat
from indexes.store.folder import IndexStore
from indexes.store.manifest import content_digest
from indexes.store.sharded import read_sharded_manifest, shard_number, write_sharded_manifest
from retrieval.errors import BadInput, RetrievalError, TooManyUnreadable
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.posterior import EvidenceMass, Posterior
from retrieval.search.query.objects import ListedPhoto
from retrieval.search.query.searcher import Searcher
from retrieval.search.query.shard import RankedObject, ShardResult, merge_results
from retrieval.search.sharding.build_sharded import build_shard, build_sharded

NUMBERS = ("logit", "probability", "probability_if_present")
STEEP = Posterior(slope=2.0, offset=-1.5, dependence=0.25, tests=1)


@pytest.fixture(scope="module")
def divided(cluster):
    with Searcher.open(cluster) as opened:
        yield opened


def without_times(document):
    """A query's document without what differs by name and by time."""
    index = {name: document["index"][name] for name in ("photos", "objects", "scored", "catalogue", "model")}
    return {**document, "index": index, "timing_ms": None}


def same_answers(ours, theirs):
    """Rankings, photos and verdicts are equal; numbers within the rounding of float32 products of other shapes."""
    ours, theirs = without_times(ours.to_dict()), without_times(theirs.to_dict())
    for document in (ours, theirs):
        document["numbers"] = [
            document.pop("none_probability"),
            document.pop("unlisted_probability"),
            *(document.pop("information") or {}).values(),
            *(match.pop(name) for match in document["results"] for name in NUMBERS),
            *(document["posterior"] or {}).values(),
        ]
        document["numbers"] = [float(one) for one in document["numbers"] if isinstance(one, int | float)]
        document.pop("posterior")
    assert ours.pop("numbers") == pytest.approx(theirs.pop("numbers"), abs=1e-5)
    assert ours == theirs


# The suite: the same over every implementation of `Shard` -------------------------------------------------------------


@pytest.mark.parametrize("posterior", ["the model's own", STEEP, None], ids=["own", "steep", "none"])
@pytest.mark.parametrize("count", [1, 3])
def test_with_all_photos_scored_answers_equal_those_of_one_folder(
    posterior, count, divided, searcher, grasps, monkeypatch
):
    if posterior != "the model's own":
        for one in (divided, searcher):
            monkeypatch.setattr(one, "posterior", posterior)
    for catalogue_copy in grasps:
        same_answers(
            divided.query(catalogue_copy[:count], none_prior=0.3),
            searcher.query(catalogue_copy[:count], none_prior=0.3),
        )


def test_the_best_of_a_few_are_the_best_of_all(divided, searcher, grasps):
    same_answers(divided.query(grasps[0], top=2), searcher.query(grasps[0], top=2))


def test_with_as_many_candidates_in_each_shard_the_exhaustive_top1_is_found_at_least_as_often(
    divided, searcher, grasps
):
    for catalogue_copy in grasps:
        for candidates in (1, 2, 5):
            best = searcher.query(catalogue_copy, top=1).top
            found = divided.query(catalogue_copy, top=1, candidates=candidates)
            alone = searcher.query(catalogue_copy, top=1, candidates=candidates)
            assert (found.top.photo == best.photo) >= (alone.top.photo == best.photo)
            assert found.top.logit >= alone.top.logit - 1e-5


def test_probabilities_add_up_to_one_whatever_was_scored(divided, grasps, monkeypatch):
    monkeypatch.setattr("retrieval.search.query.shard.MIN_COMPLETED_OBJECTS", 1)
    for candidates in (1, 2, 3, 100):
        answer = divided.query(grasps[0], top=8, candidates=candidates)
        shown = math.fsum(match.probability for match in answer.results)
        assert answer.none_probability + shown <= 1 + 1e-9
        if len(answer.results) == 8:
            assert answer.none_probability + shown == pytest.approx(1, abs=1e-9)
            assert math.fsum(match.probability_if_present for match in answer.results) == pytest.approx(1, abs=1e-9)


def test_several_objects_and_growing_answers_are_merged_too(divided, searcher, grasps):
    for ours, theirs in zip(divided.query_many(grasps), searcher.query_many(grasps), strict=True):
        same_answers(ours, theirs)
    for ours, theirs in zip(divided.query_cumulative(grasps[0]), searcher.query_cumulative(grasps[0]), strict=True):
        same_answers(ours, theirs)


def test_rows_are_found_in_whatever_shard_they_lie(divided, searcher):
    ids = [row["id"] for row in searcher.generation.rows]
    asked = [*ids[::5], "absent/1.jpg"]
    assert divided.shard.rows(asked) == searcher.shard.rows(asked)
    assert divided.shard.rows(asked)[-1] is None


def test_an_answer_says_of_how_many_shards_and_what_concerns_one_folder_is_refused(divided, searcher, touch, cluster):
    index = divided.query(touch).index
    assert (index["shards"], index["searched"]) == (len(read_sharded_manifest(cluster).shards), 1.0)
    assert "shards" not in searcher.query(touch).index
    with pytest.raises(BadInput, match="is a cluster of index folders"):
        _ = divided.generation


# Merging by hand ------------------------------------------------------------------------------------------------------


def scored(*objects, mass=None, photos=10):
    best = [RankedObject(logit, ListedPhoto(name, f"{name}/1.jpg", {})) for name, logit in objects]
    return ShardResult(photos, len(best), best, mass, photos, {"candidates": 1.0, "rerank": photos / 10})


def test_merged_objects_are_ordered_by_logit_then_by_name():
    found = merge_results([scored(("tin", 2.0), ("cup", 1.0)), scored(("mug", 2.0), ("jar", 0.5), photos=30)], top=3)
    assert [one.photo.object_id for one in found.best] == ["mug", "tin", "cup"]
    assert (found.photos, found.objects, found.searched) == (40, 4, 40)
    assert found.timing_ms == {"candidates": 1.0, "rerank": 3.0}


def test_masses_of_parts_give_the_probabilities_of_the_whole():
    """By hand: two parts of two objects each, of which the second has one that was not judged."""
    logits = [math.log(4), 0.0, math.log(2)]
    parts = [STEEP.mass(logits[:2]), STEEP.mass(logits[2:], unscored=1, sample=[math.log(3)])]
    belief = STEEP.probabilities_given(logits, EvidenceMass.merged(parts), none_prior=0.4)
    terms = [0.4, *(0.6 / 4 * math.exp(2 * logit - 1.5) for logit in [*logits, math.log(3)])]
    expected = [term / math.fsum(terms) for term in terms]
    assert [belief.none, *belief.objects, belief.unscored] == pytest.approx(expected, abs=1e-12)


def test_objects_of_which_nothing_is_known_weigh_what_the_others_do_on_average():
    mass = STEEP.mass([0.0, math.log(3)], unscored=1, sample=[math.log(2)]).extrapolated(6)
    assert mass.objects == 9
    assert math.exp(mass.scored + mass.top) == pytest.approx(1 + 9)
    assert math.exp(mass.unscored + mass.top) == pytest.approx(4 + 6 * (1 + 9 + 4) / 3)
    assert STEEP.mass([1.0]).extrapolated(0) == STEEP.mass([1.0])


# Building -------------------------------------------------------------------------------------------------------------


def rows_of(cluster):
    """{shard: its rows}, as the cluster's manifest names them."""
    return {
        entry.folder: list(IndexStore(cluster / entry.folder).open(name=entry.generation).rows)
        for entry in read_sharded_manifest(cluster).shards
    }


def test_every_photo_lies_in_the_shard_of_its_object_and_in_no_other(cluster, searcher):
    shards = rows_of(cluster)
    for folder, rows in shards.items():
        assert {shard_number(row["object_id"], 4) for row in rows} == {int(folder.split("-")[1])}
    together = sorted((row for rows in shards.values() for row in rows), key=lambda row: row["id"])
    assert together == sorted(searcher.generation.rows, key=lambda row: row["id"])
    said = read_sharded_manifest(cluster)
    assert (said.photos, said.objects) == (24, 8)


def test_a_shard_is_an_index_folder_that_answers_by_itself(cluster, divided, touch):
    entry = read_sharded_manifest(cluster).shards[0]
    with Searcher.open(cluster / entry.folder) as alone:
        names = {match.object_id for match in alone.query(touch).results}
    assert names == {row["object_id"] for row in rows_of(cluster)[entry.folder]}
    assert names < {match.object_id for match in divided.query(touch).results}


@pytest.fixture
def catalogue_copy(catalogue, cluster, tmp_path):
    """A copy of the catalogue, whose cluster is a copy too."""
    shutil.copytree(catalogue, tmp_path / "catalog")
    shutil.copytree(cluster, tmp_path / "cluster")
    return tmp_path / "catalog", tmp_path / "cluster"


def test_a_build_over_the_same_photos_embeds_nothing_and_switches_only_what_is_new(catalogue_copy, model, embedded):
    catalog, cluster = catalogue_copy
    build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True)  # the catalogue lies elsewhere now
    before = read_sharded_manifest(cluster)
    again = build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True)
    assert (again.written, again.embedded, again.reused) == (False, 0, 24)
    assert read_sharded_manifest(cluster) == before
    name = min(path.name for path in catalog.iterdir())
    shutil.copy(next(catalog.glob("*/2.jpg")), catalog / name / "new.jpg")
    changed = build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True)
    after = read_sharded_manifest(cluster)
    assert (changed.written, changed.photos, changed.embedded) == (True, 25, int(changed.renamed == 0))
    assert number(after) == number(before) + 1
    moved = {one.folder for one, other in zip(after.shards, before.shards, strict=True) if one != other}
    assert moved == {f"shard-{shard_number(name, 4):02d}-of-04"}
    assert embedded == ([1] if changed.embedded else [])


def number(manifest):
    return int(manifest.generation.split("-")[1])


def test_another_number_of_shards_takes_every_code_over(catalogue_copy, model, embedded, touch):
    catalog, cluster = catalogue_copy
    with Searcher.open(cluster) as searcher:
        expected = searcher.query(touch)
    report = build_sharded(catalog, load_checkpoint(model), cluster, 3, quiet=True)
    assert (report.embedded, report.photos, embedded) == (0, 24, [])
    with Searcher.open(cluster) as searcher:
        found = searcher.query(touch)
    assert [(one.object_id, one.photo) for one in found.results] == [
        (one.object_id, one.photo) for one in expected.results
    ]
    assert sorted(path.name for path in cluster.glob("shard-*-of-04"))  # who reads them may still
    build_sharded(catalog, load_checkpoint(model), cluster, 3, quiet=True)
    assert not list(cluster.glob("shard-*-of-04"))


class Killed(Exception):
    pass


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_killed_between_shards_the_cluster_is_as_it_was_and_the_next_build_embeds_what_is_missing(
    after, catalogue, model, tmp_path, embedded, monkeypatch
):
    from retrieval.search.sharding import build_sharded as module

    made, build = [], module.build_shard

    def killed(job, checkpoint):
        if len(made) == after:
            raise Killed
        made.append(build(job, checkpoint))
        return made[-1]

    monkeypatch.setattr(module, "build_shard", killed)
    with pytest.raises(Killed):
        build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, quiet=True)
    assert not (tmp_path / "c" / "SHARDS.json").exists()
    monkeypatch.setattr(module, "build_shard", build)
    done = sum(one.report.photos for one in made)
    embedded.clear()
    report = build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, quiet=True)
    assert (report.photos, sum(embedded)) == (24, 24 - done)


def test_killed_before_the_switch_the_old_generations_answer_however_often(catalogue_copy, model, touch, monkeypatch):
    """Each time a shard has another photo, so that its folder goes through many generations."""
    from retrieval.search.sharding import build_sharded as module

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
            build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True)
        with Searcher.open(cluster) as searcher:
            assert [match.photo for match in searcher.query(touch).results] == expected
            assert searcher.info.photos == 24


def test_bad_photos_are_named_and_too_many_of_them_leave_the_cluster_as_it_was(catalogue_copy, model):
    catalog, cluster = catalogue_copy
    before = read_sharded_manifest(cluster)
    bad = next(catalog.glob("*/2.jpg"))
    bad.write_bytes(b"no picture")
    with pytest.raises(TooManyUnreadable, match=r"1 of 24 photos cannot be read, more than the share of 0\.01"):
        build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True, max_unreadable=0.01)
    assert read_sharded_manifest(cluster) == before
    report = build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True)
    assert [item.path for item in report.skipped] == [str(bad.relative_to(catalog))]
    assert report.photos == 23


def test_a_shard_none_of_whose_photos_can_be_read_is_left_out(catalogue_copy, model):
    catalog, cluster = catalogue_copy
    lost = [path.name for path in catalog.iterdir() if shard_number(path.name, 4) == shard_number("spare", 4)]
    lost = lost or [next(catalog.iterdir()).name]
    gone = {
        name for name in (path.name for path in catalog.iterdir()) if shard_number(name, 4) == shard_number(lost[0], 4)
    }
    for name in gone:
        for photo in (catalog / name).iterdir():
            photo.write_bytes(b"no picture")
    report = build_sharded(catalog, load_checkpoint(model), cluster, 4, quiet=True, max_unreadable=1)
    assert report.without_photo == sorted(gone)
    assert report.photos == 24 - 3 * len(gone)
    assert read_sharded_manifest(cluster).photos == report.photos


def test_a_number_of_shards_that_is_none_and_an_index_folder_are_refused(catalogue, model, index, tmp_path):
    for shards in (0, -1, 5000):
        with pytest.raises(BadInput, match="shards must be from 1 to 4096"):
            build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", shards, quiet=True)
    with pytest.raises(BadInput, match="is an index folder; give another one"):
        build_sharded(catalogue, load_checkpoint(model), index, 2, quiet=True)


# Built side by side ---------------------------------------------------------------------------------------------------


@pytest.fixture
def failing(monkeypatch):
    """Ray that fails as a whole, so many times and after so many shards each: what it was asked for."""
    building, asked, plain = pytest.importorskip("retrieval.cluster.building"), [], build_shard

    def fail(times, after):
        def answers(ray, jobs, checkpoint, processes):
            asked.append([job.folder for job in jobs])
            for number, job in enumerate(jobs):
                if number == after and len(asked) <= times:
                    raise KeyError("ObjectRef(00ff)")
                yield plain(job, checkpoint)

        monkeypatch.setattr(building, "_answers", answers)
        return asked

    parts = SimpleNamespace(data=SimpleNamespace(DataContext=SimpleNamespace(get_current=SimpleNamespace)))
    monkeypatch.setattr(building, "ray_session", lambda cpus: nullcontext(parts))
    return fail


def test_where_ray_fails_as_a_whole_only_what_is_missing_is_built_again(failing, catalogue, model, tmp_path, embedded):
    from retrieval.cluster.building import ray_runner

    asked = failing(times=2, after=1)
    report = build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, quiet=True, run=ray_runner(1, 1))
    assert (report.photos, sum(embedded), len(report.shards)) == (24, 24, 4)
    assert [len(jobs) for jobs in asked] == [4, 3, 2]
    assert asked[2] == asked[0][2:]


def test_ray_that_goes_on_failing_ends_the_build_in_a_sentence(failing, catalogue, model, tmp_path):
    from retrieval.cluster.building import MAX_FAILURES, ray_runner

    asked = failing(times=99, after=0)
    with pytest.raises(RetrievalError, match=r"Ray failed 4 times without a shard \(KeyError: .*goes on where it"):
        build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, quiet=True, run=ray_runner(1, 1))
    assert len(asked) == MAX_FAILURES + 1


# Damage ---------------------------------------------------------------------------------------------------------------


def test_a_missing_shard_is_named_and_another_ones_generation_refused_in_its_place(catalogue_copy):
    _, cluster = catalogue_copy
    first, second = read_sharded_manifest(cluster).shards[:2]
    shutil.rmtree(cluster / first.folder / first.generation)
    with pytest.raises(CorruptIndex, match=f"{first.folder}: the generation {first.generation} is missing"):
        Searcher.open(cluster)
    shutil.copytree(cluster / second.folder / second.generation, cluster / first.folder / first.generation)
    with pytest.raises(CorruptIndex, match=r"is not the generation that .* was written for"):
        Searcher.open(cluster)


def test_a_shard_of_another_model_is_refused(catalogue_copy):
    _, cluster = catalogue_copy
    manifest = read_sharded_manifest(cluster)
    write_sharded_manifest(
        cluster, dataclasses.replace(manifest, fingerprint={**manifest.fingerprint, "preprocessing": "x"})
    )
    with pytest.raises(MismatchedIndex, match="made with preprocessing 'x'"):
        Searcher.open(cluster)


@pytest.mark.parametrize("cut", np.linspace(0, 0.98, 8))
def test_a_manifest_cut_short_is_refused_in_a_sentence(cut, catalogue_copy):
    _, cluster = catalogue_copy
    path = cluster / "SHARDS.json"
    path.write_bytes(path.read_bytes()[: int(cut * path.stat().st_size)])
    with pytest.raises(CorruptIndex, match="run `retrieve build-index` again"):
        Searcher.open(cluster)


ENTRY = {"folder": "shard-00-of-01", "generation": "gen-000001", "sha256": "0" * 64, "photos": 1, "objects": 1}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shards", []),
        ("shards", [ENTRY | {"folder": "../elsewhere"}]),
        ("shards", [ENTRY | {"generation": "gen/../1"}]),
        ("shards", [ENTRY | {"photos": -1}]),
        ("generation", "gen-000001"),
        ("fingerprint", {"checkpoint": 1}),
        ("about", []),
        ("of", 0),
    ],
)
def test_a_forged_manifest_is_refused(field, value, catalogue_copy):
    """Whoever alters it can write the digest that fits."""
    _, cluster = catalogue_copy
    manifest = read_sharded_manifest(cluster)
    made_up = object.__new__(type(manifest))
    for one in dataclasses.fields(manifest):
        object.__setattr__(made_up, one.name, value if one.name == field else getattr(manifest, one.name))
    write_sharded_manifest(cluster, made_up)
    with pytest.raises(CorruptIndex, match=rf"CLUSTER\.{field}.* must be"):
        Searcher.open(cluster)


def test_another_format_is_refused(catalogue_copy):
    _, cluster = catalogue_copy
    path = cluster / "SHARDS.json"
    content = json.loads(path.read_text())
    content["format"] = 99
    content.pop("sha256")
    content["sha256"] = content_digest(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UnsupportedFormat, match="has the newer format 99, this software reads 1; update"):
        Searcher.open(cluster)
