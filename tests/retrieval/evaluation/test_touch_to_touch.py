"""Touch to touch: nothing uses the query, sessions are compared with each other, controls are measured."""

import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.dataset import Grasp
from retrieval.errors import DatasetError
from retrieval.evaluation.results import read_results
from retrieval.evaluation.sequences import MOST_TOUCHES, Sequences, cosines, leave_one_out_scores
from robot.importers.estimate_modulus import import_estimate_modulus
from robot.importers.physiclear import import_physiclear
from tests.miniatures import estimate_modulus, physiclear

# Scores ----------------------------------------------------------------------------------------------------


def by_plain_loops(vectors, components):
    """Standardise and fit components by an SVD without row q; then compute each cosine."""
    scores = np.zeros((len(vectors), len(vectors)))
    for q in range(len(vectors)):
        others = np.delete(vectors, q, axis=0)
        mean, deviation = others.mean(0), others.std(0)
        axes = np.linalg.svd((others - mean) / deviation, full_matrices=False)[2][:components]
        codes = (vectors - mean) / deviation @ axes.T
        for other in range(len(vectors)):
            if other != q:
                length = np.linalg.norm(codes[q]) * np.linalg.norm(codes[other])
                scores[q, other] = codes[q] @ codes[other] / length
    return scores


@pytest.mark.parametrize("components", [1, 8])
def test_scores_are_cosines_of_principal_components_without_the_query(components):
    vectors = np.random.default_rng(3).normal(size=(11, 20)) * np.linspace(0.1, 30, 20) + 5
    expected = by_plain_loops(vectors, components)
    np.testing.assert_allclose(leave_one_out_scores(vectors, components), expected, atol=1e-5)


def test_scores_across_sessions_depend_on_the_references_and_the_query_only():
    vectors = np.random.default_rng(5).normal(size=(12, 20)) * np.linspace(0.1, 30, 20) + 5
    together = cosines(vectors[:8], vectors[8:], vectors[:6])
    alone = np.concatenate([cosines(vectors[:8], query[None], vectors[:6]) for query in vectors[8:]])
    np.testing.assert_allclose(together, alone, atol=1e-6)
    np.testing.assert_allclose(together[0], by_plain_loops(vectors[:9], 7)[8, :6], atol=1e-5)


# Sequences -------------------------------------------------------------------------------------------------


def grasps(counts, session=None):
    """Return two frames of each video of an object."""
    return [
        Grasp(f"{name}-{video}-{frame}", name, f"{name}-{video}", None, (Path("t"),), (Path("u"),), session=session)
        for name, count in counts.items()
        for video in range(count)
        for frame in range(2)
    ]


def test_a_sequence_is_the_mean_of_its_own_grasps():
    sequences = Sequences.of(grasps({"a": 2, "b": 2}))
    assert sequences.names == ("a-0", "a-1", "b-0", "b-1")
    assert sequences.owner.tolist() == [0, 0, 1, 1]
    features = np.arange(8, dtype=np.float32)[:, None]
    assert sequences.mean(features).ravel().tolist() == [0.5, 2.5, 4.5, 6.5]


@pytest.mark.parametrize(
    ("counts", "message"), [({"a": 2, "b": 1}, "and b has 1 sequence"), ({"a": 3}, r"has 1 object\(s\)")]
)
def test_one_sequence_of_an_object_or_one_object_is_refused(counts, message):
    with pytest.raises(DatasetError, match=message):
        Sequences.of(grasps(counts))


def described(sequences):
    """Return the names of queries and gallery of each round, and the number of fitted sequences."""
    names = np.array(sequences.names)
    return [(" ".join(names[one.queries]), " ".join(names[one.gallery]), len(one.fitted)) for one in sequences.rounds]


def test_objects_of_both_sessions_are_compared_in_both_directions():
    """Scaling and components are those of all references, also of objects without queries."""
    late, tuesday = grasps({"a": 1, "b": 2, "c": 1}, "late"), grasps({"b": 1, "a": 1, "d": 1}, "tuesday")
    mixed = [late[0], *tuesday, *late[1:]]  # as in a folder: one session follows the other in the order of capture
    sequences = Sequences.of([*mixed, *grasps({"a": 1})], "across")
    assert described(sequences) == [("b-0 a-0", "a-0 b-0 b-1", 4), ("a-0 b-0 b-1", "b-0 a-0", 3)]
    assert "tuesday against late: 2 queries, 3 references of 2 objects" in sequences.rule
    assert sequences.rule.endswith(" 2 grasps name no session and are left out.")
    one = Sequences.of([*grasps({"a": 2, "b": 2}, "late"), *grasps({"a": 3, "b": 3})], "across")
    assert "not compared: 12 grasps name none, all others the same one." in one.rule
    with pytest.raises(
        DatasetError, match=r"no two of late, tuesday have such objects in common.*touch-to-touch-within"
    ):
        Sequences.of([*late, *grasps({"b": 1, "d": 1}, "tuesday")], "across")


def test_within_a_session_the_gallery_is_the_rest_of_the_session_and_else_the_rest_of_the_recording():
    both = [*grasps({"a": 2, "b": 2}, "late"), *grasps({"b": 2, "c": 2}, "tuesday")]
    within = Sequences.of(both, "within").rounds
    assert [(one.is_leave_one_out, one.queries.tolist()) for one in within] == [
        (True, [0, 1, 2, 3]),
        (True, [4, 5, 6, 7]),
    ]
    assert [len(one.gallery) for one in Sequences.of(both).rounds] == [6]  # b-0 of both days is one sequence


