"""Where a photo agrees with a touch: what of it the match logit hangs on."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import resize
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.touches import AnyImage, AnyTouches, read_image
from retrieval.search.embeddings import embed_photos
from retrieval.search.query.searcher import Searcher

LONGER_SIDE = 640
"""Pixels of the photo that squares are hidden in: more than any view shows of it."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What of a photo speaks for a match, found by hiding one square of it after the other.

    logit: match logit of the whole photo with the touches. falls (rows, columns): by how much the logit falls when that
    square is hidden; a square with a negative number speaks against the match.

    >>> with retrieval.open("index") as searcher:
    ...     found = retrieval.agreement(searcher, ["a.png", "b.png"], "catalog/mug/1.jpg", squares=2)
    >>> type(found.logit), found.falls.dtype.name
    (<class 'float'>, 'float32')
    """

    logit: float
    falls: NDArray[np.float32]


def agreement(
    searcher: Searcher,
    touches: AnyTouches,
    photo: AnyImage,
    *,
    background: Sequence[AnyImage] | None = None,
    model: Checkpoint | None = None,
    squares: int = 8,
) -> Agreement:
    """Hide one square of a photo after the other (Zeiler and Fergus, ECCV 2014) and judge the rest with the touches.

    `touches`, `background`: as `Searcher.query` takes them. `model`: the searcher's checkpoint, where it is loaded
    already. `squares`: how many the photo has along each side; a hidden one gets the photo's mean colour. The photo
    tower looks squares^2 + 1 times. Raises BadInput and ImageError.

    >>> with retrieval.open("index") as searcher:
    ...     found = retrieval.agreement(searcher, ["a.png", "b.png"], "catalog/mug/1.jpg", squares=2)
    >>> found.falls.shape
    (2, 2)
    """
    if not 1 <= squares <= 32:
        raise BadInput(f"squares must be from 1 to 32; got {squares}")
    partials = searcher.encode(touches, background=background).partials
    model = model or load_checkpoint(searcher.checkpoint.path)
    image = read_image(photo, "the photo")
    scale = min(1.0, LONGER_SIDE / max(image.shape[:2]))
    height, width = (max(1, round(scale * side)) for side in image.shape[:2])
    whole = np.rint(255 * resize(image, (height, width))).astype(np.uint8)
    plain = np.rint(whole.mean(axis=(0, 1))).astype(np.uint8)
    rows, columns = (np.linspace(0, side, squares + 1).round().astype(int) for side in (height, width))

    def judged(photos: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
        return searcher.scorer.logits(partials, embed_photos(photos, model=model).partials)

    logit, falls = judged([whole])[0], []
    for top, bottom in pairwise(rows):  # one row of squares is in memory at once
        hidden = [whole.copy() for _ in range(squares)]
        for one, (left, right) in zip(hidden, pairwise(columns), strict=True):
            one[top:bottom, left:right] = plain
        falls.append(logit - judged(hidden))
    return Agreement(float(logit), np.array(falls, dtype=np.float32))
