"""`retrieve benchmark real` on miniature data sets: tables, controls, reuse and resumption."""

import json
import re
import shutil

import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.evaluation.real import PROTOCOLS, vt60
from retrieval.evaluation.real import benchmark as real_benchmark
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


def benchmark(data, out, *more, methods=TINY):
    return main(["benchmark", "real", str(data), "--out", str(out), *methods, *more])


@pytest.fixture(scope="module")
def out(data, tmp_path_factory):
    """Report of two protocols. Copy it before a change."""
    folder = tmp_path_factory.mktemp("made") / "report"
    assert benchmark(data, folder, "--protocols", ",".join(PROTOCOL_NAMES)) == 0
    return folder


@pytest.fixture(scope="module")
def results(out):
    return json.loads((out / "results.json").read_text())


def test_trained_rows_have_a_low_pass_control_and_a_verdict(results):
    assert list(results["protocols"]) == sorted(PROTOCOL_NAMES)
    for entry in results["protocols"].values():
        assert set(entry["rows"]) == {"cca", "chance"}
        row, chance = entry["rows"]["cca"], entry["rows"]["chance"]
        assert set(row["measures"]) == set(row["low_pass"]) == set(row["low_pass_differences"])
        difference = row["low_pass_differences"][entry["main"]]
        against_order = row["order_differences"][entry["main"]]
        assert row["verdict"]["counts_as_touch"] == (difference["low"] > 0 and against_order["low"] > 0)
        order = entry["controls"]["order"]["measures"][entry["main"]]["value"][0]
        by_hand = row["measures"][entry["main"]]["value"][0] - order
        assert against_order["difference"] == pytest.approx(by_hand)
        by_hand = row["measures"][entry["main"]]["value"][0] - row["low_pass"][entry["main"]]["value"][0]
        assert difference["difference"] == pytest.approx(by_hand)
        assert (chance["low_pass"], chance["verdict"]) == (None, None)


def test_a_billet_gallery_has_the_places_of_one_billet(results):
    entry = results["protocols"]["billets-places"]
    summary = entry["rows"]["cca"]["measures"]["topn_k4"]
    assert (entry["unit"], summary["objects"], summary["queries"]) == ("sequence", 3, 48)
    assert summary["few_objects"]
    assert "4 test objects, 4 photos" in summary["gallery"]


def test_controls_have_a_description_or_a_reason(results):
    for entry in results["protocols"].values():
        assert list(entry["controls"]) == ["background", "no_contact", "order", "permuted"]
        assert all(control["description"] for control in entry["controls"].values())
    assert (
        "all touches share one no-contact frame"
        in results["protocols"]["vt60-random"]["controls"]["no_contact"]["reason"]
    )
    assert "lacks no-contact frames" in results["protocols"]["billets-places"]["controls"]["no_contact"]["reason"]
    permuted = results["protocols"]["vt60-random"]["controls"]["permuted"]["measures"]["topn_k9"]
    assert permuted["low"][0] < 1 / 9 < permuted["high"][0]


def test_the_report_has_verdicts_and_tables(out, results):
    text, page = (out / "report.md").read_text(), (out / "report.html").read_text()
    for entry in results["protocols"].values():
        assert entry["title"] in text
        words = entry["rows"]["cca"]["verdict"]["words"].split(":")[0]
        assert f"{words}:" in re.sub(r"\\", "", text)
        assert words in page
    assert "counts as touch only if" in text
    assert "control: order" in text


def test_choices_report_each_fold(tmp_path, monkeypatch):
    monkeypatch.setattr(vt60, "DRAWN_CHOICES", 1)
    real_data_sets.write_vt60(tmp_path / "data" / "vt60", instances=3)
    options = ["--preset", "tiny", "--seeds", "2", "--methods", "cca_towers,chance", "--protocols", "vt60-choices"]
    assert benchmark(tmp_path / "data", tmp_path / "out", methods=options) == 0
    entry = json.loads((tmp_path / "out" / "results.json").read_text())["protocols"]["vt60-choices"]
    assert (entry["unit"], len(entry["folds"]), len(entry["folds"][0])) == (
        "choice",
        1,
        4,
    )  # one set of folds for all seeds
    row = entry["rows"]["cca_towers"]
    summary = row["measures"]["topn_k9"]
    by_choice = [one[0] for one in summary["by_split"]]
    assert len(by_choice) == 4
    assert summary["value"][0] == pytest.approx(np.mean(by_choice))
    assert (summary["min"][0], summary["max"][0]) == (min(by_choice), max(by_choice))
    assert summary["low"][0] <= summary["value"][0] <= summary["high"][0]
    assert set(row["best_params"][0][0]) >= {"ridge", "photo_ridge", "directions", "power", "posterior"}
    text = re.sub(r"\\", "", (tmp_path / "out" / "report.md").read_text())
    for words in ("over choices", "the order of capture", "4 choice(s) each"):
        assert words in text


def test_a_second_run_reuses_fits_and_is_byte_identical(data, out, tmp_path, monkeypatch):
    again = tmp_path / "again"
    shutil.copytree(out, again)
    monkeypatch.setattr(Method, "fit", lambda *_: pytest.fail("fitted"))
    assert benchmark(data, again, "--protocols", ",".join(PROTOCOL_NAMES)) == 0
    for name in ("results.json", "report.md"):
        assert (again / name).read_bytes() == (out / name).read_bytes()


