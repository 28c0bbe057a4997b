"""The benchmarks run, at sizes too small for times to matter."""

import math

import pytest

from benchmarks import again, rerank
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.shipped import shipped_model


def test_reranking_with_cells_is_compared_with_reranking_without():
    text = rerank.measure(read_checkpoint_info(shipped_model()).config.matcher, candidates=3, repetitions=1)
    assert text.startswith("3 candidates with ")


@pytest.mark.slow
def test_the_benchmark_of_a_rebuild_has_each_arm():
    text, seconds = again.measure(photos=6, rounds=1)
    assert text.startswith("6 photos, ")
    assert set(seconds) == {"first", "nothing", "one", "looking", "started", "first_encoding", "encoding"}
    assert all(map(math.isfinite, seconds.values()))  # differences of times may be below 0 for so few photos
