"""Measures of a ranking compared with trec_eval (package pytrec-eval-terrier)."""

from itertools import permutations

import numpy as np
import pytest

from retrieval.metrics import registry
from retrieval.metrics.ranking import average_precision, recall_at
from retrieval.metrics.table import ScoreTable

trec_eval = pytest.importorskip("pytrec_eval")

KS = (1, 2, 3, 5)
NAMES = {"map": "map", **{k: f"success_{k}" for k in KS}}
"""Our measure -> that of trec_eval. R@k is "any relevant item among the first k", which trec_eval calls success."""


def ours(scores, relevant, in_gallery):
    measures = {"map": average_precision(scores, relevant, in_gallery)}
    return measures | {k: recall_at(k, scores, relevant, in_gallery) for k in KS}


def theirs(scores, relevant, in_gallery, names=None):
    """Return the values of trec_eval by query; `names` of items decide its order of ties."""
    names = names or [f"{number:03}" for number in range(scores.shape[1])]
    queries = range(len(scores))
    qrels = {str(q): {names[i]: int(relevant[q, i]) for i in np.flatnonzero(in_gallery[q])} for q in queries}
    run = {str(q): {names[i]: float(scores[q, i]) for i in np.flatnonzero(in_gallery[q])} for q in queries}
    evaluator = trec_eval.RelevanceEvaluator(qrels, {"map", "success." + ",".join(map(str, KS))})
    found = evaluator.evaluate(run)
    return {key: np.array([found[str(q)][name] for q in queries]) for key, name in NAMES.items()}


def assert_equal(found, expected):
    for key in NAMES:
        np.testing.assert_allclose(found[key], expected[key], rtol=1e-12, atol=1e-14, err_msg=str(key))


def test_with_ties_the_measures_are_the_mean_of_trec_eval_over_all_names_of_items():
    """trec_eval orders equal scores by name, so its value depends on the names. We take the mean over all orders."""
    rng = np.random.default_rng(0)
    relevant = rng.random((60, 5)) < 0.4
    relevant[~relevant.any(1), 0] = True
    scores = rng.integers(0, 3, relevant.shape).astype(np.float32)
    scores[0] = 1  # a constant scorer
    every = np.ones_like(relevant)
    by_name = [theirs(scores, relevant, every, list(names)) for names in permutations("abcde")]
    assert_equal(ours(scores, relevant, every), {key: np.mean([one[key] for one in by_name], axis=0) for key in NAMES})


def test_without_ties_and_own_photos_the_metrics_equal_those_of_trec_eval():
    """trec_eval gets the gallery of each query, which excludes photos of its own grasp, in the run and in the qrels."""
    rng = np.random.default_rng(1)
    touch_owner = np.repeat(np.arange(6), 4)
    scores = rng.permuted(np.tile(np.arange(24, dtype=np.float32), (24, 1)), axis=1)
    table = ScoreTable(scores, touch_owner, touch_owner, np.eye(24, dtype=bool))
    expected = theirs(scores, table.relevant, ~table.own)
    found = {"map": registry.average_precision(table)}
    found |= {k: registry.recall(table, k) for k in KS}
    assert_equal({key: measure.values[:, 0] for key, measure in found.items()}, expected)
