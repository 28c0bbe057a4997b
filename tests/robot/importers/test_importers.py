"""Common behaviour of all importers, on a miniature of each data set; test_<name>.py tests each importer."""

import json
import re
import shutil
import sys
from hashlib import sha256
from importlib import import_module

import cv2
import pytest

from benchmarks.reference import DATA_SETS, data_sets
from retrieval.commands.main import main
from retrieval.data.check.split import check_split
from retrieval.data.dataset import Split, load_grasps
from robot.errors import ImporterError, RecordingError, RobotError, UnknownName
from robot.importers import IMPORTERS, data_set_of, load_importer, options_of, read_options, title_of
from robot.importers.importing import SOURCES_FILE, SPLITS_FOLDER, DataSet, Item, Skip, import_items
from robot.recording.folder import RecordingWriter, SharedImage, read_recording, safe_name
from robot.storage import parse_object
from tests.data import touch_data
from tests.documents import text_of
from tests.miniatures import encoded, picture, pixels

PICTURES = {".png", ".jpg"}
SOURCE_FACTS = ("folder", "lerobot", "rosbag")
"""Importers whose facts, such as the sensor, depend on the source."""


@pytest.fixture(scope="module", params=IMPORTERS)
def name(request):
    return request.param


def miniature(name):
    return import_module(f"tests.miniatures.{name.replace('-', '_')}")


@pytest.fixture(scope="module")
def source(name, tmp_path_factory):
    folder = tmp_path_factory.mktemp(name) / "src"
    miniature(name).write(folder)
    return folder


@pytest.fixture(scope="module")
def imported(name, source):
    """The recording of the data set, and the calls of its progress; no test changes it."""
    calls = []
    return load_importer(name)(source, source.with_name("out"), lambda *call: calls.append(call)), calls


