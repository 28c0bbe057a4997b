"""Verification in the report of an evaluation: rates and refusals."""

import numpy as np
import pytest

from retrieval.report.builder import Builder
from retrieval.report.error_analysis import verification
from retrieval.report.results import Results
from retrieval.report.tables import verification as table
from tests.synthetic_evaluation import verification as synthetic_verification


@pytest.fixture
def found():
    return synthetic_verification(np.random.default_rng(0))


def test_rates_are_shown_from_the_largest_false_accept_rate_and_refusals_with_the_objects_that_they_need(found):
    one = found["random"]["3"]
    one["eer"] = {"value": 0.0512, "low": 0.02, "high": 0.11, "objects_needed": 35}
    one["frr"] = {
        "0.001": {"value": None, "low": None, "high": None, "objects_needed": 1246},
        "0.01": {"value": 0.2345, "low": 0.1, "high": 0.4, "objects_needed": 78},
        "0.1": {"value": 0.01, "low": 0.0, "high": 0.06, "objects_needed": 25},
    }
    found["similar"]["1"]["eer"] = dict.fromkeys(("value", "low", "high", "objects_needed"))
    made = table(Results({"verification": found}, {}))
    assert made.header == (
        "impostors", "grasps", "EER, %", "FRR at a FAR of 10 %, %", "FRR at a FAR of 1 %, %", "FRR at a FAR of 0.1 %, %"
    )  # fmt: skip
    rows = {row[:2]: row[2:] for row in made.rows}
    assert list(rows) == [(kind, grasps) for kind in ("random", "most similar object") for grasps in "1235"]
    assert rows["random", "3"] == (
        "5.1 [2.0, 11.0]", "1.0 [0.0, 6.0]", "23.4 [10.0, 40.0]", "refused: needs 1,246 objects"
    )  # fmt: skip
    assert rows["most similar object", "1"][0] == "refused: no errors"


def test_an_evaluation_without_late_fusion_has_no_verification():
    assert not list(verification(Builder(Results({"methods": {"late_fusion": {}}, "verification": None}, {}))))
