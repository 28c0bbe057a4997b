"""Error against run time, as data: what a point says, and that errors fall where they should."""

import json
import math

import numpy as np
import pytest

from retrieval.lab.contact.closed_forms import Check, Grid, hertz
from retrieval.lab.contact.closing_jaws import Jaws
from retrieval.lab.frontier.contact import (
    closed_form_table,
    closing_points,
    contact_points,
    spring_closing,
    stability_sweep,
    timed,
)
from retrieval.lab.hard_cases.contact import HardCase
from tests.benchmarks import contact as benchmark


@pytest.fixture(scope="module")
def points():
    return contact_points(rows=(15, 30), tolerances=(1e-1, 1e-3), reference_rows=120)


def errors(points, *words):
    return [
        abs(point.error) for point in points if all(word in f"{point.approximation}, {point.setting}" for word in words)
    ]


def test_every_point_says_what_it_measured_against_what(points):
    assert len(points) == 2 * 2 + 2 * 2 * 2 + 2 * 2
    for point in points:
        assert point.seconds > 0.0
        assert math.isfinite(point.error)
        assert all((point.approximation, point.setting, point.unit, point.reference))
    assert len({(point.approximation, point.setting) for point in points}) == len(points)


def test_a_finer_grid_is_nearer_to_hertz_and_to_the_finest_grid(points):
    for kind in (("half-space", "0.001"), ("layer", "0.001", "padded"), ("gel image", "0.001")):
        coarse, fine = errors(points, *kind)
        assert fine < coarse


def test_padding_is_what_the_periodic_grid_lacks(points):
    assert max(errors(points, "layer", "padded", "30x40, tolerance 0.001")) < 0.5 * min(errors(points, "periodic"))


def test_halving_the_step_quarters_the_error():
    coarse, fine = (abs(point.error) for point in closing_points(steps_s=(4e-4, 2e-4)))
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_the_tables_that_the_frontier_reads_are_here():
    assert callable(closed_form_table)
    assert callable(stability_sweep)


def test_a_time_is_the_shortest_of_several_and_the_result_comes_along():
    calls = []
    seconds, result = timed(lambda: calls.append(1) or len(calls), 2)
    assert (len(calls), result) == (3, 1)
    assert 0.0 <= seconds < 1.0


def test_hertz_by_hand():
    # F = 4/3 E* sqrt(R) d^1.5 with R = 4, d = .25, E* = .3: 4/3 * .3 * 2 * .125 = .1 N; a = sqrt(R d) = 1.
    a, depth, peak = hertz(0.1, 4.0, 0.3)
    assert (a, depth, peak) == pytest.approx((1.0, 0.25, 0.15 / math.pi))


def test_a_spring_s_closed_form_starts_at_rest_and_ends_at_f_over_k():
    travel = spring_closing(Jaws(20.0), 100.0, np.array([0.0, 1e-6, 10.0]))
    assert travel == pytest.approx([0.0, 0.5 * 20.0 / 0.3e-3 * 1e-12, 0.2], rel=1e-3, abs=1e-16)


def test_a_grid_has_its_middle_between_pixels():
    y, x = Grid.of_field(60).axes()
    assert (y.shape, x.shape) == ((60, 1), (1, 80))
    assert y[29, 0] == -y[30, 0] == pytest.approx(-0.12)
    assert str(Grid.of_field(60)) == "60x80"


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_benchmark_prints_a_line_for_each_row(options, monkeypatch, capsys):
    made = (
        closing_points(steps_s=(1e-2,))[0],
        Check("ball", "depth", "2x2", 3.0, 2.0),
        HardCase("k", "a", "b", "c", "d", True, False),
    )
    monkeypatch.setattr(benchmark, "rows", lambda: iter(made))
    benchmark.main(options)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    if options:
        assert [json.loads(line)["table"] for line in lines] == ["Point", "Check", "HardCase"]
    else:
        assert lines[1].endswith("(limit 2)  EXCEEDED")
