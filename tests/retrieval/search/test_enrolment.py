"""Touches that are enrolled in an index: opened searchers find them at once, and no writer loses them."""

import json
import os
import subprocess
import sys

import pytest

import retrieval
from indexes.errors import CorruptIndex
from retrieval.commands.main import main
from retrieval.errors import BadInput
from retrieval.indexing.build import build_index
from retrieval.indexing.enrolled import EnrolledTable
from retrieval.indexing.sharded import build_sharded
from retrieval.model.posterior import Posterior
from retrieval.report.query import query_page
from retrieval.search.answer import QueryResult
from retrieval.search.searcher import Searcher
from tests import synthetic
from tests.killed_enrolment import enrol
from tests.reference_model import NAMES, write_reference_model
from tests.verification import calibration

OTHER = Posterior(0.8)
"""Posterior of another model."""
KILLS = os.environ.get("ENROLMENT_KILLS", "20")


@pytest.fixture
def model(tmp_path):
    return write_reference_model(tmp_path / "model.safetensors", verification=calibration(-1e3, -2e3))


@pytest.fixture
def index(catalogue, model, tmp_path):
    build_index(catalogue, model, tmp_path / "index")
    return tmp_path / "index"


def test_an_opened_searcher_finds_an_object_that_was_enrolled_in_the_meantime(index, touches):
    with Searcher.open(index) as searcher:
        before = searcher.query(touches[NAMES[0]][0], top=99)
        assert enrol(index, "a cup", touches[NAMES[0]][0], opening_mm=30) == ("a cup", 1, 1)
        after = searcher.query(touches[NAMES[0]][0], top=99)
        assert len(after.results) == len(before.results) + 1 == after.index["objects"]
        cup = next(match for match in after.results if match.object_id == "a cup")
        assert cup.reference.cosine == pytest.approx(1, abs=1e-3)
        pages = [query_page(result, searcher.catalogue).count('src="data:') for result in (before, after)]
        assert pages[1] == pages[0] + 3  # a gel image in place of the photo, and the two of the nearest touch
        read = QueryResult.from_dict(json.loads(json.dumps(after.to_dict())))
        assert cup.photo_path in [match.photo_path.absolute() for match in read.results]
        assert searcher.picture_file(searcher.shard.photos([cup.photo])[0]) == cup.photo_path
        assert searcher.verify(touches[NAMES[0]][1], "a cup ").decision == "accept"
        assert retrieval.remove_enrolled(index, "a cup") == ("a cup", 1)
        assert searcher.query(touches[NAMES[0]][0], top=99).results == before.results
        assert not cup.photo_path.exists()


def test_an_enrolled_object_is_one_object_with_a_folder_that_macos_names(catalogue_copy, model, tmp_path, touches):
    build_index(catalogue_copy, model, tmp_path / "index")
    enrol(tmp_path / "index", "T\u00fclle", touches[NAMES[0]][0])
    (catalogue_copy / NAMES[0]).rename(catalogue_copy / "Tu\u0308lle")
    build_index(catalogue_copy, model, tmp_path / "index")
    with Searcher.open(tmp_path / "index") as searcher:
        found = searcher.query(touches[NAMES[0]][0], top=99).results
    assert [(one.object_id, one.reference.is_enrolled) for one in found if one.reference] == [("Tu\u0308lle", True)]


def test_a_build_warns_of_an_enrolled_name_that_differs_from_that_of_an_object_only_by_case(
    index, catalogue, model, touches
):
    enrol(index, NAMES[0].upper(), touches[NAMES[0]][0])
    (warning,) = [line for line in build_index(catalogue, model, index).warnings if "only by case" in line]
    assert NAMES[0].upper() in warning


def test_a_picture_that_the_table_names_is_not_opened_for_writing_again(index, touches):
    """As the no-contact frame of several touches: a full disk would leave half of it."""
    enrol(index, "cup", touches[NAMES[0]][0])
    table = EnrolledTable(index)
    with table.lock() as known:
        picture = index / known[0].path
        before = picture.stat().st_mtime_ns
        table.replace(known, {known[0].path: picture.read_bytes()})
    assert picture.stat().st_mtime_ns == before


