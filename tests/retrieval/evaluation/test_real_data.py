"""`retrieve evaluate --protocol` on miniature data sets: tables, controls, choices, checkpoints, wrong use."""

import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.evaluation import PROTOCOLS, protocol
from retrieval.evaluation.protocols import vt60
from retrieval.evaluation.results import read_results
from tests import real_data_sets
from tests.data import touch_data

TINY = ["--config", "tiny", "--seeds", "2", "--methods", "cca,chance"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder with billets/."""
    folder = tmp_path_factory.mktemp("data")
    real_data_sets.write_billets(folder / "billets")
    return folder


def evaluate(data, out, *more, methods=TINY):
    return main(["evaluate", str(data), "--out", str(out), *methods, *more])


def read(out):
    """Return the results of each protocol."""
    return read_results(out / "results.json").protocols


@pytest.fixture(scope="module")
def out(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "report"
    assert evaluate(data, folder, "--protocol", "billets-places") == 0
    return folder


def test_trained_rows_have_a_low_pass_control_and_a_verdict_over_galleries_of_one_billet(out):
    (entry,) = read(out).values()
    assert list(entry.rows) == ["cca", "chance"]
    row, chance = entry.rows["cca"], entry.rows["chance"]
    assert set(row.measures) == set(row.low_pass) == set(row.differences["low_pass"])
    difference, against_order = (row.differences[name][entry.main] for name in ("low_pass", "order"))
    assert row.verdict.counts_as_touch == (difference.low > 0 and against_order.low > 0)
    value = row.measures[entry.main].value[0]
    assert against_order.value == pytest.approx(value - entry.controls["order"].measures[entry.main].value[0])
    assert difference.value == pytest.approx(value - row.low_pass[entry.main].value[0])
    assert (chance.low_pass, chance.verdict) == (None, None)
    assert (entry.unit, len(entry.folds), [len(folds) for folds in entry.folds]) == ("sequence", 2, [4, 4])
    summary = row.measures["topn_k4"]
    assert (summary.objects, summary.queries, summary.few_objects) == (3, 48, True)
    assert "4 objects, 4 photos" in summary.gallery
    assert len(row.best_params) == 2
    assert sorted(entry.controls) == ["background", "no_contact", "order", "permuted"]
    assert "lacks no-contact frames" in entry.controls["no_contact"].reason
    text = (out / "report.md").read_text().replace("\\", "")
    words = f"{'counts' if row.verdict.counts_as_touch else 'does not count'} as touch:"
    assert all(part in text for part in (entry.title, words, "low-pass control (8 x 6)", "counts as touch only if"))


def test_choices_report_each_fold(tmp_path, monkeypatch):
    monkeypatch.setattr(vt60, "DRAWN_CHOICES", 1)
    real_data_sets.write_vt60(tmp_path / "data" / "vt60", instances=3)
    options = ["--config", "tiny", "--seeds", "2", "--methods", "cca_towers,chance", "--protocol", "vt60-choices"]
    assert evaluate(tmp_path / "data", tmp_path / "out", methods=options) == 0
    entry = read(tmp_path / "out")["vt60-choices"]
    # One set of folds for all seeds
    assert (entry.unit, len(entry.folds), len(entry.folds[0])) == ("choice", 1, 4)
    row = entry.rows["cca_towers"]
    summary = row.measures["topn_k9"]
    by_choice = [one[0] for one in summary.repeats]
    assert len(by_choice) == 4
    assert summary.value[0] == pytest.approx(np.mean(by_choice))
    assert summary.low[0] <= summary.value[0] <= summary.high[0]
    assert set(row.best_params[0][0]) >= {"ridge", "photo_ridge", "directions", "power"}
    assert "all touches share one no-contact frame" in entry.controls["no_contact"].reason
    permuted = entry.controls["permuted"].measures["topn_k9"]
    assert permuted.low[0] < 1 / 9 < permuted.high[0]
    text = (tmp_path / "out" / "report.md").read_text().replace("\\", "")
    assert all(words in text for words in ("over choices", "the order of capture", "4 choices"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--protocol", "ycb"], "protocol must be one of"),
        (["--methods", "mine"], "method must be one of"),
        (["--compare", "alone"], "NAME=CHOICE"),
        (["--compare", "cca=tiny"], "Another row is already named cca"),
        (["--compare", "other=tiny"], "Only touch-to-touch protocols compare towers"),
    ],
)
def test_wrong_use_is_one_line(data, tmp_path, options, message, capsys):
    complete = options if "--protocol" in options else [*options, "--protocol", "billets-places"]
    assert evaluate(data, tmp_path / "out", *complete) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_checkpoint_is_a_row_and_one_finger_is_used_for_both_of_its_fingers(data, model, tmp_path):
    options = ["--protocol", "billets-places", "--seeds", "1", "--methods", "chance", "--compare", f"mine={model}"]
    assert evaluate(data, tmp_path, *options) == 0
    row = read(tmp_path)["billets-places"].rows["mine"]
    assert row.model
    assert row.verdict
    assert "mine, not fitted" in (tmp_path / "report.md").read_text()


@pytest.mark.slow
def test_a_checkpoint_trained_on_test_objects_is_refused(data, out, tmp_path, capsys):
    recording = out / "recordings" / "billets"
    command = ["train", str(recording), "--out", str(tmp_path / "seen.safetensors"), "--config", "tiny"]
    assert main([*command, "--iterations", "1"]) == 0
    options = ["--protocol", "billets-places", "--compare", f"seen={tmp_path / 'seen.safetensors'}"]
    assert evaluate(data, tmp_path / "out", *options) == 2
    assert "The model of row seen was trained on" in capsys.readouterr().err


@pytest.mark.slow
def test_every_protocol_runs_on_its_miniature(tmp_path):
    real_data_sets.write(tmp_path / "data")
    options = ["--seeds", "1", "--methods", "cca,late_fusion,chance", "--protocol", "all"]
    assert evaluate(tmp_path / "data", tmp_path / "out", *options) == 0
    entries = read(tmp_path / "out")
    assert set(entries) == {name for name in PROTOCOLS if PROTOCOLS.load(name).data_set}
    paper = entries["feeling-of-success"]
    assert paper.controls["no_contact"].measures
    assert "pair_auc" in paper.rows["cca"].measures
    assert "pair_accuracy" not in paper.rows["cca"].measures  # too few validation objects for a threshold
    assert any("64.3" in sentence for sentence in paper.published_results)
    for name in ("physiclear", "physiclear-sessions", "estimate-modulus", "vt60-touches"):
        assert list(entries.pop(name).rows) == ["frozen"]
    assert all(set(entry.rows) == {"cca", "chance", "late_fusion"} for entry in entries.values())


@pytest.mark.slow
def test_real_bottles_and_balls_beat_the_low_pass_control_and_unseen_billets_are_near_chance(tmp_path, monkeypatch):
    """The results of docs/real.md, with one seed."""
    weights = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    monkeypatch.setitem(protocol.MAX_GRASPS, "test", 20)
    found = {}
    for name in ("vt60-seen-classes", "billets-unseen"):
        data = touch_data(name.split("-")[0]).parent
        options = ["--protocol", name, "--seeds", "1", "--methods", "cca", "--init", str(weights)]
        assert evaluate(data, tmp_path / name, methods=options) == 0
        found[name] = read(tmp_path / name)[name]
    entry, billets = found.values()
    row = entry.rows["cca"]
    assert row.measures["topn_k9"].value[0] > 0.55
    assert row.differences["low_pass"]["topn_k9"].value > 0.04
    assert entry.controls["permuted"].measures["topn_k9"].value[0] < 0.2
    assert billets.rows["cca"].measures[billets.main].low[0] < 0.25
