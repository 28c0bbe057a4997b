"""The fit of the gel check on synthetic features, and the foreign pictures that it is fitted on."""

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import cross_entropy

from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.model.config import MatcherConfig
from retrieval.model.encode import touch_features
from retrieval.model.fusion import Matcher
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.training.calibration.gel_check import (
    SYNTHETIC_KINDS,
    ForeignPictures,
    GelCheckFeatures,
    contact_levels,
    contact_threshold,
    draw_foreign,
    fit_gel_check,
    fit_gel_head,
)


def test_the_contact_threshold_is_above_no_contact_gels_and_as_high_as_it_costs_few_touches():
    no_contact, touches = np.arange(201.0), np.arange(500.0, 601.0)
    assert contact_threshold(no_contact, touches) == pytest.approx(502)  # 2 % of the touches lie below
    assert contact_threshold(no_contact, np.arange(101.0)) == pytest.approx(199)  # exceeded by .5 % of no-contact gels


def test_levels_compare_no_contact_frames_of_one_object_and_touches_with_their_own_and_take_the_largest_finger(
    tmp_path,
):
    def files(*levels):
        for level in levels:
            cv2.imwrite(str(tmp_path / f"{level}.png"), np.full((16, 16, 3), level, np.uint8))
        return tuple(tmp_path / f"{level}.png" for level in levels)

    grasps = [
        Grasp("0", "mug", None, tmp_path, touches=files(110, 101), backgrounds=files(100, 100)),
        Grasp("1", "mug", None, tmp_path, touches=files(101, 140), backgrounds=files(101, 103)),
        Grasp("2", "tin", None, tmp_path, touches=files(160, 150), backgrounds=files(150, 150)),
    ]
    no_contact, touched = contact_levels(grasps)
    assert (no_contact, touched) == (pytest.approx([3]), pytest.approx([10, 37, 10]))


def test_every_kind_of_foreign_picture_is_drawn():
    drawn = dict(draw_foreign(7, 16, [np.full((40, 60, 3), 0.4, dtype=np.float32)], seed=3))
    assert set(drawn) == {*SYNTHETIC_KINDS, "photo", "piece of a photo"}
    assert all(picture.shape == (16, 16, 3) and 0 <= picture.min() <= picture.max() <= 1 for picture in drawn.values())


def pictures(seed, no_contact=60):
    """Return features (8) around three distant centres: touches, no-contact gels and foreign pictures."""
    rng = np.random.default_rng(seed)

    def around(place, *shape):
        return torch.from_numpy(place + rng.normal(size=(*shape, 8))).float()

    places = np.eye(8)[:3] * 9
    return GelCheckFeatures(around(places[0], 80, 2), around(places[1], no_contact, 2), around(places[2], 80))


def test_distant_kinds_are_separated_on_other_pictures_of_the_same_kinds():
    head = fit_gel_head(pictures(0))
    check = fit_gel_check(head, pictures(1), levels=([0.5, 0.7, 0.9], [12.0, 30.0]))
    rates = dict(check.rates)
    assert rates.pop("touches_rejected_as_foreign") <= 0.02
    accepted_loss = {"touches_rejected_as_no_contact": 0.025}  # 2 of 80
    assert rates == {"foreign_rejected": 1, "no_contact_accepted": 0} | accepted_loss
    assert check.level_above == pytest.approx(12.36)  # 2 % of the way from 12 to 30
    with torch.inference_mode():
        others = pictures(2)
        assert check.classify(head(others.touch).numpy()).count(CONTACT) >= 76
        assert check.classify(head(others.no_contact).numpy()).count(NO_CONTACT) >= 58


@pytest.mark.parametrize("no_contact", [60, 0])
def test_the_head_minimises_the_mean_loss_of_each_kind_and_the_penalty(no_contact):
    features = pictures(0, no_contact)
    head, parts = fit_gel_head(features, penalty=0.1), (features.touch, features.no_contact, features.foreign)
    parts = {kind: part.reshape(-1, 8) for kind, part in enumerate(parts) if len(part)}
    losses = [cross_entropy(head.classifier(part), torch.full((len(part),), kind)) for kind, part in parts.items()]
    scaled = head.classifier.weight * torch.cat(list(parts.values())).std(0, correction=0)
    (sum(losses) / len(losses) + 0.1 / 2 * (scaled**2).sum()).backward()
    assert all(part.grad.abs().max() < 1e-5 for part in head.parameters())


def test_without_no_contact_frames_every_gel_is_a_contact():
    head = fit_gel_head(pictures(0, no_contact=0))
    check = fit_gel_check(head, pictures(1, no_contact=0), levels=([], []))
    assert (check.contact_above, check.level_above) == (None, None)
    with torch.inference_mode():
        assert set(check.classify(head(pictures(2).touch).numpy())) <= {CONTACT, NOT_A_GEL}
    assert check.rates["foreign_rejected"] == 1


def test_a_feature_that_never_varies_gives_no_infinite_weight():
    features = pictures(0)
    for part in (features.touch, features.no_contact, features.foreign):
        part[..., 7] = 3.0
    assert bool(torch.isfinite(fit_gel_head(features).classifier.weight).all())


def test_the_gel_head_of_a_matcher_with_cells_reads_the_features_without_them(recording):
    """A head that was fitted on features and cells did not fit the checkpoint that stored it."""
    torch.manual_seed(0)
    config = MatcherConfig(
        "small", "stages", hidden=8, embedding_dim=4, cosine=True, cell_dim=2, touch_cells=2, photo_cells=2
    )
    matcher, settings = Matcher(config).eval(), Preprocessing(touch_px=32, photo_px=32)
    grasps = load_grasps(recording)[:6]
    images = [[settings.load_touch(path) for path in grasp.touches] for grasp in grasps]
    found = GelCheckFeatures.of(matcher, settings, grasps, touch_features(matcher, images), ForeignPictures(8), seed=0)
    pooled = matcher.touch_tower.feature_count
    assert pooled < matcher.touch_tower.output_count
    assert [part.shape[-1] for part in (found.touch, found.no_contact, found.foreign)] == [pooled] * 3
    expected = touch_features(matcher, images).view(6, 2, -1)[..., :pooled]
    assert torch.equal(found.touch, expected)
