"""From gel images to ranked objects, compared with two plain loops over the whole network."""

import dataclasses
import math
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from indexes.errors import MismatchedIndex
from indexes.kinds.vector_index import VectorIndex
from retrieval.errors import BadInput, CheckpointError, ImageError
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.encode import to_batch, touch_batch
from retrieval.model.posterior import Posterior
from retrieval.search.objects import Objects, ScoredObjects
from retrieval.search.searcher import Searcher
from retrieval.search.shard import combined_embedding
from tests import synthetic

FLOAT16_ROUNDING = 2**-11
"""Largest relative rounding of a float16 number."""
STEEP = Posterior(slope=2.0, offset=-1.5, dependence=0.25, tests=1)
"""Posterior of a model that distinguishes objects. The fixture's model does not: its own slope is near 0."""


@pytest.fixture(scope="module")
def matcher(model):
    """The model of the index, in PyTorch."""
    return load_checkpoint(model).matcher


@pytest.fixture(scope="module")
def grasps(tmp_path_factory):
    """Three grasps of one object of the catalogue."""
    objects = synthetic.make_objects(2, seed=9)[1:]
    return next(iter(synthetic.write_queries(tmp_path_factory.mktemp("grasps"), objects, 3).values()))


@pytest.fixture
def searches(monkeypatch):
    """Number of requested photos of each candidate search."""
    requested = []

    def counted(index, queries, k):
        requested.append(k)
        return search(index, queries, k)

    search = VectorIndex.candidates
    monkeypatch.setattr(VectorIndex, "candidates", counted)
    return requested


def variant(model, path, **changes):
    """The same weights with other settings, given as "part__name"."""
    checkpoint = load_checkpoint(model)
    config = checkpoint.config
    for key, value in changes.items():
        part, name = key.split("__")
        config = dataclasses.replace(config, **{part: dataclasses.replace(getattr(config, part), **{name: value})})
    provenance = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}
    posterior, check = checkpoint.posterior, checkpoint.gel_check
    contents = {"matcher": checkpoint.matcher, "posterior": posterior, "gel_check": check}
    store_checkpoint(Checkpoint(path, "", config, provenance, **contents), path)
    return load_checkpoint(path)


def give_posterior(monkeypatch, searcher, posterior):
    """Give an opened index another posterior; None for a model without one."""
    monkeypatch.setattr(searcher, "posterior", posterior)
    for shard in getattr(searcher.shard, "shards", [searcher.shard]):
        monkeypatch.setattr(shard.objects, "posterior", posterior or Posterior())


@pytest.fixture(scope="module")
def oracle(searcher, matcher, catalogue):
    """Touches -> {photo path: sum of match logits}, by the full network on every pair of touch and photo."""
    pre = searcher.checkpoint.config.preprocessing
    photos = {path.relative_to(catalogue).as_posix(): pre.load_photo(path) for path in catalogue.rglob("*.jpg")}

    @cache
    @torch.inference_mode()
    def of_touch(touch):
        images = touch_batch([[pre.load_touch(file) for file in touch]])
        return {name: float(matcher(images, to_batch([photo]))) for name, photo in photos.items()}

    return lambda touches: {name: sum(of_touch(touch)[name] for touch in touches) for name in photos}


def weight(posterior, grasps):
    """The weight of a sum of match logits over several grasps, by hand."""
    return posterior.slope / (1 + posterior.dependence * (grasps - 1))


def best_by_object(logits, posterior, grasps, photos=3):
    """[(object, best photo, log mean exp of its photos' logits)] by plain loops, best first; ties by object.

    Each object has `photos` photos; one that is missing in `logits` has zero likelihood.
    """
    by_object, scale = {}, weight(posterior, grasps)
    for photo in sorted(logits):
        by_object.setdefault(photo.split("/")[0], []).append(photo)
    found = []
    for name, own in by_object.items():
        mean = math.fsum(math.exp(scale * logits[photo]) for photo in own) / photos
        found.append((name, max(own, key=lambda photo: logits[photo]), math.log(mean) / scale))
    return sorted(found, key=lambda item: (-item[2], item[0]))


