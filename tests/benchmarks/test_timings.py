"""The benchmarks run, at sizes too small for times to matter."""

import json
import math
from importlib.util import find_spec

import pytest

from benchmarks import again, build, cold, common, query, rerank
from tests.conftest import TINY

SMALLEST = {
    "rerank": (rerank.measure, {"candidates": (3, 40), "sample": 5, "repetitions": 1}, 3),
    "query": (query.measure, {"photos": 40, "repetitions": 1}, 2 if find_spec("onnxruntime") else 1),
    "build": (build.measure, {"photos": 3, "photo_px": 64, "repetitions": 1}, 1),
}


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


@pytest.mark.slow
def test_a_build_with_the_shipped_model_is_compared_with_its_encoder(monkeypatch):
    monkeypatch.setattr(common, "MIN_SECONDS", 0.0)
    (line,) = build.measure_shipped(photos=3, photo_px=64, repetitions=1)
    assert line.figures["build_per_s"] == pytest.approx(3 / line.each["build"][0])
    assert line.each["looking"] == [0.0]  # a build of so few photos does not tune


@pytest.mark.slow
def test_the_benchmark_of_a_rebuild_has_each_arm():
    (line,) = again.measure(photos=6, rounds=1)
    encoding = {"started", "first_encoding", "encoding"}
    assert set(line.figures) == {"photos", "first", "nothing", "one", "looking"} | encoding
    assert all(map(math.isfinite, line.figures.values()))  # differences of times may be below 0 for so few photos


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
