"""Touch to touch: nothing uses the left-out sequence, the common frame removes the leak, controls are measured."""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.images import read_rgb
from retrieval.errors import DatasetError
from retrieval.evaluation.results import Results, read_results
from retrieval.evaluation.touch_to_touch import Sequences, leave_one_out_scores, with_common_frame
from robot.importers.physiclear import import_physiclear
from tests.miniatures import physiclear

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


# Sequences -------------------------------------------------------------------------------------------------


def grasps(counts):
    """Return two frames of each video of an object."""
    return [
        Grasp(f"{name}-{video}-{frame}", name, f"{name}-{video}", Path("p"), (Path("t"),), (Path("u"),))
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


# The common no-contact frame -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The miniature as a recording: 2 parts with 3 videos each; the colour of the gel identifies the part."""
    folder = tmp_path_factory.mktemp("physiclear")
    physiclear.write(folder / "data" / "physiclear")
    import_physiclear(folder / "data" / "physiclear", folder / "recording")
    return folder


def test_images_on_the_common_frame_contain_only_the_contact_difference(recording, tmp_path):
    own = load_grasps(recording / "recording")
    moved = with_common_frame(own, tmp_path / "common")
    common = np.rint(255 * read_rgb(own[0].backgrounds[0]))
    for before, after in zip(own, moved, strict=True):
        touch, rest = (np.rint(255 * read_rgb(path)) for path in (before.touches[0], before.backgrounds[0]))
        expected = np.clip(common + touch - rest, 0, 255)
        np.testing.assert_array_equal(np.rint(255 * read_rgb(after.touches[0])), expected)
        assert after.backgrounds == own[0].backgrounds


# The protocol ----------------------------------------------------------------------------------------------


def evaluate(recording, out, *more):
    options = ["--config", "tiny", "--protocol", "physiclear", "--seeds", "2", "--methods", "chance", *more]
    return main(["evaluate", str(recording / "data"), "--out", str(out), *options])


def read(out):
    return read_results(out / "results.json", Results).protocols["physiclear"]


@pytest.fixture(scope="module")
def out(recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "report"
    assert evaluate(recording, folder) == 0
    return folder


def test_each_representation_is_compared_with_three_controls(out):
    entry = read(out)
    assert set(entry.rows) == {"frozen-difference", "frozen-common-frame"}
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
    for words in ("one video left out", "| permuted |", "frozen-common-frame", "the no-contact frame as input"):
        assert words in text


def test_the_towers_of_other_configurations_are_rows_compared_with_the_first(recording, tmp_path):
    larger = tmp_path / "larger.toml"
    tiny = (resources.files("retrieval") / "configs" / "tiny.toml").read_text()
    larger.write_text(tiny.replace("touch_px = 32", "touch_px = 48"))
    assert evaluate(recording, tmp_path / "report", "--compare", "same=tiny", f"larger={larger}") == 0
    found = read(tmp_path / "report")
    assert set(found.rows) == {
        f"{name}-{representation}"
        for name in ("frozen", "same", "larger")
        for representation in ("difference", "common-frame")
    }
    assert found.rows["same-difference"].measures == found.rows["frozen-difference"].measures
    differences = {(one.a, one.b): one.difference for one in found.comparisons if one.measure == "map"}
    same = differences["same-difference", "frozen-difference"]
    assert (same.low, same.value, same.high) == (0, 0, 0)
    assert ("larger-difference", "frozen-difference") in differences
