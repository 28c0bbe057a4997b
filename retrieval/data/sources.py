"""Catalogues in an object store, behind HTTP, in Parquet files or in WebDataset archives, opened by `fsspec`.

    s3://bucket/catalog                 a folder, laid out as in `retrieval.data.catalogue`, with its metadata.jsonl
    s3://bucket/photos/*.parquet        one row per photo: `path` (or `file_name`), or `image` with its bytes (plain, or
                                        as {bytes, path}); `object_id`, else the naming rule applies to the path; other
                                        columns are the user's own metadata
    s3://bucket/photos-{000..015}.tar   members `key.jpg`, and `key.json` with metadata and perhaps `object_id`

Listing reads names, and all Parquet columns but the pictures. The pictures are read one by one when they are embedded.
Failed requests are retried. If the storage keeps failing, the job ends and can be continued later: a photo is left out
only because of its content, never because of the network.
"""

import math
import re
import tarfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

from _touch_retrieval.files import parse_json
from indexes.store.stat_cache import FolderCache
from retrieval.data.catalogue import (
    METADATA_FILE,
    Catalogue,
    CataloguePhoto,
    PhotoTable,
    list_catalogue,
    make_catalogue,
)
from retrieval.data.folder_walk import SkippedPhoto, skipped_non_utf8
from retrieval.data.images import MAX_BYTES
from retrieval.data.naming import Naming
from retrieval.data.storage import PERMANENT_ERRORS, file_system, is_inside, is_url, retry
from retrieval.data.text import is_utf8, require_utf8
from retrieval.errors import BadInput, DatasetError, ImageError

_PATHS, _PICTURES = ("path", "file_name"), ("image", "photo", "bytes")
_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
_MAX_CACHED_GROUPS = 4
"""Row groups of pictures in memory at once."""


class Source(Protocol):
    """Location of photos, which can be sent to another process."""

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file; errors of `fsspec` are raised unchanged."""


@dataclass(frozen=True)
class RemoteCatalogue(Catalogue):
    """A catalogue outside this machine's folders.

    Attributes:
        source: Location of the photos.
        url: URL of the catalogue.
    """

    source: Source | None = None
    url: str = ""

    @property
    def where(self) -> str:
        """The URL of the catalogue, which indexes store."""
        return self.url

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file.

        Raises:
            ImageError: The file is missing, unreadable or too large.
            RemoteStorageError: The storage does not respond.
        """
        assert self.source is not None
        try:
            data = retry(f"{self.url}: {path}", lambda: self.source.read(path))  # type: ignore[union-attr]
        except FileNotFoundError:
            raise ImageError(path, "no such file") from None
        except (PermissionError, IsADirectoryError, ValueError) as error:
            raise ImageError(path, f"cannot be read: {error}") from error
        if len(data) > MAX_BYTES:
            raise ImageError(path, f"cannot be read: has {len(data)} bytes; at most {MAX_BYTES} are read")
        return data


def is_url_or_archive(where: str | Path) -> bool:
    """Return whether `where` is a URL, a Parquet file or a tar file, not a folder."""
    return is_url(where) or str(where).endswith((".parquet", ".tar"))


def list_photos(where: str | Path, naming: Naming | None = None, folder_cache: FolderCache | None = None) -> Catalogue:
    """List the photos of a folder, a URL, Parquet files or tar files.

    Args:
        where: A folder or URL, as described at the top of this module.
        naming: Rule that names the object of each photo; None for the rule "folder".
        folder_cache: As for `list_catalogue`; for folders on this machine only.

    Raises:
        DatasetError: As for `list_catalogue`.
    """
    if not is_url_or_archive(where):
        return list_catalogue(Path(where), naming, folder_cache)
    url, naming = str(where), naming or Naming()
    if url.endswith(".parquet"):
        return _list_parquet_files(url, naming)
    return _list_archives(url, naming) if url.endswith(".tar") else _list_folder(url, naming)


