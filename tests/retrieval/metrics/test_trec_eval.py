"""Measures of a ranking compared with trec_eval (package pytrec-eval-terrier)."""

import numpy as np
import pytest

from retrieval.metrics import registry
from retrieval.metrics.table import ScoreTable

trec_eval = pytest.importorskip("pytrec_eval")

KS = (1, 2, 3, 5)


def test_without_ties_and_own_photos_the_metrics_equal_those_of_trec_eval():
    """trec_eval gets the gallery of each query, which excludes photos of its own grasp, in the run and in the qrels.

    R@k is "any relevant item among the first k", which trec_eval calls success.
    """
    rng = np.random.default_rng(1)
    owner = np.repeat(np.arange(6), 4)
    scores = rng.permuted(np.tile(np.arange(24, dtype=np.float32), (24, 1)), axis=1)
    table = ScoreTable(scores, owner, owner, np.eye(24, dtype=bool))
    qrels, run = (
        {str(q): {str(i): kind(values[q, i]) for i in np.flatnonzero(~table.own[q])} for q in range(24)}
        for values, kind in ((table.relevant, int), (scores, float))
    )
    theirs = trec_eval.RelevanceEvaluator(qrels, {"map", "success." + ",".join(map(str, KS))}).evaluate(run)
    ours = {"map": registry.average_precision(table)} | {f"success_{k}": registry.recall(table, k) for k in KS}
    for name, measure in ours.items():
        expected = [theirs[str(q)][name] for q in range(24)]
        np.testing.assert_allclose(measure.values[:, 0], expected, rtol=1e-12, atol=1e-14, err_msg=name)
