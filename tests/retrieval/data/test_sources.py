"""Remote photos are listed, read and embedded like those of a folder, even if the storage fails temporarily."""

import io
import json
import tarfile

import fsspec
import numpy as np
import pytest

from retrieval.data import sources, storage
from retrieval.data.catalogue import PhotoBytes, list_catalogue, read_photo
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.naming import Naming
from retrieval.data.sources import list_photos
from retrieval.errors import BadInput, DatasetError, RemoteStorageError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build.build_index import build_index
from retrieval.search.query.searcher import Searcher
from retrieval.search.sharding.build_sharded import build_sharded
from tests import s3

pyarrow = pytest.importorskip("pyarrow")


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch):
    monkeypatch.setattr(storage, "RETRY_WAITS_S", (0.0,) * 5)
    sources._read_group.cache_clear()


def write_parquet(path, table):
    import pyarrow.parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(table), path, row_group_size=2)


def write_tar(path, members):
    with tarfile.open(path, "w") as archive:
        for name, data in members:
            about = tarfile.TarInfo(name)
            about.size = len(data)
            archive.addfile(about, io.BytesIO(data))


def contents(catalogue):
    """Return {path: (object, metadata, bytes)} of every photo."""
    read = [read_photo(catalogue, photo) for photo in catalogue.photos]
    return {item.photo.path: (item.photo.object_id, item.photo.metadata, item.data) for item in read}


