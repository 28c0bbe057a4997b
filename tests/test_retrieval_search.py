"""From gel images to ranked objects, against two plain loops over the whole network."""

import copy
import dataclasses
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import expit

from indexes.errors import MismatchedIndex, NoIndex
from indexes.generation import Generation
from retrieval import defaults
from retrieval.build import build_index
from retrieval.checkpoint import load_checkpoint, save_checkpoint
from retrieval.encode import to_batch, touch_batch
from retrieval.errors import BadInput, CheckpointError, ImageError
from retrieval.search import Searcher
from tests import synthetic

HALF_STEP = 2**-11
"""Largest relative rounding of a float16 number."""


@pytest.fixture(scope="module")
def index(catalogue, model, tmp_path_factory):
    """The index over the catalogue: 24 photos of 8 objects. Not to be changed."""
    out = tmp_path_factory.mktemp("search") / "index"
    build_index(catalogue, load_checkpoint(model), out, quiet=True)
    return out


@pytest.fixture(scope="module")
def searcher(index):
    return Searcher.open(index)


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
    """One entry for each candidate search: how many photos it was asked for."""
    asked = []

    def counted(generation, queries, k):
        asked.append(k)
        return search(generation, queries, k)

    search = Generation.search
    monkeypatch.setattr(Generation, "search", counted)
    return asked


def variant(model, path, **changes):
    """The same weights under other settings, given as "part__name"."""
    checkpoint = load_checkpoint(model)
    config = checkpoint.config
    for key, value in changes.items():
        part, name = key.split("__")
        config = dataclasses.replace(config, **{part: dataclasses.replace(getattr(config, part), **{name: value})})
    provenance = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}
    calibration = checkpoint.calibration
    save_checkpoint(path, checkpoint.matcher, config, split=None, calibration=calibration, provenance=provenance)
    return load_checkpoint(path)


@pytest.fixture(scope="module")
def oracle(searcher, matcher, catalogue):
    """Touches -> {photo path: sum of match logits}: the full network on every touch with every photo, pair by pair."""
    pre = searcher.checkpoint.config.preprocessing
    photos = {path.relative_to(catalogue).as_posix(): pre.load_photo(path) for path in catalogue.rglob("*.jpg")}

    @cache
    @torch.inference_mode()
    def of_touch(touch):
        images = touch_batch([[pre.load_touch(file) for file in touch]])
        return {name: float(matcher(images, to_batch([photo]))) for name, photo in photos.items()}

    return lambda touches: {name: sum(of_touch(touch)[name] for touch in touches) for name in photos}


def best_by_object(logits):
    """[(object, photo, logit)] by two plain loops, best first; ties by object, then by photo."""
    best = {}
    for photo in sorted(logits):
        name = photo.split("/")[0]
        if name not in best or logits[photo] > logits[best[name]]:
            best[name] = photo
    return sorted(((name, photo, logits[photo]) for name, photo in best.items()), key=lambda item: (-item[2], item[0]))


def half_tolerance(searcher, grasps):
    """How far rounding the halves can move a logit: through |second| and |out|, as ReLU never enlarges a change."""
    moved = np.abs(np.asarray(searcher.generation.arrays["halves"], np.float32)).max(axis=0) * HALF_STEP
    return grasps * float(np.abs(searcher.judge.out) @ (np.abs(searcher.judge.second) @ moved)) + 1e-5


# The ranking ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3])
def test_the_ranking_is_that_of_the_full_network_on_every_pair(count, searcher, grasps, oracle):
    touches = grasps[:count]
    expected = oracle(touches)
    result = searcher.query(touches)
    tolerance = half_tolerance(searcher, count)
    assert tolerance < 0.01
    for match in result.results:
        assert match.logit == pytest.approx(expected[match.photo], abs=tolerance)
    ours = [(match.object_id, match.photo) for match in result.results]
    theirs = best_by_object(expected)
    assert len(ours) == len(theirs) == 8
    # Where logits differ by more than the rounding, the order is theirs; closer ones may change places.
    for (name, photo), (_, _, logit) in zip(ours, theirs, strict=True):
        assert photo.startswith(f"{name}/")
        assert expected[photo] == pytest.approx(logit, abs=2 * tolerance)


