"""Error against run time: recommended points, measurements of every row, defaults equal to those of the code, and the
page and the command."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import indexes
from _touch_retrieval.registry import Registry
from retrieval.commands.frontier import recording_of
from retrieval.commands.main import main
from retrieval.errors import ConfigError, DatasetError
from retrieval.frontier import APPROXIMATIONS
from retrieval.frontier.candidates import default_k
from retrieval.frontier.formats import encoders
from retrieval.frontier.measure import measure_frontier
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.report import write_frontier
from retrieval.frontier.sample import Sample, Scale
from retrieval.indexing.candidates import measure_candidates
from retrieval.model.candidate_encoder import CandidateEncoder
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.encode import encode_touches
from retrieval.training.batches import BatchImages
from tests import synthetic

TINY = Scale(photos=700, queries=6, repeats=1, quick=True)


def panel(*points, tolerance=1.0):
    made = tuple(Tradeoff("", f"s{place}", error, seconds=seconds) for place, (seconds, error) in enumerate(points))
    return Panel("errors", "one go", "%", "the truth", tolerance, made)


@pytest.fixture(scope="module")
def unseen(tmp_path_factory):
    """A recording of eight unseen objects with four grasps each."""
    folder = tmp_path_factory.mktemp("unseen") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8, seed=77), 4)


@pytest.fixture(scope="module")
def sample(unseen, model, tmp_path_factory):
    return Sample(model, lambda: unseen, tmp_path_factory.mktemp("features"), TINY)


def test_the_front_has_the_points_that_no_other_beats_in_both():
    made = panel((1, 5), (2, 6), (2, 3), (3, 3), (4, 1))
    assert [point.setting for point in made.pareto()] == ["s0", "s2", "s4"]


@pytest.mark.parametrize(
    ("points", "default", "line"),
    [
        (((1, 5), (3, 0.5), (2e-3, 1.0), (4, 0.0)), None, "cheapest within 1: s2: 1 %, 2 ms; default: none"),
        (((1, 5), (3, 2), (2, 2)), 0, "none within 1, smallest error: s2: 2 %, 2 s; default: s0: 5 %, 1 s"),
        (((4.5e-5, 0.5), (2, 0)), 0, "cheapest within 1: s0: 0.500 %, 45 us; default: the same"),
    ],
)
def test_the_fastest_within_the_tolerance_is_recommended_else_that_of_the_smallest_error(points, default, line):
    made = panel(*points)
    marked = [dataclasses.replace(point, is_default=row == default) for row, point in enumerate(made.points)]
    assert dataclasses.replace(made, points=tuple(marked)).line() == f"errors (against the truth); {line}"


@pytest.mark.parametrize("name", sorted(APPROXIMATIONS))
def test_every_row_has_points_a_reference_and_one_default(name, sample):
    row = APPROXIMATIONS.load(name)(sample)
    assert row.title
    assert row.text
    assert row.panels
    for each in row.panels:
        assert each.reference
        assert each.time
        assert each.recommended in each.points
        assert all(point.seconds > 0 and np.isfinite(point.error) and point.error >= 0 for point in each.points)
        assert len({(point.series, point.setting) for point in each.points}) == len(each.points)
        assert sum(point.is_default for point in each.points) == 1


def test_the_default_kind_and_number_of_candidates_are_those_of_build_index(candidate_sample):
    photos, queries = candidate_sample.catalogue, candidate_sample.queries["partial"].astype(np.float16)
    checkpoint = dataclasses.replace(candidate_sample.checkpoint, queries=queries)
    index = indexes.build(photos["candidate encoder"])
    assert default_k(candidate_sample) == measure_candidates(checkpoint, index, photos["partial"])["k"]
    kinds = APPROXIMATIONS.load("index_kinds")(candidate_sample)
    assert all(one.default.series == index.kind for one in kinds.panels)


@pytest.fixture(scope="module")
def candidate_sample(sample):
    """The sample with an untrained candidate encoder."""
    matcher = load_checkpoint(sample.model).matcher
    torch.manual_seed(0)
    config = dataclasses.replace(
        sample.checkpoint.config, matcher=dataclasses.replace(matcher.config, candidate_width=8)
    )
    matcher.candidate_encoder = CandidateEncoder(matcher.config.partial_width, 8, matcher.config.embedding_dim).eval()
    other = dataclasses.replace(sample)
    other.__dict__["checkpoint"] = dataclasses.replace(sample.checkpoint, matcher=matcher, config=config)
    return other


def test_touches_are_encoded_by_the_default_of_the_towers(sample):
    matcher = sample.checkpoint.matcher
    images = [BatchImages(sample.checkpoint.config.preprocessing).touch(sample.grasps[sample.touch_rows[0]])]
    default = next(encode for _, encode, is_default in encoders(sample.checkpoint) if is_default)
    assert np.array_equal(default(images), encode_touches(matcher, images).partial.numpy())
    assert not any(module.training for module in matcher.modules())


def test_grasps_provide_a_photo_or_a_touch_and_every_object_both(sample):
    photos, touches = set(sample.photo_rows.tolist()), set(sample.touch_rows.tolist())
    assert not photos & touches
    assert photos | touches == set(range(len(sample.grasps)))
    for rows in (photos, touches):
        assert len({sample.grasps[row].object_id for row in rows}) == 8


def test_trained_objects_are_left_out_and_too_few_others_refused(model, recording, tmp_path):
    own = Sample(model, lambda: recording, tmp_path, TINY)
    assert {grasp.object_id for grasp in own.grasps} == set(load_checkpoint(model).split.test)
    few = synthetic.write_recording(tmp_path / "few", synthetic.make_objects(12)[:1], 3)
    with pytest.raises(DatasetError, match="at least 2 objects that the model was not trained on"):
        _ = Sample(model, lambda: few, tmp_path, TINY).grasps


def test_exhaustive_top1_is_the_highest_logit(sample):
    partials = sample.catalogue["partial"].astype(np.float32)
    table = np.array([sample.logits(touch_partial, partials) for touch_partial in sample.queries["partial"]])
    assert sample.exhaustive_top1.tolist() == table.argmax(1).tolist()


def not_needed():
    raise AssertionError("no recording is needed")


CALLS = []
"""Names of the measured rows."""
TABLE = Registry("approximation", "tests", {name: f"{__name__}:{name}" for name in ("one", "other")}, error=ConfigError)


def one(sample):
    CALLS.append("one")
    return ApproximationResult("one", "text", (panel((1e-3, 2)),))


def other(sample):
    CALLS.append("other")
    if CALLS.count("other") == 1:
        raise KeyboardInterrupt
    return ApproximationResult("other", "text", (panel((1e-3, 2)),))


def test_finished_rows_are_reused_until_their_inputs_change_or_the_cache_is_damaged(model, tmp_path):
    def measure(*only, **changed):
        options = {"table": TABLE, "model_free": TABLE, "quick": True} | changed
        return measure_frontier(tmp_path, model, not_needed, only=only, **options)

    with pytest.raises(KeyboardInterrupt):
        measure()
    document = measure()
    assert list(document["rows"]) == ["one", "other"]
    assert CALLS == ["one", "other", "other"]
    assert json.loads((tmp_path / "frontier.json").read_text()) == document == measure()
    point = document["rows"]["one"]["panels"][0]["points"][0]
    assert (point["setting"], point["error"], point["seconds"]) == ("s0", 2, 1e-3)
    measure("one", queries=3)
    (tmp_path / "cache.sqlite").write_bytes(b"damaged")
    measure("one")
    assert CALLS[3:] == ["one", "one"]


@pytest.mark.parametrize("errors", [(3.0, 1.0, 0.0), (0.0, 0.0), (5.0,)], ids=["falling", "no errors", "one point"])
def test_a_page_has_the_plot_the_reason_of_a_skipped_row_and_every_point(errors, tmp_path):
    points = tuple(
        Tradeoff("a", f"k = {k}", error, (0.0, error + 1), seconds=1e-3 * (k + 1)) for k, error in enumerate(errors)
    )
    made = Panel("missed", "one query", "%", "every photo reranked", 1.5, points)
    rows = {
        "candidates": ApproximationResult("Candidates", "What is measured.", (made,)),
        "towers": ApproximationResult("Towers", "Left out: nothing to measure."),
    }
    machine = {"processor": "a <fast> one", "cores": 2, "system": "Linux"}
    _, page, plot = write_frontier(tmp_path, rows, machine, True)
    text = page.read_text()
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert text.count("data:image/png;base64,") == 1
    for words in ("every photo reranked", "a &lt;fast&gt; one", "A quick run", "Left out: nothing to measure."):
        assert words in text
    assert all(f"k = {k}" in text for k in range(len(errors)))


def test_the_command_writes_a_page_and_prints_a_line_for_each_panel(model, recording, tmp_path, capsys):
    command = ["frontier", "--out", str(tmp_path), "--model", str(model), "--recording", str(recording)]
    assert main([*command, "--only", "partials", "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["rows"].keys() == {"partials"}
    assert "partials: largest error of a match logit (against partial activations in float32)" in output.err
    assert (tmp_path / "figures" / "partials.png").is_file()
    assert (tmp_path / "frontier.html").is_file()
    assert not (tmp_path / "recording").exists()
    assert main([*command, "--only", "speed"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("retrieve frontier: approximation must be one of")


def test_without_a_recording_a_small_one_is_collected_once(tmp_path, capsys):
    first = recording_of(None, tmp_path, quick=True)
    lines = (first / "metadata.jsonl").read_bytes()
    assert recording_of(None, tmp_path, quick=True) == first
    assert (first / "metadata.jsonl").read_bytes() == lines
    assert "of 6 simulated objects" in capsys.readouterr().err
