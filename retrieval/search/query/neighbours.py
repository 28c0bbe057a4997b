"""Photos near a photo, by the embeddings that an index keeps."""

from typing import NamedTuple

import numpy as np

from retrieval.errors import BadInput
from retrieval.search.query.objects import ListedPhoto, listed_photo
from retrieval.search.query.searcher import Searcher


class Neighbour(NamedTuple):
    """A photo and its inner product with the one asked for, 1 for equal pictures.

    >>> with retrieval.open("index") as searcher:
    ...     near = retrieval.nearest_photos(searcher, "mug/1.jpg")
    >>> near[0].photo.object_id, near[0].score <= 1.001
    ('mug', True)
    """

    photo: ListedPhoto
    score: float


def nearest_photos(searcher: Searcher, photo: str, count: int = 10) -> list[Neighbour]:
    """The photos whose embeddings are nearest to that of `photo`, which is named by its path in the catalogue and left
    out itself; the nearest first. Raises BadInput for a photo that the index lacks, and for a model whose embeddings
    were not trained.

    >>> with retrieval.open("index") as searcher:
    ...     near = retrieval.nearest_photos(searcher, "mug/1.jpg", count=1)
    >>> near[0].photo.path != "mug/1.jpg"
    True
    """
    generation = searcher.generation
    if count < 1:
        raise BadInput(f"count must be 1 or more; got {count}")
    if not searcher.checkpoint.config.has_embeddings:
        raise BadInput("the embeddings of this model were not trained: nearness by them means nothing")
    try:
        own = generation.row_number(photo)
    except KeyError:
        raise BadInput(f"the index has no photo {photo!r}") from None
    vector = np.ascontiguousarray(generation.embeddings[generation.slots[own]][None])
    numbers, scores = generation.search(vector, min(count + 1, generation.count))[0]
    found = [
        Neighbour(listed_photo(generation.rows[int(number)]), float(score))
        for number, score in zip(numbers, scores, strict=True)
        if number != own
    ]
    return found[:count]
