"""The benchmarks run, at sizes too small for times to matter."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from benchmarks import again, recipes, rerank, scale
from benchmarks.frontier import APPROXIMATIONS, NEED_NO_MODEL
from benchmarks.frontier.__main__ import main
from retrieval import frontier
from retrieval.frontier.sample import Sample, Scale
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import shipped_model
from tests import synthetic
from tests.conftest import TINY
from tests.documents import ROOT


@pytest.fixture(scope="module")
def rows(model, tmp_path_factory):
    """Every row of the frontier of kernels, measured once, with objects that no model was trained on."""
    folder = tmp_path_factory.mktemp("unseen")
    unseen = synthetic.write_recording(folder / "recording", synthetic.make_objects(4, seed=77), 2)
    sample = Sample(model, lambda: unseen, folder, Scale(photos=700, queries=4, repeats=1, quick=True))
    return {name: APPROXIMATIONS.load(name)(sample) for name in APPROXIMATIONS}


@pytest.mark.parametrize("name", sorted(APPROXIMATIONS))
def test_every_approximation_has_points_a_reference_and_a_default_within_its_tolerance(name, rows):
    row = rows[name]
    assert row.title
    assert row.text
    assert row.panels
    for panel in row.panels:
        assert panel.reference
        assert panel.recommended in panel.points
        assert all(point.seconds > 0 and np.isfinite(point.error) and point.error >= 0 for point in panel.points)
        assert len({point.name for point in panel.points}) == len(panel.points)
        if name not in ("contact", "gel_optics"):  # their smallest sizes leave the default out
            assert panel.default
        if name in ("rays", "cca_solver", "sky_occlusion"):
            assert panel.default.error <= panel.tolerance


def test_the_frontier_of_kernels_plots_a_row_without_a_recording(model, tmp_path, capsys):
    assert "cca_solver" in NEED_NO_MODEL
    main(["--out", str(tmp_path), "--model", str(model), "--quick", "--only", "cca_solver"])
    assert "cca_solver: canonical correlations" in capsys.readouterr().err
    assert (tmp_path / "figures" / "cca_solver.png").is_file()
    assert not (tmp_path / "recording").exists()


def test_the_page_of_results_names_every_approximation_of_kernels_and_counts_those_of_a_search():
    text = (ROOT / "docs" / "results.md").read_text("utf-8")
    assert [name for name in APPROXIMATIONS if f"`{name}`" not in text] == []
    assert f" {len(frontier.APPROXIMATIONS)} approximations of a search" in text


def test_time_against_the_number_of_photos(tmp_path):
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, candidate_width=8))
    torch.manual_seed(0)
    matcher = Matcher(config.matcher).eval()
    checkpoint = Checkpoint.__new__(Checkpoint)
    object.__setattr__(checkpoint, "matcher", matcher)
    rng = np.random.default_rng(0)
    photos, touches = (rng.normal(size=(n, config.matcher.partial_width)).astype(np.float32) for n in (50, 19))
    crowd = scale.BlendedPhotos(checkpoint, matcher.head.scorer, photos, touches[:12], touches[12:])
    size = scale.measure(crowd, 2000, ("flat", "IVF{lists},SQ8", "IVF{lists},PQ16"), tmp_path / "index")
    assert (size.photos, size.queries, size.held_out) == (2000, 12, 7)
    for kind in ("flat", "IVF{lists},SQ8"):
        figures = size.kinds[kind]
        assert 0 <= figures["low"] <= figures["recall"] <= figures["high"] <= 1
        assert all(figures[name] > 0 for name in ("k", "search_s", "rerank_s", "structure_s", "open_s", "gain"))
    assert "refused" in size.kinds["IVF{lists},PQ16"]
    assert "2,000 photos: written in " in "\n".join(scale.lines(size))
    json.dumps(vars(size), allow_nan=False)


def test_reranking_with_cells_is_compared_with_reranking_without():
    text = rerank.measure(read_checkpoint_info(shipped_model()).config.matcher, candidates=3, repetitions=1)
    assert text.startswith("3 candidates with ")


@pytest.mark.slow
def test_builds_again_are_timed():
    text, seconds = again.measure(photos=60, rounds=1)
    assert text.startswith("60 photos, CPU time of one thread: one new photo ")
    assert min(seconds.values()) > 0


@pytest.mark.slow
def test_recipes_are_compared_on_objects_that_were_left_out(recording):
    found, taken, _ = recipes.measure(recording, 8, 3, 1, "random", 0)
    assert {len(accuracy.by_object()[0]) for accuracy in found.values()} == {3}
    assert found[recipes.TAKEN].values.tolist() == found[taken[0]].values.tolist()