def test_with_exact_halves_the_order_is_exactly_the_oracles(searcher, matcher, grasps, oracle, catalogue, monkeypatch):
    """The rounding taken away, what is left is ranking: no tie, no tolerance."""
    expected = best_by_object(oracle(grasps[:1]))
    logits = np.array([logit for _, _, logit in expected])
    assert np.diff(-logits).min() > 1e-6  # the drawn pictures give no near ties
    checkpoint, rows = searcher.checkpoint, searcher.generation.rows
    photos = [checkpoint.config.preprocessing.load_photo(catalogue / row["path"]) for row in rows]
    with torch.inference_mode():
        images = torch.from_numpy(np.stack(photos)).permute(0, 3, 1, 2)
        halves = matcher.photo_code(matcher.photo_features(images)).half.numpy()
    monkeypatch.setitem(searcher.generation.arrays, "halves", halves)
    result = searcher.query(grasps[:1])
    assert [(match.object_id, match.photo) for match in result.results] == [item[:2] for item in expected]
    np.testing.assert_allclose([match.logit for match in result.results], logits, atol=1e-5)


def test_several_grasps_add_their_logits(searcher, grasps):
    """On one photo an object, the sum over grasps is the sum of the single answers."""
    generation = searcher.generation
    rows = np.array(
        [generation.row_number(f"{name}/1.jpg") for name in sorted({r["object_id"] for r in generation.rows})]
    )
    single = [scores(searcher, [grasp], rows) for grasp in grasps]
    np.testing.assert_allclose(scores(searcher, grasps, rows), np.sum(single, axis=0), atol=1e-6)
    assert np.ptp(single, axis=0).max() > 1e-4  # the grasps are told apart at all


def scores(searcher, touches, rows):
    found = {match.photo: match.logit for match in only(searcher, rows).query(touches).results}
    return [found[searcher.generation.rows[row]["path"]] for row in rows]


def only(searcher, rows):
    """A searcher that judges these rows and no others."""
    limited = copy.copy(searcher)
    limited._candidates = lambda embeddings, k: rows
    return limited


def test_the_order_of_the_grasps_does_not_matter(searcher, grasps):
    ways = [searcher.query(touches).results for touches in (grasps, grasps[::-1])]
    assert [m.object_id for m in ways[0]] == [m.object_id for m in ways[1]]
    np.testing.assert_allclose([m.logit for m in ways[0]], [m.logit for m in ways[1]], atol=1e-6)


def test_the_fingers_are_told_apart(searcher, touch):
    a, b = touch
    assert searcher.query([(a, b)]).results[0].logit != searcher.query([(b, a)]).results[0].logit


def test_equal_photos_of_two_objects_both_come_back_in_the_order_of_their_ids(catalogue, model, touch, tmp_path):
    own = tmp_path / "catalog"
    for name in ("zebra", "ant", "mule"):
        (own / name).mkdir(parents=True)
        shutil.copy(sorted(catalogue.rglob("*.jpg"))[0], own / name / "1.jpg")
    build_index(own, load_checkpoint(model), tmp_path / "index", quiet=True)
    searcher = Searcher.open(tmp_path / "index")
    for candidates in (None, 1):
        results = searcher.query([touch], top=3, candidates=candidates).results
        assert [match.object_id for match in results] == ["ant", "mule", "zebra"]
        assert len({match.logit for match in results}) == 1
        assert [match.rank for match in results] == [1, 2, 3]


def test_removed_photos_vanish_from_the_results(catalogue, model, touch, tmp_path):
    own, index = shutil.copytree(catalogue, tmp_path / "catalog"), tmp_path / "index"
    build_index(own, load_checkpoint(model), index, quiet=True)
    best = Searcher.open(index).query([touch]).results[0]
    shutil.rmtree(own / best.object_id)
    build_index(own, load_checkpoint(model), index, quiet=True)
    results = Searcher.open(index).query([touch]).results
    assert len(results) == 7
    assert best.object_id not in {match.object_id for match in results}


def test_new_metadata_shows_in_the_results(catalogue, model, touch, tmp_path):
    own, index = shutil.copytree(catalogue, tmp_path / "catalog"), tmp_path / "index"
    build_index(own, load_checkpoint(model), index, quiet=True)
    assert Searcher.open(index).query([touch]).results[0].metadata == {}
    name = next(own.iterdir()).name
    (own / "metadata.jsonl").write_text(f'{{"object_id": "{name}", "shelf": "B4"}}\n')
    build_index(own, load_checkpoint(model), index, quiet=True)
    results = Searcher.open(index).query([touch]).results
    assert {match.object_id for match in results if match.metadata == {"shelf": "B4"}} == {name}


def test_a_reader_keeps_the_index_it_opened(catalogue, model, touch, tmp_path):
    own, index = shutil.copytree(catalogue, tmp_path / "catalog"), tmp_path / "index"
    build_index(own, load_checkpoint(model), index, quiet=True)
    reader = Searcher.open(index)
    before = reader.query([touch]).results
    for path in sorted(own.iterdir())[:4]:
        shutil.rmtree(path)
        build_index(own, load_checkpoint(model), index, quiet=True)
    assert reader.query([touch]).results == before


