"""The benchmarks run, at sizes too small for times to matter."""

import json
import math
import sys
import time
from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks import __main__ as program
from benchmarks import (
    again,
    arm,
    build,
    cameras,
    cold,
    common,
    cylinder,
    gpu,
    gripper,
    growth,
    large,
    peers,
    query,
    rerank,
    simulation,
    step,
    table,
    training,
    versions,
)
from retrieval.model.encode import has_fast_bfloat16
from tests.conftest import TINY

SMALLEST = {
    "rerank": (rerank.measure, {"candidates": (3, 40), "sample": 5, "repetitions": 1}, 3),
    "query": (query.measure, {"photos": 40, "repetitions": 1}, 2 if find_spec("onnxruntime") else 1),
    "build": (build.measure, {"photos": 3, "photo_px": 64, "repetitions": 1}, 1),
    "step": (step.measure, {"touches": 2, "photos_each": 2, "repetitions": 1}, 1),
}


def test_every_benchmark_has_a_smallest_case():
    assert set(SMALLEST) == set(program.BENCHMARKS)


@pytest.mark.parametrize("name", sorted(SMALLEST))
def test_a_benchmark_yields_its_lines(name, monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)  # one call of each arm
    measure, sizes, count = SMALLEST[name]
    lines = list(measure(TINY, **sizes))
    assert len(lines) == count
    for line in lines:
        assert str(line).startswith(f"{name}, small: ")
        assert all(value > 0 for value in line.figures.values())
        json.dumps(line.figures, allow_nan=False)


def test_large_photos_are_compared_with_themselves_reduced_and_saved_again():
    lines = list(large.measure(photos=2, side=64, sizes=((64, 64), (1600, 1600))))
    small, big, again = (line.figures for line in lines)
    assert (small["grey_levels"], small["same_top1"]) == (0, 1)
    assert 0 < big["grey_levels"] < 5
    assert 0 < again["logit"] <= again["most_logit"]
    for line in lines:
        json.dumps(line.figures, allow_nan=False)