@pytest.fixture(params=["the model's own", "steep"])
def posterior(request, searcher, monkeypatch):
    """The posterior of the searcher."""
    if request.param == "steep":
        give_posterior(monkeypatch, searcher, STEEP)
    return searcher.posterior


def logit_tolerance(searcher, grasps):
    """Largest change of a logit by rounding partial activations, through |second| and |out|; ReLU enlarges no change.

    A log mean exp does not either: an object's logit changes at most as much as its photos' logits.
    """
    moved = np.abs(np.asarray(searcher.generation.arrays["partials"], np.float32)).max(axis=0) * FLOAT16_ROUNDING
    return grasps * float(np.abs(searcher.scorer.out) @ (np.abs(searcher.scorer.second) @ moved)) + 1e-5


@pytest.mark.parametrize("count", [1, 3])
def test_the_ranking_equals_the_full_network_on_every_pair(count, posterior, searcher, grasps, oracle):
    touches = grasps[:count]
    photos = oracle(touches)
    result = searcher.query(touches)
    tolerance = logit_tolerance(searcher, count)
    assert tolerance < 0.01
    theirs = best_by_object(photos, posterior, count)
    logits = {name: logit for name, _, logit in theirs}
    best = {name: photo for name, photo, _ in theirs}
    assert len(result.results) == len(theirs) == 8
    # The order is equal if logits differ by more than the rounding; closer ones may be swapped.
    for match, (_, _, logit) in zip(result.results, theirs, strict=True):
        assert match.logit == pytest.approx(logits[match.object_id], abs=tolerance)
        assert logits[match.object_id] == pytest.approx(logit, abs=2 * tolerance)
        assert match.photo.startswith(f"{match.object_id}/")
        assert photos[match.photo] == pytest.approx(photos[best[match.object_id]], abs=2 * tolerance)


def test_with_exact_partials_the_order_equals_the_oracle(
    posterior, searcher, matcher, grasps, oracle, catalogue, monkeypatch
):
    """Without rounding, the rankings are equal without a tolerance."""
    expected = best_by_object(oracle(grasps[:1]), posterior, 1)
    logits = np.array([logit for _, _, logit in expected])
    assert np.diff(-logits).min() > 1e-6  # the synthetic photos give no near ties
    checkpoint, rows = searcher.checkpoint, searcher.generation.rows
    photos = [checkpoint.config.preprocessing.load_photo(catalogue / row.path) for row in rows]
    with torch.inference_mode():
        images = torch.from_numpy(np.stack(photos)).permute(0, 3, 1, 2)
        partials = matcher.photo_encoding(matcher.photo_features(images)).partial.numpy()
    monkeypatch.setitem(searcher.generation.arrays, "partials", partials)
    result = searcher.query(grasps[:1])
    assert [(match.object_id, match.photo) for match in result.results] == [item[:2] for item in expected]
    np.testing.assert_allclose([match.logit for match in result.results], logits, atol=1e-5)


def test_equal_photos_of_several_objects_are_all_found_in_the_order_of_their_ids(catalogue, model, touch, tmp_path):
    own = tmp_path / "catalog"
    for name in ("zebra", "ant", "mule"):
        (own / name).mkdir(parents=True)
        shutil.copy(sorted(catalogue.rglob("*.jpg"))[0], own / name / "1.jpg")
    build_index(own, load_checkpoint(model), tmp_path / "index")
    build_sharded(own, load_checkpoint(model), tmp_path / "sharded", 4)
    for folder, candidates in (("index", None), ("index", 1), ("sharded", None)):
        results = Searcher.open(tmp_path / folder).query([touch], top=3, candidates=candidates).results
        assert [match.object_id for match in results] == ["ant", "mule", "zebra"]
        assert len({match.logit for match in results}) == 1
        assert [match.rank for match in results] == [1, 2, 3]


