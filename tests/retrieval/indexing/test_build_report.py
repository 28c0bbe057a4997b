"""The report of `build-index`: object names, warnings and skipped files."""

import dataclasses
import json
import shutil
from functools import partial

import numpy as np
import pytest
from PIL import Image, ImageFilter

from indexes.store.folder import IndexStore
from retrieval.commands.main import main
from retrieval.data.camera import PhotoCamera
from retrieval.data.catalogue import list_catalogue
from retrieval.data.dataset import load_grasps, recording_camera
from retrieval.errors import DatasetError
from retrieval.indexing.build import ASSUMED_CAMERA, build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.training.distil import feature_partials
from retrieval.training.features import encode_recording
from robot.recording.folder import RecordingWriter
from tests.retrieval.data.simulated import rolled, square


@pytest.fixture
def index(tmp_path):
    return tmp_path / "index"


@pytest.fixture
def zooms(checkpoint):
    """A model that sees the zoom of a photo."""
    settings = dataclasses.replace(checkpoint.config.preprocessing, views=("zoom",))
    return dataclasses.replace(checkpoint, config=dataclasses.replace(checkpoint.config, preprocessing=settings))


@pytest.fixture
def photos(catalogue):
    """Files of eight photos, each of another object."""
    return sorted(catalogue.glob("*/1.jpg"))


def catalogue_of(folder, photos, *names):
    """A catalogue with the photos under these names."""
    for photo, name in zip(photos, names, strict=False):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(photo, folder / name)
    return folder


def objects(index):
    return {row.path: row.object_id for row in IndexStore(index).open().rows}


@pytest.mark.parametrize(
    ("names", "warning", "rule", "corrected"),
    [
        (
            ["train/mug/0.jpg", "train/mug/1.jpg", "train/cup/0.jpg", "test/cup/1.jpg"],
            "test, train are used as the name of an object",  # every photo below train/ becomes the object "train"
            "{split}/{object}/{photo}",
            {"mug", "cup"},
        ),
        (["mug_0.jpg", "mug_1.jpg", "cup-1.jpg", "cup-2.jpg"], "the names of 4 of 4", "stem", {"mug", "cup"}),
    ],
)
def test_suspicious_names_give_a_warning_and_a_rule_corrects_them(
    tmp_path, photos, checkpoint, index, names, warning, rule, corrected
):
    own = catalogue_of(tmp_path / "own", photos, *names)
    report = build_index(own, checkpoint, index)
    assert any(line.startswith(f"warning: {warning}") for line in report.lines())
    report = build_index(own, checkpoint, index, objects_from=rule)
    assert set(objects(index).values()) == corrected
    assert (report.written, report.embedded, report.warnings) == (True, 0, [])


def test_the_index_stores_the_rule_and_reports_a_change(tmp_path, photos, checkpoint, index):
    own = catalogue_of(tmp_path / "own", photos, "mug_0.jpg", "mug_1.jpg", "cup_0.jpg")
    build_index(own, checkpoint, index, objects_from="stem")
    again = build_index(own, checkpoint, index)
    assert (again.objects_from, again.objects, again.written) == ("stem", 2, False)
    changed = build_index(own, checkpoint, index, objects_from="folder")
    assert (changed.objects, changed.written, changed.embedded) == (3, True, 0)
    assert changed.reason.startswith("The rule for object names changed from stem to folder.")
    assert IndexStore(index).open().manifest.about["objects_from"] == "folder"
    alike = build_index(own, checkpoint, index, objects_from="{object}.jpg")
    assert (alike.objects, alike.written) == (3, True)


