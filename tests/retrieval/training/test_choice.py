"""The choice of a recipe: folds, fits without them, an honest accuracy, and an ordinary checkpoint of each recipe."""

import dataclasses

import numpy as np
import pytest
import torch

import retrieval
from retrieval.commands.main import main
from retrieval.data.camera import USUAL_CAMERA
from retrieval.data.dataset import (
    LICENCES,
    DataLicence,
    Split,
    linked_objects,
    load_grasps,
    recording_licence,
    stored_licences,
)
from retrieval.errors import BadInput, CheckpointError
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.fusion import GelHead, Matcher
from retrieval.model.gel_check import GelCheck
from retrieval.model.towers.tower import build_tower
from retrieval.training import choice
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.calibration.verification import fit_verification, verification_sequences
from retrieval.training.cca import GRID, CcaSettings, TowerWidths, fit_projections, select_settings
from retrieval.training.choice import HeldOut
from retrieval.training.features import Features
from retrieval.training.initial_weights import build_matcher
from retrieval.training.linear import _log_odds, linear_config
from retrieval.training.recipes.recipe import Problem, Start
from retrieval.training.selection import COMPARED, draw_folds
from tests.verification import calibration


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "mobilenet_v2.pth"
    torch.manual_seed(0)
    torch.save(build_tower("mobilenet_v2", "pooled").state_dict(), path)
    return path


def correlated_features(objects=30, grasps=6, seed=0):
    """Return noisy features of touches (n, 12) and photos (n, 10) with five common factors of their object, and the
    owner (n,) of each grasp."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    shared = rng.standard_normal((objects, 5))[owner]
    mixes = np.random.default_rng(99).standard_normal((2, 5, 12))
    touch, photo = (shared @ mix + 0.3 * rng.standard_normal((len(owner), 12)) for mix in mixes)
    return touch.astype(np.float32), photo[:, :10].astype(np.float32), owner


def as_features(touch, photo, owner):
    names = tuple(f"object-{number:02}" for number in owner)
    return Features(tuple(map(str, range(len(names)))), names, touch[:, None], photo)


def test_encodings_distinguish_unseen_objects_unless_the_photos_are_of_other_objects():
    touch, photo, owner = correlated_features()
    new_touch, new_photo, new_owner = correlated_features(seed=1)
    permuted = np.argsort(np.random.default_rng(2).permutation(30)[owner], kind="stable")
    for photos, low, high in ((photo, 0.9, 1.0), (photo[permuted], 0.0, 0.2)):  # chance 1 / 30
        fits = fit_projections(as_features(touch, photos, owner), TowerWidths([12], [10]), GRID[::7])
        assert set(fits) == set(GRID[::7])
        for found in fits.values():
            best = new_owner[found.cosines(new_touch, new_photo).argmax(1)]
            assert low <= (best == new_owner).mean() <= high


def test_combined_towers_have_equal_weight_at_any_scale():
    touch, photo, owner = correlated_features()
    scaled = touch * np.where(np.arange(12) < 4, 1000, 1).astype(np.float32)
    plain, rescaled = (
        fit_projections(as_features(x, photo, owner), TowerWidths([4, 8], [10]))[CcaSettings()] for x in (touch, scaled)
    )
    assert np.allclose(plain.cosines(touch, photo), rescaled.cosines(scaled, photo), atol=1e-4)


def test_every_object_is_held_out_once_and_objects_of_one_sequence_together(recording):
    grasps = load_grasps(recording)
    names = sorted({grasp.object_id for grasp in grasps})
    twins = {names[0], names[7]}
    linked = [dataclasses.replace(grasp, sequence_id="one" if grasp.object_id in twins else None) for grasp in grasps]
    folds = draw_folds(linked_objects(linked))
    assert sorted(name for fold in folds for name in fold) == names
    assert any(twins <= set(fold) for fold in folds)
    assert min(map(len, folds)) >= 3
    with pytest.raises(BadInput, match=r"at least 6 objects, got 5\. Record more"):
        draw_folds([[name] for name in names[:5]])
    with pytest.raises(BadInput, match="7 of 8 share one"):
        draw_folds([names[:7], names[7:8]])


def held_out(logits, touch_owner, photo_owner, own, names):
    scored = ScoredTouches(np.array(logits, float), np.array(touch_owner), np.array(photo_owner), np.array(own, bool))
    return HeldOut(scored, tuple(names), tuple(f"grasp-{row}" for row in range(len(logits))))


def test_accuracy_of_hand_made_scores():
    """The photo of a touch's own grasp is not drawn; two equal photos share a rank; no other photo, no query."""
    own = np.eye(4)
    # The other photo of a is photo 4 for touch 1, and photo 1 for touch 4. Touch 2 is the only grasp of b.
    logits = [[9, 2, 3, 4], [5, 5, 1, 5], [0, 1, 2, 3], [3, 2, 3, 9]]
    found = choice.identification([held_out(logits, [0, 1, 2, 0], [0, 1, 2, 0], own, "abc")])
    assert (found.owner.tolist(), found.values.ravel().tolist()) == ([0, 0], [1.0, 0.5])
    assert found.chance.tolist() == [pytest.approx(1 / 3)]
    with pytest.raises(BadInput, match="at least two grasps of each object"):
        choice.identification([held_out(np.eye(2), [0, 1], [0, 1], np.eye(2), "ab")])