# A folder --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FolderSource:
    """Files below a URL."""

    url: str

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file, as `Source.read`."""
        system, root = file_system(self.url)
        data: bytes = system.cat_file(f"{root.rstrip('/')}/{path}" if "://" not in path else path)
        return data


def _list_folder(url: str, naming: Naming) -> Catalogue:
    system, root = file_system(url)
    below = root.rstrip("/") + "/"
    try:
        names = retry(url, lambda: sorted(system.find(root)))
    except PERMANENT_ERRORS as error:
        raise DatasetError(f"the catalogue {url} cannot be listed: {error}") from error
    files, skipped = [], list[SkippedPhoto]()
    for name in (name.removeprefix(below) for name in names if name.startswith(below)):
        if any(part.startswith(".") for part in PurePosixPath(name).parts):
            continue
        if is_utf8(name):
            files.append(name)
        else:
            skipped.append(skipped_non_utf8(name))
    source = FolderSource(url)
    lines = retry(url, lambda: source.read(METADATA_FILE)) if METADATA_FILE in files else b""
    listed = make_catalogue(Path(), url, files, skipped, naming, lines)
    return RemoteCatalogue(**{one.name: getattr(listed, one.name) for one in fields(listed)}, source=source, url=url)


def _make_remote_catalogue(
    url: str, photos: Sequence[tuple[CataloguePhoto, str | None]], naming: Naming, source: Source
) -> RemoteCatalogue:
    """Return the catalogue of photos, each with an object id or None; the naming rule applies if it is None."""
    found, skipped, paths_seen = list[CataloguePhoto](), list[SkippedPhoto](), set[str]()
    for photo, object_id in photos:
        name = object_id or naming.object_of(photo.path)
        if not is_utf8(photo.path):
            skipped.append(skipped_non_utf8(photo.path))
        elif photo.path in paths_seen:
            skipped.append(SkippedPhoto(photo.path, "is listed twice"))
        elif not is_inside(photo.path):
            skipped.append(SkippedPhoto(photo.path, "its path is outside the catalogue"))
        elif not name:
            skipped.append(SkippedPhoto(photo.path, f"does not fit --objects-from {naming.text}"))
        else:
            found.append(replace(photo, object_id=name))
        paths_seen.add(photo.path)
    if not found:
        why = f"; {skipped[0].path}: {skipped[0].reason}" if skipped else ""
        raise DatasetError(f"no photo in the catalogue {url}{why}")
    listed = PhotoTable.of(sorted(found, key=lambda photo: photo.path))
    return RemoteCatalogue(Path(), listed, skipped=tuple(skipped), source=source, url=url)


# Parquet ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ParquetSource:
    """Pictures in a column of Parquet files.

    Attributes:
        column: Name of the column.
        places: (file, row group, row in the group) of each photo, by path.
    """

    column: str
    places: Mapping[str, tuple[str, int, int]]

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file, as `Source.read`."""
        file, group, row = self.places[path]
        data = _row_group(file, group, self.column)[row]
        if not isinstance(data, bytes):
            raise ValueError("the row contains no picture")
        return data


_row_group_lock = threading.Lock()


def _row_group(file: str, group: int, column: str) -> list[Any]:
    with _row_group_lock:  # without the lock each thread would read the group
        return _read_group(file, group, column)


@lru_cache(maxsize=_MAX_CACHED_GROUPS)
def _read_group(file: str, group: int, column: str) -> list[Any]:
    with _parquet_file(file) as table:
        values = table.read_row_group(group, columns=[column]).column(0).to_pylist()
    return [value.get("bytes") if isinstance(value, dict) else value for value in values]


def _parquet_file(url: str) -> Any:
    try:
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise BadInput(f"{url}: pyarrow is missing; run: pip install 'touch-retrieval[cluster]'") from error
    system, path = file_system(url)
    return ParquetFile(system.open(path, "rb"))


def _expand_pattern(url: str) -> list[str]:
    """Return the URLs of the files that match a pattern."""
    span = _RANGE.search(url)
    if span:
        low, high = span.groups()
        numbers = (f"{number:0{len(low)}d}" for number in range(int(low), int(high) + 1))
        return [one for number in numbers for one in _expand_pattern(url[: span.start()] + number + url[span.end() :])]
    system, path = file_system(url)
    try:
        found = retry(url, lambda: sorted(system.glob(path)) if "*" in path else [path])
    except PERMANENT_ERRORS as error:
        raise DatasetError(f"{url} cannot be listed: {error}") from error
    if not found:
        raise DatasetError(f"no file matches {url}")
    return [system.unstrip_protocol(one) for one in found]


def _list_parquet_files(url: str, naming: Naming) -> Catalogue:
    photos, places = list[tuple[CataloguePhoto, str | None]](), dict[str, tuple[str, int, int]]()
    files = _expand_pattern(url)
    column = None
    for file in files:
        try:
            own, listed = retry(file, lambda file=file: _list_parquet(file))  # type: ignore[misc]
        except PERMANENT_ERRORS as error:
            raise DatasetError(f"{file} is not a readable Parquet file: {error}") from error
        if column not in (None, own):
            columns = [f"{name} has {each or 'names of files'}" for name, each in ((files[0], column), (file, own))]
            raise DatasetError(f"{url}: pictures must be in the same column of all files; {', '.join(columns)}")
        column = own
        for photo, object_id, place in listed:
            photos.append((photo, object_id))
            places.setdefault(photo.path, place)  # the first of two photos with one name
    source: Source = ParquetSource(column, places) if column else FolderSource(url.rpartition("/")[0] or ".")
    return _make_remote_catalogue(url, photos, naming, source)


