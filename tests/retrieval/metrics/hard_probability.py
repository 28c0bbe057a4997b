"""Logits whose probabilities are all 1, and fits whose likelihood has no maximum."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, softmax

from retrieval.evaluation.reject import galleries, statistic
from retrieval.metrics.pairs import negative_log_likelihood, reliability_bins
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.scores import ScoredTouches
from tests.hard_case import HardCase

Matrix = NDArray[np.float64]
_LOGITS = "logits"
_ADDING = Posterior(slope=1.0, offset=0.0, dependence=0.0)
"""Uses logits unchanged, and assumes independent grasps."""


def hard_cases() -> Iterator[HardCase]:
    """Cases of the logits and of probabilities from them."""
    yield _probabilities_tie()
    yield _sure_and_wrong()
    yield _many_grasps()
    yield _choices_without_errors()
    yield _odds_of_a_gallery()
    yield _last_bin()


def _probabilities_tie() -> HardCase:
    """The best of four photos, by logits 20 to 50."""
    logits = np.array([20.0, 50.0, 30.0, 40.0], np.float32)
    ones = int((expit(logits) == 1).sum())
    order = np.argsort(-logits)
    naive, ours = f"{ones} of 4 probabilities are exactly 1", f"by logit: {', '.join(map(str, order))}"
    expected = "photos 1, 3, 2, 0"
    return HardCase(
        _LOGITS, "ranking logits 20 to 50, float32", expected, naive, ours, order.tolist() == [1, 3, 2, 0], ones < 2
    )


def _sure_and_wrong() -> HardCase:
    """Mean negative log-likelihood of two pairs that are wrong by 400: 400."""
    logits, labels = np.array([-400.0, 400.0]), np.array([1, 0])
    p = 1 / (1 + np.exp(-logits))
    naive = float(-np.mean(labels * np.log(p) + (1 - labels) * np.log(1 - p)))
    ours = negative_log_likelihood(logits, labels)
    return HardCase(
        _LOGITS, "likelihood of logits wrong by 400", "400 nats", f"{naive}", f"{ours}", ours == 400, naive == 400
    )


def _many_grasps() -> HardCase:
    """Eight grasps and two objects, the second slightly less unlikely: its odds are e^0.8 to 1."""
    logits = np.array([[-100.0] * 8, [-99.9] * 8])
    naive = expit(logits.astype(np.float32)).prod(axis=1)
    summed = logits.sum(axis=1)
    ours = _ADDING.probabilities_given(summed, _ADDING.mass(summed, 8), 8, none_prior=0).objects
    text = f"probabilities {ours[0]:.3f} and {ours[1]:.3f}"
    products = f"products {naive[0]:g} and {naive[1]:g}"
    must = float(expit(0.8))
    holds = [abs(float(pair[1] / pair.sum()) - must) < 1e-9 for pair in (ours, naive)]
    return HardCase(_LOGITS, "8 grasps at logit -100", f"the second object with {must:.3f}", products, text, *holds)


def naive_slope(scores: Matrix) -> float:
    """Return the factor of the scores (Q, k), true one first, by Newton steps on the plain softmax likelihood."""
    slope = 1.0
    for _ in range(100):
        softmax_of = np.exp(slope * scores)
        softmax_of /= softmax_of.sum(axis=1, keepdims=True)
        mean = (softmax_of * scores).sum(axis=1)
        spread = (softmax_of * scores**2).sum(axis=1) - mean**2
        slope += float((scores[:, 0] - mean).sum() / spread.sum())
    return slope


def _choices_without_errors() -> HardCase:
    """Thirty choices among five, all correct: the likelihood grows with the factor until the arithmetic ends."""
    scores = np.tile([2.0, 1.0, 0.0, -1.0, -2.0], (30, 1))
    fitted = fit_posterior(scored_choices(scores))
    probabilities = [
        softmax(naive_slope(scores) * scores[0]),
        fitted.probabilities_given(scores[0], fitted.mass(scores[0])).objects,
    ]
    wrong = [float(1 - each[0]) for each in probabilities]
    naive, ours = (f"wrong with probability {each:.2g}" for each in wrong)
    expected = "wrong once in 100, or more often"
    return HardCase("softmax", "30 of 30 choices right", expected, naive, ours, wrong[1] > 0.01, wrong[0] > 0.01)


def scored_choices(scores: Matrix) -> ScoredTouches:
    """Return the choices (Q, k), true one first, as touches of k objects with one photo each, in rotation."""
    owner = np.arange(len(scores)) % scores.shape[1]
    logits = np.stack([np.roll(row, place) for row, place in zip(scores, owner, strict=True)])
    return ScoredTouches(logits, owner, np.arange(scores.shape[1]), np.zeros(logits.shape, dtype=bool))


def _odds_of_a_gallery() -> HardCase:
    """Log of the mean odds over 2 objects of 3, one with log-odds 1000: 1000 - log 2."""
    log_odds, own = np.array([[1000.0, -3.0, -3.0]]), np.array([[True, False, False]])
    naive = float(np.log(np.mean(np.exp(log_odds[0, :2]))))
    ours = float(statistic(galleries(log_odds, own)[0])[0])
    must = 1000 - np.log(2)
    correct = [abs(value - must) < 1e-9 for value in (naive, ours)]
    return HardCase(
        "is it in the gallery", "log-odds of 1000", f"{must:.6f}", f"{naive}", f"{ours:.6f}", correct[1], correct[0]
    )


def naive_bins(probability: Matrix, outcomes: Matrix) -> Matrix:
    """Return sums of probability minus outcome in 15 equal bins."""
    sums = np.zeros(15)
    np.add.at(sums, (probability * 15).astype(int), probability - outcomes)
    return sums


def _last_bin() -> HardCase:
    """A probability of exactly 1, as of every certain pair, is in the last bin."""
    p, y = np.array([1.0, 0.5]), np.array([1.0, 0.5])
    ours = reliability_bins(p, y)["ece"]
    naive = _raised(lambda: naive_bins(p, y))
    return HardCase("reliability", "a probability of 1", "error 0", naive, f"error {ours:g}", ours == 0, not naive)


def _raised(work: Callable[[], object]) -> str:
    """Return type and text of the exception of a naive formula; empty without one."""
    try:
        work()
    except (IndexError, ValueError, ArithmeticError) as error:
        return f"{type(error).__name__}: {error}"
    return ""
