"""The findings of a recording check, and the data that it stores for each picture."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.console.output import abbreviate_list
from retrieval.data.check.near_copies import Thumbnail
from retrieval.data.dataset import Grasp


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


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """The data stored for one picture.

    Attributes:
        digest: SHA-256 (hex) of the file's bytes.
        is_flat: Whether the picture has one colour only.
        small: The picture at (6, 8, 3).
        photo: The picture at (64, 64, 3), for photos only.
        thumbnail: Data for finding near copies, for accepted photos and touches only.
        error: Why the picture cannot be read; empty if it can.
    """

    digest: str = ""
    is_flat: bool = False
    small: NDArray[np.float32] | None = None
    photo: NDArray[np.float32] | None = None
    thumbnail: Thumbnail | None = None
    error: str = ""


ImageRecords = dict[Path, ImageRecord]


def findings_for(
    severity: str, kind: str, what: str, names: Sequence[str], grasps: Sequence[Grasp]
) -> Iterator[Finding]:
    """Yield one finding about the grasps called `names`, if there are any."""
    if names:
        where = f"in {len(names)} of {len(grasps)} grasps: {abbreviate_list(names)}"
        yield Finding(severity, kind, f"{what} {where}", tuple(names))
