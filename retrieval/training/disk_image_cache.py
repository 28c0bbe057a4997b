"""Images decoded once for all trainings: memory-mapped files in a folder, read in place of the pictures.

Like features (`retrieval.training.features`), images are kept in parts, `photo-<digest>.npy`; the digest is of the
files that a part was decoded from and of how they were seen. A part is written whole or not at all, so what was
interrupted goes on, and where a picture or the preprocessing changed the part is another one. A part holds what was
decoded, to the bit: eight bits would take a quarter of the disk, and be off by half a grey level wherever a picture was
resized. Nothing deletes parts that are no longer asked for; the whole folder may be deleted at any time.
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
"""What one image is made from."""
_Part = tuple[Path, list[ImageFiles]]


class DiskImageCache:
    """`load(*files)`, for images that were kept without decoding anything.

    load: gives images of one shape and type. kind: begins the names of the parts. seen_by: what decides what `load`
    gives beside the files, as a digest. workers: as `retrieval.data.loading.worker_count` takes it.
    """

    def __init__(
        self,
        load: Callable[..., NDArray[Any]],
        folder: Path,
        kind: str,
        preprocessing_digest: str,
        workers: int | str = "auto",
    ) -> None:
        self._load, self._folder, self._kind, self._preprocessing_digest, self._workers = (
            load,
            folder,
            kind,
            preprocessing_digest,
            workers,
        )
        self._mapped: dict[ImageFiles, NDArray[Any]] = {}

    def __call__(self, *files: Path | None) -> NDArray[Any]:
        """The image; what was not kept is loaded."""
        kept = self._mapped.get(files)
        return self._load(*files) if kept is None else kept

    def cache_decoded(self, images: Sequence[ImageFiles], *, quiet: bool = False) -> None:
        """Decode those that the folder does not hold, each rank its share, and map all of them.

        Raises DatasetError for a picture that cannot be read, BadInput where the disk is too small, OSError.
        """
        parts = [
            (part_path(self._folder, self._kind, [self._preprocessing_digest], part).with_suffix(".npy"), part)
            for part in batches(dict.fromkeys(images), _PART)
        ]
        missing = self._map_existing(parts)
        if missing:
            self._require_space(missing, quiet)
        self._decode_parts(missing[distributed.rank() :: distributed.world_size()], quiet)
        distributed.any_rank(False, default_device())  # all have made theirs
        self._decode_parts(self._map_existing(missing), quiet)  # what the others wrote to disks of their own

    def _map_existing(self, parts: Sequence[_Part]) -> list[_Part]:
        """Those that are not there; the images of the others are taken from them."""
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
        """Image after image, so that a few are in memory at a time."""
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
        """Whether the part is there, whole; then its images are taken from it."""
        try:
            with open_regular(path):
                images = np.load(path, mmap_mode="r", allow_pickle=False)
            if len(images) != len(part):
                raise ValueError(f"it holds {len(images)} images, not {len(part)}")
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
        said = f"{size / 1e9:.2f} GB for {count} decoded images ({self._kind})"
        folder = self._folder.absolute()
        there = next(each for each in (folder, *folder.parents) if each.is_dir())
        if size > shutil.disk_usage(there).free:
            raise BadInput(f"{self._folder} must have room for {said}; give a folder on another disk, or none")
        if not quiet:
            say(f"{self._folder} takes {said}")


def part_path(folder: Path, kind: str, made_by: Sequence[str], part: Sequence[ImageFiles]) -> Path:
    """Return where a part lies that was made in this very way from these very files; it has no suffix.

    Raises:
        DatasetError: A file cannot be read.
    """
    try:
        digests = [[path and file_digest(path) for path in files] for files in part]
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read ({error.strerror}); run `retrieve check`") from error
    key = hashlib.sha256(json.dumps([_FORMAT, kind, *made_by, digests]).encode()).hexdigest()
    return folder / f"{kind}-{key[:32]}"
