"""The findings of a recording check, and what it stores of each picture, which it reads once."""

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.console.output import abbreviate_list
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.data.images import decode_rgb, read_bytes
from retrieval.data.resize import resize
from retrieval.errors import ImageError

_FLAT = 3.5 / 255
"""Range of the samples of a single colour after JPEG compression, at most."""

SmallImages = NDArray[np.float32]
"""(n, 6, 8, 3): pictures of one kind, 0..1."""


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        severity: "error" (do not train on this), "warning", or "note" (something could not be checked).
        kind: Short name for programs.
        message: Sentence for the user.
        grasps: Ids of the grasps concerned, if the finding concerns single grasps.
    """

    severity: str
    kind: str
    message: str
    grasps: tuple[str, ...] = ()


def findings_for(
    severity: str, kind: str, what: str, names: Sequence[str], grasps: Sequence[Grasp]
) -> Iterator[Finding]:
    """Yield one finding about the grasps called `names`, if there are any."""
    if names:
        where = f"in {len(names)} of {len(grasps)} grasps: {abbreviate_list(names)}"
        yield Finding(severity, kind, f"{what} {where}", tuple(names))


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """The data stored for one picture.

    Attributes:
        digest: SHA-256 (hex) of the file's bytes.
        is_flat: Whether the picture has one colour only.
        small: The picture at (6, 8, 3).
    """

    digest: str
    is_flat: bool
    small: NDArray[np.float32]


ImageRecords = dict[Path, ImageRecord]


def small_images(records: ImageRecords, paths: Sequence[Path]) -> SmallImages:
    """Return the small pictures (n, 6, 8, 3) of files."""
    return np.array([records[path].small for path in paths], dtype=np.float32)


def fingers_of(grasps: Sequence[Grasp]) -> range:
    """Return the numbers of the fingers that every grasp has."""
    return range(min((len(grasp.touches) for grasp in grasps), default=0))


def read_pictures(files: Collection[Path]) -> tuple[ImageRecords, dict[Path, str]]:
    """Read each file once, with a progress bar on stderr.

    Returns:
        The data of each readable file, and the reason for each other file.
    """

    def read(path: Path) -> ImageRecord | str:
        try:
            data = read_bytes(path)
            image = decode_rgb(data, path)
        except ImageError as error:
            return error.reason
        is_flat = bool(np.ptp(image, axis=(0, 1)).max() <= _FLAT)
        return ImageRecord(sha256(data).hexdigest(), is_flat, resize(image, (6, 8)))

    records, broken, paths = ImageRecords(), dict[Path, str](), sorted(files)
    with ThreadPoolExecutor(2) as pool, Bar("checking", len(paths), "images") as bar:
        for path, record in zip(paths, pool.map(read, paths), strict=True):
            if isinstance(record, str):
                broken[path] = record
            else:
                records[path] = record
            bar.advance()
    return records, broken
