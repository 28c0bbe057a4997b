"""Damaged, forged and foreign files: one of our errors, or an index that works; user files stay as they are."""

import json
import os
import resource
import socket

import numpy as np
import pytest

from _touch_retrieval.files import file_digest
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat, WriteFailed
from indexes.store.folder import IndexStore
from indexes.store.manifest import FORMAT, content_digest
from tests.indexes.test_search import unit
from tests.indexes.test_store import DIM, filled

FILES = ["manifest.json", "vectors.faiss", "touches.json", "rows.jsonl", "rows.npy", "embeddings.npy", "partials.npy"]


def make(path):
    arrays, documents = {"partials": np.ones((20, 3), np.float16)}, {"touches": {"a": 1}}
    return filled(path, 20, "HNSW8", arrays=arrays, documents=documents).folder


@pytest.fixture
def folder(tmp_path):
    """The folder of the current generation of a good index."""
    return make(tmp_path / "index")


@pytest.fixture(scope="module")
def restored(tmp_path_factory):
    """As `folder`, for examples that restore what they change."""
    return make(tmp_path_factory.mktemp("restored") / "index")


def opened(folder, **options):
    """Open the index, read each row and search once."""
    generation = IndexStore(folder.parent).open(**options)
    list(generation.rows)
    generation.index.search(unit(1, DIM), 3)
    return generation