def content(folder):
    """Return the digest of every file in a folder, by path."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder): sha256(path.read_bytes()).digest() for path in files}


def test_a_data_set_becomes_a_recording_with_its_facts(name, imported):
    recording, calls = imported
    assert len(recording.grasps) == miniature(name).GRASPS
    facts = data_set_of(name)
    for key in ("source", "licence", "citation", "sensor", "fingers", "background"):
        assert recording.info[key]
        assert recording.info[key] == getattr(facts, key) or name in SOURCE_FACTS
    assert set(facts.notes()) <= set(recording.notes) & set(recording.info["notes"])
    assert {len(grasp.touches) for grasp in recording.grasps} == {recording.info["fingers"]}
    for grasp in recording.grasps:
        assert all(cv2.imread(str(recording.folder / path)) is not None for path in grasp.images().values())
        assert bool(grasp.touches_before) == (recording.info["background"] != "none")
    assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
    assert calls[-1][0] == calls[-1][1] >= miniature(name).GRASPS
    grasps = load_grasps(recording.folder)
    for path in (recording.folder / SPLITS_FOLDER).glob("*.json"):
        split = Split.from_dict(parse_object(path.read_bytes(), RecordingError))
        assert not [finding for finding in check_split(grasps, split) if finding.severity == "error"]
        objects = {object_id for part in (split.train, split.validation, split.test) for object_id in part}
        assert objects <= {grasp.object_id for grasp in recording.grasps}


def test_a_second_import_by_the_command_reads_no_grasp_again_and_changes_no_byte(
    name, source, imported, monkeypatch, capsys
):
    recording, _ = imported
    before = content(recording.folder)
    monkeypatch.setattr(RecordingWriter, "append", None)
    assert main(["import", name, str(source), "--out", str(recording.folder)]) == 0
    assert f"{miniature(name).GRASPS} grasps of" in capsys.readouterr().err
    assert content(recording.folder) == before
    assert main(["import"]) == 0
    assert [title_of(name)] == [
        line.removeprefix(name).strip() for line in capsys.readouterr().out.splitlines() if line.split()[0] == name
    ]


def test_a_stopped_import_resumes_and_ends_with_the_same_bytes(name, source, imported, tmp_path):
    def stop(done, total):
        if done == total // 2 + 1:
            raise KeyboardInterrupt

    importer = load_importer(name)
    with pytest.raises(KeyboardInterrupt):
        importer(source, tmp_path / "out", stop)
    assert 0 < len(read_recording(tmp_path / "out").grasps) < miniature(name).GRASPS
    importer(source, tmp_path / "out")
    assert content(tmp_path / "out") == content(imported[0].folder)


def test_an_import_of_changed_files_into_the_same_recording_is_refused(name, source, imported, tmp_path):
    out = shutil.copytree(imported[0].folder, tmp_path / "out")
    sources = json.loads((out / SOURCES_FILE).read_text())
    assert sources["options"].keys() == {"licence", "fingers", *options_of(load_importer(name))}
    changed = list(sources["files"])[-1]
    sources["files"][changed] = [0, 0, "another digest"]
    (out / SOURCES_FILE).write_text(json.dumps(sources))
    with pytest.raises(RecordingError, match=rf"the file {re.escape(changed)}, which has changed"):
        load_importer(name)(source, out)


@pytest.mark.parametrize("exists", [False, True])
def test_a_folder_that_is_not_the_data_set_is_refused_and_nothing_is_written(name, exists, tmp_path):
    if exists:
        picture(tmp_path / "src/holiday/beach.jpg", 1)
        (tmp_path / "src/notes.txt").write_text("nothing of the kind")
    with pytest.raises(ImporterError) as caught:
        load_importer(name)(tmp_path / "src", tmp_path / "out")
    assert str(tmp_path / "src") in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_broken_files_cost_their_own_grasps_and_no_traceback(name, tmp_path):
    """Damage the first and the last file of each kind in turn."""
    source = tmp_path / "src"
    miniature(name).write(source)
    by_kind = {}
    for path in sorted(path for path in source.rglob("*") if path.is_file()):
        by_kind.setdefault((path.suffix, len(path.relative_to(source).parts)), []).append(path)
    harmed = [(files[0], harm) for files in by_kind.values() for harm in ("truncated", "folder")]
    harmed += [(files[-1], harm) for files in by_kind.values() for harm in ("garbage", "empty")]
    for number, (path, harm) in enumerate(harmed):
        whole, out = path.read_bytes(), tmp_path / f"out-{number}"
        if harm == "folder":
            path.unlink()
            path.mkdir()
        else:
            path.write_bytes({"empty": b"", "garbage": b"\x00garbage" * 9, "truncated": whole[: len(whole) // 2]}[harm])
        try:
            recording = load_importer(name)(source, out)
        except RobotError:
            pass
        else:
            lost = miniature(name).GRASPS - len(recording.grasps)
            assert lost >= 0
            if lost and path.suffix in PICTURES and harm != "folder":
                assert any(note.startswith("skipped") for note in recording.notes)
            for grasp in recording.grasps:
                assert all(cv2.imread(str(out / image)) is not None for image in grasp.images().values())
        if harm == "folder":
            path.rmdir()
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("real", "grasps", "objects", "sequences", "skipped"),
    [
        ("billets", 9 * 16, 9 * 16, 9, 0),
        pytest.param("estimate-modulus", 45 * 5, 11, 45, 0, marks=pytest.mark.slow),
        pytest.param("physiclear", 241 * 5, 44, 241, 0, marks=pytest.mark.slow),
        pytest.param("vt60", 4991, 40, 36, 4, marks=pytest.mark.slow),
    ],
)
def test_the_real_data_are_imported_completely(real, grasps, objects, sequences, skipped, tmp_path):
    recording = load_importer(real)(touch_data(real), tmp_path / "out")
    ids = [{getattr(grasp, key) for grasp in recording.grasps} for key in ("grasp_id", "object_id", "sequence_id")]
    assert list(map(len, ids)) == [grasps, objects, sequences]
    assert sum(recording.info["skipped"].values()) == skipped


def test_the_page_of_data_sets_is_generated_from_the_importers():
    assert text_of(DATA_SETS) == data_sets(), "run `python -m benchmarks.reference`"


EXTRAS = {"feeling-of-success": "h5py", "lerobot": "pyarrow", "physiclear": "av"}


@pytest.mark.parametrize(("name", "package"), [*EXTRAS.items(), ("rosbag", "rosbags")])
def test_an_error_names_the_extra_of_a_missing_package(name, package, tmp_path, monkeypatch):
    miniature(name).write(tmp_path / "src")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImporterError, match=rf"needs {package}, .*pip install 'touch-retrieval\[importers\]'"):
        load_importer(name)(tmp_path / "src", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unknown_name_lists_the_known_ones_and_an_import_without_folders_prints_the_usage(capsys):
    with pytest.raises(UnknownName, match=r"one of billets, .*; got 'bilets'"):
        load_importer("bilets")
    assert main(["import", "bilets", "src", "--out", "out"]) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert all(name in message for name in IMPORTERS)
    assert main(["import", "billets"]) == 2
    assert "retrieve import billets SRC --out recording/" in capsys.readouterr().err


def with_options(
    src, out, progress=None, *, sensor: str = "mine", every: int = 1, ratio: float = 0.5, all: bool = True
):
    """An importer."""


def test_options_are_parsed_by_the_type_that_the_importer_declares_and_others_are_refused():
    assert options_of(with_options)["every"] == (int, 1)
    words = ["sensor=GelSight = Mini", "every=3", "ratio=0.25", "all=false"]
    assert read_options(with_options, words) == {"sensor": "GelSight = Mini", "every": 3, "ratio": 0.25, "all": False}
    for word in ("every=many", "every=", "nonsense=1", "every", ""):
        with pytest.raises(ImporterError, match="every"):
            read_options(with_options, [word])


FACTS = DataSet("here", "none", "nobody", "gel", "by hand", "nothing", caveats=("beware",), unverified=("its size",))


def item(number, **changes):
    images = {"photo": encoded(".jpg", number), "touch_a": encoded(".png", 100 + number)}
    return Item(f"g{number}", f"object{number % 2}", images | changes, {"sequence_id": "s"})


def run(items, out, **more):
    items = list(items)
    return import_items(FACTS, iter(items), out, total=len(items), **more)


def test_skips_are_counted_by_reason_with_the_first_names(tmp_path):
    items = [item(0), *(Skip("it is dark", f"n{n}") for n in range(5)), item(1, touch_a=tmp_path / "gone.png")]
    recording = run([*items, item(0, photo=encoded(".jpg", 50))], tmp_path / "out")
    assert len(recording.grasps) == 1
    assert recording.notes == (
        "skipped 5: it is dark, such as n0",
        "skipped 1: its touch a is missing, such as g1",
        "skipped 1: another grasp has the same name, such as g0",
        "beware",
        "not verified on the data itself: its size",
    )
    assert read_recording(tmp_path / "out").info["skipped"]["it is dark"] == 5


def test_an_unusable_picture_costs_its_own_grasp(tmp_path):
    photos = ["a" * 5000, encoded(".jpg", 1)[:-60], encoded(".png", 1)[:-60]]  # a path too long for the disk, cut files
    items = [item(0), *(item(number, photo=photo) for number, photo in enumerate(photos, start=1))]
    skipped = {"its photo is missing": 1, "its photo is cut off or damaged": 2}
    assert run(items, tmp_path / "out").info["skipped"] == skipped


def test_a_picture_is_read_late_and_not_for_stored_grasps_and_a_shared_one_once(tmp_path):
    calls = []

    def read(number):
        calls.append(number)
        return pixels(number)

    rest = SharedImage("rest", lambda: read(4))
    items = [item(n, touch_a=lambda n=n: read(n), touch_a_before=rest) for n in range(3)]
    run(items[:2], tmp_path / "out")
    assert calls == [0, 4, 1]
    recording = run(items, tmp_path / "out")
    assert calls == [0, 4, 1, 2]
    assert {grasp.touches_before["a"] for grasp in recording.grasps} == {"images/rest_shared.png"}


def test_an_error_states_why_nothing_can_be_imported_or_names_the_file(tmp_path):
    with pytest.raises(ImporterError, match=r"no grasp could be imported: skipped 1: it is dark, such as n"):
        run([Skip("it is dark", "n")], tmp_path / "out")
    gone = (path.read_bytes() for path in [tmp_path / "gone"])
    with pytest.raises(ImporterError, match=r"gone cannot be read: No such file or directory"):
        import_items(FACTS, gone, tmp_path / "out", total=1)


def test_a_published_split_is_stored_unless_its_parts_have_objects_in_common(tmp_path):
    objects, split = {"object0": {"material": "wood"}}, {"train": ["object0"], "test": ["object1"]}
    recording = run([item(0), item(1)], tmp_path / "out", objects=objects, split=split)
    path = tmp_path / "out" / SPLITS_FOLDER / "published.json"
    assert Split.from_dict(parse_object(path.read_bytes(), RecordingError)) == Split(0, ("object0",), (), ("object1",))
    assert recording.info["objects"] == objects
    both = run([item(0), item(1)], tmp_path / "both", split={"train": ["object0", "object1"], "test": ["object1"]})
    assert not (tmp_path / "both" / SPLITS_FOLDER).exists()
    assert any("has objects in two parts" in note for note in both.notes)


def test_any_parts_become_a_valid_grasp_id():
    assert safe_name("mug", "01") == "mug-01"
    # The last two: a file name that is not UTF-8, and a surrogate that JSON can escape.
    parts = [("my mug", "1"), ("my/mug", "1"), ("..", "1"), ("é" * 300,), ("", ""), ("caf\udce9",), ("caf\ud800",)]
    strange = [safe_name(*each) for each in parts]
    assert len(set(strange)) == len(strange)
    assert all(name[0].isalnum() and len(name) <= 128 for name in strange)
