"""Occlusion sensitivity: which parts of a photo the match logit depends on."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import shrink
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.touches import AnyImage, AnyTouches, read_image
from retrieval.search.embeddings import embed_photos
from retrieval.search.query.searcher import Searcher

LONGER_SIDE = 640
"""Longer side of the photo in pixels before squares are hidden: more than any view of it has."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Occlusion map of a photo: the effect of each square on the match logit.

    Attributes:
        logit: Match logit of the whole photo with the touches.
        falls: Decrease of the logit when a square is hidden (rows, columns) float32. Positive squares support the
            match; negative squares are evidence against it.

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
    """Hide one square of a photo after another and measure the match logit (Zeiler and Fergus, ECCV 2014).

    A hidden square has the photo's mean colour. The photo tower encodes squares^2 + 1 images.

    Args:
        searcher: The opened index.
        touches: As for `Searcher.query`.
        photo: One photo, in a form that `retrieval.embed_photos` accepts.
        background: As for `Searcher.query`.
        model: The searcher's checkpoint, if it is already loaded.
        squares: Number of squares along each side, from 1 to 32.

    Raises:
        BadInput: An argument is invalid.
        ImageError: An image cannot be read.

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
    whole = np.rint(255 * shrink(image, LONGER_SIDE / max(image.shape[:2]))).astype(np.uint8)
    plain = np.rint(whole.mean(axis=(0, 1))).astype(np.uint8)
    rows, columns = (np.linspace(0, side, squares + 1).round().astype(int) for side in whole.shape[:2])

    def logits(photos: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
        return searcher.scorer.logits(partials, embed_photos(photos, model=model).partials)

    logit, falls = logits([whole])[0], []
    for top, bottom in pairwise(rows):  # one row of squares is in memory at once
        hidden = [whole.copy() for _ in range(squares)]
        for one, (left, right) in zip(hidden, pairwise(columns), strict=True):
            one[top:bottom, left:right] = plain
        falls.append(logit - logits(hidden))
    return Agreement(float(logit), np.array(falls, dtype=np.float32))
