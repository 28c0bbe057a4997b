"""Recall, the check of claimed results, and the choice of a kind by measurement."""

import itertools

import numpy as np
import pytest

from indexes.errors import ParameterError
from indexes.kinds import choice
from indexes.kinds.base import VectorIndex
from indexes.kinds.choice import Choice, choose_kind, operating_points
from indexes.kinds.exact import ExactIndex
from indexes.kinds.measure import disagreements, query_ms, recall_against_exact, sample_queries

AXES = np.eye(6, dtype=np.float32)


def unit(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def claimed(slots: list[list[int]], queries: np.ndarray, vectors: np.ndarray) -> list[str]:
    """The disagreements when each claimed slot comes with its own true score."""
    table = np.array(slots)
    scores = np.take_along_axis(queries @ vectors.T, np.maximum(table, 0), axis=1)
    return disagreements(vectors, queries, scores, table, 1e-6)


# A query with the scores 0.8, 0.48, 0.36, 0, 0, 0 against the axes.
QUERY = np.array([[0.8, 0.48, 0.36, 0, 0, 0]], np.float32)


def test_the_true_results_are_accepted():
    assert claimed([[0, 1, 2]], QUERY, AXES) == []


def test_a_wrong_slot_is_rejected_at_k_of_one():
    assert claimed([[1]], QUERY, AXES) == ["query 0, rank 1: 0.48 is not the best left"]


def test_a_wrong_slot_is_rejected_at_the_last_rank():
    assert claimed([[0, 1, 3]], QUERY, AXES) == ["query 0, rank 3: 0 is not the best left"]


def test_a_wrong_score_is_rejected():
    found = disagreements(AXES, QUERY, np.array([[0.8, 0.4]], np.float32), np.array([[0, 1]]), 1e-6)
    assert found[0] == "query 0, rank 2: slot 1 does not score 0.4"


def test_a_nan_score_is_rejected():
    assert disagreements(AXES, QUERY, np.array([[np.nan]], np.float32), np.array([[0]]), 1e-6)


@pytest.mark.parametrize("last", [3, 4, 5])
def test_every_tie_partner_is_accepted_at_the_last_rank(last):
    assert claimed([[0, 1, 2, last]], QUERY, AXES) == []


def test_a_slot_that_comes_twice_is_rejected_even_where_its_score_would_do():
    assert claimed([[0, 1, 2, 4, 4]], QUERY, AXES) == ["query 0: a slot comes twice in [0, 1, 2, 4, 4]"]


@pytest.mark.parametrize("slot", [-1, 6])
def test_padding_and_slots_that_do_not_exist_are_rejected(slot):
    found = disagreements(AXES, QUERY, np.array([[0.8, 0.48]], np.float32), np.array([[0, slot]]), 1e-6)
    assert found == [f"query 0: slots must be in 0..5; got [0, {slot}]"]


def test_results_of_another_shape_are_rejected():
    assert "shape" in disagreements(AXES, QUERY, np.zeros((1, 2), np.float32), np.zeros((1, 3), int), 1e-6)[0]


class Fixed(VectorIndex):
    """An index that always returns the same slots, with their true scores."""

    kind = "fixed"

    def _search(self, queries, k, live):
        slots = np.tile(np.array(self.seed)[:k], (len(queries), 1))
        return np.take_along_axis(queries @ self._vectors.T, slots, axis=1), slots


@pytest.mark.parametrize(
    ("slots", "recall"), [([0, 1, 2], 1.0), ([0, 1, 3], 2 / 3), ([3, 4, 5], 0.0), ([2, 1, 0], 1.0)]
)
def test_recall_is_the_share_of_the_best_that_is_found(slots, recall):
    assert recall_against_exact(Fixed(AXES, None, slots, None), QUERY, 3) == pytest.approx(recall)


def test_recall_counts_a_tie_partner_as_found():
    assert recall_against_exact(Fixed(AXES, None, [0, 1, 2, 5], None), QUERY, 4) == 1.0


def test_recall_of_more_than_there_is_is_over_what_there_is():
    assert recall_against_exact(ExactIndex.build(AXES), QUERY, 50) == 1.0


def test_recall_without_queries_is_refused():
    with pytest.raises(ParameterError, match="at least one query"):
        recall_against_exact(ExactIndex.build(AXES), np.empty((0, 6), np.float32))


def test_recall_of_the_whole_is_the_mean_over_any_partition():
    vectors = unit(800, 16)
    index = choice.load_kind("ivf_flat").build(vectors).tuned(probes=1)
    queries = sample_queries(vectors, 60)
    parts = [recall_against_exact(index, queries[start : start + 20]) for start in (0, 20, 40)]
    assert np.mean(parts) == pytest.approx(recall_against_exact(index, queries))


def test_sampled_queries_are_unit_vectors_near_the_data_and_follow_the_seed():
    vectors = unit(100, 64)
    queries = sample_queries(vectors, 50, seed=3)
    np.testing.assert_allclose(np.linalg.norm(queries, axis=1), 1, atol=1e-6)
    nearest = (queries @ vectors.T).max(axis=1)
    assert 0.8 < nearest.min() < nearest.max() < 0.98
    assert np.array_equal(queries, sample_queries(vectors, 50, seed=3))
    assert not np.array_equal(queries, sample_queries(vectors, 50, seed=4))


def test_the_time_of_a_query_is_the_median_without_the_first():
    ticks = iter([0.0, 0.001, 1.0, 1.009, 2.0, 2.002])
    assert query_ms(ExactIndex.build(AXES), AXES[:3], 2, clock=lambda: next(ticks)) == pytest.approx(2.0)


def scripted(monkeypatch, **ms: float) -> list[str]:
    """Let each kind take the given milliseconds; returns the kinds that were built, as they are built."""
    built: list[str] = []
    real = choice.load_kind

    def counting(name):
        built.append(name)
        return real(name)

    monkeypatch.setattr(choice, "load_kind", counting)
    monkeypatch.setattr(choice, "query_ms", lambda index, queries, k, clock: ms[index.kind])
    return built


VECTORS = unit(900, 16)


def test_without_a_budget_exact_search_is_taken_and_nothing_is_measured():
    def no_clock() -> float:
        raise AssertionError("nothing should be timed")

    got = choose_kind(VECTORS, None, clock=no_clock)
    assert (got.kind, got.measured_ms, got.recall) == ("flat", None, 1.0)
    assert got.reason == "Exact search: no time budget was asked for."


def test_exact_search_within_the_budget_is_kept_and_nothing_else_is_built(monkeypatch):
    built = scripted(monkeypatch, flat=3.0)
    got = choose_kind(VECTORS, 5)
    assert set(built) == {"flat"}
    assert got.reason == "Exact search: it takes 3 ms, within the budget of 5 ms."


def test_a_graph_is_taken_when_exact_search_breaks_the_budget_and_its_recall_is_said(monkeypatch):
    built = scripted(monkeypatch, flat=30.0, hnsw=0.5)
    got = choose_kind(VECTORS, 5)
    assert "ivf_flat" not in built
    assert (got.kind, got.exact_ms, got.measured_ms) == ("hnsw", 30.0, 0.5)
    assert got.recall >= 0.99
    assert got.reason == (
        "hnsw: exact search takes 30 ms, over the budget of 5 ms; this takes 0.5 ms, "
        f"with a measured recall@10 of {got.recall:.3f}."
    )


def test_inverted_lists_are_taken_when_the_graph_is_too_slow(monkeypatch):
    scripted(monkeypatch, flat=30.0, hnsw=8.0, ivf_flat=2.0)
    got = choose_kind(VECTORS, 5)
    assert (got.kind, got.measured_ms) == ("ivf_flat", 2.0)
    assert got.recall >= 0.99


def test_a_budget_that_nothing_meets_gets_the_fastest_and_says_so(monkeypatch):
    scripted(monkeypatch, flat=30.0, hnsw=8.0, ivf_flat=9.0)
    got = choose_kind(VECTORS, 5)
    assert got.kind == "hnsw"
    assert "over the budget too but the fastest" in got.reason


def test_exact_search_stays_where_nothing_faster_is_good_enough(monkeypatch):
    scripted(monkeypatch, flat=30.0, hnsw=40.0, ivf_flat=50.0)
    got = choose_kind(VECTORS, 5)
    assert (got.kind, got.recall) == ("flat", 1.0)
    assert "nothing faster reaches a recall@10 of 0.99" in got.reason


def test_a_kind_with_too_little_recall_is_not_taken(monkeypatch):
    scripted(monkeypatch, flat=30.0, hnsw=0.1, ivf_flat=0.1)
    monkeypatch.setattr(choice, "recall_against_exact", lambda index, queries, k: 0.98)
    assert choose_kind(VECTORS, 5, min_recall=0.99).kind == "flat"
    assert choose_kind(VECTORS, 5, min_recall=0.98).kind == "hnsw"


@pytest.mark.parametrize(("budget", "recall"), [(0, 0.9), (-1, 0.9), (float("nan"), 0.9), (1, 0), (1, 1.1)])
def test_budgets_and_recalls_out_of_range_are_refused(budget, recall):
    with pytest.raises(ParameterError, match="budget must be above 0 ms"):
        choose_kind(VECTORS, budget, recall)


def test_copies_are_left_out_of_the_measurement(monkeypatch):
    scripted(monkeypatch, flat=30.0, hnsw=0.5)
    got = choose_kind(np.repeat(VECTORS[:50], 30, axis=0), 5)
    assert (got.kind, got.recall) == ("hnsw", 1.0)


def test_operating_points_come_for_each_kind_and_setting_with_the_exact_one_at_recall_one():
    ticks = itertools.count()
    points = list(operating_points(VECTORS, ("flat", "hnsw", "ivf_flat", "ivf_pq"), clock=lambda: next(ticks)))
    assert [point.kind for point in points] == ["flat"] + ["hnsw"] * 6 + ["ivf_flat"] * 5 + ["ivf_pq"] * 5
    assert points[0].recall == 1.0
    assert all(point.ms == 1000.0 for point in points)
    assert points[6].recall >= points[1].recall


def test_a_choice_is_made_on_this_machine():
    got = choose_kind(VECTORS, 1e9)
    assert isinstance(got, Choice)
    assert got.kind == "flat"
    assert got.exact_ms is not None
    assert got.exact_ms > 0