def forge(folder, change=lambda content: None, **fields):
    """Change the manifest and update every size and digest, as other software could."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text()) | fields
    content.pop("sha256", None)
    for name, must in content["files"].items() if isinstance(content["files"], dict) else ():
        if (folder / name).is_file():
            must |= {"bytes": (folder / name).stat().st_size, "sha256": file_digest(folder / name)}
    change(content)
    path.write_text(json.dumps(content | {"sha256": content_digest(content)}))


def flip(path, position: int, bit: int = 0) -> None:
    damaged = bytearray(path.read_bytes())
    damaged[position] ^= 1 << bit
    path.write_bytes(bytes(damaged))


def test_a_missing_index_error_names_the_command(tmp_path):
    (tmp_path / "file").write_text("hello")
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(NoIndex, match="run `retrieve build-index` first"):
            IndexStore(path).open()
    with pytest.raises(NoIndex):
        IndexStore(tmp_path / "file").open()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *((text, "CURRENT: must name a generation") for text in ("", "gen-000001x", "../gen-000001", "\xff\x00")),
        ("gen-000009\n", "gen-000009.*build-index"),
    ],
)
def test_a_current_file_without_a_matching_generation_is_corrupt(folder, text, words):
    (folder.parent / "CURRENT").write_text(text)
    with pytest.raises(CorruptIndex, match=words):
        opened(folder)


def test_user_files_in_an_index_folder_are_not_changed(tmp_path):
    (tmp_path / "CURRENT").write_text("my notes on electricity")
    with pytest.raises(NoIndex, match="does not belong to an index; give another folder"):
        filled(tmp_path)
    assert (tmp_path / "CURRENT").read_text() == "my notes on electricity"
    (tmp_path / "CURRENT").unlink()
    (tmp_path / "LOCK").write_text("the combination is 1234")
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
    assert (tmp_path / "notes.tmp-1").read_text() == "not yours"


def test_a_damaged_index_does_not_block_a_new_one(folder):
    (folder.parent / "CURRENT").write_text("garbage")
    (folder / "manifest.json").unlink()
    assert make(folder.parent).name == opened(folder).folder.name == "gen-000002"


@pytest.mark.parametrize("name", FILES)
def test_a_missing_truncated_or_longer_file_is_reported_even_without_verifying(folder, name):
    path = folder / name
    whole = path.read_bytes()
    path.unlink()
    with pytest.raises(CorruptIndex, match=rf"{name}: cannot be read .*retrieve build-index"):
        opened(folder, verify=False)
    lengths = range(0, len(whole) - 1, 97) if name == "manifest.json" else {0, 10, len(whole) - 2}
    for content in (*(whole[:length] for length in lengths), *([] if name == "manifest.json" else [whole + b"\n"])):
        path.write_bytes(content)
        with pytest.raises(CorruptIndex, match=name):
            opened(folder, verify=False)


@pytest.mark.parametrize("name", FILES)
def test_one_flipped_bit_in_any_file_is_detected(restored, name):
    path, rng = restored / name, np.random.default_rng(0)
    whole = path.read_bytes()
    for place in [0, len(whole) - 2, *rng.integers(len(whole) - 1, size=3).tolist()]:
        flip(path, place, int(rng.integers(8)))  # the last byte is a line break in some
        with pytest.raises((CorruptIndex, UnsupportedFormat), match=path.name):
            IndexStore(restored.parent).open()
        path.write_bytes(whole)
    assert IndexStore(restored.parent).open().count == 20


@pytest.mark.parametrize("name", ["manifest.json", "rows.jsonl", "../CURRENT"])
def test_a_path_that_is_not_a_regular_file_raises_without_reading(folder, name):
    path = folder / name
    path.unlink()
    server = socket.socket(socket.AF_UNIX)
    for make_it in (os.mkfifo, server.bind, lambda there: os.symlink("/dev/zero", there), os.mkdir):
        make_it(str(path))
        with pytest.raises(IndexesError, match=r"not a regular file|No such device"):
            IndexStore(folder.parent).open()
        path.rmdir() if path.is_dir() else path.unlink()
    server.close()


@pytest.mark.parametrize("name", ["manifest.json", "touches.json"])
def test_an_oversized_file_raises_without_reading(folder, name):
    os.truncate(folder / name, 300 * 10**6)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if name != "manifest.json":
        forge(folder, lambda content: content["files"][name].__setitem__("sha256", ""))
    with pytest.raises(CorruptIndex, match=r"has 300000000 bytes; at most \d+ are allowed"):
        opened(folder, verify=False)  # verifying would compute the digest of 300 MB first
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize(
    ("fields", "error", "words"),
    [
        ({"format": FORMAT + 1}, UnsupportedFormat, "newer format.*update"),
        *(({"format": old}, UnsupportedFormat, f"older format {old}.*build-index") for old in (FORMAT - 1, -1)),
        *(({"format": odd}, CorruptIndex, "with a format version") for odd in (None, "1", True, 1.5)),
        ({"kind": "nowhere:Nothing"}, UnsupportedFormat, r"nowhere.*Update the software"),
        ({"colour": "red"}, CorruptIndex, "has no setting 'colour'"),
        ({"photos": 21}, CorruptIndex, "the files have"),
        ({"dim": DIM + 1}, CorruptIndex, "the files have"),
        ({"arrays": ["../../secret"]}, CorruptIndex, "arrays"),
    ],
)
def test_manifests_of_other_software_raise_a_clear_error(folder, fields, error, words):
    forge(folder, **fields)
    with pytest.raises(error, match=words):
        opened(folder)


@pytest.mark.parametrize("text", ["[]", "null", "[" * 100_000], ids=["list", "null", "deep"])
def test_a_manifest_that_is_not_one_object_is_corrupt(folder, text):
    (folder / "manifest.json").write_text(text)
    with pytest.raises(CorruptIndex, match=r"manifest\.json: must be"):
        opened(folder)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rows.npy", lambda table: table[:-1]),
        ("rows.npy", lambda table: table["stop"]),
        ("partials.npy", lambda partials: partials[:7]),
        ("partials.npy", lambda partials: np.array([{"a": 1}] * 20, dtype=object)),  # must not be unpickled
        ("embeddings.npy", lambda vectors: vectors[:, :5]),
        ("embeddings.npy", lambda vectors: vectors[0, 0]),
    ],
)
def test_a_forged_array_is_corrupt(folder, name, change):
    np.save(folder / name, change(np.load(folder / name)), allow_pickle=True)
    forge(folder)
    with pytest.raises(CorruptIndex):
        opened(folder)
