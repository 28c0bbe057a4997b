"""An index that somebody wrote on purpose: digests fit, contents do not. Each has an error of ours, and nothing outside
the folder is read, waited for or written over."""

import json
import os
import resource
import shutil
import socket
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from _touch_retrieval.files import DEEPEST, file_digest, read_regular
from indexes.errors import CorruptIndex, IndexesError, LockedIndex, NoIndex, RowError, WriteFailed
from indexes.store.folder import IndexStore
from indexes.store.manifest import own_digest
from tests.indexes.test_store import FINGERPRINT, filled, names, rows_of, unit


def make(path):
    return filled(path, arrays={"halves": np.ones((20, 3), np.float16)}, documents={"calibration": {"a": 1}}).folder


@pytest.fixture
def folder(tmp_path):
    """The folder of the current generation of a good index."""
    return make(tmp_path / "index")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """As `folder`, for examples that put back what they change."""
    return make(tmp_path_factory.mktemp("kept") / "index")


def forge(folder, change=lambda content: None):
    """Change the manifest, with every size and digest made to fit."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    content.pop("sha256", None)
    for name, must in content["files"].items():
        must |= {"bytes": (folder / name).stat().st_size, "sha256": file_digest(folder / name)}
    change(content)
    path.write_text(json.dumps(content | {"sha256": own_digest(content)}))


def forge_array(folder, name, change):
    array = np.load(folder / name)
    np.save(folder / name, change(array))
    forge(folder)


def opened(folder, **options):
    generation = IndexStore(folder.parent).open(**options)
    list(generation.rows)
    generation.search(unit(1), 3)
    return generation


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)
FIELDS = ["about", "arrays", "asked", "counts", "dim", "documents", "files", "fingerprint", "format", "generation"]
FIELDS += ["kind", "parameters", "parent", "recall", "seed", "metric", "created", "software"]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(field=st.sampled_from(FIELDS), value=JSON)
def test_any_field_of_the_manifest_may_be_forged(kept, field, value):
    before = (kept / "manifest.json").read_bytes()
    forge(kept, lambda content: content.__setitem__(field, value))
    try:
        opened(kept)
    except IndexesError:
        pass
    finally:
        (kept / "manifest.json").write_bytes(before)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["files"].__setitem__("../../../etc/passwd", {"bytes": 1, "sha256": ""}),
        lambda content: content["files"].__setitem__("a\0b", {"bytes": 1, "sha256": ""}),
        lambda content: content["files"]["calibration.json"].pop("bytes"),
        lambda content: content["files"].pop("rows.jsonl"),
        lambda content: content["documents"].append("calibration"),
        lambda content: content["documents"].append("halves"),
        lambda content: content["arrays"].append("halves"),
        lambda content: content["documents"].append("../../secret"),
        lambda content: content["arrays"].append("../../secret"),
        lambda content: content["counts"].__setitem__("records", 20),
        lambda content: content["files"]["calibration.json"].__setitem__("colour", "red"),
        lambda content: content["counts"].__setitem__("rows", 2**70),
        lambda content: content["counts"].__setitem__("rows", True),
        lambda content: content.__setitem__("dim", 10**9),
        lambda content: content.__setitem__("about", json.loads("[" * 900 + "]" * 900)),
    ],
)
def test_a_forged_manifest_is_refused(folder, change):
    forge(folder, change)
    with pytest.raises(CorruptIndex):
        opened(folder)


def out_of(field, value):
    def change(table):
        table[field][3] = value
        return table

    return change


def same(field):
    def change(table):
        table[field][4] = table[field][3] if field != "object_id" else b"other"
        return table

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("table.npy", out_of("stop", -1)),
        ("table.npy", out_of("stop", 2**40)),
        ("table.npy", lambda table: table[:-1]),  # lines that no row has
        ("table.npy", lambda table: table[[0, *range(20 - 1)]]),  # two rows of one id
        ("table.npy", same("id")),
        ("table.npy", same("stop")),  # a row without a line
        ("table.npy", same("object_id")),  # of one row, to rank its object twice
        ("table.npy", out_of("slot", -1)),
        ("table.npy", out_of("slot", 10**6)),
        ("table.npy", lambda table: table[:0]),
        ("table.npy", lambda table: table["stop"]),
        ("halves.npy", lambda halves: halves[:7]),
        ("embeddings.npy", lambda vectors: vectors * np.float32("nan")),
        ("embeddings.npy", lambda vectors: vectors * 1000),
        ("embeddings.npy", lambda vectors: vectors[:, :5]),
        ("embeddings.npy", lambda vectors: vectors.astype(complex)),
        ("embeddings.npy", lambda vectors: vectors[0, 0]),
    ],
)
def test_a_forged_array_is_refused(folder, name, change):
    forge_array(folder, name, change)
    with pytest.raises(CorruptIndex):
        opened(folder)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(line=st.binary(max_size=30) | JSON.map(lambda row: json.dumps(row).encode()))
def test_any_row_may_be_forged(kept, line):
    path = kept / "rows.jsonl"
    before, manifest = path.read_bytes(), (kept / "manifest.json").read_bytes()
    length = before.index(b"\n")
    path.write_bytes(line[:length].ljust(length) + before[length:])
    forge(kept)
    try:
        opened(kept)
    except IndexesError:
        pass
    finally:
        path.write_bytes(before)
        (kept / "manifest.json").write_bytes(manifest)


def test_a_row_nested_deeper_than_anyone_reads_is_refused_as_it_is_written(tmp_path):
    deep = json.loads("[" * DEEPEST + "]" * DEEPEST)
    rows = rows_of(names(2))
    with pytest.raises(RowError, match="must not be nested deeper than 64 levels"):
        IndexStore(tmp_path).write([rows[0], rows[1] | {"metadata": deep}], unit(2), fingerprint=FINGERPRINT)


@pytest.mark.parametrize("name", ["manifest.json", "rows.jsonl", "calibration.json", "../CURRENT"])
@pytest.mark.parametrize("verify", [True, False])
def test_what_is_no_file_is_refused_without_being_read(folder, name, verify):
    path = folder / name
    path.unlink()
    server = socket.socket(socket.AF_UNIX)
    for make_it in (os.mkfifo, server.bind, lambda there: os.symlink("/dev/zero", there), os.mkdir):
        make_it(str(path))
        with pytest.raises(IndexesError, match=r"is a (pipe|socket|device|folder), not a"):
            IndexStore(folder.parent).open(verify=verify)
        path.rmdir() if path.is_dir() else path.unlink()
    server.close()


def test_a_file_larger_than_what_is_read_whole_is_refused_unread(tmp_path):
    (tmp_path / "large").touch()
    os.truncate(tmp_path / "large", 2**40)
    with pytest.raises(OSError, match="has 1099511627776 bytes; at most 536870912 are read"):
        read_regular(tmp_path / "large")


@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize("name", ["manifest.json", "calibration.json"])
def test_a_json_file_larger_than_its_index_needs_is_refused_at_once_and_unread(folder, name, verify):
    with (folder / name).open("ab") as file:
        file.truncate(300 * 10**6)
    if name != "manifest.json":
        files = {"calibration.json": {"bytes": 300 * 10**6, "sha256": ""}}
        path = folder / "manifest.json"
        content = json.loads(path.read_text())
        del content["sha256"]
        content["files"] |= files
        path.write_text(json.dumps(content | {"sha256": own_digest(content)}))
        verify = False  # the digest of 300 MB would be taken first
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    with pytest.raises(CorruptIndex, match=r"has 300000000 bytes; at most \d+ are read"):
        opened(folder, verify=verify)
    assert time.perf_counter() - start < 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_manifest_that_has_a_key_twice_is_refused(folder):
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace('"documents": [', '"documents": [], "documents": [', 1))
    with pytest.raises(CorruptIndex, match="it has the key 'documents' twice"):
        opened(folder)


@pytest.mark.parametrize("field", ["about", "documents", "rows"])
def test_json_larger_than_a_reader_takes_is_refused_as_it_is_written(tmp_path, field):
    long = {"note": "x" * 5 * 10**6}
    more = {"rows": {}, "about": {"about": long}, "documents": {"documents": {"calibration": long}}}[field]
    rows = [row | (long if field == "rows" else {}) for row in rows_of(names(2))]
    with pytest.raises(RowError, match=r"must have (at most|less than) \d+ bytes"):
        IndexStore(tmp_path).write(rows, unit(2), fingerprint=FINGERPRINT, **more)
    assert not (tmp_path / "CURRENT").exists()


def test_files_of_the_user_in_the_folder_of_an_index_stay(tmp_path):
    (tmp_path / "CURRENT").write_text("my notes on electricity")
    with pytest.raises(NoIndex, match="is not of an index, and is left as it is"):
        filled(tmp_path)
    assert (tmp_path / "CURRENT").read_text() == "my notes on electricity"
    (tmp_path / "CURRENT").unlink()
    (tmp_path / "LOCK").write_text("the combination is 1234")
    with pytest.raises(WriteFailed, match="is not the lock file of an index"):
        filled(tmp_path)
    assert (tmp_path / "LOCK").read_text() == "the combination is 1234"
    (tmp_path / "LOCK").unlink()
    (tmp_path / "photo.jpg").write_text("a photo")
    (tmp_path / "LOCK").symlink_to("photo.jpg")
    with pytest.raises(WriteFailed, match="cannot be opened"):
        filled(tmp_path)
    assert (tmp_path / "photo.jpg").read_text() == "a photo"
    (tmp_path / "LOCK").unlink()
    (tmp_path / "notes.tmp-1").write_text("not yours")
    filled(tmp_path)
    filled(tmp_path)
    assert (tmp_path / "notes.tmp-1").read_text() == "not yours"


def test_a_damaged_current_is_healed_by_building_again(tmp_path):
    filled(tmp_path)
    (tmp_path / "CURRENT").write_text("gen-\0\0")
    assert filled(tmp_path).name == "gen-000002"


def test_a_second_writer_is_still_told_of_the_first(tmp_path):
    store = IndexStore(tmp_path)
    with store.lock(), pytest.raises(LockedIndex):
        filled(tmp_path)
    shutil.rmtree(tmp_path)