def test_no_candidate_stage_runs_without_trained_embeddings(catalogue, model, touch, tmp_path, searches):
    checkpoint = variant(model, tmp_path / "paper.safetensors", training__weights={})
    build_index(catalogue, checkpoint, tmp_path / "index")
    assert Searcher.open(tmp_path / "index").query([touch], candidates=2, top=1).index["scored"] == 24
    assert searches == []


@pytest.mark.parametrize(
    ("measured", "numbers", "expected"),
    [
        ({"k": 5}, {"top": 2}, [5]),
        ({"k": 5}, {"top": 2, "candidates": 9}, [9]),
        ({"k": 5}, {"top": 2, "candidates": 1}, [2]),
        (None, {"top": 2}, []),
        ({"k": 24}, {"top": 2}, []),
    ],
)
def test_the_index_sets_the_number_of_candidates_unless_the_query_does(
    measured, numbers, expected, searcher, grasps, searches, monkeypatch
):
    monkeypatch.setitem(searcher.generation.manifest.about, "candidates", measured)
    scored = searcher.query(grasps, **numbers).index["scored"]
    assert searches == expected
    assert sum(expected) <= scored <= 24


@pytest.mark.parametrize(("candidates", "completed"), [(5, 1), (2, 1), (2, 20)])
@torch.inference_mode()
def test_the_candidates_are_the_photos_nearest_to_all_grasps_together(
    candidates, completed, posterior, searcher, matcher, grasps, oracle, monkeypatch
):
    """Plain loops: the best sums of inner products, the full network on these photos, and on the other photos of the
    best objects among them."""
    monkeypatch.setattr("retrieval.search.shard.MIN_COMPLETED_OBJECTS", completed)
    checkpoint, generation = searcher.checkpoint, searcher.generation
    load, products = checkpoint.config.preprocessing.load_touch, np.zeros(24)
    for grasp in grasps:
        touch = matcher.touch_features(touch_batch([[load(path) for path in grasp]]))
        products += generation.embeddings @ matcher.touch_search_encoding(touch).embedding[0].numpy()
    near = {generation.rows[row].path for row in np.argsort(-products)[:candidates]}
    logits = oracle(grasps)
    first = best_by_object({photo: logits[photo] for photo in near}, posterior, 3)
    whole = {name for name, _, _ in first[: max(2, completed)]}
    scored = {photo: logit for photo, logit in logits.items() if photo in near or photo.split("/")[0] in whole}
    expected = best_by_object(scored, posterior, 3)
    result = searcher.query(grasps, candidates=candidates, top=2)
    assert result.index["scored"] == len(scored) < 24
    assert result.posterior["scored_objects"] == len(expected) < 8
    assert [(match.object_id, match.photo) for match in result.results] == [item[:2] for item in expected[:2]]


def test_the_combined_embedding_is_that_of_the_first_grasp_if_they_cancel():
    """The direction of the sum would be that of its rounding, or 0 / 0."""
    grasp = np.array([[0.6, 0.8]], dtype=np.float32)
    for off in (0, 1e-6):
        np.testing.assert_array_equal(combined_embedding(np.concatenate([grasp, off - grasp])), grasp)


@pytest.mark.parametrize("none_prior", [0.5, 0.2, 0.0])
@pytest.mark.parametrize("count", [1, 3])
def test_probabilities_equal_normalised_likelihoods_with_none_of_these_and_follow_the_logits(
    count, none_prior, posterior, searcher, grasps
):
    """Of 8 objects, each with the prior (1 - p) / 8: its likelihood ratio times the prior, over the sum of all."""
    result = searcher.query(grasps[:count], none_prior=none_prior)
    scale = weight(posterior, count)
    terms = [(1 - none_prior) / 8 * math.exp(scale * match.logit + posterior.offset) for match in result.results]
    total = none_prior + math.fsum(terms)
    probabilities = [match.probability for match in result.results]
    assert probabilities == pytest.approx([term / total for term in terms], abs=1e-12)
    assert result.none_probability == pytest.approx(none_prior / total, abs=1e-12)
    assert math.fsum([result.none_probability, *probabilities]) == pytest.approx(1, abs=1e-12)
    assert probabilities == sorted(probabilities, reverse=True)
    if_present = [match.probability_if_present for match in result.results]
    assert if_present == pytest.approx([term / math.fsum(terms) for term in terms], abs=1e-12)


