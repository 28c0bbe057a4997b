"""What Windows, macOS and network drives leave behind is no object, for every reader, and is reported."""

from retrieval.data.catalogue import list_catalogue
from robot.importers.folder import import_folder
from robot.recording.folder import read_recording
from tests.as_they_come import write_pictures

SYSTEM = ["@eaDir", "#recycle", "$RECYCLE.BIN", "System Volume Information", "__MACOSX", "lost+found", ".Trashes"]


def check(folder, get):
    thumbnails = [f"{name}/photo_{number}.jpg" for name in SYSTEM for number in (0, 1)]
    touches = [f"{name}/touch_0.png" for name in SYSTEM]
    write_pictures(folder, "mug/photo_0.jpg", "mug/touch_0.png", "mug/@eaDir/photo_0.jpg", *thumbnails, *touches)
    (folder / "Thumbs.db").write_bytes(b"\xff\xd8\xff\xe0 a thumbnail")
    catalogue = list_catalogue(folder)
    assert catalogue.object_ids == ("mug",)
    assert [photo.path for photo in catalogue.photos] == ["mug/photo_0.jpg"]
    assert any("@eaDir" in note or "#recycle" in note for note in catalogue.notes)
    out = get("tmp_path") / "recording"
    import_folder(folder, out)
    assert {grasp.object_id for grasp in read_recording(out).grasps} == {"mug"}
