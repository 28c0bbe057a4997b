"""Evaluation from recording to results: byte-identical, resumable, equal to plain loops."""

import dataclasses
import json
import shutil
from collections import defaultdict
from importlib import resources

import numpy as np
import pytest
import torch

from retrieval.commands.main import main
from retrieval.data.camera import USUAL_CAMERA
from retrieval.data.dataset import Split, load_grasps
from retrieval.errors import BadInput, ConfigError, DatasetError, JobInterrupted
from retrieval.evaluation import UNSEEN_OBJECTS
from retrieval.evaluation.evaluate import evaluate
from retrieval.evaluation.inputs import TowerEncoder
from retrieval.evaluation.protocol import read_recording_facts
from retrieval.evaluation.protocols.recording import with_split
from retrieval.methods.cca import Cca
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import Method
from retrieval.model.checkpoint import load_checkpoint
from retrieval.report.evaluation import write_report
from retrieval.training.features import Features
from retrieval.training.trainer import Trainer, train_matcher
from tests import synthetic
from tests.conftest import TINY

TRAINING = dataclasses.replace(TINY.training, freeze_towers=True, validation_fraction=0.2, test_fraction=0.34)
CONFIG = dataclasses.replace(TINY, training=TRAINING)
TRAINED_TOWERS = dataclasses.replace(CONFIG, training=dataclasses.replace(TRAINING, freeze_towers=False))


class Constant(Method):
    """Method that gives every pair the same score: every measure must be exactly at chance."""

    is_seeded = False

    def _fit(self, train, validation):
        pass

    def _encode_touch(self, touch):
        return np.zeros((len(touch), 1), np.float32)

    def _encode_photo(self, photo):
        return np.zeros((len(photo), 1), np.float32)


CONSTANT = f"{__name__}:Constant"
FEW = ("late_fusion", "retrieve_rerank", "cca", CONSTANT)


@pytest.fixture(scope="module")
def grasped(tmp_path_factory):
    """18 drawn objects with 4 grasps each: 6 test objects, enough for top-1 of 5."""
    return synthetic.write_recording(tmp_path_factory.mktemp("grasped") / "drawn", synthetic.make_objects(18), 4)


def of(results):
    """Return the results of the only protocol."""
    return results.protocols[UNSEEN_OBJECTS]


@pytest.fixture(scope="module")
def run(grasped):
    """Function that evaluates the recording into a folder."""

    def run(out, **changes):
        towers = {} if "model" in changes else {"config": CONFIG, "preset": "test"}
        options = towers | {"methods": FEW} | changes
        return evaluate(options.pop("recording", grasped), out, **options)

    return run


@pytest.fixture(scope="module")
def made(run, tmp_path_factory):
    """Results and folder of an evaluation with two seeds."""
    out = tmp_path_factory.mktemp("made") / "report"
    return run(out, seeds=2), out


def count_fits(monkeypatch):
    """Return a list that gets the name of each method that is fitted."""
    fitted, fit = [], Method.fit
    monkeypatch.setattr(Method, "fit", lambda self, *parts: fitted.append(type(self).__name__) or fit(self, *parts))
    return fitted


def no_fits(monkeypatch):
    monkeypatch.setattr(Method, "fit", lambda *_: pytest.fail("fitted"))
    monkeypatch.setattr(Trainer, "run", lambda *_: pytest.fail("trained"))


def test_results_describe_data_settings_and_measures_with_intervals(made):
    found = of(made[0])
    assert (found.recording.objects, found.recording.grasps) == (18, 72)
    assert made[0].setting.seeds == [0, 1]
    ((split,),) = found.folds
    assert [len(split[part]) for part in ("train", "validation", "test")] == [8, 4, 6]
    assert list(found.rows) == list(FEW)
    assert list(found.controls) == ["permuted", "no_contact", "low_pass"]
    assert list(found.ceilings) == ["touch_to_touch", "photo_to_photo"]
    assert {(one.a, one.b) for one in found.comparisons} == {(name, "late_fusion") for name in FEW[1:]}
    summary = found.rows["late_fusion"].measures["topn_k5"]
    assert (summary.objects, summary.queries, len(summary.value)) == (6, 24, 5)
    for row in found.rows.values():
        assert {"pair_auc", "topn_k5", "topn_k5_g1_p3", "map"} <= set(row.measures)
        assert "topn_k10" not in row.measures  # there are six test objects
        assert all(one.low[0] <= one.value[0] <= one.high[0] for one in row.measures.values())


