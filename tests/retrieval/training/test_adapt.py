"""Adaptation to a new sensor: linear maps, cross-validation over objects, and an ordinary checkpoint."""

import dataclasses

import numpy as np
import pytest
import torch

import retrieval
from retrieval.commands.main import main
from retrieval.commands.options import training_config
from retrieval.data.dataset import LICENCES, DataLicence, Split, load_grasps, recording_licence, stored_licences
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.fusion import GelHead, Matcher
from retrieval.model.gel_check import GelCheck
from retrieval.model.towers.tower import build_tower
from retrieval.training.adapt import accuracies, adapt, combined_matcher, draw_folds, fit_folds
from retrieval.training.calibration import ScoredTouches, fit_posterior, fit_verification, verification_sequences
from retrieval.training.cca import GRID, CcaSettings, TowerWidths, fit_projections, select_settings
from retrieval.training.features import Features
from retrieval.training.initial_weights import build_matcher
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
    for seed in range(5):
        folds = draw_folds(linked, seed)
        assert sorted(name for fold in folds for name in fold) == names
        assert any(twins <= set(fold) for fold in folds)
        assert min(map(len, folds)) >= 3
    with pytest.raises(BadInput, match=r"at least 6 objects, got 5\. Record more"):
        draw_folds([grasp for grasp in grasps if grasp.object_id in names[:5]], 0)


def test_a_held_out_fold_affects_neither_settings_nor_fit():
    """The features of its objects are replaced by noise, which would change every fit to them."""
    features = as_features(*correlated_features(objects=24))
    names = sorted(set(features.object_ids))
    folds = [names[:8], names[8:16], names[16:]]
    rng, noisy = np.random.default_rng(0), np.isin(features.object_ids, folds[0])
    touch, photo = features.touch.copy(), features.photo.copy()
    touch[noisy], photo[noisy] = (rng.standard_normal(part[noisy].shape) for part in (touch, photo))
    changed = dataclasses.replace(features, touch=touch, photo=photo)

    def fit(some):
        objects = sorted(set(some.object_ids))
        return select_settings(some, TowerWidths([12], [10]), [objects[::2], objects[1::2]], GRID[::5])

    before, after = (list(fit_folds(inputs, folds, fit, "fit", quiet=True)) for inputs in (features, changed))
    assert after[0].settings == before[0].settings
    np.testing.assert_array_equal(after[0].projections.touch.weight, before[0].projections.touch.weight)
    assert not np.array_equal(after[1].projections.touch.weight, before[1].projections.touch.weight)


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


def test_touches_are_encoded_by_the_shipped_the_gel_and_the_published_tower_and_photos_by_the_last(published):
    preset = training_config("adapt", None, init=str(published))
    preset = dataclasses.replace(preset, matcher=dataclasses.replace(preset.matcher, fingers=1))
    start = load_checkpoint(retrieval.shipped_model(1))
    matcher, made = combined_matcher(start, 1, str(published))[1], build_matcher(preset)
    for side in ("touch_tower", "photo_tower"):
        for name, tensor in getattr(matcher, side).state_dict().items():
            assert torch.equal(getattr(made, side).state_dict()[name], tensor), name
    training = preset.without_paths()["training"]
    assert (training["init"], training["init_touch"]) == (published.name, "shipped+gel+init")
    gel, added = build_tower("mobilenet_v2", "stages"), build_tower("mobilenet_v2", "stages")
    gel.initialise("gel")
    added.initialise(str(published))
    images, pooled = torch.rand(2, 3, 64, 64), start.matcher.touch_tower.feature_count
    with torch.inference_mode():
        shipped = start.matcher.touch_tower.eval()(images)[:, :pooled]  # without cells
        parts = [gel.eval()(images), added.eval()(images)]
        assert torch.allclose(matcher.touch_tower.eval()(images), torch.cat([shipped, *parts], 1), atol=1e-5)
        assert torch.allclose(matcher.photo_tower.eval()(images), parts[1], atol=1e-5)


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


# The checkpoint ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(recording, model, tmp_path_factory):
    """An adaptation that left three test objects out. The start model has one finger, so it cannot be kept."""
    start, names = load_checkpoint(model), sorted({grasp.object_id for grasp in load_grasps(recording)})
    config = dataclasses.replace(start.config, matcher=dataclasses.replace(start.config.matcher, fingers=1))
    start = dataclasses.replace(start, config=config, matcher=Matcher(config.matcher))
    split = Split(0, tuple(names[3:]), (), tuple(names[:3]))
    return adapt(
        recording, tmp_path_factory.mktemp("fit") / "own.safetensors", start, init="none", split=split, quiet=True
    )


def test_an_adapted_checkpoint_is_an_ordinary_one_fitted_without_test_objects(
    fitted, recording, catalogue, touch, tmp_path
):
    assert not fitted.is_baseline
    measures = [f"held_out_{name}{suffix}" for suffix in ("", "_low_pass") for name in ("top1", "pair_accuracy")]
    assert list(fitted.measures) == measures
    made = fitted.checkpoint
    assert made.posterior is not None
    retrieval.build_index(catalogue, made, tmp_path / "index", quiet=True)
    answer = retrieval.open(tmp_path / "index", model=made.path).query([touch])
    assert 0 <= answer.none_probability <= 1
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    assert set(made.split.train) == set(names[3:])  # without the test objects
    assert len(fitted.measures["held_out_top1"].by_object()[0]) == 9


def test_the_logit_is_only_the_scaled_cosine_of_the_projections(fitted):
    matcher = fitted.checkpoint.matcher
    with torch.inference_mode():
        touch = matcher.touch_encoding(torch.randn(5, matcher.config.fingers * matcher.touch_tower.output_count))
        photo = matcher.photo_encoding(torch.randn(5, matcher.photo_feature_count))
        logits = matcher.head(touch.partial, photo.partial)
    cosines = (touch.embedding * photo.embedding).sum(1)
    assert torch.allclose(logits, matcher.cosine_scale.item() * cosines + matcher.head.out.bias.item(), atol=1e-4)
    assert matcher.cosine_scale > 0


def test_a_baseline_that_is_as_good_is_kept_with_new_calibrations(recording, model, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(  # all scores tie, so both models are exactly at chance
        "retrieval.training.adapt.accuracies", lambda scores, folds: accuracies([0 * part for part in scores], folds)
    )
    start, out, path = load_checkpoint(model), tmp_path / "own.safetensors", tmp_path / "start.safetensors"
    provenance = start.provenance | {LICENCES: [dataclasses.asdict(DataLicence("another"))]}
    check = GelCheck(-1e6, None, None, {})  # of another sensor: it refuses every touch
    start.matcher.gel_head = GelHead(start.matcher.touch_tower.feature_count)
    verification = calibration(accept=1.0, reject=-1.0)
    start = dataclasses.replace(start, verification=verification, gel_check=check, provenance=provenance)
    store_checkpoint(start, path)
    assert main(["adapt", str(recording), "--out", str(out), "--model", str(path), "--init", "none"]) == 0
    output, made = capsys.readouterr(), load_checkpoint(out)
    assert "unadapted model is used" in output.out
    assert made.config == start.config
    for name, tensor in made.matcher.state_dict().items():
        assert torch.equal(tensor, start.matcher.state_dict()[name])
    assert made.posterior != start.posterior
    # Those of the start model are for its posterior and its sensor; 12 objects are too few for new ones
    assert (made.verification, made.gel_check) == (None, None)
    assert set(made.provenance["adapted_to"]) == {"source", "data_digest"}
    assert stored_licences(made.provenance) == [DataLicence("another"), recording_licence(recording)]