def test_the_accuracy_of_the_choice_is_nested():
    """For the objects of each fold, the recipe is chosen by the other folds, so it may be worse than both."""
    first, second = (
        Measure(np.array(values)[:, None], np.arange(4), np.array([0.5]), "") for values in ([1, 1, 0, 0], [0, 0, 1, 1])
    )
    groups = choice._groups([["a", "b"], ["c", "d"]])
    table = choice._table({"first": first, "second": second}, first, groups, across_sessions=False)
    assert table["rows"][choice.CHOSEN][0] == 0
    assert table["rows"]["second"][0] == 0.5
    assert choice._groups([["a", "b", "c", "d"]]).tolist() == [0, 1, 0, 1]


def test_touches_are_encoded_by_the_gel_and_the_published_tower_and_photos_by_the_published(published):
    matcher = build_matcher(linear_config(1, str(published))).eval()
    gel, added = build_tower("mobilenet_v2", "stages"), build_tower("mobilenet_v2", "stages")
    gel.initialise("gel")
    added.initialise(str(published))
    images = torch.rand(2, 3, 64, 64)
    with torch.inference_mode():
        parts = [gel.eval()(images), added.eval()(images)]
        assert torch.allclose(matcher.touch_tower(images), torch.cat(parts, 1), atol=1e-5)
        assert torch.allclose(matcher.photo_tower(images), parts[1], atol=1e-5)


def test_initial_weights_are_for_all_towers_or_for_each(published):
    two = build_tower("mobilenet_v2+small", "pooled")
    two.initialise(f"{published}+random")
    expected = torch.load(published, weights_only=True)["features.0.0.weight"]
    assert torch.equal(two.parts[0].features[0][0].weight, expected)
    with pytest.raises(CheckpointError, match="2 concatenated towers need initial weights each"):
        two.initialise("random+random+random")


def test_thresholds_of_verifications_come_from_objects_outside_the_fit():
    """A fit separates its own objects too well, so thresholds from them would accept other objects too often."""
    touch, photo, owner = correlated_features(objects=60)
    features = as_features(touch, photo, owner)
    objects = sorted(set(features.object_ids))
    choice = select_settings(features, TowerWidths((12,), (10,)), [objects[::2], objects[1::2]], GRID[::5])
    posterior = fit_posterior(*choice.held_out_touches)
    found = fit_verification(choice.held_out_touches, posterior)
    assert found.group_sizes == (30, 30)

    def scored(touch, photo, owner):
        cosines = choice.projections.cosines(touch, photo)
        own, photos = np.eye(len(owner), dtype=bool), choice.projections.photo(photo)
        return ScoredTouches(cosines, owner, owner, own, photos, photos)

    unseen = scored(*correlated_features(objects=80, seed=1))
    ratios = verification_sequences(unseen, posterior).impostor
    fitted = fit_verification([scored(touch, photo, owner)], posterior)
    assert (ratios >= found.bounds(0.05).accept).mean() == pytest.approx(0.05, abs=0.015)
    assert (ratios >= fitted.bounds(0.05).accept).mean() > 0.065


