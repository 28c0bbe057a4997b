"""Every way an index on disk can be unusable has its own error, and none is taken for a good one."""

import json
import shutil

import faiss
import numpy as np
import pytest

from _touch_retrieval.files import file_digest
from indexes import KINDS, load_kind
from indexes.errors import CorruptIndex, IndexesError, MismatchedIndex, NoIndex, UnsupportedFormat
from indexes.store.folder import IndexStore
from indexes.store.manifest import own_digest
from tests.indexes.test_store import FINGERPRINT, filled, unit

TABLES = ["rows.jsonl", "table.npy", "embeddings.npy", "halves.npy"]
FILES = ["manifest.json", "vectors.faiss", "calibration.json", *TABLES]


@pytest.fixture
def folder(tmp_path):
    """The folder of the current generation of a good index."""
    return make(tmp_path / "index")


def make(path):
    return filled(
        path,
        kind="hnsw",
        arrays={"halves": np.ones((20, 3), np.float16)},
        documents={"calibration": {"a": 1}},
    ).folder


def reopened(folder, **options):
    return IndexStore(folder.parent).open(**options)


def rewrite_manifest(folder, **changes) -> None:
    """Change fields of the manifest and give it the digest that fits, as other software would."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text()) | changes
    content.pop("sha256")
    path.write_text(json.dumps(content | {"sha256": own_digest(content)}))


def flip(path, position: int, bit: int = 0) -> None:
    damaged = bytearray(path.read_bytes())
    damaged[position] ^= 1 << bit
    path.write_bytes(bytes(damaged))


@pytest.mark.parametrize("make_path", [lambda path: path / "absent", lambda path: path])
def test_no_index_says_what_to_run(tmp_path, make_path):
    with pytest.raises(NoIndex, match=r"no index here; run `retrieve build-index` first"):
        IndexStore(make_path(tmp_path)).open()


def test_a_file_in_the_place_of_the_folder_is_no_index(tmp_path):
    (tmp_path / "index").write_text("hello")
    with pytest.raises(NoIndex):
        IndexStore(tmp_path / "index").open()


@pytest.mark.parametrize("text", ["", "\n", "gen-1", "gen-000001x", "../gen-000001", "\xff\x00", "gen-000001 gen"])
def test_a_current_file_of_garbage_is_corrupt(folder, text):
    (folder.parent / "CURRENT").write_text(text)
    with pytest.raises(CorruptIndex, match="CURRENT: must name a generation"):
        reopened(folder)


def test_a_current_file_that_names_a_missing_generation_is_corrupt(folder):
    (folder.parent / "CURRENT").write_text("gen-000009\n")
    with pytest.raises(CorruptIndex, match="the generation gen-000009 is missing"):
        reopened(folder)


def test_a_generation_under_the_name_of_another_is_corrupt(folder):
    shutil.copytree(folder, folder.parent / "gen-000002")
    (folder.parent / "CURRENT").write_text("gen-000002\n")
    with pytest.raises(CorruptIndex, match="the manifest is that of gen-000001"):
        reopened(folder)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(CorruptIndex, match=rf"{name}: cannot be read .*retrieve build-index"):
        reopened(folder, verify=False)


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_at_any_of_many_lengths_is_named_even_without_verifying(folder, name):
    whole = (folder / name).read_bytes()
    cuts = sorted({0, 1, 10, len(whole) // 3, len(whole) // 2, len(whole) - 2} & set(range(len(whole))))
    for length in cuts:
        (folder / name).write_bytes(whole[:length])
        with pytest.raises(CorruptIndex, match=name):
            reopened(folder, verify=False)
    (folder / name).write_bytes(whole + b"\n")
    if name != "manifest.json":
        with pytest.raises(CorruptIndex, match=name):
            reopened(folder, verify=False)


def test_the_manifest_cut_at_any_length_is_corrupt(folder):
    path = folder / "manifest.json"
    whole = path.read_bytes()
    for length in [*range(0, len(whole) - 1, 13), len(whole) - 2]:  # the last byte is the final line break
        path.write_bytes(whole[:length])
        with pytest.raises(CorruptIndex, match=r"manifest\.json"):
            reopened(folder, verify=False)


@pytest.mark.parametrize("name", FILES)
def test_one_flipped_bit_anywhere_is_found_and_named(folder, name):
    path = folder / name
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [0, len(whole) // 2, len(whole) - 2, *rng.integers(len(whole) - 1, size=20)]
    for place in places:
        flip(path, int(place), int(rng.integers(8)))
        with pytest.raises((CorruptIndex, UnsupportedFormat), match=name):
            reopened(folder)
        path.write_bytes(whole)
    assert reopened(folder).count == 20


@pytest.mark.parametrize("kind", KINDS)
def test_whatever_is_flipped_or_cut_in_an_index_of_any_kind_is_found_by_its_digest(tmp_path, kind):
    count = 650  # what the codes of the largest kinds need
    arrays, documents = {"halves": np.ones((count, 3), np.float16)}, {"calibration": {"a": 1}}
    folder = filled(tmp_path, count, kind, arrays=arrays, documents=documents).folder
    rng = np.random.default_rng(0)
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        for place in rng.integers(len(whole) - 1, size=6).tolist():  # the last byte is a line break in some
            flip(path, place, int(rng.integers(8)))
            with pytest.raises((CorruptIndex, UnsupportedFormat), match=path.name):
                reopened(folder)
            path.write_bytes(whole[:place])
            with pytest.raises(CorruptIndex, match=path.name):
                reopened(folder, verify=False)
            path.write_bytes(whole)
    assert reopened(folder).count == count


@pytest.mark.parametrize("kind", ["ivf_flat", "ivf_sq8", "ivf_pq"])
@pytest.mark.parametrize("wrong", [3530822107858468864, -7, 650])
def test_an_id_out_of_range_in_a_structure_is_an_error_of_the_search(tmp_path, kind, wrong):
    """FAISS reads it, and the digest fits: the file was written so."""
    folder = filled(tmp_path, 650, kind).folder
    structure = faiss.read_index(str(folder / "vectors.faiss"))
    lists = structure.invlists
    for number in range(structure.nlist):
        ids = np.full(lists.list_size(number), wrong, np.int64)
        lists.update_entries(number, 0, len(ids), faiss.swig_ptr(ids), lists.get_codes(number))
    faiss.write_index(structure, str(folder / "vectors.faiss"))
    files = json.loads((folder / "manifest.json").read_text())["files"]
    files["vectors.faiss"]["sha256"] = file_digest(folder / "vectors.faiss")
    rewrite_manifest(folder, files=files)
    generation = reopened(folder)
    for search in (generation.search, generation.candidates):
        with pytest.raises(CorruptIndex, match=rf"found slot {wrong}, the index has 650.*build-index"):
            search(unit(3), 4)


def test_a_slot_that_a_structure_names_twice_is_an_error_of_the_search(tmp_path):
    index = load_kind("ivf_flat").build(unit(650))
    index._candidates = lambda queries, fetch, effort: (np.ones((len(queries), 3), np.float32), np.int64([[1, 2, 1]]))
    with pytest.raises(CorruptIndex, match="found one slot twice"):
        index.search(unit(1), 2)


def test_a_kind_of_ones_own_is_held_to_the_same_slots():
    class Wrong(load_kind("exact")):
        def _search(self, queries, k, live):
            return np.ones((len(queries), k), np.float32), np.full((len(queries), k), 99)

    with pytest.raises(CorruptIndex, match="found slot 99, the index has 20"):
        Wrong.build(unit(20)).search(unit(1), 1)


def test_naive_faiss_loads_a_flipped_bit_in_silence_and_answers_wrongly(tmp_path):
    path, vectors = tmp_path / "x", unit(50)
    good = faiss.IndexFlatIP(8)
    good.add(vectors)
    faiss.write_index(good, str(path))
    flip(path, path.stat().st_size - 1, 6)  # an exponent bit of the last component
    wrong = faiss.read_index(str(path))
    assert wrong.ntotal == 50
    assert not np.array_equal(good.search(vectors, 3)[0], wrong.search(vectors, 3)[0])


def test_without_verifying_the_content_is_trusted(folder):
    path = folder / "calibration.json"
    path.write_text(path.read_text().replace("1", "2"))
    assert reopened(folder, verify=False).documents == {"calibration": {"a": 2}}
    with pytest.raises(CorruptIndex, match=r"calibration\.json: the SHA-256 differs"):
        reopened(folder)


@pytest.mark.parametrize("name", ["vectors.faiss", *TABLES])
def test_garbage_of_the_right_size_never_escapes_as_a_raw_exception(folder, name):
    path = folder / name
    path.write_bytes(b"\x93" * path.stat().st_size)
    with pytest.raises(CorruptIndex):
        reopened(folder, verify=False).rows[3]  # rows are read when somebody looks


def test_a_pickled_array_is_not_loaded(folder):
    path = folder / "halves.npy"
    np.save(path, np.array([{"a": 1}] * 20, dtype=object), allow_pickle=True)
    files = json.loads((folder / "manifest.json").read_text())["files"]
    files["halves.npy"]["bytes"] = path.stat().st_size
    rewrite_manifest(folder, files=files)
    with pytest.raises(CorruptIndex, match="cannot be read"):
        reopened(folder, verify=False)


@pytest.mark.parametrize(
    ("version", "words"),
    [(5, "newer format 5.*reads 4; update"), *((old, f"older format {old}.*build-index") for old in (3, 2, 0, -1))],
)
def test_other_formats_say_whether_they_are_newer_or_older(folder, version, words):
    rewrite_manifest(folder, format=version)
    with pytest.raises(UnsupportedFormat, match=words):
        reopened(folder)


@pytest.mark.parametrize("version", [None, "1", True, 1.5, [1]])
def test_a_format_that_is_no_number_is_corrupt(folder, version):
    rewrite_manifest(folder, format=version)
    with pytest.raises(CorruptIndex, match="must say its format version"):
        reopened(folder)


def test_a_kind_that_this_software_does_not_know_is_unsupported(folder):
    rewrite_manifest(folder, kind="quantum")
    with pytest.raises(UnsupportedFormat, match=r"quantum.*Update the software"):
        reopened(folder)


@pytest.mark.parametrize("text", ["[]", "3", '"x"', "null", "[" * 100_000])
def test_a_manifest_that_is_no_object_is_corrupt(folder, text):
    (folder / "manifest.json").write_text(text)
    with pytest.raises(CorruptIndex, match=r"manifest\.json: must be"):
        reopened(folder)


@pytest.mark.parametrize("field", ["rows", "slots", "tombstones"])
def test_counts_that_the_files_do_not_bear_out_are_corrupt(folder, field):
    counts = json.loads((folder / "manifest.json").read_text())["counts"]
    rewrite_manifest(folder, counts=counts | {field: counts[field] + 1})
    with pytest.raises(CorruptIndex, match=r"the manifest says .* the files hold"):
        reopened(folder)


def test_missing_and_unknown_fields_are_named(folder):
    rewrite_manifest(folder, colour="red")
    with pytest.raises(CorruptIndex, match="has no setting 'colour'"):
        reopened(folder)


def test_a_structure_of_other_vectors_is_corrupt(folder):
    rewrite_manifest(folder, kind="ivf_flat", parameters={}, asked={})
    with pytest.raises(CorruptIndex, match="IndexHNSWFlat"):
        reopened(folder)


@pytest.mark.parametrize(
    ("expect", "words"),
    [
        ({"checkpoint": "xyz"}, "checkpoint 'abc', asked for is 'xyz'.*retrieve build-index"),
        (FINGERPRINT | {"preprocessing": "new"}, "preprocessing 'def', asked for is 'new'"),
        ({"tower": "small"}, "tower None, asked for is 'small'"),
    ],
)
def test_another_model_or_preprocessing_is_a_mismatch_naming_both(folder, expect, words):
    with pytest.raises(MismatchedIndex, match=words):
        reopened(folder, expect=expect)
    assert reopened(folder, expect={"checkpoint": "abc"}).count == 20


def test_every_error_leaves_with_the_promised_exit_code():
    import indexes.errors

    found = [thing for thing in vars(indexes.errors).values() if hasattr(thing, "exit_code")]
    assert {thing.__name__ for thing in found if thing.exit_code == 1} == {
        "JobFailed",
        "SelfRetrievalFailed",
        "WriteFailed",
        "EngineError",
    }
    assert all(issubclass(thing, IndexesError) and thing.exit_code in (1, 2) for thing in found)


def test_a_damaged_index_is_not_in_the_way_of_a_new_one(folder):
    (folder.parent / "CURRENT").write_text("garbage")
    (folder / "manifest.json").unlink()
    make(folder.parent)
    assert reopened(folder).name == "gen-000002"
