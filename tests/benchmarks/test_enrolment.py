"""The measures of enrolled objects: by hand, and the same verdicts as the answers of an index."""

import numpy as np
import pytest

import retrieval
from benchmarks import enrolment
from benchmarks.enrolment import Content
from models.shipped import grasps_by_object
from retrieval.data.dataset import load_grasps
from retrieval.metrics.intervals import summarise
from tests.reference_model import write_reference_model


def values(measures):
    return {name: summarise([measure]).value[0] for name, measure in measures.items()}


def test_accuracy_and_verdicts_of_a_small_table(monkeypatch):
    monkeypatch.setattr(enrolment, "CANDIDATES", (2, 3))
    ratios = np.array([[9.0, 0.1, 0.0], [0.3, 0.2, 0.1], [0.0, 0.2, 0.5]])
    found = values(enrolment.drawn_measures(ratios, np.arange(3)))
    # The second query's object is second of three; of two, it is first next to one of the two others. Only 9 > log 2.
    assert found.pop('"none", AUROC') > 0.9
    expected = {"top-1 of 2": 5 / 6, "top-1 of 3": 2 / 3, "false accepts": 0.0, "false rejects": 2 / 3}
    assert found == pytest.approx(expected)

    # Objects 3 and 4 are not enrolled. log 3 = 1.1: object 4 is taken for an enrolled one, and it exceeds one of three.
    others = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    found = values(enrolment.enrolled_measures(np.concatenate([ratios, others]), np.arange(5), rig=0))
    expected = {"top-1 of 3": 2 / 3, '"none", AUROC': 4 / 6, "false accepts": 1 / 2, "false rejects": 2 / 3}
    assert found == pytest.approx(expected)


def test_an_area_under_the_curve_has_the_variance_of_delong():
    above, below = np.array([1.0, 0.6, 0.8]), np.array([0.9, 0.7])
    measure = enrolment.two_samples(above, below, np.arange(3), np.array([7, 8]), "")
    values = measure.values[:, 0]
    assert values.mean() == pytest.approx(0.8)
    assert ((values - 0.8) ** 2).sum() / 5**2 == pytest.approx(0.08 / 3**2 + 0.02 / 2**2)


def test_queries_are_answered_with_photos_and_reference_grasps(recording, tmp_path):
    checkpoint = write_reference_model(tmp_path / "model.safetensors")
    grasps = grasps_by_object(load_grasps(recording))
    references = {name: part[:1] for name, part in grasps.items()}
    queries = enrolment.encode(checkpoint, {name: part[1:2] for name, part in grasps.items()})
    contents = Content(True, 0), Content(True, 1)
    answered = [enrolment.answer(tmp_path / "r", checkpoint, content, references, queries) for content in contents]
    assert [each.shape for each in answered] == [(len(grasps), len(grasps))] * 2
    assert not np.allclose(*answered)
    with retrieval.open(tmp_path / "r-index") as searcher:  # of the last content
        result = searcher.query(list(queries.grasps[0].touches), top=len(grasps))
    ratios = searcher.posterior.log_ratio([match.logit for match in result.results], 1)
    np.testing.assert_allclose(sorted(answered[1][0], reverse=True), ratios, atol=1e-4)  # touches in other batches
    assert (answered[1][0].max() > np.log(len(grasps))) == (result.verdict == "match")