@pytest.mark.parametrize("top", [1, 3, 8, 50])
def test_top_gives_the_first_of_the_ranking_and_never_more_than_there_are(top, searcher, touch):
    whole = searcher.query([touch], top=8).results
    assert searcher.query([touch], top=top).results == whole[:top]


def test_the_ranking_does_not_depend_on_the_number_of_threads(searcher, grasps):
    answers, threads = [], torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            answers.append({match.photo: match.logit for match in searcher.query(grasps).results})
    finally:
        torch.set_num_threads(threads)
    assert answers[0] == pytest.approx(answers[1], abs=1e-4)


# The candidate stage -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("candidates", [None, 24, 1000])
def test_no_candidate_stage_runs_where_it_would_leave_nothing_out(candidates, searcher, touch, searches):
    result = searcher.query([touch], candidates=candidates)
    assert searches == []
    assert result.index["scored"] == 24


@pytest.mark.parametrize("candidates", [1, 9, 23])
def test_one_candidate_stage_runs_where_it_leaves_something_out(candidates, searcher, grasps, searches):
    result = searcher.query(grasps, candidates=candidates, top=1)
    assert searches == [candidates]
    assert candidates <= result.index["scored"] <= 24


def test_the_classifier_judges_at_least_as_many_photos_as_objects_are_wanted(searcher, touch, searches):
    assert searcher.query([touch], candidates=2, top=5).index["scored"] >= 5
    assert searches == [5]


@torch.inference_mode()
def test_the_candidates_are_the_nearest_photos_of_each_grasp(searcher, matcher, grasps, oracle):
    """Two plain loops: the 5 best inner products of each grasp, then the full network on their union."""
    checkpoint, generation = searcher.checkpoint, searcher.generation
    load, near = checkpoint.config.preprocessing.load_touch, set()
    for grasp in grasps:
        touch = matcher.touch_features(touch_batch([[load(path) for path in grasp]]))
        products = generation.embeddings[generation.slots] @ matcher.touch_entry(touch).embedding[0].numpy()
        near |= {generation.rows[row]["path"] for row in np.argsort(-products)[:5]}
    logits = oracle(grasps)
    expected = best_by_object({photo: logits[photo] for photo in near})
    result = searcher.query(grasps, candidates=5, top=5)
    assert result.index["scored"] == len(near) < 24
    assert [match.object_id for match in result.results] == [name for name, _, _ in expected][:5]


def test_a_model_without_trained_embeddings_never_runs_a_candidate_stage(catalogue, model, touch, tmp_path, searches):
    checkpoint = variant(model, tmp_path / "paper.safetensors", training__contrastive_weight=0.0)
    build_index(catalogue, checkpoint, tmp_path / "index", quiet=True)
    result = Searcher.open(tmp_path / "index").query([touch], candidates=2, top=1)
    assert searches == []
    assert result.index["scored"] == 24


# Probability and verdict -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3])
def test_the_probability_is_the_calibrated_logit_and_follows_its_order(count, searcher, grasps):
    results = searcher.query(grasps[:count]).results
    fitted = searcher.calibration
    for match in results:
        expected = expit(fitted.slope * match.logit + count * fitted.intercept)
        assert match.probability == pytest.approx(expected, abs=1e-12)
    probabilities = [match.probability for match in results]
    assert probabilities == sorted(probabilities, reverse=True)


def test_objects_with_saturated_probabilities_are_still_ranked_by_logit(searcher, touch, monkeypatch):
    """float32 sigmoids of logits beyond 17 all equal 1: ranked by probability, they would be one tie."""
    plain, head = searcher.query([touch]).results, searcher.judge
    larger = dataclasses.replace(head, out=100 * head.out, out_bias=100 * head.out_bias + 100)
    monkeypatch.setattr(searcher, "judge", larger)
    large = searcher.query([touch]).results
    naive = torch.sigmoid(torch.tensor([match.logit for match in large]))
    assert len(set(naive.tolist())) == 1
    assert [match.object_id for match in large] == [match.object_id for match in plain]


@pytest.mark.parametrize(("threshold", "verdict"), [(-1e9, "match"), (1e9, "no match")])
def test_the_verdict_compares_the_best_with_the_reject_threshold(threshold, verdict, searcher, touch, monkeypatch):
    fitted = dataclasses.replace(searcher.calibration, reject_log_odds=threshold)
    monkeypatch.setattr(searcher, "calibration", fitted)
    result = searcher.query([touch])
    assert result.verdict == verdict
    assert len(result.results) == 8  # the nearest are shown all the same


