"""Which photos need not be read: files that look as they did when an earlier build read them.

Size, both times and inode are compared. A write within one tick of the disk's clock would leave all four as they were,
so a file that had changed just before a build looked at it is not noted, and the next build reads it again: what git
does with its "racily clean" files.
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
from retrieval.data.sources import RemoteCatalogue

MIN_RUN = 256
"""Photos in a row that are worth being taken over as they lie; each such run ends a batch of photos to encode."""

_MASK = 2**64 - 1
_STATUS_STRUCT = struct.Struct(f"={len(STATUS)}Q")
_NO_METADATA_ENDING = b'"metadata": {}}'
"""How the line of a row without metadata ends, as `photo_row` has it last."""


class StatCache:
    """How the files of a catalogue's photos look, N of them, in its order; taken before any is read.

    ids: keys of the photos' ids. verify: all are to be read, whatever they look like. unnoted: whether all are read for
    want of notes.
    """

    def __init__(self, catalogue: Catalogue, index: Path, verify: bool = False) -> None:
        self.photos = catalogue.photos
        self.ids = keys_of(self.photos.paths)
        self._records = StatRecords(index)
        self._verify = verify
        self._file_statuses, self._settled = _file_statuses(catalogue)
        self.lacks_records = (
            not isinstance(catalogue, RemoteCatalogue) and not verify and not len(self._records.records)
        )

    def known(self, parent: Generation | None) -> Slots:
        """For each photo the parent's row (N,) of its id and content, where its file need not be read; else -1."""
        if parent is None or self._verify:
            return np.full(len(self.photos), -1)
        digests = self._records.digests(self.ids, self._file_statuses)
        return parent.match_rows(self.ids, digests)

    def note(self, made: Generation) -> None:
        """Write down how files look whose content is that of the generation's rows, for the next build."""
        numbers = made.rows.by_id.find(self.ids)
        good = (numbers >= 0) & self._settled
        self._records.write(self.ids[good], made.rows.table["digest"][numbers[good]], self._file_statuses[good])


def unchanged_runs(photos: PhotoTable, known: Slots, parent: Generation | None) -> Iterator[slice]:
    """Long runs of photos whose rows in the parent follow each other and would be written as they are."""
    if parent is None:
        return
    same = np.where(_is_unchanged(photos, known, parent), known, -1)
    kept = same >= 0
    ends = np.flatnonzero((kept[1:] != kept[:-1]) | (kept[1:] & (same[1:] != same[:-1] + 1))) + 1
    for start, stop in pairwise([0, *ends.tolist(), len(same)]):
        if stop - start >= MIN_RUN and same[start] >= 0:
            yield slice(start, stop)


def _is_unchanged(photos: PhotoTable, known: Slots, parent: Generation) -> NDArray[np.bool_]:
    """Whether the parent's rows of these numbers say of the photos (N,) what is to be said now. Ids and contents fit.

    Rows without metadata are compared by the keys of their objects, and not parsed.
    """
    key_of_name = {name: key_of(name) for name in photos.objects}
    objects = np.array([key_of_name[name] for name in photos.objects], "S16")
    same: NDArray[np.bool_] = (known >= 0) & (parent.rows.table["object_id"][known] == objects)
    telling = ~parent.rows.lines_end_with(_NO_METADATA_ENDING)[known]
    if photos.metadata:
        telling |= [path in photos.metadata for path in photos.paths]
    for place in np.flatnonzero(same & telling).tolist():
        number = int(known[place])
        same[place] = parent.rows.line(number) == encoded(photo_row(photos[place], parent.rows[number]["digest"]))
    return same


def photo_row(photo: CataloguePhoto, digest: str) -> dict[str, Any]:
    """What an index says of a photo with this content."""
    return {
        "id": photo.path,
        "object_id": photo.object_id,
        "path": photo.path,
        "digest": digest,
        "metadata": photo.metadata,
    }


def _file_statuses(catalogue: Catalogue) -> tuple[Statuses, NDArray[np.bool_]]:
    """Of each file (N, 4), and whether it had been left alone for `MIN_AGE_NS`; zeros where the disk does not tell."""
    now, paths, looks = time.time_ns(), catalogue.photos.paths, list[bytes]()
    unknown = np.zeros((len(paths), len(STATUS)), np.uint64), np.zeros(len(paths), bool)
    if isinstance(catalogue, RemoteCatalogue):
        return unknown
    try:
        folder = os.open(catalogue.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # gone since it was listed
        return unknown
    try:
        for path in paths:  # below an open folder they are found sooner
            try:
                found = os.stat(path, dir_fd=folder)
            except (OSError, ValueError):  # reading it will say why
                looks.append(bytes(_STATUS_STRUCT.size))
                continue
            modified, changed = found.st_mtime_ns & _MASK, found.st_ctime_ns & _MASK
            looks.append(_STATUS_STRUCT.pack(found.st_size & _MASK, modified, changed, found.st_ino & _MASK))
    finally:
        os.close(folder)
    table = np.frombuffer(b"".join(looks), np.uint64).reshape(-1, len(STATUS))
    times = table[:, 1:3].view(np.int64)
    return table, (times.max(axis=1) + MIN_AGE_NS < now) & table.any(axis=1)