def test_late_interaction_changes_the_features_of_late_fusion_and_of_no_method_without_cells(grasped, tmp_path):
    matcher = dataclasses.replace(CONFIG.matcher, tower_output="stages")
    cells = dataclasses.replace(matcher, cell_dim=4, touch_cells=2, photo_cells=2)
    grasps = load_grasps(grasped)
    plain, with_cells = (
        TowerEncoder.of(grasps, dataclasses.replace(CONFIG, matcher=one), USUAL_CAMERA, 0, tmp_path)
        for one in (matcher, cells)
    )
    for kind in ("touch", "touch_to_touch"):
        late = [towers.inputs(kind, LateFusion.uses_cells) for towers in (plain, with_cells)]
        cca = [towers.inputs(kind, Cca.uses_cells) for towers in (plain, with_cells)]
        assert cca[0].digest == cca[1].digest
        assert late[0].touch.shape[2] < late[1].touch.shape[2]


def test_details_and_measures_of_each_method(made):
    rows = of(made[0]).rows
    for name, summary in rows[CONSTANT].measures.items():
        assert summary.value == pytest.approx(summary.chance, abs=1e-12), name
    for by_grasps in rows["late_fusion"].details.verification.values():
        assert list(by_grasps) == ["1", "2", "3"]  # each object has four grasps
        for one in by_grasps.values():
            assert (one.objects, one.sequences) == (6, 48)
            assert {rate.value for rate in one.frr.values()} == {None}  # six test objects support no rate
    assert rows["cca"].details.verification is None
    repeats = {name: rows[name].measures["pair_auc"].repeats for name in FEW}
    assert [len(repeats[name]) for name in FEW] == [2, 2, 1, 1]  # only methods with seeds are trained for each seed
    assert rows["late_fusion"].measures["pair_auc"].value[0] == pytest.approx(np.mean(repeats["late_fusion"]))


@torch.inference_mode()
def match_logits(matcher, grasps):
    """Return the logits of every touch with every photo, from the images, one by one."""

    def pictures(images):
        return torch.tensor(np.array(images)).permute(0, 3, 1, 2)

    load = CONFIG.preprocessing
    fingers = [pictures([load.load_touch(path) for path in grasp.touches])[None] for grasp in grasps]
    touches = [matcher.touch_encoding(matcher.touch_features(touch)).partial for touch in fingers]
    photos = [pictures([load.load_photo(grasp.photo)]) for grasp in grasps]
    photos = [matcher.photo_encoding(matcher.photo_features(photo)).partial for photo in photos]
    return [[matcher.head(touch, photo).item() for photo in photos] for touch in touches]


def test_measures_equal_plain_loops_over_images_and_the_checkpoint_of_the_fit(made, grasped):
    seed = 1
    results, out = made
    (fit,) = (path for path in (out / "fits").rglob(f"late_fusion-{seed}.safetensors") if "touch" in str(path))
    matcher = load_checkpoint(fit).matcher
    test = [grasp for grasp in load_grasps(grasped) if grasp.object_id in of(results).folds[0][0]["test"]]
    table = match_logits(matcher, test)
    first, areas = defaultdict(list), defaultdict(list)
    for row, grasp in enumerate(test):
        mine = [table[row][c] for c, other in enumerate(test) if other.object_id == grasp.object_id and c != row]
        theirs = [table[row][c] for c, other in enumerate(test) if other.object_id != grasp.object_id]
        first[grasp.object_id].append(max(mine) > max(theirs))
        areas[grasp.object_id].append(np.mean([own > other for own in mine for other in theirs]))
    for name, by_object in (("recall_1", first), ("pair_auc", areas)):
        expected = np.mean([np.mean(values) for values in by_object.values()])
        found = of(results).rows["late_fusion"].measures[name].repeats[seed][0]
        # One pair of 1,440 may swap: features were encoded in batches of another size.
        assert found == pytest.approx(expected, abs=1e-3)


