"""Names are looked up in any Unicode form; objects that differ only so, by case or space, or share photos are named."""

import json
import shutil
import unicodedata

from retrieval.data.catalogue import list_catalogue
from retrieval.data.naming import same_name_warnings
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.searcher import Searcher
from retrieval.search.shard import resolve_object
from tests.as_they_come import write_pictures

NFC, NFD = "Caf\u00e9 cup", unicodedata.normalize("NFD", "Caf\u00e9 cup")


def check(folder, get):
    catalogue = shutil.copytree(get("catalogue"), folder / "catalog")
    names = sorted(path.name for path in catalogue.iterdir())
    (catalogue / names[0]).rename(catalogue / NFD)  # as macOS writes it
    for name in names[1:3]:
        shutil.copy(next((catalogue / names[3]).iterdir()), catalogue / name / "no-image-yet.jpg")
    line = {"object_id": f" {NFC} ", "shelf": "B4"}  # as a person types it
    (catalogue / "metadata.jsonl").write_text(json.dumps(line, ensure_ascii=False), "utf-8")
    report = build_index(catalogue, load_checkpoint(get("model")), folder / "index")
    assert report.notes == []
    (warning,) = report.warnings
    assert "one picture is the photo of 3 objects" in warning
    assert all(name in warning for name in names[1:4])
    with Searcher.open(folder / "index") as searcher:
        for name in (NFC, NFD, f" {NFC}"):
            (photo,) = searcher.shard.page([], resolve_object(searcher.shard, name), 0, 1).photos
            assert photo.metadata == {"shelf": "B4"}

    (catalogue / names[4]).rename(catalogue / NFC)
    build_sharded(catalogue, load_checkpoint(get("model")), folder / "shards", 3)
    with Searcher.open(folder / "shards") as searcher:
        for name, meant in ((NFC, NFC), (NFD, NFD), (f" {NFC}", f" {NFC}"), (f"{names[5]} ", names[5])):
            assert resolve_object(searcher.shard, name) == meant  # with a space two objects could be meant

    same = {"Mug": 1, "mug": 1, "blue  cup": 1, "blue cup": 1, NFC: 1, NFD: 1, "tin": 1}
    (warning,) = same_name_warnings(same)
    assert "the names of 6 objects differ only by case, spaces" in warning
    assert list_catalogue(write_pictures(folder / "other", "tin/1.jpg")).notes == ()
