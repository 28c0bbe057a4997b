"""Reference touches in an index: encoding, storage, scoring and display next to photos."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest

from _touch_retrieval.documents import typed
from indexes.errors import CorruptIndex
from indexes.store.folder import IndexStore
from retrieval.data.dataset import load_grasps
from retrieval.errors import BadInput
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.model.opening import OpeningCalibration
from retrieval.model.references import SHARPNESS, ReferenceCalibration, unit_embeddings
from retrieval.report.query import query_page
from retrieval.report.terminal import print_table
from retrieval.search.answer import QueryResult
from retrieval.search.objects import Objects
from retrieval.search.searcher import Searcher
from tests import synthetic
from tests.documents import ROOT, text_of
from tests.indexes.test_damage import forge
from tests.reference_model import NAMES, POSTERIOR, REFERENCE_CALIBRATION, write_reference_model

EMBEDDING = slice(32, 48)
"""Columns of a partial activation with the scaled embedding."""


@pytest.fixture
def calibrated_model(tmp_path):
    return write_reference_model(tmp_path / "model.safetensors")


def query_new_index(catalogue, model, index, files, **options):
    build_index(catalogue, model, index)
    with Searcher.open(index) as searcher:
        return searcher.query(files, **{"top": 8, **options})


def test_a_touch_that_is_itself_a_reference_is_the_nearest(catalogue_with_touches, calibrated_model, tmp_path, touches):
    result = query_new_index(catalogue_with_touches, calibrated_model, tmp_path / "index", touches[NAMES[1]][1])
    best = {match.object_id: match for match in result.results}[NAMES[1]]
    assert best.reference.touch == (f"{NAMES[1]}/touch_1_a.png", f"{NAMES[1]}/touch_1_b.png")
    assert best.reference.cosine == pytest.approx(1.0, abs=1e-3)  # partial activations are float16
    assert [match.reference is None for match in result.results].count(False) == 4


def test_an_object_without_photos_is_found_and_displayed_by_its_touches(
    catalogue_with_touches, calibrated_model, tmp_path, touches, capsys
):
    result = query_new_index(catalogue_with_touches, calibrated_model, tmp_path / "index", touches[NAMES[2]][0])
    touch_only = {match.object_id: match for match in result.results}[NAMES[2]]
    assert touch_only.reference.adds is None
    assert touch_only.photo == f"{NAMES[2]}/touch_0_a.png"  # displayed in place of a photo
    cosines = [1.0, other_cosine(calibrated_model, touches[NAMES[2]][:2])]
    near = math.log(sum(math.exp(SHARPNESS * one) for one in cosines) / 2) / SHARPNESS
    ratio = REFERENCE_CALIBRATION.touch_only.slope * near + REFERENCE_CALIBRATION.touch_only.offset
    assert touch_only.logit == pytest.approx((ratio - POSTERIOR.offset) / POSTERIOR.slope, abs=0.05)
    page = query_page(result, catalogue_with_touches)
    assert page.count('alt="reference touch"') == 8  # two fingers of each of four objects
    assert "no photo: scored by its touches only" in page
    print_table(result)
    assert "nearest touch" in capsys.readouterr().out


def other_cosine(model, grasps):
    from retrieval.model.encode import encode_touches

    load = model.config.preprocessing.load_touch
    codes = unit_embeddings(
        encode_touches(model.matcher, [[load(path) for path in one] for one in grasps]).partial.numpy(), EMBEDDING
    )
    return float(codes[0] @ codes[1])


def test_photos_and_references_of_an_object_combine_as_computed_by_hand(
    catalogue_with_touches, calibrated_model, tmp_path, touches
):
    files = touches[NAMES[0]][2]
    index = tmp_path / "index"
    result = query_new_index(catalogue_with_touches, calibrated_model, index, files)
    match = {one.object_id: one for one in result.results}[NAMES[0]]
    with Searcher.open(index) as searcher:
        partials = searcher.encode(files).partials
        rows = [at for at, row in enumerate(searcher.generation.rows) if row.object_id == NAMES[0]]
        photos = searcher.scorer.logits(partials, searcher.generation.arrays["partials"][rows])
        mine = [at for at, row in enumerate(searcher.generation.documents["references"]["touches"]) if at < 2]
        stored = unit_embeddings(searcher.generation.documents["touches"][mine], EMBEDDING)
    cosines = unit_embeddings(partials, EMBEDDING) @ stored.T
    near = math.log(np.exp(SHARPNESS * cosines.astype(float)).mean()) / SHARPNESS
    slope = REFERENCE_CALIBRATION.with_photos.slope
    photo_logits = math.log(np.exp(slope * (photos.astype(float) + REFERENCE_CALIBRATION.weight * near)).mean()) / slope
    ratio = slope * photo_logits + REFERENCE_CALIBRATION.with_photos.offset
    assert match.logit == pytest.approx((ratio - POSTERIOR.offset) / POSTERIOR.slope, abs=1e-4)
    bare = math.log(np.exp(POSTERIOR.slope * photos.astype(float)).mean()) / POSTERIOR.slope
    assert match.reference.adds == pytest.approx(match.logit - bare, abs=1e-4)


def test_photos_of_the_nearest_reference_are_always_scored(
    catalogue_with_touches, calibrated_model, tmp_path, touches, monkeypatch
):
    scored = []
    whole = Objects.score
    monkeypatch.setattr(Objects, "score", lambda *arguments: scored.append(arguments[1]) or whole(*arguments))
    build_index(catalogue_with_touches, calibrated_model, tmp_path / "index")
    with Searcher.open(tmp_path / "index") as searcher:
        for name in NAMES[:4]:
            searcher.query(touches[name][0], top=1, candidates=1)
            rows = scored.pop(0).tolist()
            scored.clear()
            photos = {at for at, row in enumerate(searcher.generation.rows) if row.object_id == name}
            assert photos <= set(rows)
            assert len(rows) <= len(photos) + 1


def test_the_documented_keys_of_references_are_those_written_and_the_result_reads_back(
    catalogue_with_touches, calibrated_model, tmp_path, touches
):
    documented = text_of(ROOT / "docs" / "formats.md").split("| with reference touches |")[1].split("\n\n")[0]
    result = query_new_index(catalogue_with_touches, calibrated_model, tmp_path / "index", touches[NAMES[0]][2])
    document = json.loads(json.dumps(result.to_dict()))
    assert QueryResult.from_dict(document).to_dict() == result.to_dict()
    generation = IndexStore(tmp_path / "index").open()
    keys = {f"about.references.{key}" for key in generation.manifest.about["references"]}
    keys |= {f"reference.{key}" for key in document["results"][0]["reference"]}
    assert keys | {"posterior.references"} == set(re.findall(r"`([a-z_0-9]+\.[\w.]+)`", documented))
    references = result.posterior["references"]
    assert set(references) == {*generation.manifest.about["references"], "calibration"}
    assert (references["touches"], references["objects"]) == (8, 4)
    assert typed(references["calibration"], ReferenceCalibration, complete=True) == REFERENCE_CALIBRATION
    assert {"references.json", "touches.npy"} <= {path.name for path in generation.folder.iterdir()}


OPENING = OpeningCalibration(mean=3.4, spread=0.7, width=0.001, floor=0.001, objects=9, touches=9)


def test_the_opening_of_a_reference_adds_its_log_ratio_and_brings_its_object_among_the_candidates(
    catalogue_with_touches, tmp_path, touches
):
    first, last = f"{NAMES[3]}/touch_0_b.png", f"{NAMES[3]}/touch_1_a.png"
    lines = [{"file_name": first, "opening_mm": 30}, {"object_id": NAMES[0], "opening_mm": 90}]
    (catalogue_with_touches / "metadata.jsonl").write_text("\n".join(map(json.dumps, lines)))
    model = write_reference_model(tmp_path / "model.safetensors", opening=OPENING)
    build_index(catalogue_with_touches, model, tmp_path / "index")
    files = touches[NAMES[1]][:2]
    with Searcher.open(tmp_path / "index") as searcher:
        bare = searcher.query(files, top=8)
        result = searcher.query(files, top=8, opening_mm=[30, None])
        few = searcher.query(files, top=1, candidates=1, opening_mm=[30, 30])
    before, after = ({match.object_id: match.logit for match in some.results} for some in (bare, result))
    ratios = OPENING.log_ratios([30], [30, math.nan, 90, 90], np.array([0, 2]))[0]
    expected = {NAMES[3]: before[NAMES[3]] + ratios[0] / 0.9, NAMES[0]: before[NAMES[0]] + ratios[1] / 0.9}
    assert after == pytest.approx(before | expected, abs=1e-4)
    assert few.top.object_id == NAMES[3]
    assert result.posterior["opening"] == {"compared_objects": 2, "calibration": dataclasses.asdict(OPENING)}
    document = json.loads(json.dumps(result.to_dict()))
    assert document["query"]["opening_mm"] == [30, None]
    assert QueryResult.from_dict(document).to_dict() == result.to_dict()
    (catalogue_with_touches / "metadata.jsonl").write_text(json.dumps({"file_name": last, "opening_mm": 0.03}))
    with pytest.raises(BadInput, match=rf"opening_mm of {NAMES[3]}/touch_1_a.png must be .*metres"):
        build_index(catalogue_with_touches, model, tmp_path / "index")


def test_only_new_touches_are_encoded_again(catalogue_with_touches, calibrated_model, tmp_path, touches):
    index = tmp_path / "index"
    first = build_index(catalogue_with_touches, calibrated_model, index)
    assert first.references == {"touches": 8, "objects": 4, "touch_only": 1, "encoded": 8}
    again = build_index(catalogue_with_touches, calibrated_model, index)
    assert (again.written, again.references["encoded"]) == (False, 0)
    synthetic.put_touch(catalogue_with_touches, NAMES[5], 0, touches[NAMES[5]][0])
    more = build_index(catalogue_with_touches, calibrated_model, index)
    assert (more.written, more.embedded, more.references["touches"], more.references["encoded"]) == (True, 0, 9, 1)


def test_a_recording_is_a_catalogue_of_the_photos_and_touches_of_its_grasps(recording, calibrated_model, tmp_path):
    report = build_index(recording, calibrated_model, tmp_path / "index")
    assert (report.objects, report.photos) == (12, 36)
    assert report.references["touches"] == 36
    grasp = load_grasps(recording)[4]
    with Searcher.open(tmp_path / "index") as searcher:
        found = {match.object_id: match for match in searcher.query(grasp.touches).results}[grasp.object_id]
    assert [recording / path for path in found.reference.touch] == list(grasp.touches)


def test_unusable_touches_are_left_out_with_a_reason(catalogue_with_touches, calibrated_model, tmp_path):
    (catalogue_with_touches / NAMES[0] / "touch_0_b.png").unlink()
    (catalogue_with_touches / NAMES[1] / "touch_0_a.png").write_bytes(b"not an image")
    for path in (catalogue_with_touches / NAMES[2]).glob("touch_*"):
        path.write_bytes(b"")
    report = build_index(catalogue_with_touches, calibrated_model, tmp_path / "index")
    reasons = {item.path: item.reason for item in report.skipped}
    assert "1 gel image(s), the model takes 2: names end in _a and _b" in reasons[f"{NAMES[0]}/touch_0_a.png"]
    assert len(reasons) == 4
    assert report.references["touches"] == 4
    assert report.without_photo == [NAMES[2]]  # no photo or touch of it is usable


@pytest.mark.parametrize("posterior", [POSTERIOR, None])
def test_a_model_without_reference_calibration_builds_nothing(catalogue_with_touches, tmp_path, posterior):
    model = write_reference_model(tmp_path / "other.safetensors", references=None, posterior=posterior)
    with pytest.raises(BadInput, match="no calibration of reference touches"):
        build_index(catalogue_with_touches, model, tmp_path / "index")
    with pytest.raises(BadInput, match="no calibration of reference touches"):
        build_sharded(catalogue_with_touches, model, tmp_path / "sharded", 2)
    assert not (tmp_path / "index" / "CURRENT").exists()


def test_a_sharded_index_gives_the_results_of_one_folder(catalogue_with_touches, calibrated_model, tmp_path, touches):
    files = touches[NAMES[1]][2]
    whole = query_new_index(catalogue_with_touches, calibrated_model, tmp_path / "index", files)
    report = build_sharded(catalogue_with_touches, calibrated_model, tmp_path / "sharded", 3)
    assert (report.references["touches"], report.references["touch_only"]) == (8, 1)
    with Searcher.open(tmp_path / "sharded") as searcher:
        divided = searcher.query(files, top=8)
    assert [one.object_id for one in divided.results] == [one.object_id for one in whole.results]
    for mine, other in zip(divided.results, whole.results, strict=True):
        assert (mine.logit, mine.probability) == pytest.approx((other.logit, other.probability), abs=1e-5)
        assert (mine.reference is None) == (other.reference is None)
    assert divided.posterior["references"]["touches"] == 8


TOUCH = {"object_id": NAMES[0], "touch": ["a.png"], "digests": ["0"]}


@pytest.mark.parametrize(
    "references",
    [[], *({"touches": [TOUCH | change] * 8, "touch_only": []} for change in ({"touch": ["../a"]}, {"digests": []}))],
)
def test_forged_references_raise_a_clear_error(catalogue_with_touches, calibrated_model, tmp_path, references):
    build_index(catalogue_with_touches, calibrated_model, tmp_path / "index")
    folder = IndexStore(tmp_path / "index").open().folder
    (folder / "references.json").write_text(json.dumps(references))
    forge(folder)
    with pytest.raises(CorruptIndex, match="retrieve build-index"):
        Searcher.open(tmp_path / "index")
