"""Views of a product, an extension in capitals and a table of titles are recognised, or the user is told what to do."""

from retrieval.data.catalogue import list_catalogue
from retrieval.data.naming import Naming, naming_warnings
from tests.as_they_come import write_pictures


def check(folder, get):
    names = [f"SKU-{sku}_{view}.JPG" for sku in (123, 124, 125) for view in ("front", "back (1)", "side")]
    write_pictures(folder, *names)  # products.csv lies next to them
    flat = list_catalogue(folder)
    (note,) = flat.notes
    assert "products.csv: not read" in note
    assert "metadata.jsonl" in note
    (warning,) = naming_warnings([(photo.object_id, photo.path) for photo in flat.photos], Naming())
    assert "the names of 9 objects differ from another name only by back, front, side" in warning
    assert "--objects-from '{object}_{view}'" in warning
    for rule in ("{object}_{view}", "{object}_{view}.jpg", "{object}_{view}.JPG"):
        catalogue = list_catalogue(folder, Naming(rule))
        assert catalogue.object_ids == ("SKU-123", "SKU-124", "SKU-125")
        photos = [(photo.object_id, photo.path) for photo in catalogue.photos]
        assert naming_warnings(photos, Naming(rule)) == []  # a rule is given already