def test_the_benchmark_of_a_card_runs_on_any_device(monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    lines = list(gpu.measure(TINY, "cpu:0", photos=3, repetitions=1))
    assert [line.text.split(",")[0] for line in lines] == ["build", "query", "train"]
    for line in lines:
        assert set(line.figures) == {"cpu_s", "cpu:0_s", "ratio"}
        json.dumps(line.figures, allow_nan=False)


def test_candidate_search_is_compared_with_the_plain_call(monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    monkeypatch.setattr(peers, "NAMED", (10, 50))
    lines = list(peers.named(photos=700, queries=3, repetitions=2))
    assert [(line.tower, line.figures["k"]) for line in lines] == [
        (kind, k) for kind in ("flat", "ivf_sq8", "hnsw") for k in (10, 50)
    ]
    for line in lines:
        ours, bare = line.each["ours"], line.each["bare"]
        assert line.figures["ratio"] == pytest.approx(np.median(ours) / np.median(bare))


@pytest.mark.slow
def test_a_build_with_the_shipped_model_is_compared_with_its_encoder(monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    (line,) = build.measure_shipped(photos=3, photo_px=64, repetitions=1)
    assert line.figures["build_per_s"] == pytest.approx(3 / line.each["build"][0])
    assert line.each["looking"] == [0.0]  # a build of so few photos does not tune


def test_a_row_of_the_table_has_medians_with_their_spread():
    row = table.TableRow("work", "ms", [2.0, 1.0, 1234.5], "other work", [4.0])
    assert str(row) == "| work | 2 (1 to 1,234) ms | other work | 4 (4 to 4) ms | 0.50 |"
    assert str(table.TableRow("work", "ms", [2.0])) == "| work | 2 (2 to 2) ms |  |  |  |"


@pytest.mark.slow
def test_a_section_of_the_table_is_measured_in_a_separate_process():
    rows = list(table.rows("reranking"))
    assert [row.what for row in rows] == ["100 candidates reranked", "1,000 candidates reranked"]
    assert all(len(row.ours) == len(row.theirs) > 1 for row in rows)


def test_the_benchmark_of_training_has_rates_and_parts_of_a_step(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    with training.matching(TINY, recording, tmp_path) as (trainer, works):
        rates, parts = training.rates("small", works, threads=1, steps=1, repetitions=1)
        assert training.validation("small", trainer).figures["validation_s"] > 0
        if has_fast_bfloat16(trainer.device):
            assert 0 < training.rounding("small", trainer, works["cached"]).figures["apart"] < 1
    images = 4 * 2 + len(trainer.sampler.batch(0, 4).photos)
    assert works["cached"].images == images
    rate = rates.figures
    assert rate["ratio_cached"] == pytest.approx(rate["cached_per_s"] / rate["bare_per_s"])
    assert list(parts.figures) == ["draw and decode_s", "draw and map_s", "forward_s", "backward_s", "optimiser_s"]


@pytest.mark.slow
def test_the_benchmark_of_training_compares_two_processes_with_one(recording):
    (line,) = training.ranks(["small"], recording, "auto", rounds=1)
    figures = line.figures
    assert figures["ratio"] == pytest.approx(figures["one_s"] / figures["two_s"])
    assert figures["ratio_cpu"] == pytest.approx(figures["alone_cpu_s"] / figures["two_cpu_s"])


@pytest.mark.slow
def test_the_benchmark_of_a_rebuild_has_each_arm():
    (line,) = again.measure(photos=6, rounds=1)
    encoding = {"started", "first_encoding", "encoding"}
    assert set(line.figures) == {"photos", "unnoted", "verify", "nothing", "one", "looking"} | encoding
    assert all(map(math.isfinite, line.figures.values()))  # differences of times may be below 0 for so few photos


def test_every_engine_uses_the_least_width_that_finds_enough():
    lines = list(peers.measure(photos=700, queries=10))
    assert [line.tower for line in lines] == 2 * list(peers.ENGINES)
    for line in lines:
        assert line.figures["recall"] > 0.8
        assert line.figures["query_us"] > 0
    width_of = peers.GraphIndex(lambda query, width: np.arange(width), (1, 10, 20))
    vectors = np.eye(30, peers.DIM, dtype=np.float32)
    assert peers.least_width(width_of, vectors, vectors[:1]) == 10


@pytest.mark.slow
def test_the_parts_of_a_simulated_grasp_are_compared_with_another_checkout():
    made = simulation.compare_checkouts(
        {"ours": simulation.ROOT, "before": simulation.ROOT}, rounds=1, objects=1, grasps=1
    )
    assert set(made["ours"]) == set(made["before"]) >= {"photo of 256 px", "two contacts", "attempt with its files"}
    texts = [simulation.line(part, ours, made["before"][part]) for part, ours in made["ours"].items()]
    assert all(" ms, " in each and " times (" in each for each in texts)


@pytest.mark.slow
def test_builds_queries_and_collection_of_two_versions_are_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(versions, "PHOTOS", 3)
    monkeypatch.setattr(versions, "OBJECTS", 2)
    compared = {name: versions.Version(versions.ROOT, tmp_path / name) for name in ("before", "now")}
    lines = [line.split(" | ") for line in versions.lines(compared, tmp_path, repetitions=1)]
    assert len(lines) == 7
    assert all(before.endswith(" ms") and now.endswith(" ms") for _, before, now, _ in lines)
    assert (tmp_path / "now" / "build 0" / "CURRENT").exists()
    assert (tmp_path / "before" / "two 0" / "recording.json").exists()


def test_the_slope_of_a_growth_is_its_power():
    assert growth.slope({1: 3.0, 2: 3.0 * 2**1.5, 8: 3.0 * 8**1.5}) == pytest.approx(1.5)


@pytest.mark.slow
def test_growth_is_measured_with_grasps_objects_and_touches():
    tables = [*growth.collecting([1, 2], [1, 2], rounds=1), *growth.querying([1, 2], rounds=1, photos=9)]
    assert [what for what, _ in tables] == ["grasps per object", "objects", "grasps per query"]
    for _, seconds in tables:
        assert list(seconds) == [1, 2]
        assert min(seconds.values()) > 0


OF_DEVICES = {
    "gripper": lambda: gripper.measure(trips=5, grasps=1, seconds=0.05),
    "arm": lambda: arm.measure(calls=5),
    "cameras": lambda: cameras.measure(seconds=0.2),
}


@pytest.mark.parametrize("name", sorted(OF_DEVICES))
def test_a_benchmark_of_devices_yields_its_lines(name):
    lines = list(OF_DEVICES[name]())
    assert len(lines) > 2
    for line in lines:
        assert str(line).startswith(f"{name}, ")
        json.dumps(line.figures, allow_nan=False)


@pytest.mark.slow
def test_a_cold_query_is_timed_step_by_step_for_each_backend(model):
    lines = list(cold.measure(photos=12, repetitions=1, model=model))
    assert len(lines) == 1 + SMALLEST["query"][2]
    for line in lines[1:]:
        steps = [name for name in line.figures if name.endswith(" ms")]
        assert [f"{stage} ms" for stage in query.STAGES] == steps[-6:-2]
        assert sum(line.figures[name] for name in steps) == pytest.approx(line.figures["total_ms"])


def test_the_query_benchmark_of_the_shipped_model_ends_with_the_time_of_opening():
    *queries, opening = query.measure_shipped(photos=40, repetitions=1)
    assert len(queries) == SMALLEST["query"][2]
    assert set(opening.figures) == {"photos", "open_s"}


def test_the_table_of_cylinders_has_a_line_for_each_case():
    lines = list(cylinder.measure(count=1))
    assert [line.tower for line in lines] == [*cylinder.CASES, "R33 h120 of glass"]
    for line in lines:
        json.dumps(line.figures, allow_nan=False)
        assert line.figures["worst_mm"] < 6.0
    assert str(lines[0]).startswith("cylinder, R33 h120: centre 0.")


def test_the_arms_take_turns_and_the_first_round_is_not_measured(monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    order = []
    times = common.in_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3
    low, high = sorted(times.seconds["a"][n] / times.seconds["b"][n] for n in range(2))
    assert times.ratio("a", "b")[1:] == (low, high)


def test_a_short_arm_is_called_until_its_time_is_measurable(monkeypatch):
    calls = {"short": 0, "long": 0}

    def arm(name, seconds):
        calls[name] += 1
        time.sleep(seconds)

    monkeypatch.setattr(common, "MIN_SECONDS", 0.5)
    common.in_turns({"short": lambda: arm("short", 0.002), "long": lambda: arm("long", 0.6)}, 1)
    assert calls["long"] == 2
    assert 2 < calls["short"] <= 251


def test_the_program_prints_one_document_per_line(monkeypatch, capsys):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    monkeypatch.setattr(program, "BENCHMARKS", {"step": lambda config: step.measure(TINY, 2, 2, 1)})
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--tower", "small", "resnet18", "--only", "step", "--json"])
    program.main()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["benchmark"] for line in lines] == ["step", "step"]


def test_the_presets_are_those_of_users():
    assert common.config_of("small").preprocessing.photo_px == 128
    paper = common.config_of("resnet18")
    assert (paper.matcher.tower, paper.matcher.hidden, paper.preprocessing.photo_px) == ("resnet18", 1024, 256)