def test_objects_without_a_readable_photo_are_listed_and_give_exit_code_1(tmp_path, photos, model, index, capsys):
    own = catalogue_of(tmp_path / "own", photos, "mug/0.jpg", "cup/0.jpg", "cup/1.jpg", "ball/0.jpg")
    command = ["build-index", str(own), "--model", str(model), "--out", str(index)]
    (own / "cup" / "0.jpg").write_bytes(b"broken")
    assert main(command) == 0  # the cup has another photo
    (own / "cup" / "1.jpg").write_bytes(b"broken")
    (own / "ball" / "0.jpg").write_bytes(b"broken")
    capsys.readouterr()
    assert main([*command, "--json"]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["without_photo"] == ["ball", "cup"]
    assert "2 of 3 objects are not in the index, because none of their images can be read: ball, cup" in printed.err
    assert "the index is written, but 2 object(s) have no readable photo" in printed.err
    assert objects(index) == {"mug/0.jpg": "mug"}


def test_new_photos_in_which_objects_are_hard_to_recognise_give_a_warning(tmp_path, checkpoint, index):
    own, rng = tmp_path / "own", np.random.default_rng(0)
    crops = dataclasses.replace(checkpoint.config.preprocessing, views=("crop",))
    checkpoint = dataclasses.replace(checkpoint, config=dataclasses.replace(checkpoint.config, preprocessing=crops))
    for name in ("mug", "cup"):
        photo = np.full((256, 256, 3), 60, np.uint8)
        photo[60:200, 100:180] = rng.integers(120, 220, (140, 80, 1))
        own.mkdir(exist_ok=True)
        Image.fromarray(photo).filter(ImageFilter.GaussianBlur(3 * (name == "mug"))).save(own / f"{name}.png")
    report = build_index(own, checkpoint, index)
    assert ["1 of 2" in line and "1 blurred; for example mug.png" in line for line in report.warnings] == [True]
    assert build_index(own, checkpoint, index).warnings == []  # no photo is new


def test_a_stated_field_changes_the_zoom_and_embeds_the_photo_again(tmp_path, zooms, index):
    own, photo = tmp_path / "own", np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
    own.mkdir()
    for name in ("mug", "cup"):
        Image.fromarray(photo if name == "mug" else photo[::-1]).save(own / f"{name}.png")
    assert build_index(own, zooms, index).embedded == 2
    before = IndexStore(index).open().arrays["partials"][:]
    (own / "metadata.jsonl").write_text('{"file_name": "mug.png", "field_mm": 400}')
    report = build_index(own, zooms, index)
    assert (report.written, report.embedded) == (True, 1)
    after = IndexStore(index).open().arrays["partials"][:]
    assert (before == after).all(axis=1).tolist() == [True, False]  # cup, mug


@pytest.mark.parametrize(
    ("photo", "warning", "stated"),
    [
        (
            partial(square, share=0.16),
            "2.0 times smaller than usual, so photos are assumed to show 380 mm",
            '{"field_mm": 190}',
        ),
        (
            partial(rolled, roll_deg=90),
            "turned by 90 degrees anticlockwise, and are turned back (roll_deg 90)",
            '{"roll_deg": 0}',
        ),
    ],
)
def test_the_camera_that_all_photos_share_is_assumed_until_it_is_stated(tmp_path, zooms, index, photo, warning, stated):
    own = tmp_path / "own"
    own.mkdir()
    for number in range(20):
        Image.fromarray(photo(number)).save(own / f"{number}.png")
    assert any(warning in line for line in build_index(own, zooms, index).warnings)
    (own / "metadata.jsonl").write_text('{"field_mm": null, "roll_deg": null}')  # states nothing
    assert any(warning in line for line in build_index(own, zooms, index).warnings)
    (own / "metadata.jsonl").write_text(stated)
    report = build_index(own, zooms, index)
    assert (report.embedded, [line for line in report.warnings if warning in line]) == (20, [])
    (own / "metadata.jsonl").unlink()
    for _ in range(2):
        report = build_index(own, zooms, index)
        assert (report.embedded, any(warning in line for line in report.warnings)) == (0, True)  # codes are stored
        (own / "0.png").unlink(missing_ok=True)  # too few objects are left to tell: it stays


def test_all_shards_assume_the_camera_that_the_whole_catalogue_shows(tmp_path, zooms):
    own = tmp_path / "own"
    own.mkdir()
    for number in range(20):
        Image.fromarray(square(number, 0.16)).save(own / f"{number}.png")
    report = build_sharded(own, zooms, tmp_path / "shards", 3)
    assert ["are assumed to show 380 mm" in line for line in report.warnings].count(True) == 1
    assumed = {
        tuple(IndexStore(tmp_path / "shards" / each["folder"]).open().manifest.about[ASSUMED_CAMERA])
        for each in report.shards
    }
    assert assumed == {(380, 0)}


def test_training_sees_the_photos_of_a_recording_as_an_index_of_them_does(tmp_path, zooms, index):
    with RecordingWriter(tmp_path / "lab", {"source": "lab", "sensor": "gel"}) as writer:
        for number in range(20):
            picture = square(number, 0.16)
            writer.append(f"{number:02}", f"{number:02}", {"photo": picture, "touch_a": picture, "touch_b": picture})
    grasps = load_grasps(tmp_path / "lab")
    catalogue = catalogue_of(
        tmp_path / "own", [each.photo for each in grasps], *(f"{each.object_id}.png" for each in grasps)
    )
    assert any("are assumed to show 380 mm" in line for line in build_index(catalogue, zooms, index).warnings)
    camera = recording_camera(tmp_path / "lab", grasps, zooms.config.preprocessing)
    _, photos = feature_partials(
        zooms.matcher, encode_recording(grasps, zooms.matcher, zooms.config, None, camera=camera)
    )
    np.testing.assert_allclose(IndexStore(index).open().arrays["partials"][:], photos, atol=0.01)


@pytest.mark.parametrize(("stated", "camera"), [({}, (380, 0)), ({"field_mm": 300, "roll_deg": 90}, (300, 90))])
def test_recording_json_states_the_camera_of_all_photos(recording, tmp_path, zooms, monkeypatch, stated, camera):
    own = shutil.copytree(recording, tmp_path / "own")
    info = json.loads((own / "recording.json").read_text())
    monkeypatch.setattr("retrieval.data.dataset.assumed_camera", lambda *_: PhotoCamera(380, 0))
    (own / "recording.json").write_text(json.dumps(info | stated))
    assert recording_camera(own, load_grasps(own), zooms.config.preprocessing) == camera
    assert all(photo.metadata == stated for photo in list_catalogue(own).photos)
    (own / "recording.json").write_text(json.dumps(info | {"field_mm": "wide"}))
    with pytest.raises(DatasetError, match=r"recording\.json: field_mm must be"):
        recording_camera(own, load_grasps(own), zooms.config.preprocessing)
