"""Photos similar to a photo, by the embeddings in an index."""

from typing import NamedTuple

import numpy as np

from retrieval.errors import BadInput
from retrieval.search.query.objects import ListedPhoto, listed_photo
from retrieval.search.query.searcher import Searcher


class Neighbour(NamedTuple):
    """A photo and the inner product of its embedding with that of the query photo, 1 for equal images.

    >>> with retrieval.open("index") as searcher:
    ...     near = retrieval.nearest_photos(searcher, "mug/1.jpg")
    >>> near[0].photo.object_id, near[0].score <= 1.001
    ('mug', True)
    """

    photo: ListedPhoto
    score: float


def nearest_photos(searcher: Searcher, photo: str, count: int = 10) -> list[Neighbour]:
    """Return the photos with the nearest embeddings to that of a photo, the nearest first, without the photo itself.

    Args:
        searcher: The opened index.
        photo: Path of the photo in the catalogue.
        count: Number of photos to return.

    Raises:
        BadInput: The index lacks the photo, or the model has no trained embeddings.

    >>> with retrieval.open("index") as searcher:
    ...     near = retrieval.nearest_photos(searcher, "mug/1.jpg", count=1)
    >>> near[0].photo.path != "mug/1.jpg"
    True
    """
    generation = searcher.generation
    if count < 1:
        raise BadInput(f"count must be 1 or more; got {count}")
    if not searcher.checkpoint.config.has_embeddings:
        raise BadInput("this model has no trained embeddings, so they cannot measure similarity")
    own = generation.rows.find(photo)
    if own < 0:
        raise BadInput(f"the index has no photo {photo!r}")
    scores, rows = generation.search(np.ascontiguousarray(generation.embeddings[own][None]), count + 1)
    found = [
        Neighbour(listed_photo(generation.rows[row]), score)
        for score, row in zip(scores[0].tolist(), rows[0].tolist(), strict=True)
        if row not in (own, -1)
    ]
    return found[:count]