def scored(true, false):
    """Return two touches with photos of their two objects: `true` cosines with photos of one's own, `false` others."""
    cosines = np.block([[np.array(true), np.array(false)], [np.array(false), np.array(true)]])
    return ScoredTouches(cosines, np.arange(2), np.repeat([0, 1], len(true)), np.zeros(cosines.shape, bool))


def test_the_log_odds_of_a_cosine_are_those_of_the_pairs_that_have_it():
    """At 0.6 three of four pairs are true, at -0.4 one of four: log-odds of log 3 and -log 3."""
    scale, offset = _log_odds([scored([0.6, 0.6, 0.6, -0.4], [0.6, -0.4, -0.4, -0.4])])
    assert scale * 0.6 + offset == pytest.approx(np.log(3), rel=0.01)
    assert scale * -0.4 + offset == pytest.approx(-np.log(3), rel=0.01)


def test_cosines_that_separate_the_pairs_have_a_finite_scale_and_offset():
    scale, offset = _log_odds([scored([0.7] * 20, [0.5] * 20)])
    assert 0 < scale < 200
    assert scale * 0.6 + offset == pytest.approx(0, abs=1e-3)


def test_cosines_without_information_or_with_wrong_information_have_a_small_positive_scale():
    for part in (scored([0.5] * 4, [0.5] * 4), scored([0.5] * 4, [0.7] * 4)):
        scale, offset = _log_odds([part])
        assert 0 < scale < 0.1
        assert abs(offset) < 0.1


def test_log_odds_without_another_photo_of_any_object_are_refused():
    alone = ScoredTouches(np.eye(3), np.arange(3), np.arange(3), np.eye(3, dtype=bool))
    with pytest.raises(BadInput, match="at least two grasps of each object"):
        _log_odds([alone])


# The checkpoint ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def start(model, tmp_path_factory):
    """A start model with calibrations and a gel check of another sensor, which refuses every touch."""
    found, path = load_checkpoint(model), tmp_path_factory.mktemp("start") / "start.safetensors"
    provenance = found.provenance | {LICENCES: [dataclasses.asdict(DataLicence("another"))]}
    check = GelCheck(-1e6, None, None, {})
    found.matcher.gel_head = GelHead(found.matcher.touch_tower.feature_count)
    verification = calibration(accept=1.0, reject=-1.0)
    split = Split(0, ("an object of another recording",), (), ())
    changed = dataclasses.replace(found, verification=verification, gel_check=check, provenance=provenance, split=split)
    store_checkpoint(changed, path)
    return load_checkpoint(path)


@pytest.fixture(scope="module")
def made(recording, start, tmp_path_factory):
    """A model of each recipe that left three test objects out, and the other objects."""
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    split = Split(0, tuple(names[3:]), (), tuple(names[:3]))
    folder = tmp_path_factory.mktemp("made")
    options = {"model": start, "init": "random", "split": split}
    models = {
        recipe: retrieval.train(recording, folder / f"{recipe}.safetensors", recipe=recipe, **options)
        for recipe in ("start", "linear", "head")
    }
    assert not list(folder.glob("*.parts"))
    return models, set(names[3:])


def test_each_recipe_makes_an_ordinary_checkpoint_without_test_objects(
    made, recording, start, catalogue, touch, tmp_path
):
    models, known = made
    for recipe, model in models.items():
        assert model.provenance["recipe"] == recipe
        assert list(model.provenance[COMPARED]["rows"]) == [recipe, "chosen recipe", "low-pass control"]
        assert model.provenance[COMPARED]["objects"] == len(known)
        licences = stored_licences(model.provenance)
        assert recording_licence(recording) in licences
        assert (DataLicence("another") in licences) == (recipe != "linear")  # which does not use the start model
        # Calibrations of the start model are for its posterior and its sensor; nine objects are too few for new ones.
        assert model.posterior not in (None, start.posterior)
        assert (model.verification, model.gel_check) == (None, None)
        assert recipe == "start" or {*model.split.train, *model.split.validation} == known
        retrieval.build_index(catalogue, model, tmp_path / recipe)
        answer = retrieval.open(tmp_path / recipe, model=model.path).query([touch])
        assert 0 <= answer.none_probability <= 1
    assert start.matcher.gel_head is not None  # the caller's model is not changed
    weights = models["start"].matcher.state_dict()
    assert models["start"].config == start.config
    assert all(torch.equal(tensor, start.matcher.state_dict()[name]) for name, tensor in weights.items())


