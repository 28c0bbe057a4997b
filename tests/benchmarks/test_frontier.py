"""Error against run time of the kernels: every row measures points, and the defaults are those of the code."""

import numpy as np
import pytest

from benchmarks.frontier import APPROXIMATIONS, NEED_NO_MODEL
from benchmarks.frontier.__main__ import main
from benchmarks.frontier.correlation import _by_covariance, _by_svd, known_problem
from retrieval.frontier.sample import Sample, Scale
from tests import synthetic

TINY = Scale(photos=700, queries=6, repeats=1, quick=True)


@pytest.fixture(scope="module")
def rows(model, tmp_path_factory):
    """Every row, measured once, with a recording of eight objects that no model was trained on."""
    folder = tmp_path_factory.mktemp("unseen")
    unseen = synthetic.write_recording(folder / "recording", synthetic.make_objects(8, seed=77), 4)
    sample = Sample(model, lambda: unseen, folder / "features", TINY, quiet=True)
    return {name: APPROXIMATIONS.load(name)(sample) for name in APPROXIMATIONS}


@pytest.mark.parametrize("name", sorted(APPROXIMATIONS))
def test_every_row_measures_points_and_names_its_reference(name, rows):
    row = rows[name]
    assert row.title
    assert row.text
    assert row.skipped is None
    assert row.panels
    for panel in row.panels:
        assert panel.reference
        assert panel.time
        assert panel.recommended in panel.points
        assert all(point.seconds > 0 and np.isfinite(point.error) and point.error >= 0 for point in panel.points)
        assert len({(point.series, point.setting) for point in panel.points}) == len(panel.points)


@pytest.mark.parametrize("name", sorted(set(APPROXIMATIONS) - {"contact", "gel_optics"}))
def test_every_panel_marks_one_default(name, rows):
    for panel in rows[name].panels:
        assert sum(point.is_default for point in panel.points) == 1, panel.title


def test_the_command_plots_a_kernel_s_row_without_a_recording(model, tmp_path, capsys):
    assert "cca_solver" in NEED_NO_MODEL
    main(["--out", str(tmp_path), "--model", str(model), "--quick", "--only", "cca_solver"])
    assert "cca_solver: canonical correlations" in capsys.readouterr().err
    assert (tmp_path / "figures" / "cca_solver.png").is_file()
    assert not (tmp_path / "recording").exists()


def test_the_rig_solves_contacts_at_the_default():
    from benchmarks.frontier.contact import contact_panels
    from robot.sim.scene import Hand

    panels = contact_panels(1, rows=(60, 120), tolerances=(1e-1, 1e-2), reference_rows=120)
    hand = Hand()
    expected = f"{hand.grid[0]}x{hand.grid[1]}, tolerance {hand.tolerance:g}"
    assert [panel.default.name for panel in panels] == [expected] * 3


# Canonical correlations ------------------------------------------------------------------------------------


def test_the_constructed_problem_has_the_stated_correlations():
    """Checked independently: principal angles between the column spaces."""
    problem = known_problem(300, 6, spread=10.0)
    x, y = (np.linalg.qr(one - one.mean(0))[0] for one in (problem.x, problem.y))
    assert np.linalg.svd(x.T @ y, compute_uv=False) == pytest.approx(problem.rho, abs=1e-12)


def test_the_textbook_solver_fails_and_ours_does_not():
    problem = known_problem(500, 24, spread=1e6)
    assert _by_svd(problem) == pytest.approx(problem.rho, abs=1e-6)
    naive = _by_covariance(np.float32, problem)
    assert np.abs(naive - problem.rho).max() > 0.05