@pytest.fixture
def memory():
    """The file system of an empty object store in this process."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield system
    system.store.clear()


def put(system, folder, below="/bucket/catalog"):
    for path in folder.rglob("*"):
        if path.is_file():
            system.pipe_file(f"{below}/{path.relative_to(folder)}", path.read_bytes())


def test_a_folder_of_an_object_store_is_listed_like_a_local_folder(catalogue, memory):
    put(memory, catalogue)
    memory.pipe_file("/bucket/catalog/.hidden/1.jpg", b"")
    memory.pipe_file("/bucket/catalog/readme.txt", b"")
    name = min(path.name for path in catalogue.iterdir())
    memory.pipe_file("/bucket/catalog/metadata.jsonl", json.dumps({"object_id": name, "price": 3}).encode())
    listed = list_photos("memory://bucket/catalog")
    here = contents(list_catalogue(catalogue))
    there = contents(listed)
    assert {path: (of, data) for path, (of, _, data) in there.items()} == {
        path: (of, data) for path, (of, _, data) in here.items()
    }
    assert {metadata.get("price") for of, metadata, _ in there.values() if of == name} == {3}
    assert (listed.ignored, listed.where) == (("readme.txt",), "memory://bucket/catalog")


def test_parquet_contains_pictures_or_their_names(catalogue, tmp_path):
    photos = contents(list_catalogue(catalogue))
    own = {path: of for path, (of, _, _) in photos.items()}
    write_parquet(
        tmp_path / "a.parquet",
        {
            "path": list(photos),
            "image": [{"bytes": data, "path": path} for path, (_, _, data) in photos.items()],
            "object_id": list(own.values()),
            "price": list(range(len(own))),
            "weight": [float("nan")] * len(own),
        },
    )
    listed = contents(list_photos(str(tmp_path / "a.parquet")))
    assert {path: (of, data) for path, (of, _, data) in listed.items()} == {
        path: (of, data) for path, (of, _, data) in photos.items()
    }
    assert [metadata for _, metadata, _ in listed.values()] == [{"price": number} for number in range(len(own))]
    write_parquet(catalogue.parent / "names.parquet", {"file_name": [f"{catalogue.name}/{path}" for path in photos]})
    named = contents(list_photos(str(catalogue.parent / "names.parquet"), Naming("{root}/{object}/{photo}")))
    assert [data for _, _, data in named.values()] == [data for _, _, data in photos.values()]
    assert [of for of, _, _ in named.values()] == list(own.values())


def test_a_parquet_file_that_fails_half_way_is_listed_once(catalogue, tmp_path, monkeypatch):
    photos = contents(list_catalogue(catalogue))
    write_parquet(tmp_path / "a.parquet", {"path": list(photos), "image": [data for _, _, data in photos.values()]})
    real, refusals = sources._parquet_file, [OSError("the storage is busy")]

    class Refusing:
        def __init__(self, url):
            self.file = real(url)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self.file.close()

        def __getattr__(self, name):
            return getattr(self.file, name)

        def read_row_group(self, number, columns):
            if number == 1 and refusals:
                raise refusals.pop()
            return self.file.read_row_group(number, columns=columns)

    monkeypatch.setattr(sources, "_parquet_file", Refusing)
    listed = list_photos(str(tmp_path / "a.parquet"))
    assert not refusals
    assert listed.skipped == ()
    assert {path: data for path, (_, _, data) in contents(listed).items()} == {
        path: data for path, (_, _, data) in photos.items()
    }


def test_of_two_rows_with_one_name_the_whole_first_row_is_used(catalogue, tmp_path):
    first, second = [data for _, _, data in contents(list_catalogue(catalogue)).values()][:2]
    rows = {"path": ["mug/1.jpg"] * 2, "image": [first, second], "object_id": ["mug", "tin"]}
    write_parquet(tmp_path / "a.parquet", rows)
    listed = list_photos(str(tmp_path / "a.parquet"))
    assert contents(listed) == {"mug/1.jpg": ("mug", {}, first)}
    assert [item.reason for item in listed.skipped] == ["is listed twice"]


def test_pictures_without_a_name_are_named_by_their_row(catalogue, tmp_path):
    data = [item for _, _, item in contents(list_catalogue(catalogue)).values()][:5]
    for part, rows in (("one", data[:3]), ("two", data[3:])):
        write_parquet(tmp_path / f"{part}.parquet", {"image": rows, "object_id": ["mug"] * len(rows)})
    listed = contents(list_photos(f"{tmp_path}/*.parquet"))
    assert list(listed) == [f"one/{row:08d}" for row in range(3)] + [f"two/{row:08d}" for row in range(2)]
    assert [item for _, _, item in listed.values()] == data


def test_webdataset_archives_contain_pictures_and_their_metadata(catalogue, tmp_path):
    photos = contents(list_catalogue(catalogue))
    for number, part in enumerate(np.array_split(np.array(list(photos)), 2)):
        members = []
        for row, path in enumerate(part):
            members.append((f"{row:04d}.jpg", photos[path][2]))
            members.append((f"{row:04d}.json", json.dumps({"object_id": photos[path][0], "from": path}).encode()))
        write_tar(tmp_path / f"p-{number:03d}.tar", members)
    listed = contents(list_photos(f"{tmp_path}/p-{{000..001}}.tar"))
    assert len(listed) == len(photos)
    for path, (of, metadata, data) in listed.items():
        assert path.startswith(("p-000/", "p-001/"))
        assert (of, data) == (photos[metadata["from"]][0], photos[metadata["from"]][2])


def test_names_that_lead_out_of_an_archive_and_duplicates_are_skipped_and_named(catalogue, tmp_path):
    data = next(catalogue.rglob("*.jpg")).read_bytes()
    write_tar(
        tmp_path / "a.tar",
        [("mug/1.jpg", data), ("../up.jpg", data), ("/root/1.jpg", data), ("mug/1.jpg", data), ("tin/1.jpg", b"")],
    )
    listed = list_photos(str(tmp_path / "a.tar"))
    assert [photo.path for photo in listed.photos] == ["mug/1.jpg", "tin/1.jpg"]
    assert {item.path: item.reason for item in listed.skipped} == {
        "../up.jpg": "its path is outside the catalogue",
        "/root/1.jpg": "its path is outside the catalogue",
        "mug/1.jpg": "is listed twice",
    }


def test_parquet_files_with_pictures_in_different_columns_are_refused(tmp_path):
    """Otherwise the first file's pictures would be read from the last file's column."""
    write_parquet(tmp_path / "a.parquet", {"image": [b"1"], "object_id": ["mug"]})
    for other, column in ({"photo": [b"2"]}, "photo"), ({"path": ["mug/1.jpg"]}, "names of files"):
        write_parquet(tmp_path / "b.parquet", other)
        message = rf"in the same column of all files; .*a\.parquet has image, .*{column}"
        with pytest.raises(DatasetError, match=message):
            list_photos(f"{tmp_path}/*.parquet")


@pytest.mark.parametrize("ending", ["parquet", "tar"])
@pytest.mark.parametrize("content", [b"", b"no such format" * 100, b"PAR1" * 10])
def test_invalid_files_are_refused_in_one_sentence(ending, content, tmp_path):
    path = tmp_path / f"a.{ending}"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"is not a readable|no photo in the catalogue"):
        list_photos(str(path))


def test_a_url_without_a_file_system_is_refused():
    with pytest.raises(BadInput, match="nosuch://bucket cannot be opened"):
        list_photos("nosuch://bucket")


def test_a_url_without_a_photo_is_refused(memory):
    memory.pipe_file("/bucket/readme.txt", b"")
    with pytest.raises(
        DatasetError, match=r"no photo \(.*\) in the catalogue memory://bucket, only 1 other file\(s\) "
    ):
        list_photos("memory://bucket")


# Storage that fails ---------------------------------------------------------------------------------------------------


@pytest.fixture
def failures(monkeypatch, memory):
    """Settings of a failing storage: of each `every` readings, the first `times` fail."""
    settings, calls, plain = {"every": 20, "times": 1}, [], type(memory).cat_file

    def cat_file(self, path, start=None, end=None, **kwargs):
        calls.append(path)
        if (len(calls) - 1) % settings["every"] < settings["times"]:
            raise OSError("503 Slow Down")
        return plain(self, path, start, end, **kwargs)

    monkeypatch.setattr(type(memory), "cat_file", cat_file)
    return settings


def test_a_storage_that_fails_one_request_in_twenty_loses_nothing(catalogue, model, memory, failures, tmp_path, index):
    put(memory, catalogue)
    report = build_index("memory://bucket/catalog", load_checkpoint(model), tmp_path / "index", quiet=True)
    assert (report.photos, report.skipped) == (24, [])
    with Searcher.open(tmp_path / "index") as ours, Searcher.open(index) as theirs:
        assert list(ours.generation.rows) == list(theirs.generation.rows)
        np.testing.assert_array_equal(ours.generation.arrays["partials"], theirs.generation.arrays["partials"])


def test_a_storage_that_keeps_failing_ends_the_build_and_a_later_build_succeeds(
    catalogue, model, memory, failures, tmp_path, embedded
):
    put(memory, catalogue)
    failures.update(every=40, times=21)
    listed = list_photos("memory://bucket/catalog")
    assert len(listed.photos) == 24
    with pytest.raises(RemoteStorageError, match=r"the storage failed 6 times \(OSError: 503 Slow Down\)"):
        read_photo(listed, listed.photos[0])
    checkpoint = load_checkpoint(model)
    failures.update(every=10**9, times=0)
    build_sharded("memory://bucket/catalog", checkpoint, tmp_path / "c", 2, quiet=True)
    assert sum(embedded) == 24


def test_a_photo_that_is_missing_or_broken_is_skipped_and_named(catalogue, model, memory, tmp_path):
    put(memory, catalogue)
    listed = list_photos("memory://bucket/catalog")
    memory.rm_file(f"/bucket/catalog/{listed.photos[0].path}")
    assert read_photo(listed, listed.photos[0]) == SkippedPhoto(listed.photos[0].path, "no such file")
    assert isinstance(read_photo(listed, listed.photos[1]), PhotoBytes)
    truncated = listed.photos[1].path
    memory.pipe_file(f"/bucket/catalog/{truncated}", memory.cat_file(f"/bucket/catalog/{truncated}")[:100])
    report = build_sharded("memory://bucket/catalog", load_checkpoint(model), tmp_path / "c", 2, quiet=True)
    assert ([item.path for item in report.skipped], report.photos) == ([truncated], 22)
    assert report.embedded == 22


# A real S3 server -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_catalogue_on_s3_is_built_like_one_on_disk(s3_server, catalogue, model, index, tmp_path):
    s3.put(catalogue, "photos/catalog")
    report = build_index("s3://photos/catalog", load_checkpoint(model), tmp_path / "index", quiet=True)
    assert (report.photos, report.skipped) == (24, [])
    with Searcher.open(tmp_path / "index") as ours, Searcher.open(index) as theirs:
        assert list(ours.generation.rows) == list(theirs.generation.rows)
        assert ours.info.about["catalogue"] == "s3://photos/catalog"
    for path in catalogue.rglob("1.jpg"):
        fsspec.filesystem("s3").rm_file(f"photos/catalog/{path.relative_to(catalogue)}")
    fsspec.filesystem("s3").invalidate_cache()
    again = build_index("s3://photos/catalog", load_checkpoint(model), tmp_path / "index", quiet=True)
    assert (again.photos, again.embedded, again.removed) == (16, 0, 8)