def test_a_model_that_was_never_calibrated_gives_no_probability(searcher, touch, monkeypatch):
    monkeypatch.setattr(searcher, "calibration", None)
    result = searcher.query([touch])
    assert result.verdict == "uncalibrated"
    assert {match.probability for match in result.results} == {None}


def test_the_document_says_what_was_asked_of_what_and_how_long_it_took(searcher, grasps, index):
    document = searcher.query(grasps).to_dict()
    assert document["query"] == {"touches": [[str(path) for path in touch] for touch in grasps]}
    assert list(document["timing_ms"]) == ["decode", "encode", "candidates", "rerank", "total"]
    stages = list(document["timing_ms"].values())
    assert 0 < sum(stages[:-1]) <= stages[-1]
    about = document["index"]
    assert (about["path"], about["photos"], about["objects"], about["kind"]) == (str(index), 24, 8, "flat")
    assert "drawn test pictures" in about["trained_on"]


# Wrong use -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3])
def test_the_number_of_gel_images_must_be_the_models(count, searcher, touch):
    files = (*touch, *touch)[:count]
    with pytest.raises(BadInput, match=rf"takes 2 gel image\(s\) for one touch; got {count}: .*a\.png"):
        searcher.query([touch, files])


@pytest.mark.parametrize("numbers", [{"top": 0}, {"top": -1}, {"candidates": 0}, {"candidates": -5}])
def test_top_and_candidates_must_be_positive(numbers, searcher, touch):
    with pytest.raises(BadInput, match="top and candidates must be 1 or more"):
        searcher.query([touch], **numbers)


def test_at_least_one_touch_is_needed(searcher):
    with pytest.raises(BadInput, match="at least one touch"):
        searcher.query([])


def test_a_missing_a_truncated_and_a_textual_gel_image_are_named(searcher, touch, tmp_path):
    a, b = touch
    cut, text = tmp_path / "cut.png", tmp_path / "text.png"
    cut.write_bytes(b.read_bytes()[:400])
    text.write_text("this is no picture")
    for path, reason in ((tmp_path / "none.png", "no such file"), (cut, "truncated"), (text, "not a PNG")):
        with pytest.raises(ImageError, match=rf"{path.name}: .*{reason}"):
            searcher.query([(a, path)])


def test_of_several_bad_files_the_first_is_told_however_long_each_takes(searcher, touch, tmp_path):
    large = tmp_path / "large.png"
    large.write_text("no picture" * 1_000_000)
    with pytest.raises(ImageError, match=r"large\.png"):
        searcher.query([touch, (touch[0], large), (tmp_path / "none.png", touch[1])])


@pytest.fixture(scope="module")
def subtracting(catalogue, model, tmp_path_factory):
    """A searcher whose model takes the untouched gel off."""
    folder = tmp_path_factory.mktemp("background")
    checkpoint = variant(model, folder / "difference.safetensors", preprocessing__background="difference")
    build_index(catalogue, checkpoint, folder / "index", quiet=True)
    return Searcher.open(folder / "index")


def test_a_model_that_subtracts_the_background_asks_for_it(subtracting, touch):
    with pytest.raises(BadInput, match=r'background = "difference".* give a no-contact frame for each finger'):
        subtracting.query([touch])


def test_the_background_is_subtracted_from_each_finger(subtracting, touch, tmp_path):
    """The touch as its own background leaves nothing: every touch is then the same."""
    frames = [Path(shutil.copy(path, tmp_path / path.name)) for path in touch]
    nothing = subtracting.query([touch], background=touch).results
    assert subtracting.query([frames], background=frames).results == nothing
    assert subtracting.query([touch], background=frames[::-1]).results != nothing


@pytest.mark.parametrize("count", [1, 3])
def test_there_must_be_one_background_for_each_finger(count, subtracting, touch):
    with pytest.raises(BadInput, match=rf"2 gel image\(s\) for one background; got {count}"):
        subtracting.query([touch], background=(*touch, *touch)[:count])


def test_a_background_that_would_not_be_looked_at_is_refused(searcher, touch):
    with pytest.raises(BadInput, match="would not look at --background"):
        searcher.query([touch], background=touch)


# Index and model -------------------------------------------------------------------------------------------------


def test_no_index_is_a_clear_error(tmp_path):
    with pytest.raises(NoIndex, match="run `retrieve build-index` first"):
        Searcher.open(tmp_path)


