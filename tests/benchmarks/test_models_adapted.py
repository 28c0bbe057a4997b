"""Tables of verification and next grasp after `retrieve adapt`, from scores made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.models.adapted import Scored, next_grasp_table, touch_places, verification_table
from retrieval.model.posterior import ScoredTouches, fit_posterior


@pytest.fixture(scope="module")
def fits():
    """Return two fits with other objects: the true object is 8 logits above each other one, and noise."""
    rng = np.random.default_rng(0)
    found = []
    for first in (0, 6):
        owner = np.repeat(np.arange(first, first + 6), 8)
        logits = 8.0 * (owner[:, None] == owner) + rng.normal(size=(len(owner), len(owner)))
        touches = ScoredTouches(logits, owner, owner, np.zeros(logits.shape, dtype=bool))
        checkpoint = SimpleNamespace(posterior=fit_posterior(touches, seed=0))
        found.append(Scored(checkpoint, touches, rng.normal(size=(len(owner), 4)), rng.random((len(owner), 3))))
    return found


def test_clear_scores_verify_without_errors_and_each_object_counts_as_one_trial(fits):
    header, _, *rows = verification_table(fits)
    assert header == "| impostor | grasps | EER | FRR at FAR 0.2 | FRR at FAR 0.1 |"
    assert len(rows) == 8
    # No error in 12 trials: the upper end is 1 - 0.025 ** (1 / 12).
    assert rows[0] == "| random | 1 | 0.000 [0.000, 0.265] | 0.000 [0.000, 0.265] | 0.000 [0.000, 0.265] |"


def test_clear_scores_need_one_grasp(fits):
    about, _, _, _, *rows = next_grasp_table(fits)
    assert about == "12 left-out objects, 384 sequences, 6 candidates"
    assert [row.split(" | ")[0] for row in rows] == ["| spread", "| random", "| repeated", "| upper_bound"]
    assert all("1.000 [1.000, 1.000]" in row and "1.00 [1.00, 1.00]" in row for row in rows)


def test_places_come_from_the_names_of_the_files(tmp_path):
    folder = tmp_path / "touch" / "01_stapler" / "02"
    folder.mkdir(parents=True)
    (folder / "touch_1_img_100_name_stapler_greyred_at_37821_-6073_24880.jpg").touch()
    (tmp_path / "touch" / "baselineForCalibration.jpg").touch()
    assert touch_places(tmp_path) == {"01_stapler-02-100": (37821.0, -6073.0, 24880.0)}
