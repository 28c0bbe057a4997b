"""Adaptation to a new sensor: linear maps, cross-validation over objects, and an ordinary checkpoint."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import retrieval
from retrieval.commands.main import main
from retrieval.commands.options import training_config
from retrieval.data.dataset import Split, load_grasps
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.config import load_config
from retrieval.model.fusion import Matcher
from retrieval.model.towers.tower import build_tower
from retrieval.report.adaptation import print_adaptation
from retrieval.training import adapt as adaptation
from retrieval.training import cca_towers
from retrieval.training.adapt import Estimate, accuracies, adapt, config_for, draw_folds, fit_folds, load_towers
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.calibration.verification import fit_verification, verification_sequences
from retrieval.training.cca_towers import GRID, CcaSettings, TowerWidths, fit_projections, select_settings
from retrieval.training.features import Features
from retrieval.training.initial_weights import build_matcher
from tests.verification import calibration


@pytest.fixture
def unchecked(monkeypatch):
    """Skip the gel check, whose 700 foreign images take most of the time."""
    monkeypatch.setattr("retrieval.training.adapt.with_gel_check", lambda made, *_, **__: made)


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


def top1_accuracy(projections, touch, photo, owner):
    best = owner[projections.cosines(touch, photo).argmax(1)]
    return float((best == owner).mean())


def test_codes_distinguish_unseen_objects():
    touch, photo, owner = correlated_features()
    other = correlated_features(seed=1)
    projections = fit_projections(as_features(touch, photo, owner), TowerWidths([12], [10]))
    assert set(projections) == set(GRID)
    assert all(top1_accuracy(found, *other) > 0.9 for found in projections.values())  # chance 1 / 30
    permuted = np.random.default_rng(2).permutation(30)[owner]  # photos of other objects
    control = fit_projections(
        as_features(touch, photo[np.argsort(permuted, kind="stable")], owner), TowerWidths([12], [10])
    )
    assert all(top1_accuracy(found, *other) < 0.2 for found in control.values())


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
    grasps = [
        dataclasses.replace(grasp, sequence_id="one session" if grasp.object_id in twins else None) for grasp in grasps
    ]
    for seed in range(5):
        folds = draw_folds(grasps, seed)
        assert sorted(name for fold in folds for name in fold) == names
        assert any(twins <= set(fold) for fold in folds)
        assert min(map(len, folds)) >= 3
    few = [grasp for grasp in grasps if grasp.object_id in names[:5]]
    with pytest.raises(BadInput, match=r"at least 6 objects, got 5\. Record more"):
        draw_folds(few, 0)


def with_noise(features, names, seed):
    """Return the features with those of `names` replaced by noise."""
    rng, rows = np.random.default_rng(seed), np.isin(features.object_ids, names)
    touch, photo = features.touch.copy(), features.photo.copy()
    touch[rows], photo[rows] = (rng.standard_normal(part[rows].shape) for part in (touch, photo))
    return dataclasses.replace(features, touch=touch, photo=photo)


def test_a_held_out_fold_affects_neither_settings_nor_fit(monkeypatch):
    touch, photo, owner = correlated_features(objects=24)
    features = as_features(touch, photo, owner)
    names = features.object_ids
    data = SimpleNamespace(grasps=[], kind_of={}, widths=TowerWidths([12], [10]), config=load_config("adapt"))
    drawn = [names[start : start + 8 * 6 : 6] for start in range(0, len(names), 8 * 6)]
    calls = []
    monkeypatch.setattr(adaptation, "select_settings", lambda *args: calls.append(args) or select_settings(*args))

    def fit(inputs):
        return list(fit_folds(inputs, drawn, data, "fit", quiet=True))

    fit(features)
    for fold, (fitted, _, inner) in zip(drawn, calls, strict=False):
        assert not set(fold) & {*fitted.object_ids, *(name for part in inner for name in part)}
    first = fit(features)[0]
    noise, other = (fit(with_noise(features, drawn[0], seed))[0] for seed in range(2))
    for found in (noise, other):
        assert found.settings == first.settings
        np.testing.assert_array_equal(found.projections.touch.weight, first.projections.touch.weight)
    # Noise in fitted objects does change the fit.
    changed = fit(with_noise(features, drawn[1], 0))[0]
    assert not np.array_equal(changed.projections.touch.weight, first.projections.touch.weight)


def test_a_setting_that_is_best_only_on_the_held_out_fold_is_not_selected(monkeypatch):
    """Planted: one setting is perfect on the objects of one fold and useless on all others."""
    touch, photo, owner = correlated_features(objects=24)
    features = as_features(touch, photo, owner)
    names = features.object_ids
    data = SimpleNamespace(grasps=[], kind_of={}, widths=TowerWidths([12], [10]), config=load_config("adapt"))
    drawn = [names[start : start + 8 * 6 : 6] for start in range(0, len(names), 8 * 6)]
    planted, plain = GRID[0], GRID[-1]
    current = []
    fit = cca_towers._Reduced.fit
    monkeypatch.setattr(cca_towers._Reduced, "fit", lambda *args: (current.append(one[0]) or one for one in fit(*args)))
    held_out = []
    monkeypatch.setattr(
        cca_towers,
        "ranking_auc",
        lambda *_: float(current[-1] == planted if held_out[-1] <= set(drawn[0]) else current[-1] == plain),
    )
    rows = cca_towers.validation_rows
    monkeypatch.setattr(
        cca_towers, "validation_rows", lambda part, count: held_out.append(set(part.object_ids)) or rows(part, count)
    )
    found = list(fit_folds(features, drawn, data, "fit", quiet=True))
    assert found[0].settings == plain
    # With the fold itself the planted setting is selected.
    assert select_settings(features, TowerWidths([12], [10]), drawn[:1]).settings == planted


def test_accuracy_of_hand_made_scores():
    features = Features(
        tuple("1234"), ("a", "b", "c", "a"), np.zeros((4, 1, 1), np.float32), np.zeros((4, 1), np.float32)
    )
    # The own photo of a touch of a is that of the other grasp: photo 4 for touch 1, photo 1 for touch 4.
    scores = np.array([[9, 2, 3, 4], [5, 5, 1, 5], [0, 1, 2, 3], [2, 2, 1, 9]], np.float32)
    top1, pairs = accuracies([scores], [features]).values()
    assert top1.gallery == "3 held-out objects, one photo of each"
    (unclear,) = set(top1.values[top1.owner == 2].flatten())
    assert (top1.owner.tolist(), top1.values.flatten().tolist()) == ([0, 0, 1, 2], [1.0, 0.5, 0.5, unclear])
    assert pairs.values.flatten().tolist()[::2] == [1.0, 0.75]
    assert (top1.chance.tolist(), pairs.chance.tolist()) == ([pytest.approx(1 / 3)], [0.5])


def test_the_preset_builds_the_same_towers_as_adapt_with_the_shipped_model(published):
    preset = training_config("adapt", None, init=str(published))
    preset = dataclasses.replace(preset, matcher=dataclasses.replace(preset.matcher, fingers=1))
    start = load_checkpoint(retrieval.shipped_model(1))
    expected = Matcher(config_for(start, 1, str(published)).matcher, 2)
    load_towers(expected, start, str(published))
    made = build_matcher(preset)
    for side in ("touch_tower", "photo_tower"):
        for name, tensor in getattr(expected, side).state_dict().items():
            assert torch.equal(getattr(made, side).state_dict()[name], tensor), name
    training = preset.without_paths()["training"]
    assert (training["init"], training["init_touch"]) == (published.name, "shipped+gel+init")


def test_touches_are_encoded_by_the_shipped_the_gel_and_the_published_tower_and_photos_by_the_last(published):
    start = load_checkpoint(retrieval.shipped_model(1))
    matcher = Matcher(config_for(start, 1, str(published)).matcher)
    load_towers(matcher, start, str(published))
    gel, added = build_tower("mobilenet_v2", "stages"), build_tower("mobilenet_v2", "stages")
    gel.initialise("gel")
    added.initialise(str(published))
    images, pooled = torch.rand(2, 3, 64, 64), start.matcher.touch_tower.feature_count
    with torch.inference_mode():
        shipped = start.matcher.touch_tower.eval()(images)[:, :pooled]  # without cells
        parts = [gel.eval()(images), added.eval()(images)]
        assert torch.allclose(matcher.touch_tower.eval()(images), torch.cat([shipped, *parts], 1), atol=1e-5)
        assert torch.allclose(matcher.photo_tower.eval()(images), parts[1], atol=1e-5)


@pytest.mark.slow
def test_the_adapted_checkpoint_is_an_ordinary_checkpoint(recording, model, catalogue, touch, tmp_path, monkeypatch):
    monkeypatch.setattr(Estimate, "is_baseline_better", False)
    out = tmp_path / "own.safetensors"
    features = adapt(recording, out, load_checkpoint(model), init="none", quiet=True).features
    made = load_checkpoint(out)
    assert set(made.split.train) == {grasp.object_id for grasp in load_grasps(recording)}
    assert made.posterior is not None
    # The logit is only the scaled cosine of the projections.
    matcher = made.matcher
    with torch.inference_mode():
        touch_codes = matcher.touch_encoding(torch.from_numpy(features.touch).flatten(1))
        photo_codes = matcher.photo_encoding(torch.from_numpy(features.photo))
        logits = matcher.head(touch_codes.partial, photo_codes.partial)
        cosines = (touch_codes.embedding * photo_codes.embedding).sum(1)
    assert torch.allclose(logits, matcher.cosine_scale.item() * cosines + matcher.head.out.bias.item(), atol=1e-4)
    assert matcher.cosine_scale > 0
    retrieval.build_index(catalogue, made, tmp_path / "index", quiet=True)
    answer = retrieval.open(tmp_path / "index", model=out).query([touch])
    assert 0 <= answer.none_probability <= 1


def test_thresholds_of_verifications_come_from_objects_outside_the_fit():
    """A fit separates its own objects too well, so thresholds from them would accept other objects too often."""
    touch, photo, owner = correlated_features(objects=60)
    features = as_features(touch, photo, owner)
    objects = sorted(set(features.object_ids))
    choice = select_settings(features, TowerWidths((12,), (10,)), [objects[::2], objects[1::2]])
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


@pytest.mark.usefixtures("unchecked")
def test_the_calibrations_of_a_fit_are_fitted_on_held_out_touches(recording, model, tmp_path, monkeypatch):
    monkeypatch.setattr(Estimate, "is_baseline_better", False)
    given = []
    monkeypatch.setattr("retrieval.training.adapt.fit_verification", lambda parts, posterior: given.extend(parts))
    made = adapt(recording, tmp_path / "own.safetensors", load_checkpoint(model), init="none", quiet=True)
    held_out = made.estimate.choice.held_out_touches
    assert len(given) == len(held_out) > 1
    scale, offset = made.checkpoint.matcher.cosine_scale.item(), made.checkpoint.matcher.head.out.bias.item()
    for part, expected in zip(given, held_out, strict=True):
        np.testing.assert_allclose(part.logits, scale * expected.logits + offset, rtol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_a_better_baseline_is_stored_with_fitted_probabilities(recording, model, tmp_path, monkeypatch, capsys):
    start = dataclasses.replace(load_checkpoint(model), verification=calibration(accept=1.0, reject=-1.0))
    estimate = adapt(recording, tmp_path / "own.safetensors", start, init="none", quiet=True).estimate
    assert estimate.is_baseline_better == (
        estimate.to_dict()["baseline_pair_accuracy"] >= estimate.to_dict()["held_out_pair_accuracy"]
    )
    monkeypatch.setattr(Estimate, "is_baseline_better", True)
    print_adaptation(adapt(recording, tmp_path / "own.safetensors", start, init="none", quiet=True))
    made = load_checkpoint(tmp_path / "own.safetensors")
    assert "unadapted model is used" in capsys.readouterr().out
    assert made.config == start.config
    for name, tensor in start.matcher.state_dict().items():
        assert torch.equal(tensor, made.matcher.state_dict()[name])
    assert made.posterior != start.posterior
    # Those of the start model are for its posterior; 12 objects are too few for new ones
    assert made.verification is None
    assert set(made.provenance["adapted_to"]) == {"source", "data_digest"}
    monkeypatch.undo()
    best = {
        name: dataclasses.replace(each, values=np.ones_like(each.values)) for name, each in estimate.measures.items()
    }
    assert dataclasses.replace(estimate, measures=best).is_baseline_better
    for name in ("baseline_top1", "baseline_pair_accuracy"):  # of a model for another number of fingers
        del best[name]
    assert not dataclasses.replace(estimate, measures=best, baseline=None).is_baseline_better


@pytest.mark.usefixtures("unchecked")
def test_test_objects_of_a_split_are_left_out_of_everything(recording, model, tmp_path, monkeypatch):
    monkeypatch.setattr(Estimate, "is_baseline_better", False)
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    split = Split(0, tuple(names[3:]), (), tuple(names[:3]))
    out = tmp_path / "own.safetensors"
    made = adapt(recording, out, load_checkpoint(model), init="none", split=split, quiet=True)
    assert set(made.features.object_ids) == set(names[3:])
    assert set(load_checkpoint(tmp_path / "own.safetensors").split.train) == set(names[3:])


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Random weights in place of those of a published tower."""
    path = tmp_path_factory.mktemp("weights") / "mobilenet_v2.pth"
    torch.manual_seed(0)
    torch.save(build_tower("mobilenet_v2", "pooled").state_dict(), path)
    return path


def test_initial_weights_are_for_all_towers_or_for_each(published):
    two = build_tower("mobilenet_v2+small", "pooled")
    two.initialise(f"{published}+random")
    assert torch.equal(
        two.parts[0].features[0][0].weight, torch.load(published, weights_only=True)["features.0.0.weight"]
    )
    with pytest.raises(CheckpointError, match="2 concatenated towers need initial weights each"):
        two.initialise("random+random+random")


@pytest.mark.usefixtures("unchecked")
def test_the_command_prints_the_estimate(recording, model, tmp_path, capsys):
    out = tmp_path / "own.safetensors"
    assert main(["adapt", str(recording), "--out", str(out), "--model", str(model), "--init", "none"]) == 0
    output = capsys.readouterr()
    for part in ("top-1 accuracy", "low-pass touches", "pair accuracy", "Each object was held out once"):
        assert part in output.out
    assert "fitted to 12 objects, 36 touches" in output.err