def test_a_stopped_run_resumes_and_ends_byte_identical_without_paths_and_times(made, run, tmp_path, monkeypatch):
    out, fitted = tmp_path / "out", count_fits(monkeypatch)

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as during:
        during.setattr(Cca, "_fit", stop)
        with pytest.raises(JobInterrupted, match="run the same command to continue"):
            run(out, seeds=2)
    assert fitted == ["LateFusion", "LateFusion", "RetrieveRerank", "RetrieveRerank", "Cca"]
    fitted.clear()
    run(out, seeds=2)
    # last: the controls and the ceilings
    assert fitted == ["Cca", "Constant", "Cca", "Cca", "LateFusion", "Cca", "Cca"]
    text = (out / "results.json").read_text()
    assert text == (made[1] / "results.json").read_text()
    assert not [part for part in (str(tmp_path), '_s"', '_ms"') if part in text]


def test_a_second_run_fits_only_new_and_edited_methods_of_a_user(made, run, monkeypatch):
    with monkeypatch.context() as during:
        no_fits(during)
        assert run(made[1], seeds=2) == made[0]
    fitted = count_fits(monkeypatch)
    monkeypatch.setattr("inspect.getsource", lambda _: "edited in between")
    added = run(made[1], methods=("late_fusion", "cca", Constant, "chance"), seeds=2)
    assert fitted == ["Constant", "Chance", "Chance"]
    assert {name: of(added).rows[name] for name in ("cca", CONSTANT)} == {
        name: of(made[0]).rows[name] for name in ("cca", CONSTANT)
    }
    write_report(made[1])
    assert "Constant" in (made[1] / "report.md").read_text()


def test_with_two_sessions_queries_are_of_the_second_and_all_else_of_the_first(grasped, run, tmp_path, monkeypatch):
    fitted, fit = set(), Constant._fit
    monkeypatch.setattr(Constant, "_fit", lambda self, *of: fitted.update(of[0].grasp_ids) or fit(self, *of))
    lines = [json.loads(line) for line in (grasped / "metadata.jsonl").read_text().splitlines()]

    def evaluated(name, session_of, wanted):
        shutil.copytree(grasped, tmp_path / name)
        sessions = [json.dumps(line | {"session": str(session_of(line))}) for line in lines]
        (tmp_path / name / "metadata.jsonl").write_text("\n".join(sessions) + "\n")
        found = of(run(tmp_path / "report", recording=tmp_path / name, methods=[CONSTANT, "cca"]))
        assert wanted in found.rule
        measure = found.rows[CONSTANT].measures["topn_k5"]
        assert measure.value == pytest.approx(measure.chance, abs=1e-12)
        return found, measure

    across, measure = evaluated("two", lambda line: line["grasp_id"][-1] > "1", "all photos are of session False")
    assert {name[-1] for name in fitted} == {"0", "1"}  # two of four grasps
    assert list(across.controls) == ["permuted", "no_contact", "low_pass", "order"]
    assert (measure.objects, measure.queries) == (6, 12)
    _, measure = evaluated("alone", lambda line: int(line["object_id"][-1]) % 2, "share too few objects")
    assert measure.queries == 24


def test_a_control_is_left_out_without_no_contact_frames(run, tmp_path):
    bare = synthetic.write_recording(tmp_path / "bare", synthetic.make_objects(12), 3, before=False)
    results = run(tmp_path / "out", recording=bare, methods=("chance",))
    found = of(results)
    assert [name for name, control in found.controls.items() if not control.reason] == ["permuted", "low_pass"]
    assert len(found.folds[0][0]["validation"]) == 2  # too few for a posterior
    assert found.rows["chance"].details.reject is None
    assert found.rows["chance"].details.reliability == {}