def test_objects_with_equal_probabilities_are_still_ranked_by_logit(searcher, touch, monkeypatch):
    """Float64 probabilities of logits that are 745 below the best are all 0; ranked by probability, they would tie."""
    head, partials = searcher.scorer, searcher.encode(touch).partials
    larger = dataclasses.replace(head, out=10_000 * head.out, out_bias=10_000 * head.out_bias)
    monkeypatch.setattr(searcher.shard, "scorer", larger)
    give_posterior(monkeypatch, searcher, Posterior(slope=100.0))
    result = searcher.query([touch])
    assert [match.probability for match in result.results[-2:]] == [0.0, 0.0]
    # With this slope an object's logit is that of its best photo, minus log 3 / 100 for each object.
    best, logits = {}, head.logits(partials, searcher.generation.arrays["partials"])
    for row, logit in zip(searcher.generation.rows, logits, strict=True):
        best[row.object_id] = max(float(logit), best.get(row.object_id, -math.inf))
    assert [match.object_id for match in result.results] == sorted(best, key=best.get, reverse=True)


@pytest.mark.parametrize(
    ("offset", "none_prior", "verdict"), [(50.0, 0.2, "match"), (-50.0, 0.2, "none of these"), (-50.0, 0.0, "match")]
)
def test_the_verdict_compares_the_best_with_none_of_these(offset, none_prior, verdict, searcher, touch, monkeypatch):
    give_posterior(monkeypatch, searcher, dataclasses.replace(searcher.posterior, offset=offset))
    result = searcher.query([touch], none_prior=none_prior)
    assert (result.verdict, result.none_probability == 0) == (verdict, none_prior == 0)
    assert len(result.results) == 8  # the nearest objects are listed anyway


def test_an_uncalibrated_model_gives_no_probability(searcher, touch, monkeypatch):
    give_posterior(monkeypatch, searcher, None)
    result = searcher.query([touch])
    assert result.verdict == "uncalibrated"
    assert {match.probability for match in result.results} == {None}
    assert (result.none_probability, result.posterior) == (None, None)


@pytest.mark.parametrize("count", [1, 3])
def test_the_number_of_gel_images_must_match_the_model(count, searcher, touch):
    files = (*touch, *touch)[:count]
    with pytest.raises(BadInput, match=rf"takes 2 gel image\(s\) for one touch; got {count}: .*a\.png"):
        searcher.query([touch, files])


@pytest.mark.parametrize("numbers", [{"top": 0}, {"top": 2.5}, {"candidates": -5}])
def test_top_and_candidates_must_be_whole_and_positive(numbers, searcher, touch):
    with pytest.raises(BadInput, match="top and candidates must be whole numbers of 1 or more"):
        searcher.query([touch], **numbers)


def test_the_first_bad_gel_image_is_reported_for_any_decoding_times(searcher, touch, tmp_path):
    a, b = touch
    cut, text, none = (tmp_path / f"{name}.png" for name in ("cut", "text", "none"))
    cut.write_bytes(b.read_bytes()[:400])
    text.write_text("not an image" * 1_000_000)
    for path, reason in ((none, "no such file"), (cut, "truncated"), (text, "not a PNG")):
        with pytest.raises(ImageError, match=rf"{path.name}: .*{reason}"):
            searcher.query([touch, (a, path), (none, b)])


@pytest.fixture(scope="module")
def subtracting(catalogue, model, tmp_path_factory):
    """A searcher whose model subtracts the no-contact frame."""
    folder = tmp_path_factory.mktemp("background")
    checkpoint = variant(model, folder / "difference.safetensors", preprocessing__background="difference")
    build_index(catalogue, checkpoint, folder / "index")
    return Searcher.open(folder / "index")


