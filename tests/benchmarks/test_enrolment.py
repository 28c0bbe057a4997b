"""The measures of enrolled objects: by hand, and the same verdicts as the answers of an index."""

import numpy as np
import pytest

from benchmarks import enrolment
from benchmarks.enrolment import Content, Ratios
from retrieval.data.dataset import load_grasps
from retrieval.metrics.intervals import summarise
from tests.reference_model import write_reference_model


def test_accuracy_and_verdicts_of_a_small_table(monkeypatch):
    monkeypatch.setattr(enrolment, "CANDIDATES", (2, 3))
    ratios = Ratios(np.array([[9.0, 0.1, 0.0], [0.3, 0.2, 0.1], [0.0, 0.2, 0.5]]), np.arange(3))
    found = {name: summarise([value]).value[0] for name, value in enrolment.measures(ratios, 2).items()}
    # The second query's object is second of three; of two, it is first next to one of the two others. Only 9 > log 2.
    assert found.pop('"none", AUROC') > 0.9
    assert found == pytest.approx({"K = 2": 5 / 6, "K = 3": 2 / 3, "false accepts": 0.0, "false rejects": 2 / 3})


def test_an_area_under_the_curve_has_the_variance_of_delong():
    above, below = np.array([1.0, 0.6, 0.8]), np.array([0.9, 0.7])
    measure = enrolment.two_samples(above, below, np.arange(3), np.array([7, 8]), "")
    values = measure.values[:, 0]
    assert values.mean() == pytest.approx(0.8)
    assert ((values - 0.8) ** 2).sum() / 5**2 == pytest.approx(0.08 / 3**2 + 0.02 / 2**2)


def test_queries_are_answered_with_photos_and_reference_grasps(recording, tmp_path):
    checkpoint = write_reference_model(tmp_path / "model.safetensors")
    grasps = enrolment.by_object(load_grasps(recording))
    references = {name: part[:1] for name, part in grasps.items()}
    queries = {name: part[1:2] for name, part in grasps.items()}
    answered = [
        enrolment.answer(tmp_path, checkpoint, content, references, queries)
        for content in (Content(True, 0), Content(True, 1))
    ]
    assert [each.values.shape for each in answered] == [(len(grasps), len(grasps))] * 2
    assert not np.allclose(answered[0].values, answered[1].values)
    text = enrolment.table({str(Content(True, 0)): enrolment.measures(answered[0], 4)}, "photo")
    assert text.splitlines()[2].startswith("| photo | ")