_Row = tuple[CataloguePhoto, str | None, tuple[str, int, int]]


def _list_parquet(file: str) -> tuple[str, list[_Row]]:
    """Return the column with pictures ("" if rows name files), and the rows.

    Each row is (photo, object id or None, place), with the place as in `ParquetSource`.
    """
    found = list[_Row]()
    with _parquet_file(file) as table:
        names = list(table.schema_arrow.names)
        picture = next((name for name in _PICTURES if name in names), "")
        path = next((name for name in _PATHS if name in names), "")
        if not picture and not path:
            raise ValueError(f"it needs one column of {', '.join((*_PATHS, *_PICTURES))}; it has {', '.join(names)}")
        others, stem = [name for name in names if name != picture], PurePosixPath(file).stem
        count = 0
        for group in range(table.num_row_groups):
            rows = table.metadata.row_group(group).num_rows
            columns = table.read_row_group(group, columns=others).to_pylist() if others else [{}] * rows
            for place, row in enumerate(columns):
                own = row.pop(path, None) if path else None
                name = str(own) if own else f"{stem}/{count + place:08d}"
                object_id = row.pop("object_id", None)
                metadata = {key: value for key, value in row.items() if _is_plain(value)}
                owner = None if object_id is None else str(object_id)
                found.append((CataloguePhoto(name, "", metadata), owner, (file, group, place)))
            count += rows
    return picture, found


def _is_plain(value: object) -> bool:
    return isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


# WebDataset ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArchiveSource:
    """Members of tar files.

    Attributes:
        places: (archive, start, end) of each photo in bytes, by path.
    """

    places: Mapping[str, tuple[str, int, int]]

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file, as `Source.read`."""
        url, start, end = self.places[path]
        system, name = file_system(url)
        data: bytes = system.cat_file(name, start=start, end=end)
        if len(data) != end - start:
            raise OSError("the archive is truncated")
        return data


def _list_archives(url: str, naming: Naming) -> Catalogue:
    photos, places = list[tuple[CataloguePhoto, str | None]](), dict[str, tuple[str, int, int]]()
    for file in _expand_pattern(url):
        try:
            members = retry(file, lambda file=file: list(_members(file)))  # type: ignore[misc]
        except PERMANENT_ERRORS as error:
            raise DatasetError(f"{file} is not a readable tar file: {error}") from error
        stem, metadata = PurePosixPath(file).stem, dict[str, dict[str, Any]]()
        for name, data, _, _ in members:
            if data is not None:
                metadata[_sample_key(name)] = _metadata(f"{file}, {name}", data)
        for name, data, start, end in members:
            if data is None:
                own = dict(metadata.get(_sample_key(name), {}))
                object_id = own.pop("object_id", None)
                path = f"{stem}/{name}" if "/" not in name else name
                photos.append((CataloguePhoto(path, "", own), None if object_id is None else str(object_id)))
                places.setdefault(path, (file, start, end))
    return _make_remote_catalogue(url, photos, naming, ArchiveSource(places))


def _members(url: str) -> Iterator[tuple[str, bytes | None, int, int]]:
    """Yield (name, document or None for a picture, start, end) of each picture and JSON member."""
    from retrieval.data.images import EXTENSIONS

    system, path = file_system(url)
    with system.open(path, "rb") as handle, tarfile.open(fileobj=handle, mode="r:") as archive:
        for member in archive:
            ending = PurePosixPath(member.name).suffix.lower()
            if not member.isfile() or member.size > MAX_BYTES:
                continue
            name = member.name.removeprefix("./")
            if ending in EXTENSIONS:
                yield name, None, member.offset_data, member.offset_data + member.size
            elif ending == ".json":
                opened = archive.extractfile(member)
                yield name, opened.read() if opened else b"", 0, 0


def _sample_key(name: str) -> str:
    """Return the key of a member's sample: the name up to the first dot after the folders."""
    folder, _, last = name.rpartition("/")
    return f"{folder}/{last.partition('.')[0]}"


def _metadata(where: str, data: bytes) -> dict[str, Any]:
    """Return the plain values of a JSON object by key; empty for any other document.

    Raises DatasetError for text that is not valid UTF-8.
    """
    try:
        document = parse_json(data)
    except ValueError:
        return {}
    try:
        require_utf8(document)
    except ValueError as error:
        raise DatasetError(f"{where}: {error}") from error
    return {key: value for key, value in document.items() if _is_plain(value)} if isinstance(document, dict) else {}