def test_late_touches_are_compared_with_early_ones_if_every_object_has_one_sequence():
    long = [replace(grasp, sequence_id=grasp.object_id) for grasp in grasps({"a": 3, "b": 60})]
    sequences = Sequences.of(long, "across")
    ((queries, gallery, _),) = described(sequences)
    assert gallery.split()[:2] == ["a-0-0", "a-0-1"]
    assert queries.split()[:2] == ["a-2-0", "a-2-1"]
    assert len(queries.split()) == len(gallery.split()) == 2 + MOST_TOUCHES
    assert (gallery.split()[-1], queries.split()[2]) == ("b-19-1", "b-40-0")


# The protocol ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The miniature as a recording: 2 parts with 3 videos each; the colour of the gel identifies the part."""
    folder = tmp_path_factory.mktemp("physiclear")
    physiclear.write(folder / "data" / "physiclear")
    import_physiclear(folder / "data" / "physiclear", folder / "recording")
    return folder


def evaluate(recording, out, *more):
    options = ["--config", "tiny", "--protocol", "physiclear", "--seeds", "2", "--methods", "chance", *more]
    return main(["evaluate", str(recording / "data"), "--out", str(out), *options])


def read(out):
    return read_results(out / "results.json").protocols["physiclear"]


@pytest.fixture(scope="module")
def out(recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "report"
    assert evaluate(recording, folder) == 0
    return folder


def test_a_tower_is_compared_with_three_controls(out):
    entry = read(out)
    assert set(entry.rows) == {"frozen"}
    for row in entry.rows.values():
        summary = row.measures["recall_1"]
        assert (summary.queries, summary.objects) == (6, 2)
        assert summary.chance[0] == pytest.approx(2 / 5)  # two of five other videos
        assert set(row.differences) == {"low_pass", "order", "no_contact"}
        lows = [found["recall_1"].low for found in row.differences.values()]
        assert row.verdict.counts_as_touch == all(low > 0 for low in lows)
    assert entry.comparisons == []
    assert set(entry.controls) == {"no_contact", "order", "permuted"}
    assert len(entry.controls["permuted"].measures["recall_1"].repeats) == 2
    # The gels have a colour for each part: the no-contact frame identifies the part, and so does the order.
    assert entry.controls["no_contact"].measures["recall_1"].value[0] == 1.0
    assert entry.controls["order"].measures["recall_1"].value[0] >= 2 / 3
    text = (out / "report.md").read_text().replace("\\", "")
    for words in ("one video left out", "| permuted |", "| frozen |", "the no-contact frame as input"):
        assert words in text


def test_the_towers_of_other_configurations_are_rows_compared_with_the_first(recording, tmp_path):
    larger = tmp_path / "larger.toml"
    tiny = (resources.files("retrieval") / "configs" / "tiny.toml").read_text()
    larger.write_text(tiny.replace("touch_px = 32", "touch_px = 48"))
    assert evaluate(recording, tmp_path / "report", "--compare", "same=tiny", f"larger={larger}") == 0
    found = read(tmp_path / "report")
    assert list(found.rows) == ["frozen", "same", "larger"]
    assert found.rows["same"].measures == found.rows["frozen"].measures
    differences = {(one.a, one.b): one.difference for one in found.comparisons if one.measure == "map"}
    same = differences["same", "frozen"]
    assert (same.low, same.value, same.high) == (0, 0, 0)
    assert ("larger", "frozen") in differences


@pytest.fixture(scope="module")
def two_days(tmp_path_factory):
    """The miniature of EstimateModulus as a recording: two days, which share two objects."""
    folder = tmp_path_factory.mktemp("days")
    estimate_modulus.write(folder / "src")
    return import_estimate_modulus(folder / "src", folder / "recording").folder


def run(recording, out, *more):
    options = ["--config", "tiny", "--seeds", "2", "--out", str(out), *more]
    assert main(["evaluate", str(recording), "--protocol", "touch-to-touch", *options]) == 0
    return read_results(out / "results.json").protocols["touch-to-touch"]


def test_a_recording_of_two_sessions_is_compared_across_them_with_counts_of_both_directions(two_days, tmp_path):
    entry = run(two_days, tmp_path / "out")
    directions = [label for name, label in entry.labels if name.startswith("recall_1_")]
    assert directions == ["top-1, 2023-12-16 against 2023-12-06", "top-1, 2023-12-06 against 2023-12-16"]
    measures = entry.rows["frozen"].measures
    assert (measures["recall_1"].queries, measures["recall_1_0"].queries, measures["recall_1"].objects) == (8, 4, 2)
    assert measures["recall_1"].value[0] == np.mean([measures[f"recall_1_{number}"].value[0] for number in (0, 1)])
    assert entry.controls["order"].measures["recall_1"].value[0] == 0.5 == measures["recall_1"].chance[0]


def test_touches_without_no_contact_frames_are_compared_as_they_are(two_days, tmp_path):
    without = shutil.copytree(two_days, tmp_path / "recording")
    lines = (without / "metadata.jsonl").read_text()
    (without / "metadata.jsonl").write_text(lines.replace("touch_a_before_file_name", "other"))
    entry = run(without, tmp_path / "out")
    assert entry.controls["no_contact"].reason == "the recording lacks no-contact frames"
    assert "Features of the touches themselves are compared" in entry.rule
