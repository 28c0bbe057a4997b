"""What a check of a recording says, and what it keeps of every picture."""

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
    """One remark. severity: "error" (do not train on this), "warning" or "note" (what could not be checked). kind:
    short name for programs. grasps: those it is about, where it is about single ones.
    """

    severity: str
    kind: str
    message: str
    grasps: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """What is kept of one picture, or why it cannot be read: the digest of its bytes, whether it is of one colour, a
    small picture (6, 8, 3), of photos a larger one too, and of accepted photos and touches what copies are found by.
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
    """A remark on those of the grasps that are named, if any."""
    if names:
        where = f"in {len(names)} of {len(grasps)} grasps: {abbreviate_list(names)}"
        yield Finding(severity, kind, f"{what} {where}", tuple(names))
