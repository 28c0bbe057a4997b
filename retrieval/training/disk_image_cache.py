"""Disk cache of decoded images: memory-mapped files in a folder that all training runs can use.

Images are stored in parts, `photo-<digest>.npy`, like features (`retrieval.training.features`). The digest covers the
picture files of a part and their preprocessing, so a changed picture or setting gives a new part. A part is written
completely or not at all, so an interrupted job continues. A part contains the exact decoded values: eight bits would
take a quarter of the disk, but be wrong by half a grey level wherever a picture was resized. Unused parts are never
deleted; you may delete the whole folder at any time.
"""

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import atomic_file, file_digest, named_write_errors, open_regular
from retrieval.console.output import say
from retrieval.console.progress import Bar
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.errors import BadInput, DatasetError
from retrieval.model.encode import batches, default_device
from retrieval.training import distributed

log = logging.getLogger(__name__)
_PART, _FORMAT = 128, 1
_AHEAD = 16

ImageFiles = tuple[Path | None, ...]
"""The files of one image."""
_Part = tuple[Path, list[ImageFiles]]


class DiskImageCache:
    """A function like `load(*files)` that returns cached images without decoding."""

    def __init__(
        self,
        load: Callable[..., NDArray[Any]],
        folder: Path,
        kind: str,
        preprocessing_digest: str,
        workers: int | str = "auto",
    ) -> None:
        """Set up an empty cache.

        Args:
            load: Function that returns images of one shape and type.
            folder: Folder of the cache.
            kind: Prefix of the names of the parts.
            preprocessing_digest: Digest of everything besides the files that determines the result of `load`.
            workers: As for `retrieval.data.loading.worker_count`.
        """
        self._load, self._folder, self._kind, self._preprocessing_digest, self._workers = (
            load,
            folder,
            kind,
            preprocessing_digest,
            workers,
        )
        self._mapped: dict[ImageFiles, NDArray[Any]] = {}

    def __call__(self, *files: Path | None) -> NDArray[Any]:
        """Return the image, from the cache if possible."""
        cached = self._mapped.get(files)
        return self._load(*files) if cached is None else cached

    def cache_decoded(self, images: Sequence[ImageFiles], *, quiet: bool = False) -> None:
        """Decode the images that are not in the folder, distributed over the ranks, and map all images.

        Args:
            images: The files of each image.
            quiet: No messages or progress on stderr.

        Raises:
            DatasetError: A picture cannot be read.
            BadInput: The disk is too small.
            OSError: The folder cannot be written.
        """
        parts = [
            (part_path(self._folder, self._kind, [self._preprocessing_digest], part).with_suffix(".npy"), part)
            for part in batches(dict.fromkeys(images), _PART)
        ]
        missing = self._map_existing(parts)
        if missing:
            self._require_space(missing, quiet)
        self._decode_parts(missing[distributed.rank() :: distributed.world_size()], quiet)
        distributed.any_rank(False, default_device())  # wait for all ranks
        self._decode_parts(self._map_existing(missing), quiet)  # parts that other ranks wrote to another disk

    def _map_existing(self, parts: Sequence[_Part]) -> list[_Part]:
        """Map the existing parts and return the missing ones."""
        return [part for part in parts if not self._map(*part)]

    def _decode_parts(self, parts: Sequence[_Part], quiet: bool) -> None:
        if not parts:
            return
        count = sum(len(part) for _, part in parts)
        with (
            Bar(f"decode {self._kind}", count, "images", quiet=quiet) as bar,
            worker_pool(self._workers) as pool,
        ):
            for path, part in parts:
                self._write(path, part, pool, bar)
                self._map(path, part)

    def _write(self, path: Path, part: list[ImageFiles], pool: Executor, bar: Bar) -> None:
        """Write a part image by image, so that only a few are in memory at a time."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            for number, image in enumerate(map_in_order(pool, lambda files: self._load(*files), part, _AHEAD)):
                if number == 0:
                    form = {"descr": image.dtype.str, "fortran_order": False, "shape": (len(part), *image.shape)}
                    np.lib.format.write_array_header_1_0(file, form)
                with named_write_errors(path):
                    file.write(image.tobytes())
                bar.advance()

    def _map(self, path: Path, part: list[ImageFiles]) -> bool:
        """Map a part, and return whether it exists and is complete."""
        try:
            with open_regular(path):
                images = np.load(path, mmap_mode="r", allow_pickle=False)
            if len(images) != len(part):
                raise ValueError(f"it contains {len(images)} images, not {len(part)}")
        except FileNotFoundError:
            return False
        except (OSError, ValueError, EOFError) as error:
            log.warning("%s is damaged (%s); its images are decoded again", path, error)
            return False
        self._mapped |= zip(part, np.asarray(images), strict=True)
        return True

    def _require_space(self, missing: Sequence[_Part], quiet: bool) -> None:
        count = sum(len(part) for _, part in missing)
        size = count * self._load(*missing[0][1][0]).nbytes
        amount = f"{size / 1e9:.2f} GB for {count} decoded images ({self._kind})"
        folder = self._folder.absolute()
        existing = next(each for each in (folder, *folder.parents) if each.is_dir())
        if size > shutil.disk_usage(existing).free:
            raise BadInput(f"{self._folder} needs {amount}; use a folder on another disk, or no cache")
        if not quiet:
            say(f"{self._folder} takes {amount}")


def part_path(folder: Path, kind: str, made_by: Sequence[str], part: Sequence[ImageFiles]) -> Path:
    """Return the path, without suffix, of a part in a cache folder.

    Args:
        folder: The cache folder.
        kind: Prefix of the part's name.
        made_by: Everything besides the files that determines the part's content.
        part: The files of each image.

    Raises:
        DatasetError: A file cannot be read.
    """
    try:
        digests = [[path and file_digest(path) for path in files] for files in part]
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read ({error.strerror}); run `retrieve check`") from error
    key = hashlib.sha256(json.dumps([_FORMAT, kind, *made_by, digests]).encode()).hexdigest()
    return folder / f"{kind}-{key[:32]}"
