"""Skip unchanged photos: compare each file's size, times and inode with those of the previous build.

A write within one tick of the disk's clock may leave all four values unchanged. A file that changed just before the
build read its stat is therefore not recorded, and the next build reads it again, as git does for "racily clean" files.
"""

import os
import struct
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import encoded
from indexes.kinds.scores import Slots
from indexes.store.generation import Generation
from indexes.store.rows import key_of, keys_of
from indexes.store.stat_cache import MIN_AGE_NS, STATUS, StatRecords, Statuses
from retrieval.data.catalogue import Catalogue, CataloguePhoto, PhotoTable

MIN_RUN = 256
"""Smallest run of unchanged photos that is copied as a block; each run ends a batch of photos to encode."""

_MASK = 2**64 - 1
_STATUS_STRUCT = struct.Struct(f"={len(STATUS)}Q")
_NO_METADATA_ENDING = b'"metadata": {}}'
"""End of the line of a row without metadata; `photo_row` puts metadata last."""


class StatCache:
    """Stat of the files of a catalogue's N photos, read before any file.

    Args:
        catalogue: The catalogue.
        index: Folder of the index.
        verify: Read all files, even if their stat did not change.

    Attributes:
        photos: The photos.
        ids: Keys (N,) of their ids.
        lacks_records: Whether all files are read because the index has no stat records.
    """

    def __init__(self, catalogue: Catalogue, index: Path, verify: bool = False) -> None:
        self.photos = catalogue.photos
        self.ids = keys_of(self.photos.paths)
        self._records = StatRecords(index)
        self._verify = verify
        self._file_statuses, self._recordable = _file_statuses(catalogue)
        self.lacks_records = not verify and not len(self._records.records)

    def known(self, parent: Generation | None) -> Slots:
        """Return the parent's row (N,) of each photo whose file is not read again, else -1."""
        if parent is None or self._verify:
            return np.full(len(self.photos), -1)
        digests = self._records.digests(self.ids, self._file_statuses)
        return parent.match_rows(self.ids, digests)

    def note(self, generation: Generation) -> None:
        """Store the stat of the files that the rows of the new generation describe, for the next build."""
        numbers = generation.rows.by_id.find(self.ids)
        good = (numbers >= 0) & self._recordable
        self._records.write(self.ids[good], generation.rows.table["digest"][numbers[good]], self._file_statuses[good])


def unchanged_runs(photos: PhotoTable, known: Slots, parent: Generation | None) -> Iterator[slice]:
    """Yield long runs of photos whose rows are consecutive in the parent and unchanged.

    Args:
        photos: The N photos.
        known: The parent's row of each photo whose file is not read again (N,), else -1.
        parent: The current generation; without one (None) there are no runs.
    """
    if parent is None:
        return
    same = np.where(_is_unchanged(photos, known, parent), known, -1)
    is_same = same >= 0
    ends = np.flatnonzero((is_same[1:] != is_same[:-1]) | (is_same[1:] & (same[1:] != same[:-1] + 1))) + 1
    for start, stop in pairwise([0, *ends.tolist(), len(same)]):
        if stop - start >= MIN_RUN and same[start] >= 0:
            yield slice(start, stop)


def _is_unchanged(photos: PhotoTable, known: Slots, parent: Generation) -> NDArray[np.bool_]:
    """Return whether the parent's rows of these photos (N,) equal the new rows; ids and contents are known to be equal.

    Rows without metadata are compared by the keys of their objects, without parsing.
    """
    key_of_name = {name: key_of(name) for name in photos.objects}
    objects = np.array([key_of_name[name] for name in photos.objects], "S16")
    same: NDArray[np.bool_] = (known >= 0) & (parent.rows.table["object_id"][known] == objects)
    has_metadata = ~parent.rows.lines_end_with(_NO_METADATA_ENDING)[known]
    if photos.metadata:
        has_metadata |= [path in photos.metadata for path in photos.paths]
    for place in np.flatnonzero(same & has_metadata).tolist():
        number = int(known[place])
        same[place] = parent.rows.line(number) == encoded(photo_row(photos[place], parent.rows[number]["digest"]))
    return same


def photo_row(photo: CataloguePhoto, digest: str) -> dict[str, Any]:
    """Return the index row of a photo with this content digest."""
    return {
        "id": photo.path,
        "object_id": photo.object_id,
        "path": photo.path,
        "digest": digest,
        "metadata": photo.metadata,
    }


def _file_statuses(catalogue: Catalogue) -> tuple[Statuses, NDArray[np.bool_]]:
    """Return the stat (N, 4) of each file, zeros if unknown, and whether it is older than `MIN_AGE_NS` (N,)."""
    now, paths, packed = time.time_ns(), catalogue.photos.paths, list[bytes]()
    unknown = np.zeros((len(paths), len(STATUS)), np.uint64), np.zeros(len(paths), bool)
    try:
        folder = os.open(catalogue.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # removed since it was listed
        return unknown
    try:
        for path in paths:  # relative to an open folder, stat is faster
            try:
                found = os.stat(path, dir_fd=folder)
            except (OSError, ValueError):  # reading the file reports the error
                packed.append(bytes(_STATUS_STRUCT.size))
                continue
            modified, changed = found.st_mtime_ns & _MASK, found.st_ctime_ns & _MASK
            packed.append(_STATUS_STRUCT.pack(found.st_size & _MASK, modified, changed, found.st_ino & _MASK))
    finally:
        os.close(folder)
    table = np.frombuffer(b"".join(packed), np.uint64).reshape(-1, len(STATUS))
    times = table[:, 1:3].view(np.int64)
    return table, (times.max(axis=1) + MIN_AGE_NS < now) & table.any(axis=1)
