"""Shards compared with one folder, and the queues of many shards against results by hand."""

import json
import math
import sys

import numpy as np
import pytest

from benchmarks import queueing, shards
from benchmarks.queueing import ENCODE_S, HOP_S, ServiceTimes, answers, service_of, tables

MEASURED = [
    {
        "photos": photos,
        "shards": 10,
        "slowest_p50_s": 1e-7 * photos / 10,
        "folder_p50_s": 1e-7 * photos,
        "shard_p99_s": 2e-7 * photos / 10,
        "bytes_per_photo": 1000,
    }
    for photos in (1e4, 1e5, 1e6)
]


def test_drawn_times_have_the_measured_median_and_percentile():
    times = ServiceTimes(0.02, 0.05).draw(np.random.default_rng(0), (200_000,))
    assert np.median(times) == pytest.approx(0.02, rel=0.02)
    assert np.percentile(times, 99) == pytest.approx(0.05, rel=0.03)
    assert times.mean() == pytest.approx(ServiceTimes(0.02, 0.05).mean, rel=0.02)


def test_a_single_request_waits_for_its_slowest_shard():
    service = ServiceTimes(0.02, 0.04)
    one, many = (answers(shards, 1, service, rate=0.01) - ENCODE_S - HOP_S for shards in (1, 60))
    assert np.median(one) == pytest.approx(0.02, rel=0.05)
    spread = math.log(2) / 2.3263  # the median of the largest of 60: the 0.5 ** (1 / 60) quantile, 2.27 deviations
    assert np.median(many) == pytest.approx(0.02 * math.exp(2.27 * spread), rel=0.05)


def test_one_server_follows_the_pollaczek_khinchine_formula():
    """Mean wait = rate * E[S^2] / (2 (1 - rate E[S]))."""
    service = ServiceTimes(0.02, 0.04)
    waits = [answers(1, 1, service, rate=30.0, seed=seed).mean() - ENCODE_S - HOP_S for seed in range(10)]
    spread = math.log(2) / 2.3263
    second = 0.02**2 * math.exp(2 * spread**2)
    expected = service.mean + 30 * second / (2 * (1 - 30 * service.mean))
    assert np.mean(waits) == pytest.approx(expected, rel=0.1)


def test_a_lost_replica_and_a_slow_shard_cost_time():
    service = ServiceTimes(0.02, 0.04)
    plain, slow, lost = (answers(4, 2, service, 40.0, **options) for options in ({}, {"slow": 1}, {"lost": 1}))
    assert np.percentile(plain, 99) < np.percentile(lost, 99)
    assert np.median(slow) > np.median(plain) + 0.03


@pytest.mark.parametrize("photos", [1e3, 5e4, 1e6, 1e7])
def test_other_sizes_follow_the_measured_power_law(photos):
    assert service_of(photos, MEASURED).p50 == pytest.approx(1e-7 * photos)
    assert service_of(photos, MEASURED).p99 == pytest.approx(2e-7 * photos)


def test_the_tables_have_a_row_for_every_plan(monkeypatch):
    monkeypatch.setattr(queueing, "REQUESTS", 50)
    monkeypatch.setattr(queueing, "PLANS", {1e6: (1, 8), 1e7: (10,)})
    lines = list(tables(json.loads(json.dumps(MEASURED)), rate=5.0))
    assert sum(line.startswith("| 1e+06") for line in lines) == 3
    assert sum(line.startswith("| 1e+07") for line in lines) == 2
    # Of the shipped checkpoint: 384 bytes of embedding, 104 of a list's entry, 3,200 of cells; 90 photos a second.
    assert "| 1e+06 | 1 GB | 4.2 GB | 384 MB | 104 MB | 3 h | 0.0 h |" in lines


@pytest.mark.slow
def test_shards_answer_as_one_folder_does(monkeypatch, capsys):
    options = ["--sizes", "1e3", "--shards", "2", "--touches", "4", "--reranked", "2", "--json"]
    monkeypatch.setattr(sys, "argv", ["shards", *options])
    shards.main()
    measured, opened = map(json.loads, capsys.readouterr().out.splitlines())
    assert (measured["photos"], measured["shards"]) == (1000, 2)
    assert measured["all_scored_same"] == measured["top1_no_worse"] == 1
    assert list(opened) == ["client_open_1e+03_s"]