def test_a_stopped_run_resumes(data, out, tmp_path, monkeypatch, capsys):
    again = tmp_path / "again"
    shutil.copytree(out, again)
    for path in sorted((again / "cache" / "measures" / "billets-places").iterdir())[:2]:
        path.unlink()
    fitted = []
    fit = Method.fit

    def stopping(self, *parts):
        fitted.append(self)
        if len(fitted) == 2:
            raise KeyboardInterrupt
        fit(self, *parts)

    monkeypatch.setattr(Method, "fit", stopping)
    assert benchmark(data, again, "--protocols", ",".join(PROTOCOL_NAMES)) == 1
    assert "run the same command to continue" in capsys.readouterr().err
    assert benchmark(data, again, "--protocols", ",".join(PROTOCOL_NAMES)) == 0
    assert len(fitted) == 3
    assert (again / "results.json").read_bytes() == (out / "results.json").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--protocols", "ycb"], "protocol must be one of"),
        (["--methods", "mine"], "method must be one of"),
        (["--model", "alone"], "NAME=FILE"),
        (["--seeds", "0"], "must be a whole number >= 1, got 0"),
    ],
)
def test_wrong_use_is_one_line(data, tmp_path, options, message, capsys):
    complete = [*options] if "--protocols" in options else [*options, "--protocols", "billets-places"]
    assert benchmark(data, tmp_path / "out", *complete) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_checkpoint_is_a_row_and_one_finger_is_used_for_both_of_its_fingers(data, model, tmp_path):
    options = ["--protocols", "billets-places", "--seeds", "1", "--methods", "chance", "--model", f"mine={model}"]
    assert benchmark(data, tmp_path, *options) == 0
    row = json.loads((tmp_path / "results.json").read_text())["protocols"]["billets-places"]["rows"]["mine"]
    assert row["model"]
    assert row["verdict"]
    assert "mine (unadapted)" in (tmp_path / "report.md").read_text()


@pytest.mark.slow
def test_a_checkpoint_trained_on_test_objects_is_refused(data, out, tmp_path, capsys):
    recording = out / "cache" / "recordings" / "billets"
    command = ["train", str(recording), "--out", str(tmp_path / "seen.safetensors"), "--config", "tiny"]
    assert main([*command, "--iterations", "1"]) == 0
    options = ["--protocols", "billets-places", "--model", f"seen={tmp_path / 'seen.safetensors'}"]
    assert benchmark(data, tmp_path / "out", *options) == 2
    assert "Model seen was trained on" in capsys.readouterr().err


@pytest.mark.slow
def test_every_protocol_runs_on_its_miniature(tmp_path):
    data = tmp_path / "data"
    real_data_sets.write(data)
    methods = "cca,late_fusion,chance"
    assert benchmark(data, tmp_path / "out", "--seeds", "1", "--methods", methods) == 0
    entries = json.loads((tmp_path / "out" / "results.json").read_text())["protocols"]
    assert set(entries) == set(PROTOCOLS)
    assert entries["feeling-of-success"]["controls"]["no_contact"]["measures"]
    measures = entries["feeling-of-success"]["rows"]["cca"]["measures"]
    assert "pair_auc" in measures
    assert "pair_accuracy" not in measures  # too few validation objects for a threshold
    assert any("64.3" in sentence for sentence in entries["feeling-of-success"]["published_results"])
    for name, entry in entries.items():
        if name == "physiclear":
            assert set(entry["rows"]) == {"frozen-difference", "frozen-common-frame"}
            continue
        assert set(entry["rows"]) == {"cca", "chance", "late_fusion"}


@pytest.mark.slow
def test_real_bottles_and_balls_beat_the_low_pass_control(tmp_path, monkeypatch):
    """VT60, seen classes: the result of docs/real.md, with one seed."""
    weights = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    data = touch_data("vt60").parent
    monkeypatch.setattr(real_benchmark, "MAX_GRASPS", {"train": 1, "validation": 12, "test": 20})
    options = ["--protocols", "vt60-seen-classes", "--seeds", "1", "--methods", "cca", "--init", str(weights)]
    assert benchmark(data, tmp_path, methods=options) == 0
    entry = json.loads((tmp_path / "results.json").read_text())["protocols"]["vt60-seen-classes"]
    row = entry["rows"]["cca"]
    assert row["measures"]["topn_k9"]["value"][0] > 0.55
    assert row["low_pass_differences"]["topn_k9"]["difference"] > 0.04
    assert entry["controls"]["permuted"]["measures"]["topn_k9"]["value"][0] < 0.2


@pytest.mark.slow
def test_unseen_real_billets_are_near_chance(tmp_path):
    weights = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    data = touch_data("billets").parent
    options = ["--protocols", "billets-unseen", "--seeds", "1", "--methods", "cca", "--init", str(weights)]
    assert benchmark(data, tmp_path, methods=options) == 0
    entry = json.loads((tmp_path / "results.json").read_text())["protocols"]["billets-unseen"]
    summary = entry["rows"]["cca"]["measures"][entry["main"]]
    assert summary["low"][0] < 0.25
    assert (tmp_path / "report.html").is_file()
