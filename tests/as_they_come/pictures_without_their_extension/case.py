"""The content decides what a picture is, and a folder with files but no picture is named."""

from retrieval.data.catalogue import list_catalogue
from tests.as_they_come import write_pictures


def check(folder, get):
    names = ["shoe.jpg?v=123", "mug/photo", "cup/1.jfif", "tin/1.jpe", "box/1.JPG_large", "pen/1.gif", "hat/1.tmp"]
    write_pictures(folder, *names, kind="JPEG")
    write_pictures(folder, "fox/1.img", kind="BMP")
    write_pictures(folder, "owl/1.picture", kind="WEBP")
    write_pictures(folder, "raw/1.nef", kind="TIFF")  # like a camera's raw photo
    (folder / "empty").mkdir()
    (folder / "empty" / "photo.psd").write_bytes(b"8BPS\0\1")
    (folder / "empty" / "BMW.txt").write_text("BM is how this text begins, too")
    catalogue = list_catalogue(folder)
    assert catalogue.object_ids == ("box", "cup", "fox", "hat", "mug", "owl", "pen", "shoe", "tin")
    assert [item.path for item in catalogue.skipped] == ["raw/1.nef"]
    (note,) = catalogue.notes
    assert "no picture in 2 folder(s)" in note
    assert "empty" in note