@pytest.mark.parametrize("shards", [None, 16])
def test_enrolled_touches_count_like_the_same_touches_in_the_catalogue(
    catalogue_copy, model, tmp_path, touches, shards
):
    """Of objects with photos and without; with 16 shards, some objects are in a shard that has no photo."""
    grasps = {NAMES[0]: touches[NAMES[0]][0], NAMES[5]: touches[NAMES[5]][0]}
    grasps |= {f"new {number}": touches[name][1] for number, name in enumerate(NAMES)}
    build = build_index if shards is None else build_sharded
    build(catalogue_copy, model, tmp_path / "index", *filter(None, [shards]))
    with Searcher.open(tmp_path / "index") as searcher:
        for name, grasp in grasps.items():
            searcher.enrol(name, grasp)
            synthetic.put_touch(catalogue_copy, name, 0, grasp)
        ours = searcher.query(touches[NAMES[0]][2], top=99)
    build_index(catalogue_copy, model, tmp_path / "expected")
    with Searcher.open(tmp_path / "expected") as searcher:
        theirs = searcher.query(touches[NAMES[0]][2], top=99)
    logits = [{match.object_id: match.logit for match in result.results} for result in (ours, theirs)]
    assert logits[0] == pytest.approx(logits[1], abs=1e-3)
    assert ours.none_probability == pytest.approx(theirs.none_probability, abs=1e-3)
    assert ours.posterior["references"]["touches"] == len(grasps)


def test_what_cannot_be_a_reference_touch_is_refused(index, touches, catalogue, tmp_path):
    grasp, other = touches[NAMES[0]][:2]
    assert enrol(index, f" {NAMES[0]}", grasp).object_id == NAMES[0]
    for name, images, options, reason in (
        ("tin", grasp, {}, f"is enrolled already, for {NAMES[0]}"),
        ("tin", [grasp, other], {"opening_mm": 5}, "one opening for each grasp"),
        ("tin", other, {"opening_mm": 0}, "from 0.5 to 300; got 0"),
        (" \n", other, {}, "must be printable text"),
    ):
        with pytest.raises(BadInput, match=reason):
            enrol(index, name, images, **options)
    plain = write_reference_model(tmp_path / "plain.safetensors", references=None)
    build_index(catalogue, plain, tmp_path / "plain")
    with pytest.raises(BadInput, match="no calibration of reference touches"):
        enrol(tmp_path / "plain", "tin", grasp)
    assert [touch.object_id for touch in EnrolledTable(index).read()] == [NAMES[0]]


def test_a_build_with_another_model_encodes_again_and_keeps_a_touch_that_it_cannot_read(
    catalogue_copy, tmp_path, touches, capsys
):
    """The index lies in the catalogue: the enrolled pictures are no photos of it."""
    model, index = write_reference_model(tmp_path / "model.safetensors"), catalogue_copy / "index"
    assert main(["build-index", str(catalogue_copy), "--model", str(model.path), "--out", str(index)]) == 0
    for name in NAMES[:2]:
        files = [str(path) for path in touches[name][0]]
        assert main(["enrol", f"my {name}", "--index", str(index), "--gelsight", *files, "--json"]) == 0
    damaged, usable = EnrolledTable(index).read()
    (index / damaged.path).write_bytes(b"damaged")
    other = write_reference_model(tmp_path / "other.safetensors", posterior=OTHER)
    report = build_index(catalogue_copy, other, index)
    assert (report.photos, report.enrolled) == (24, {"touches": 2, "objects": 2, "encoded": 1, "usable": 1})
    assert f"enrolled for {damaged.object_id}" in report.skipped[0].reason
    assert len(EnrolledTable(index).read()[1].codes) == 2  # readers may still use the model before
    with Searcher.open(index) as searcher:
        found = {match.object_id: match for match in searcher.query(touches[NAMES[1]][0], top=99).results}
        assert found[usable.object_id].reference.cosine == pytest.approx(1, abs=1e-3)
        assert damaged.object_id not in found
    (index / "enrolled" / "touches.json").write_text("{}")
    assert main(["enrol", usable.object_id, "--remove", "--index", str(index)]) == 2
    assert "the table of enrolled touches is damaged" in capsys.readouterr().err
    with pytest.raises(CorruptIndex, match="restore it from a backup, or rename the folder"):
        Searcher.open(index).query(touches[NAMES[1]][0])


@pytest.mark.slow
def test_writers_that_are_killed_lose_nothing(index, catalogue, model, tmp_path):
    other = write_reference_model(tmp_path / "other.safetensors", posterior=OTHER)
    command = [sys.executable, "-m", "tests.killed_enrolment", KILLS, catalogue, index, model.path, other.path]
    assert f"{KILLS} kills" in subprocess.run(command, check=True, capture_output=True, text=True).stdout
