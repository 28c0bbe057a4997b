"""The contract of every method: one behaviour suite over the table of methods."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from retrieval.errors import BadInput, NumericalError
from retrieval.evaluation.inputs import ControlCca
from retrieval.methods import CHANCE, METHODS, cca_towers
from retrieval.methods.cca import Cca
from retrieval.methods.method import Method, MethodSettings
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.training.cca import GRID, CcaSettings, TowerWidths, fit_projections, select_settings, tower_widths
from retrieval.training.features import Features
from retrieval.training.selection import ranking_auc

FEATURES = 256  # of the small tower
CONFIG = Config(
    matcher=MatcherConfig(
        tower="small", tower_output="pooled", hidden=32, dropout=0.2, standardise=True, embedding_dim=16
    ),
    training=TrainingConfig(
        init="random",
        iterations=160,
        touches_per_batch=12,
        learning_rate=3e-3,
        schedule="cosine",
        weights={"contrastive": 1.0},
        freeze_towers=True,
        validate_every=40,
    ),
)


def planted(objects, seed, each=8, noise=0.5, widths=(2 * FEATURES, FEATURES)):
    """Return an easy problem: objects with three numbers, linear in both modalities, and noise."""
    shared, rng = np.random.default_rng(5), np.random.default_rng(seed)
    latent = np.repeat(rng.standard_normal((objects, 3)), each, axis=0)
    n = len(latent)
    touch, photo = (
        latent @ shared.standard_normal((3, width)) + noise * rng.standard_normal((n, width)) for width in widths
    )
    return Features(
        tuple(f"grasp-{seed}-{row}" for row in range(n)),
        tuple(f"object-{seed}-{row // each:02}" for row in range(n)),
        touch.reshape(n, 2, -1).astype(np.float32),
        photo.astype(np.float32),
    )


TRAIN, VALIDATION, TEST = planted(12, 0), planted(4, 1), planted(6, 2)


@lru_cache
def fitted(name, seed=0) -> Method:
    method = METHODS.load(name)(MethodSettings(CONFIG, seed=seed))
    method.fit(TRAIN, VALIDATION)
    return method


def encodings(method, features=TEST):
    return method.encode_touch(features.touch), method.encode_photo(features.photo)


every_method = pytest.mark.parametrize("name", METHODS)


@every_method
def test_scores_are_finite_float32_and_higher_for_photos_of_the_touched_object(name):
    scores = fitted(name).score(*encodings(fitted(name)))
    assert (scores.shape, scores.dtype) == ((len(TEST), len(TEST)), np.float32)
    assert np.isfinite(scores).all()
    if name != CHANCE:
        assert ranking_auc(scores, TEST.owner) > 0.8


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "contrastive" else ()) for name in METHODS]
)
def test_fits_with_one_seed_give_the_same_scores_bit_for_bit_and_those_with_another_do_not(name):
    again = METHODS.load(name)(MethodSettings(CONFIG))
    again.fit(TRAIN, VALIDATION)
    np.testing.assert_array_equal(again.score(*encodings(again)), fitted(name).score(*encodings(fitted(name))))
    assert again.best_params == fitted(name).best_params
    other = fitted(name, seed=1 if again.is_seeded else 0)
    assert (other.score(*encodings(other)) != again.score(*encodings(again))).any() == again.is_seeded


# Reranking depends on the whole gallery.
@pytest.mark.parametrize("name", [name for name in METHODS if name != "retrieve_rerank"])
def test_a_score_depends_on_its_touch_and_photo_only(name):
    touch, photo = encodings(fitted(name))
    whole = fitted(name).score(touch, photo)
    plain = np.concatenate([fitted(name).encode_touch(TEST.touch[row : row + 1]) for row in (5, 3)])
    part = fitted(name).score(plain, photo[10:14])
    np.testing.assert_allclose(part, whole[[5, 3], 10:14], rtol=1e-4, atol=1e-4)  # float32 sums in other blocks


@every_method
def test_a_set_scores_the_sum_over_its_grasps_in_any_order(name):
    touch, photo = encodings(fitted(name))
    sets = np.array([[0, 1, 2, 3, 4], [9, 8, 15, 10, 11]])
    scores = fitted(name).score_sets(touch, photo, sets)
    turned = fitted(name).score_sets(touch, photo, sets[:, [3, 0, 4, 2, 1]])
    np.testing.assert_allclose(turned, scores, rtol=1e-5, atol=1e-5)
    if name != "retrieve_rerank":
        single = fitted(name).score(touch, photo).astype(np.float64)
        np.testing.assert_allclose(scores, single[sets].sum(1), rtol=1e-4, atol=1e-5)


def test_objects_in_both_parts_are_refused():
    with pytest.raises(BadInput, match="'object-0-00' is in both"):
        METHODS.load("chance")(MethodSettings(CONFIG)).fit(TRAIN, TRAIN)


def test_scores_of_a_method_that_are_not_finite_or_of_another_shape_are_refused():
    class Broken(type(fitted("chance"))):
        def _score(self, touch_encodings, photo_encodings):
            return self.output

    broken = Broken(MethodSettings(CONFIG))
    broken.fit(TRAIN, VALIDATION)
    broken.output = np.full((48, 48), np.nan)
    with pytest.raises(NumericalError, match=r"scores must be finite; got nan at \(0, 0\)"):
        broken.score(*encodings(broken))
    broken.output = np.zeros((48, 47))
    with pytest.raises(BadInput, match=r"shape \(48, 48\)"):
        broken.score(*encodings(broken))


def test_the_ranking_auc_equals_that_of_loops():
    rng, owner = np.random.default_rng(3), np.array([0, 0, 1, 1, 2])  # object 2 has one photo only
    scores = rng.integers(0, 4, (5, 5)).astype(float)
    by_object = {}
    for i in range(5):
        own = [j for j in range(5) if owner[j] == owner[i] and j != i] or [i]
        others = [j for j in range(5) if owner[j] != owner[i]]
        wins = [(scores[i, a] > scores[i, b]) + (scores[i, a] == scores[i, b]) / 2 for a in own for b in others]
        by_object.setdefault(owner[i], []).append(np.mean(wins))
    expected = np.mean([np.mean(values) for values in by_object.values()])
    assert ranking_auc(scores, owner) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("fit_on_validation", [False, True])
def test_settings_are_chosen_on_held_out_objects_and_fitted_on_all_if_requested(fit_on_validation, monkeypatch):
    calls = []
    monkeypatch.setattr(cca_towers, "select_settings", lambda *args: calls.append(args) or select_settings(*args))
    method = METHODS.load("cca_towers")(MethodSettings(CONFIG, fit_on_validation=fit_on_validation))
    method.fit(TRAIN, VALIDATION)
    ((features, blocks, folds),) = calls
    known = {*TRAIN.object_ids, *VALIDATION.object_ids}
    assert blocks == tower_widths(CONFIG, TRAIN) == ([FEATURES, FEATURES], [FEATURES], 1)
    assert set(features.object_ids) == known
    held_out = [name for fold in folds for name in fold]
    assert sorted(held_out) == sorted(known if fit_on_validation else set(VALIDATION.object_ids))
    best_params = CcaSettings(*(method.best_params[name] for name in CcaSettings._fields))
    fitted_to = TRAIN.concatenate(VALIDATION) if fit_on_validation else TRAIN
    projections = fit_projections(fitted_to, blocks, [best_params])[best_params]
    expected = projections.cosines(TEST.touch.reshape(len(TEST), -1), TEST.photo)
    np.testing.assert_array_equal(method.score(*encodings(method)), expected)


def test_a_touch_tower_without_information_is_left_out():
    """The first tower of each finger sees noise, so the projections are those of a fit to the last tower only."""
    informative = planted(16, 6, noise=1.0, widths=(80, 40))
    noise = np.random.default_rng(0).standard_normal(informative.touch.shape).astype(np.float32)
    both = replace(informative, touch=np.concatenate([noise, informative.touch], axis=2))
    folds = [tuple(sorted(set(both.object_ids)))[start::2] for start in range(2)]
    choice = select_settings(both, TowerWidths([40, 40] * 2, [40], 2), folds)
    expected = select_settings(informative, TowerWidths([40] * 2, [40]), folds)
    assert choice.settings == expected.settings._replace(last_tower=True)
    rows = [part.touch.reshape(len(part), -1) for part in (both, informative)]
    cosines = [one.projections.cosines(row, both.photo) for one, row in zip((choice, expected), rows, strict=True)]
    np.testing.assert_allclose(*cosines, atol=1e-5)


def test_the_setting_that_ranks_held_out_objects_best_is_chosen_not_the_one_that_fits_best():
    hard = planted(12, 7, noise=2.0, widths=(24, 10))
    folds = [tuple(sorted(set(hard.object_ids)))[start::2] for start in range(2)]
    blocks = TowerWidths([12, 12], [10])
    plain = {one: select_settings(hard, blocks, folds, [one]).auc for one in GRID}
    choice = select_settings(hard, blocks, folds)
    assert choice.auc == plain[choice.settings] == pytest.approx(max(plain.values()))
    assert len({round(one, 6) for one in plain.values()}) > 1


@pytest.mark.parametrize("method", [Cca, ControlCca])
def test_with_fit_on_validation_cca_is_fitted_on_validation_objects_too(method):
    plain, both = (method(MethodSettings(CONFIG, fit_on_validation=which)) for which in (False, True))
    plain.fit(TRAIN, VALIDATION)
    both.fit(TRAIN, VALIDATION)
    assert [one.best_params["max_components"] for one in (plain, both)] == [12 - 1, 12 + 4 - 1]
    same = ("ridge", "components", "power", "validation_auc")
    assert {name: both.best_params[name] for name in same} == {name: plain.best_params[name] for name in same}


def test_concatenated_towers_accept_only_their_own_features():
    other = Features(TRAIN.grasp_ids, TRAIN.object_ids, TRAIN.touch, TRAIN.photo[:, 1:])
    with pytest.raises(BadInput, match=r"towers small \(pooled\), 512 of a touch and 256 of a photo; got 512 and 255"):
        tower_widths(CONFIG, other)