def test_ceilings_compare_touches_with_touches_and_photos_with_photos(tmp_path):
    touch, photo = np.arange(24, dtype=np.float32).reshape(4, 2, 3), np.ones((4, 5), np.float32)
    features = Features(tuple("1234"), tuple("aabb"), touch, photo)
    encoded = {("touch", False, None): features, ("touch", True, None): features}
    towers = TowerEncoder([], CONFIG, None, None, USUAL_CAMERA, tmp_path, encoded)
    touches, photos = (towers.inputs(kind, with_cells=False) for kind in ("touch_to_touch", "photo_to_photo"))
    np.testing.assert_array_equal(touches.photo, touch.reshape(4, 6))
    np.testing.assert_array_equal(photos.touch, photo[:, None])
    assert touches.touch is touch
    assert photos.photo is photo
    assert towers.missing_reason("photo_to_photo") == "no object has two different photos"


@pytest.fixture(scope="module")
def model(grasped, tmp_path_factory):
    """A checkpoint with trained towers."""
    return train_matcher(grasped, tmp_path_factory.mktemp("m") / "m.safetensors", TRAINED_TOWERS)


def test_a_checkpoint_is_evaluated_on_its_unseen_objects(model, run, tmp_path, monkeypatch):
    fitted = count_fits(monkeypatch)
    results = run(tmp_path / "out", model=model.path, methods=("late_fusion", "cca"), seeds=2)
    # The model as it is, late fusion from its head for each seed, then the controls and the ceilings
    assert fitted == [*["LateFusion"] * 3, "Cca", "Cca", "Cca", "LateFusion", "Cca", "Cca"]
    assert set(of(results).folds[0][0]["test"]) == set(model.split.test)
    assert "the model's own" in of(results).rule
    assert results.setting.model == model.digest
    own = -model.posterior.offset / model.posterior.slope  # where slope * logit + offset is 0
    fusion, cca = of(results).rows["m.safetensors"], of(results).rows["cca"]
    assert list(of(results).rows) == ["m.safetensors", "late_fusion", "cca"]
    assert fusion.best_params == [
        [{"step": model.provenance["step"], **model.provenance["metrics"], "pair_threshold": pytest.approx(own)}]
    ]
    threshold = fusion.details.pair_threshold
    assert (threshold.at, threshold.source, threshold.reason) == (pytest.approx(own), "the checkpoint", None)
    assert "pair_accuracy" in fusion.measures
    assert cca.details.pair_threshold.source is None  # there are four validation objects
    assert "pair_accuracy" not in cca.measures
    assert all(one.measure != "pair_accuracy" for one in of(results).comparisons)


def test_the_split_is_the_given_one_the_models_own_or_drawn(model, grasped, tmp_path):
    def chosen(facts, split=None):
        protocol = with_split(facts, TRAINING, model, split)
        return protocol.rule.rpartition("The split is ")[2], protocol.folds(facts, 0)[0]

    own = read_recording_facts(grasped)
    assert chosen(own) == ("the model's own.", model.split)
    other = synthetic.write_recording(tmp_path / "other", synthetic.make_objects(12, seed=50), 3)
    assert chosen(read_recording_facts(other))[0] == "drawn; the model was trained on none of its objects."
    names = own.names[:9]  # some of the training objects
    part = dataclasses.replace(own, grasps=[grasp for grasp in own.grasps if grasp.object_id in names])
    with pytest.raises(DatasetError, match="Give a split with --split"):
        chosen(part)
    split = Split(0, tuple(names[:5]), tuple(names[5:7]), tuple(names[7:]))
    assert chosen(part, split) == ("given.", split)