def test_the_background_is_subtracted_from_each_finger(subtracting, touch, tmp_path):
    """With itself as background every touch gives the same input."""
    frames = [Path(shutil.copy(path, tmp_path / path.name)) for path in touch]
    nothing = subtracting.query([touch], background=touch).results
    assert subtracting.query([frames], background=frames).results == nothing
    assert subtracting.query([touch], background=frames[::-1]).results != nothing


def test_a_model_that_uses_a_background_needs_one_for_each_finger(subtracting, searcher, touch):
    with pytest.raises(BadInput, match=r'background = "difference".* give a no-contact frame for each finger'):
        subtracting.query([touch])
    for count in (1, 3):
        with pytest.raises(BadInput, match=rf"2 gel image\(s\) for one background; got {count}"):
            subtracting.query([touch], background=(*touch, *touch)[:count])
    with pytest.raises(BadInput, match="would ignore --background"):
        searcher.query([touch], background=touch)


def test_another_model_than_the_indexs_raises(index, model, tmp_path):
    other = variant(model, tmp_path / "other.safetensors", training__seed=5)
    must = f"made with checkpoint '{load_checkpoint(model).digest[:12]}', but '{other.digest[:12]}' is required"
    with pytest.raises(MismatchedIndex, match=must):
        Searcher.open(index, model=other.path)


@pytest.fixture
def moved(catalogue, model, tmp_path):
    """An index whose model was moved: (index, new path of the model)."""
    here, there = tmp_path / "here.safetensors", tmp_path / "there.safetensors"
    shutil.copy(model, here)
    build_index(catalogue, load_checkpoint(here), tmp_path / "index")
    here.rename(there)
    return tmp_path / "index", there


def test_a_moved_model_must_be_given(moved, touch):
    index, there = moved
    with pytest.raises(CheckpointError, match=r"no longer at .*here\.safetensors; name it with --model"):
        Searcher.open(index)
    assert len(Searcher.open(index, model=there).query([touch]).results) == 8


@pytest.mark.parametrize("photos", [1, 2, 3, 7, 24, 29])
def test_equal_photos_give_the_same_logit_for_any_number_of_them(photos):
    """Their mean equals each of them; rounding in the last bit would put the later of two names first."""
    count = photos + 1
    rows = SimpleNamespace(
        objects=np.arange(count) // photos, object_count=2, originals=np.arange(count), find_object=int
    )
    header = SimpleNamespace(posterior=Posterior(slope=0.9), references=None, opening=None)
    objects = Objects(SimpleNamespace(rows=rows, documents={}), header, slice(0, 4))
    logits = np.full(count, 1.3, np.float32)
    evidence = objects.compare_references(np.zeros((1, 4), np.float32))
    many, one = objects.score(np.arange(count), logits, evidence, 1).logits
    assert many == one


@pytest.mark.parametrize("levels", [1, 3, 10_000])
@pytest.mark.parametrize("top", [1, 2, 7, 40, 1000])
def test_the_best_objects_equal_a_plain_sort(top, levels):
    """By logit, then by number, which is the order of names."""
    rng = np.random.default_rng(top + levels)
    numbers = np.sort(rng.choice(40, 30, replace=False))
    logits = rng.integers(0, levels, 30).astype(np.float64)
    scored = ScoredObjects(numbers, logits, numbers, logits)
    expected = sorted(range(30), key=lambda place: (-logits[place], numbers[place]))
    assert scored.best(top).tolist() == expected[:top]


def test_a_damaged_model_is_distinguished_from_another_one(moved):
    index, there = moved
    data = bytearray(there.read_bytes())
    data[-3] ^= 1
    there.write_bytes(data)
    with pytest.raises(CheckpointError, match="is damaged: its checksum does not match"):
        Searcher.open(index, model=there)
