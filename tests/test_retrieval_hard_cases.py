"""The table of hard inputs of every kernel here: ours holds, and the naive formula fails on the same input."""

import numpy as np
import pytest
import torch

from retrieval.errors import BadInput
from retrieval.lab.hard_cases import hard_cases, linear, losses, probability, ranking
from retrieval.lab.hard_cases.case import refused

KERNELS = (
    "match loss",
    "InfoNCE",
    "listwise loss",
    "sigmoid loss",
    "pruner loss",
    "tower statistics",
    "cosine",
    "pooling of grasps",
    "logits",
    "calibration",
    "softmax",
    "is it in the gallery",
    "reliability",
    "CCA",
    "PLS",
    "whitening",
    "standardising",
    "top k",
    "halves",
    "rank measures",
    "bootstrap",
    "intervals",
    "permutation test",
    "background",
    "samples",
    "resize",
)


@pytest.fixture(scope="module")
def rows():
    return hard_cases()


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_must_hold_does_and_the_naive_formula_fails(rows, kernel):
    of_kernel = [row for row in rows if row.kernel == kernel]
    assert of_kernel
    assert [f"{row.case}: {row.ours}" for row in of_kernel if not row.holds] == []
    assert [f"{row.case}: {row.naive}" for row in of_kernel if row.naive_holds] == []


def test_every_row_says_all_of_it_and_comes_once(rows):
    assert {row.kernel for row in rows} == set(KERNELS)
    assert len({(row.kernel, row.case) for row in rows}) == len(rows)
    assert all(row.case and row.must_hold and row.naive and row.ours for row in rows)


def test_a_kernel_that_no_longer_holds_is_shown_so(monkeypatch):
    monkeypatch.setattr(losses, "match_loss", lambda z, y: -torch.log(torch.sigmoid(z)).mean())
    row = losses._sure_and_wrong()
    assert not row.holds
    assert row.ours == row.naive == "inf, gradient nan"


def test_what_is_accepted_does_not_count_as_refused():
    def raising():
        raise BadInput("row 7 is NaN")

    assert refused(raising, "row 7") == ("refused: row 7 is NaN", True)
    assert refused(raising, "row 8") == ("refused: row 7 is NaN", False)
    assert refused(lambda: 3) == ("accepted: 3", False)
    with pytest.raises(ZeroDivisionError):
        refused(lambda: 1 / 0)


# The naive formulae are right where nothing is hard: they fail by their arithmetic, not by a mistake ----------


def test_the_naive_canonical_correlations_are_ours_on_plain_features():
    touch, photo = linear._views(200, 4)
    ours = linear._correlations(touch, photo).correlations
    assert linear.naive_correlations(touch, photo) == pytest.approx(ours, abs=1e-9)
    assert linear._by_eigenvectors(touch, photo) == pytest.approx(ours, abs=1e-5)


def test_the_naive_fits_are_ours_where_pairs_overlap():
    rng = np.random.default_rng([8])
    logits, labels = np.append(rng.normal(1, 1, 20_000), rng.normal(-1, 1, 20_000)), np.repeat([1, 0], 20_000)
    fitted = probability.fit_calibration(logits, labels)
    # Platt's targets differ from 0 and 1 by 1 in 20,000.
    assert probability.naive_fit(logits, labels) == pytest.approx((fitted.slope, fitted.intercept), rel=1e-3, abs=1e-3)
    scores = rng.normal(0, 1, (5000, 5)) + 1.5 * np.eye(5)[0]
    fitted = probability.fit_posterior(probability.judged_choices(scores))
    assert probability.naive_slope(scores) == pytest.approx(fitted.slope, rel=2e-2)


def test_the_naive_components_are_those_of_the_cross_covariance_where_there_are_as_many():
    touch, photo = linear._views(300, 5)
    first = np.linalg.svd((touch - touch.mean(0)).T @ (photo - photo.mean(0)))[0][:, 0]
    assert abs(linear.naive_pls(touch, photo, 2)[:, 0] @ first) == pytest.approx(1, abs=1e-6)


def test_the_naive_interval_is_the_t_interval_of_many_values():
    values = np.random.default_rng([9]).normal(0.5, 0.1, 400)
    low, high = ranking.naive_interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)
