"""docs/formats.md lists all keys of the files on disk, and no others."""

import json
import re
from dataclasses import replace

import pytest

from retrieval.commands.main import main
from retrieval.data.dataset import load_grasps, make_split
from retrieval.model.checkpoint_info import read_header
from retrieval.search.answer import EXIT_CODES
from robot.recording.folder import RecordingWriter, read_recording
from tests.documents import ROOT, text_of

PAGE = ROOT / "docs" / "formats.md"


def documented_keys(table):
    """Return the keys in the first column of a table of the page, by its number."""
    tables = re.findall(r"^\| key \|.*\n\|.*\n((?:\|.*\n)+)", text_of(PAGE), re.M)
    return {key for row in tables[table].splitlines() for key in re.findall(r"`([\w.]+)`", row.split("|")[1])}


def keys_of(document, documented):
    """Return the keys of a document; nested keys, such as "a.b", where the documented keys are nested."""
    nested = {key.partition(".")[0] for key in documented if "." in key}
    return {key for key in document if key not in nested} | {
        f"{key}.{inner}" for key in nested & set(document) for inner in document[key]
    }


def check(table, document):
    documented = documented_keys(table)
    assert documented == keys_of(document, documented)


def test_a_recording(tmp_path, recording):
    picture = next(recording.glob("images/*"))
    names = ("photo", "touch_a", "touch_b", "touch_a_before", "touch_a_after", "depth")
    with RecordingWriter(tmp_path / "recording", {"source": "drawn", "sensor": "none"}) as writer:
        writer.append("1", "mug", dict.fromkeys(names, picture))
        writer.update_info(skipped_objects={"ball": "wider than the gripper opens"})
    read = read_recording(tmp_path / "recording")
    check(0, read.info)
    others = dict.fromkeys(("force_n", "opening_mm", "touch_skew_s", "time_s"), 1.0)
    others |= {"sequence_id": "s", "session": "monday", "outcome": "held"}
    check(1, replace(read.grasps[0], **others, pose=(0.0,), grasped=True).to_row())


def test_an_index_and_the_answer_to_a_query(tmp_path, catalogue, model, touch, capsys):
    index = tmp_path / "index"
    assert main(["build-index", str(catalogue), "--model", str(model), "--out", str(index)]) == 0
    generation = index / (index / "CURRENT").read_text().strip()
    check(2, json.loads((generation / "manifest.json").read_text()))
    check(3, json.loads((generation / "rows.jsonl").read_text().splitlines()[0]))
    names = {path.name for path in generation.iterdir()}
    assert names <= set(re.findall(r"^ {0,2}(\S+\.\w+) ", text_of(PAGE), re.M))
    capsys.readouterr()
    main(["query", "--gelsight", *map(str, touch), "--index", str(index), "--json"])
    document = json.loads(capsys.readouterr().out)
    check(5, document)
    check(6, document["results"][0])


def test_a_checkpoint(model):
    check(4, read_header(model))


def test_the_exit_codes_of_a_query():
    verdicts = text_of(ROOT / "docs" / "answers.md").partition("##")[0]
    assert {verdict: int(code) for verdict, code in re.findall(r"^\| `(.*?)` \| (\d) \|", verdicts, re.M)} == EXIT_CODES


@pytest.mark.slow
def test_the_results_of_an_evaluation(tmp_path, recording):
    split = make_split(load_grasps(recording), validation=0.3, test=0.3, seed=0)
    (tmp_path / "split.json").write_text(json.dumps(split.to_dict()))
    quick = ["--config", "tiny", "--methods", "late_fusion,chance"]
    quick += ["--split", str(tmp_path / "split.json")]
    assert main(["evaluate", str(recording), "--out", str(tmp_path / "out"), *quick]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    check(7, results)
    protocol = results["protocols"]["unseen-objects"]
    check(8, protocol)
    row = protocol["rows"]["late_fusion"]
    check(9, row)
    check(10, row["details"]["verification"]["random"]["1"])