def test_another_model_than_the_indexs_is_refused(index, model, tmp_path):
    other = variant(model, tmp_path / "other.safetensors", training__seed=5)
    with pytest.raises(MismatchedIndex, match="made with checkpoint"):
        Searcher.open(index, model=other.path)


@pytest.fixture
def moved(catalogue, model, tmp_path):
    """An index whose model was moved away: (index, where the model lies now)."""
    here, there = tmp_path / "here.safetensors", tmp_path / "there.safetensors"
    shutil.copy(model, here)
    build_index(catalogue, load_checkpoint(here), tmp_path / "index", quiet=True)
    here.rename(there)
    return tmp_path / "index", there


def test_a_model_that_was_moved_is_asked_for(moved, touch):
    index, there = moved
    with pytest.raises(CheckpointError, match=r"no longer at .*here\.safetensors; name it with --model"):
        Searcher.open(index)
    assert len(Searcher.open(index, model=there).query([touch]).results) == 8


def test_a_model_that_was_moved_is_found_where_it_is_the_default(moved):
    index, there = moved
    defaults.remember("model", there)
    assert Searcher.open(index).checkpoint.path == there


@pytest.mark.parametrize("default", ["none", "damaged"])
def test_a_moved_model_is_asked_for_whatever_the_default_is(default, moved, tmp_path, monkeypatch):
    index, there = moved
    monkeypatch.setattr(defaults, "shipped_model", lambda: tmp_path / "absent")
    if default == "damaged":
        there.write_bytes(there.read_bytes()[:100])
        defaults.remember("model", there)
    with pytest.raises(CheckpointError, match="name it with --model"):
        Searcher.open(index)


def test_a_model_trained_again_at_the_same_path_is_refused(moved, model):
    index, there = moved
    variant(model, there.with_name("here.safetensors"), training__seed=5)
    with pytest.raises(MismatchedIndex):
        Searcher.open(index)


# The best of each object -----------------------------------------------------------------------------------------


def by_two_loops(names, rows, logits, top):
    """[(row, logit)] of the best photo of each object, ties by the object's name, then by row."""
    best = {}
    for row, logit in zip(rows.tolist(), logits.tolist(), strict=True):
        if names[row] not in best or logit > best[names[row]][1]:
            best[names[row]] = (row, logit)
    ordered = sorted(best.items(), key=lambda item: (-item[1][1], item[0]))
    return [pair for _, pair in ordered[:top]]


@pytest.mark.parametrize("levels", [1, 3, 10_000])
@pytest.mark.parametrize("top", [1, 2, 7, 40, 1000])
def test_the_best_of_each_object_are_those_of_two_plain_loops(top, levels, searcher):
    rng = np.random.default_rng(top + levels)
    names = [f"object-{number}" for number in rng.integers(0, 40, 500)]
    made_up = copy.copy(searcher.objects)
    made_up._rows = [{"object_id": name} for name in names]
    seen = list(dict.fromkeys(names))
    made_up._of_row = np.array([seen.index(name) for name in names])
    rows = np.sort(rng.choice(500, 300, replace=False))
    logits = rng.integers(0, levels, 300).astype(np.float32)
    assert made_up.best(rows, logits, top) == by_two_loops(names, rows, logits, top)


def test_photos_of_equal_bytes_get_the_logit_of_the_first_of_them_among_the_judged(searcher):
    made_up = copy.copy(searcher.objects)
    made_up._original = np.array([0, 1, 0, 1, 4, 0, *range(6, 24)])
    rows, logits = np.array([2, 3, 4, 5]), np.array([0.25, 0.5, 0.75, 0.26], dtype=np.float32)
    assert made_up.equal_for_equals(rows, logits).tolist() == [0.25, 0.5, 0.75, 0.25]


@pytest.mark.parametrize(
    ("measured", "expected"), [({"k": 5, "winner_recall": 0.99}, [5]), (None, []), ({"k": 24}, [])]
)
def test_the_index_says_how_many_candidates_are_judged_unless_the_query_does(
    measured, expected, searcher, touch, searches, monkeypatch
):
    about = searcher.generation.manifest.about
    monkeypatch.setitem(about, "candidates", measured)
    searcher.query([touch], top=2)
    assert searches == expected
    searcher.query([touch], top=2, candidates=9)
    assert searches == [*expected, 9]


def test_a_damaged_model_is_told_from_another_one(moved):
    index, there = moved
    data = bytearray(there.read_bytes())
    data[-3] ^= 1
    there.write_bytes(data)
    with pytest.raises(CheckpointError, match="is damaged: its checksum does not fit"):
        Searcher.open(index, model=there)