def test_a_preset_with_trained_towers_uses_them_for_late_fusion(run, model, tmp_path, monkeypatch):
    results = run(tmp_path / "out", config=TRAINED_TOWERS, methods=("late_fusion", "retrieve_rerank"))
    made = load_checkpoint(tmp_path / "out" / "model.safetensors")
    assert of(results).rows["late_fusion"].model == made.digest == model.digest  # the checkpoint of `retrieve train`
    assert of(results).rows["late_fusion"].best_params[0][0]["step"] == made.provenance["step"]  # not trained further
    no_fits(monkeypatch)
    assert run(tmp_path / "out", config=TRAINED_TOWERS, methods=("late_fusion", "retrieve_rerank")) == results


def test_wrong_arguments_are_refused_before_anything_is_read(run, tmp_path):
    with pytest.raises(ConfigError, match=r"late_fusion, .*; got 'oracle'"):
        run(tmp_path / "out", methods=("cca", "oracle"))
    with pytest.raises(BadInput, match="either a model or a configuration"):
        run(tmp_path / "out", config=CONFIG, model=tmp_path / "m.safetensors")
    with pytest.raises(BadInput, match="at least 1 seed, got 0"):
        run(tmp_path / "out", seeds=0)
    with pytest.raises(BadInput, match="takes a split, got objectfolder"):
        run(tmp_path / "out", protocols=["objectfolder"], split=Split(0, (), (), ()))
    assert not (tmp_path / "out").exists()


def test_the_command_writes_a_report_and_one_json_document(grasped, tmp_path, capsys):
    out = tmp_path / "report"
    tiny = (resources.files("retrieval") / "configs" / "tiny.toml").read_text()
    (tmp_path / "tiny.toml").write_text(tiny.replace("iterations = 120", "iterations = 6"))
    command = ["evaluate", str(grasped), "--out", str(out), "--config", str(tmp_path / "tiny.toml")]
    assert main([*command, "--methods", "late_fusion,cca,chance", "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out) == json.loads((out / "results.json").read_text())
    assert (out / "report.html").is_file()
    assert json.loads(output.out)["setting"]["preset"] == "tiny"
    assert main([*command, "--methods", "late_fusion,cca,chance"]) == 0  # resumes
    table = capsys.readouterr().out.splitlines()
    assert table[0].split()[:3] == ["method,", "%", "pair"]
    assert any(line.startswith("No pair accuracy of CCA, random scores: ") for line in table)
    assert [line.split("  ")[0] for line in table[1:4]] == ["late fusion", "CCA", "random scores"]


def test_the_command_refuses_conflicting_options(grasped, tmp_path, capsys):
    command = ["evaluate", str(grasped), "--out", str(tmp_path / "r"), "--model", "m.safetensors"]
    assert main([*command, "--config", "paper"]) == 2
    assert "give either --model or --config and --init" in capsys.readouterr().err
    assert main(command) == 2
    assert main([*command[:-2], "--init", "random"]) == 2
    assert "--init needs --config" in capsys.readouterr().err


def test_without_a_configuration_the_first_row_is_the_shipped_model(grasped, tmp_path):
    results = evaluate(grasped, tmp_path, methods=("late_fusion", "retrieve_rerank", "chance"))
    write_report(tmp_path)
    found, text = of(results), (tmp_path / "report.md").read_text()
    assert list(found.rows) == ["shipped model", "late_fusion", "retrieve_rerank", "chance"]
    assert "Shipped model, not fitted: the checkpoint as it is, trained on none of the test objects." in text
    assert [len(found.folds[0][0][part]) for part in ("train", "validation", "test")] == [9, 4, 5]


@pytest.mark.parametrize("objects", [1, 3])
def test_too_few_objects_are_one_line(objects, tmp_path, capsys):
    few = synthetic.write_recording(tmp_path / "few", synthetic.make_objects(objects), 3)
    assert main(["evaluate", str(few), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "two objects in each" in line


def test_eight_objects_give_a_result_that_says_how_little_it_is_worth(tmp_path, capsys):
    few = synthetic.write_recording(tmp_path / "few", synthetic.make_objects(8), 3)
    assert main(["evaluate", str(few), "--out", str(tmp_path / "out"), "--methods", "cca,chance"]) == 0
    assert "Fewer than 5 objects" in capsys.readouterr().out
