"""The benchmarks of scale run, at sizes too small for times to matter."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import scale
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import Matcher
from tests.conftest import TINY


@pytest.fixture(scope="module")
def crowd():
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, candidate_width=8))
    torch.manual_seed(0)
    matcher = Matcher(config.matcher).eval()
    checkpoint = Checkpoint.__new__(Checkpoint)
    object.__setattr__(checkpoint, "matcher", matcher)
    rng = np.random.default_rng(0)
    photos, touches = (rng.normal(size=(n, config.matcher.partial_width)).astype(np.float32) for n in (50, 19))
    return scale.BlendedPhotos(checkpoint, matcher.head.scorer, photos, touches[:12], touches[12:])


def test_every_kind_returns_its_figures(crowd, tmp_path):
    size = scale.measure(crowd, 2000, ("flat", "IVF{lists},SQ8"), tmp_path / "index", queries=5)
    assert (size.photos, size.queries, size.held_out) == (2000, 5, 7)
    for kind in ("flat", "IVF{lists},SQ8"):
        figures = size.kinds[kind]
        assert 0 <= figures["low"] <= figures["recall"] <= figures["high"] <= 1
        assert all(figures[name] > 0 for name in ("k", "search_s", "rerank_s", "structure_s", "open_s", "gain"))
    text = "\n".join(scale.lines(size))
    assert "2,000 photos: written in " in text
    assert "  flat: " in text
    json.dumps(vars(size), allow_nan=False)


def test_held_out_touches_evaluate_the_number_of_candidates_that_others_chose(crowd, tmp_path, monkeypatch):
    """A search that never finds the top-1 of a held-out touch, and always that of the others."""
    numbers = {touch.tobytes(): number for number, touch in enumerate(crowd.embeddings(crowd.touches, "touch"))}

    def point(top1_of):
        found = SimpleNamespace(
            count=9,
            manifest=None,
            arrays={"partials": np.zeros((9, crowd.photos.shape[1]), np.float16)},
            index=SimpleNamespace(
                kind="flat",
                candidates=lambda query, k: [np.array([top1_of(numbers.get(query[0].tobytes()))])],
                search=lambda query, k: (None, np.array([[top1_of(numbers.get(query[0].tobytes()))]])),
            ),
        )
        touches = np.concatenate([crowd.touches, crowd.held_out])
        exhaustive_top1 = np.concatenate([np.arange(12), np.full(7, 8)]) % 9
        return scale._operating_point(crowd, found, touches, exhaustive_top1, choosing=12)

    missed = point(lambda number: 0 if number is None else number % 9)
    assert (missed["k"], missed["recall"], missed["needed"]) == (4, 0, 9)  # the choosing touches needed one
    assert point(lambda number: 8 if number is None else number % 9)["recall"] == 1


def test_a_kind_that_needs_more_photos_reports_it(crowd, tmp_path):
    size = scale.measure(crowd, 100, ("IVF{lists},SQ8",), tmp_path / "index", queries=2)
    assert "needs at least 312 photos" in "\n".join(scale.lines(size))


def test_the_exhaustive_top1_has_the_greatest_match_logit(crowd):
    partials = np.concatenate([block["partials"] for block in crowd.blocks(0, 60, 0)])
    exhaustive_top1, seconds = scale._top1(crowd.scorer, crowd.touches[:3], partials)
    with torch.inference_mode():
        head, photos = crowd.checkpoint.matcher.head, torch.from_numpy(partials.astype(np.float32))
        expected = [int(head(torch.from_numpy(touch[None]), photos).argmax()) for touch in crowd.touches[:3]]
    assert exhaustive_top1.tolist() == expected
    assert seconds > 0


def test_the_slope_of_a_power_of_n_is_its_exponent():
    sizes = [
        scale.Size(n, figures={"exhaustive_s": 3 * n**0.7}, kinds={"flat": {"search_s": 2.0 * n}})
        for n in (10**3, 10**4, 10**6)
    ]
    assert dict(scale.slopes(sizes)) == pytest.approx({"exhaustive_s": 0.7, "flat search_s": 1.0})
