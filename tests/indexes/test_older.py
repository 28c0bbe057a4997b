"""Indexes of format 2 (0.1.0) are read, answer bit for bit what they answered, and serve as parents.

`fixtures/index-format-2.tar.xz` was written by the last software of that format: two indexes of two segments each,
whose rows are fewer than their records and in another order, one with a structure that lacks the last vectors, and what
they answered to `unit(6, seed=2)`.
"""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from indexes.errors import CorruptIndex, UnsupportedFormat
from indexes.store.folder import IndexStore
from tests.indexes.test_forged import forge, forge_array
from tests.indexes.test_store import unit

KINDS = ["flat", "hnsw"]
OF = {"checkpoint": "abc"}


@pytest.fixture
def older(tmp_path):
    """The folder of the indexes, by kind, and what they answered."""
    with tarfile.open(Path(__file__).parents[1] / "fixtures" / "index-format-2.tar.xz") as tar:
        tar.extractall(tmp_path, filter="data")
    return tmp_path


def check_answers(generation, must):
    """Rows, halves and vectors as they were, and the answers to the last bit."""
    assert list(generation.rows) == must["rows"]
    assert generation.arrays["halves"][:, 0].tolist() == must["halves"]
    vectors = generation.embeddings[generation.slots[:4]]
    assert [[float(number).hex() for number in vector] for vector in vectors] == must["vectors"]
    found = [
        [[generation.rows[int(row)]["id"] for row in rows], [float(score).hex() for score in scores]]
        for rows, scores in generation.search(unit(6, seed=2), 7)
    ]
    assert found == must["found"]
    generation.self_check()


@pytest.mark.parametrize("kind", KINDS)
def test_an_older_index_answers_as_it_did(older, kind):
    generation = IndexStore(older / kind).open(expect=OF, threads=1)
    check_answers(generation, json.loads((older / f"{kind}.json").read_text()))
    assert generation.documents == {"calibration": {"scale": 2.5}}
    assert generation.manifest.counts.tombstones == 3
    if kind == "hnsw":
        assert generation.index.covered == len(generation.embeddings) - 3


@pytest.mark.parametrize("kind", KINDS)
def test_an_older_index_is_a_parent_and_the_next_one_is_written_whole(older, kind):
    store, must = IndexStore(older / kind), json.loads((older / f"{kind}.json").read_text())
    parent = store.open(threads=1)
    documents = {"calibration": {"scale": 2.5}}
    made = store.write(
        parent.rows, None, None, documents, fingerprint=OF, parent=parent, kind=kind, threads=1, software="next"
    )
    names = {path.name for path in made.folder.iterdir()} - {"vectors.faiss"}
    assert names == {"manifest.json", "rows.jsonl", "table.npy", "embeddings.npy", "halves.npy", "calibration.json"}
    assert (made.manifest.parent, made.manifest.counts.tombstones) == (parent.name, 3)
    check_answers(store.open(threads=1), must)


def test_an_older_index_that_never_grew_is_read_where_it_lies(older):
    folder = older / "flat" / "gen-000002"
    (folder / "order.npy").unlink()

    for path in folder.glob("*-000002.*"):
        path.unlink()
    manifest = folder / "manifest.json"
    content = json.loads(manifest.read_text()) | {"segments": {"records": [1], "vectors": [1]}}
    content["files"] = {name: must for name, must in content["files"].items() if (folder / name).exists()}
    content["counts"] |= {"rows": 60, "records": 60, "slots": 59, "tombstones": 0}
    manifest.write_text(json.dumps(content))
    forge(folder)
    generation = IndexStore(older / "flat").open()
    assert isinstance(generation.arrays["halves"], np.memmap)
    assert isinstance(generation.embeddings, np.memmap)
    assert [row["id"] for row in generation.rows] == [f"p{number:02d}" for number in range(60)]


@pytest.mark.parametrize("order", [np.arange(59) - 1, np.arange(59) + 6, np.arange(59.0)])
def test_an_order_of_records_that_are_not_there_is_refused(older, order):
    folder = older / "flat" / "gen-000002"
    forge_array(folder, "order.npy", lambda _: order)
    with pytest.raises(CorruptIndex, match="must name records 0 to 63"):
        IndexStore(older / "flat").open()


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["segments"].__setitem__("records", []),
        lambda content: content["segments"].__setitem__("records", [1, 2, 2]),
        lambda content: content["segments"].__setitem__("vectors", [-1]),
        lambda content: content["segments"].__setitem__("vectors", [1]),
        lambda content: content["segments"].__setitem__("more", [1]),
        lambda content: content["files"].pop("halves-000002.npy"),
        lambda content: content.pop("segments"),
        lambda content: content.__setitem__("counts", 3),
    ],
)
def test_a_forged_older_manifest_is_refused(older, change):
    forge(older / "flat" / "gen-000002", change)
    with pytest.raises(CorruptIndex):
        IndexStore(older / "flat").open()


def test_the_format_before_is_refused(older):
    forge(older / "flat" / "gen-000002", lambda content: content.__setitem__("format", 1))
    with pytest.raises(UnsupportedFormat, match="older format 1, this software reads 2 to 3"):
        IndexStore(older / "flat").open()
