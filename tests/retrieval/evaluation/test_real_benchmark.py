"""`retrieve evaluate --protocol` on miniature data sets: tables, controls, reuse and resumption."""

import re
import shutil

import numpy as np
import pytest

from _touch_retrieval.cache import Cache
from retrieval.commands.main import main
from retrieval.evaluation import PROTOCOLS, UNSEEN_OBJECTS, protocol
from retrieval.evaluation.protocols import vt60
from retrieval.evaluation.results import Results, read_results
from retrieval.methods.method import Method
from tests import real_data_sets
from tests.data import touch_data

TINY = ["--preset", "tiny", "--iterations", "2", "--seeds", "2", "--methods", "cca,chance"]
PROTOCOL_NAMES = ("vt60-random", "billets-places")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder with vt60/ and billets/."""
    folder = tmp_path_factory.mktemp("data")
    real_data_sets.write_vt60(folder / "vt60")
    real_data_sets.write_billets(folder / "billets")
    return folder


def evaluate(data, out, *more, methods=TINY):
    return main(["evaluate", str(data), "--out", str(out), *methods, *more])


def read(out):
    """Return the results of each protocol."""
    return read_results(out / "results.json", Results).protocols


@pytest.fixture(scope="module")
def out(data, tmp_path_factory):
    """Report of two protocols. Copy it before a change."""
    folder = tmp_path_factory.mktemp("made") / "report"
    assert evaluate(data, folder, "--protocol", ",".join(PROTOCOL_NAMES)) == 0
    return folder


@pytest.fixture(scope="module")
def results(out):
    return read(out)


def test_trained_rows_have_a_low_pass_control_and_a_verdict(results):
    assert list(results) == list(PROTOCOL_NAMES)
    for entry in results.values():
        assert list(entry.rows) == ["cca", "chance"]
        row, chance, main_measure = entry.rows["cca"], entry.rows["chance"], entry.main
        assert set(row.measures) == set(row.low_pass) == set(row.differences["low_pass"])
        difference, against_order = (row.differences[name][main_measure] for name in ("low_pass", "order"))
        assert row.verdict.counts_as_touch == (difference.low > 0 and against_order.low > 0)
        value = row.measures[main_measure].value[0]
        order = entry.controls["order"].measures[main_measure].value[0]
        assert against_order.value == pytest.approx(value - order)
        assert difference.value == pytest.approx(value - row.low_pass[main_measure].value[0])
        assert (chance.low_pass, chance.verdict) == (None, None)


def test_a_billet_gallery_has_the_places_of_one_billet(results):
    entry = results["billets-places"]
    summary = entry.rows["cca"].measures["topn_k4"]
    assert (entry.unit, summary.objects, summary.queries) == ("sequence", 3, 48)
    assert summary.few_objects
    assert "4 test objects, 4 photos" in summary.gallery


def test_controls_have_a_description_or_a_reason(results):
    for entry in results.values():
        assert sorted(entry.controls) == ["background", "no_contact", "order", "permuted"]
        assert all(control.description for control in entry.controls.values())
    assert "all touches share one no-contact frame" in results["vt60-random"].controls["no_contact"].reason
    assert "lacks no-contact frames" in results["billets-places"].controls["no_contact"].reason
    permuted = results["vt60-random"].controls["permuted"].measures["topn_k9"]
    assert permuted.low[0] < 1 / 9 < permuted.high[0]


def test_the_report_has_verdicts_and_tables(out, results):
    text = (out / "report.md").read_text().replace("\\", "")
    page = (out / "report.html").read_text()
    for entry in results.values():
        words = f"{'counts' if entry.rows['cca'].verdict.counts_as_touch else 'does not count'} as touch:"
        for part in (entry.title, words, "low-pass control (8 x 6)"):
            assert part in text
            assert part in page
    assert "counts as touch only if" in text
    assert "| order |" in text


def test_choices_report_each_fold(tmp_path, monkeypatch):
    monkeypatch.setattr(vt60, "DRAWN_CHOICES", 1)
    real_data_sets.write_vt60(tmp_path / "data" / "vt60", instances=3)
    options = ["--preset", "tiny", "--seeds", "2", "--methods", "cca_towers,chance", "--protocol", "vt60-choices"]
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
    assert set(row.best_params[0][0]) >= {"ridge", "photo_ridge", "directions", "power", "posterior"}
    text = re.sub(r"\\", "", (tmp_path / "out" / "report.md").read_text())
    for words in ("over choices", "the order of capture", "4 choices"):
        assert words in text


def test_a_second_run_reuses_fits_and_is_byte_identical(data, out, tmp_path, monkeypatch):
    again = tmp_path / "again"
    shutil.copytree(out, again)
    monkeypatch.setattr(Method, "fit", lambda *_: pytest.fail("fitted"))
    assert evaluate(data, again, "--protocol", ",".join(PROTOCOL_NAMES)) == 0
    assert (again / "results.json").read_bytes() == (out / "results.json").read_bytes()


def test_a_stopped_run_resumes(data, out, tmp_path, monkeypatch, capsys):
    again = tmp_path / "again"
    shutil.copytree(out, again)
    with Cache(again / "cache.sqlite") as cache:
        keys = sorted(cache.keys("experiments"))
        cache.keep(keys[2:])
    fitted = []
    fit = Method.fit

    def stopping(self, *parts):
        fitted.append(self)
        if len(fitted) == 2:
            raise KeyboardInterrupt
        fit(self, *parts)

    monkeypatch.setattr(Method, "fit", stopping)
    assert evaluate(data, again, "--protocol", ",".join(PROTOCOL_NAMES)) == 1
    assert "run the same command to continue" in capsys.readouterr().err
    assert evaluate(data, again, "--protocol", ",".join(PROTOCOL_NAMES)) == 0
    assert 2 <= len(fitted) <= 4  # a stopped fit, and those of the missing entries
    assert (again / "results.json").read_bytes() == (out / "results.json").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--protocol", "ycb"], "protocol must be one of"),
        (["--methods", "mine"], "method must be one of"),
        (["--compare", "alone"], "NAME=CHOICE"),
        (["--seeds", "0"], "must be a whole number >= 1, got 0"),
    ],
)
def test_wrong_use_is_one_line(data, tmp_path, options, message, capsys):
    complete = [*options] if "--protocol" in options else [*options, "--protocol", "billets-places"]
    assert evaluate(data, tmp_path / "out", *complete) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_checkpoint_is_a_row_and_one_finger_is_used_for_both_of_its_fingers(data, model, tmp_path):
    options = ["--protocol", "billets-places", "--seeds", "1", "--methods", "chance", "--compare", f"mine={model}"]
    assert evaluate(data, tmp_path, *options) == 0
    row = read(tmp_path)["billets-places"].rows["mine"]
    assert row.model
    assert row.verdict
    assert "mine (unadapted)" in (tmp_path / "report.md").read_text()


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
    data = tmp_path / "data"
    real_data_sets.write(data)
    methods = "cca,late_fusion,chance"
    assert evaluate(data, tmp_path / "out", "--seeds", "1", "--methods", methods, "--protocol", "all") == 0
    entries = read(tmp_path / "out")
    assert set(entries) == set(PROTOCOLS) - {UNSEEN_OBJECTS}
    assert entries["feeling-of-success"].controls["no_contact"].measures
    measures = entries["feeling-of-success"].rows["cca"].measures
    assert "pair_auc" in measures
    assert "pair_accuracy" not in measures  # too few validation objects for a threshold
    assert any("64.3" in sentence for sentence in entries["feeling-of-success"].published_results)
    for name, entry in entries.items():
        if name == "physiclear":
            assert set(entry.rows) == {"frozen-difference", "frozen-common-frame"}
            continue
        assert set(entry.rows) == {"cca", "chance", "late_fusion"}


@pytest.mark.slow
def test_real_bottles_and_balls_beat_the_low_pass_control(tmp_path, monkeypatch):
    """VT60, seen classes: the result of docs/real.md, with one seed."""
    weights = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    data = touch_data("vt60").parent
    monkeypatch.setitem(protocol.MAX_GRASPS, "test", 20)
    options = ["--protocol", "vt60-seen-classes", "--seeds", "1", "--methods", "cca", "--init", str(weights)]
    assert evaluate(data, tmp_path, methods=options) == 0
    entry = read(tmp_path)["vt60-seen-classes"]
    row = entry.rows["cca"]
    assert row.measures["topn_k9"].value[0] > 0.55
    assert row.differences["low_pass"]["topn_k9"].value > 0.04
    assert entry.controls["permuted"].measures["topn_k9"].value[0] < 0.2


@pytest.mark.slow
def test_unseen_real_billets_are_near_chance(tmp_path):
    weights = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    data = touch_data("billets").parent
    options = ["--protocol", "billets-unseen", "--seeds", "1", "--methods", "cca", "--init", str(weights)]
    assert evaluate(data, tmp_path, methods=options) == 0
    entry = read(tmp_path)["billets-unseen"]
    assert entry.rows["cca"].measures[entry.main].low[0] < 0.25
    assert (tmp_path / "report.html").is_file()
