"""The scoring of the experiment on real billets: right for a perfect scorer, at chance for one that knows nothing."""

from pathlib import Path

import numpy as np
import pytest

from retrieval.data.dataset import Grasp
from tests.billets import KS, fold_split, report, score_fold, share


def places(*billets):
    return [
        Grasp(f"{billet}-{place}", f"{billet}-{place}", billet, Path(f"{billet}-{place}.jpg"), (Path("a.png"),), ())
        for billet in billets
        for place in range(16)
    ]


def test_a_perfect_scorer_is_always_right():
    grasps, outcomes = places("welded1", "ground1"), {}
    score_fold(outcomes, grasps, np.where(np.eye(32, dtype=bool), 1.0, -1.0).astype(np.float32), seed=0)
    assert set(outcomes) == {"one welded billet", "welded and ground"}
    for kept in outcomes.values():
        assert all(np.mean(kept[name]) == 1 for name in ("pair", *(f"K={k}" for k in KS)))
    assert len(outcomes["one welded billet"]["K=5"]) == 16


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_a_constant_scorer_is_at_chance(value):
    grasps, outcomes = places("welded1", "ground1"), {}
    for seed in range(40):
        score_fold(outcomes, grasps, np.full((32, 32), value, dtype=np.float32), seed=seed)
    kept = outcomes["welded and ground"]
    # Five standard deviations of the mean of 1,280 (pairs: 2,560) draws.
    assert np.mean(kept["pair"]) == pytest.approx(0.5, abs=0.05)
    assert np.mean(kept["K=5"]) == pytest.approx(0.2, abs=0.056)
    np.testing.assert_allclose(np.mean(kept["curve5"], axis=0), [0.2, 0.4, 0.6, 0.8, 1.0])


def test_no_billet_stands_on_two_sides_of_a_fold():
    grasps = places(*(f"welded{n}" for n in range(1, 6)), *(f"ground{n}" for n in range(1, 5)))
    split = fold_split(grasps, "welded5", "ground4", fold=4)
    sides = [{name.split("-")[0] for name in part} for part in (split.train, split.validation, split.test)]
    assert sides[2] == {"welded5", "ground4"}
    assert sides[1] == {"welded1", "ground2"}
    assert not sides[0] & (sides[1] | sides[2])
    assert sum(map(len, sides)) == 9


def test_the_report_shows_value_interval_counts_control_and_chance():
    outcomes = {}
    score_fold(outcomes, places("welded1", "ground1"), np.eye(32, dtype=np.float32) * 2 - 1, seed=0)
    text = report({"touch": outcomes, "control": outcomes, "billet_from_thumbnail": {"all": [1, 0]}})
    assert "| one welded billet | K=5, first guess | 1.000 [0.794, 1.000] (16/16) |" in text
    assert "| 0.20 |" in text
    assert share([1, 0]) == "0.500 [0.013, 0.987] (1/2)"