def test_the_logit_of_the_linear_fit_is_only_the_scaled_cosine_of_the_projections(made):
    matcher = made[0]["linear"].matcher
    with torch.inference_mode():
        touch = matcher.touch_encoding(torch.randn(5, matcher.config.fingers * matcher.touch_tower.output_count))
        photo = matcher.photo_encoding(torch.randn(5, matcher.pooled_counts[1]))
        logits = matcher.head(touch.partial, photo.partial)
    cosines = (touch.embedding * photo.embedding).sum(1)
    assert torch.allclose(logits, matcher.cosine_scale.item() * cosines + matcher.head.out.bias.item(), atol=1e-4)
    assert matcher.cosine_scale > 0


def test_the_command_compares_the_recipes_and_says_which_it_took(recording, start, tmp_path, capsys):
    out = tmp_path / "own.safetensors"
    command = ["train", str(recording), "--out", str(out), "--model", str(start.path), "--init", "random"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    for row in ("start", "linear", "head", "chosen recipe", "low-pass control"):
        assert f"\n{row}  " in printed
    recipe = load_checkpoint(out).provenance["recipe"]
    assert f"made by the recipe {recipe}: of those compared, it identifies the most touches" in printed
    assert main([*command, "--config", "tiny"]) == 2
    assert "--model does not apply with --config" in capsys.readouterr().err


def test_queries_of_a_recording_with_sessions_are_compared_with_photos_of_another_session(recording, start, tmp_path):
    grasps = [
        dataclasses.replace(grasp, session="friday" if number % 2 else "monday")
        for number, grasp in enumerate(load_grasps(recording))
    ]
    names = sorted({grasp.object_id for grasp in grasps})
    problem = Problem(grasps, USUAL_CAMERA, start.config.matcher.fingers, start, "random", {}, [], tmp_path)
    (part,) = choice.Comparison(problem, [names]).held_out("start", Start(problem))
    sessions = np.array([grasp.session for name in names for grasp in grasps if grasp.object_id == name])
    assert np.array_equal(part.touches.own, sessions[:, None] == sessions)


def test_a_start_model_that_knows_the_objects_is_not_tested_with_them(recording, start, tmp_path, capsys):
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    knowing = dataclasses.replace(start, split=Split(0, tuple(names[:-2]), (), ()))
    out = tmp_path / "own.safetensors"
    made = retrieval.train(recording, out, model=knowing, init="random")
    assert made.provenance["recipe"] == "linear"
    assert "The start model was trained on these objects" in capsys.readouterr().err
    with pytest.raises(BadInput, match="Recipe head does not apply: the start model was trained on these objects"):
        retrieval.train(recording, out, model=knowing, recipe="head", init="random")


def test_too_few_objects_or_grasps_are_refused_before_any_work(recording, tmp_path):
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    with pytest.raises(BadInput, match=r"at least 8 objects with two grasps each, got 5 objects.*Record more"):
        retrieval.train(recording, tmp_path / "own.safetensors", split=Split(0, tuple(names[:5]), (), tuple(names[5:])))
    assert not list(tmp_path.iterdir())


def test_a_recipe_of_another_number_of_fingers_is_refused_by_name(recording, start, tmp_path):
    config = dataclasses.replace(start.config, matcher=dataclasses.replace(start.config.matcher, fingers=1))
    other = dataclasses.replace(start, config=config, matcher=Matcher(config.matcher))
    with pytest.raises(BadInput, match="Recipe head does not apply: the start model takes 1 gel image"):
        retrieval.train(recording, tmp_path / "own.safetensors", model=other, recipe="head", init="random")
