"""Embeddings of photos, for use with another vector index."""

import os
from collections.abc import Sequence
from pathlib import Path

from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import encode_photos
from retrieval.model.touch_reader import EncodedTouches
from retrieval.model.touches import AnyImage, read_image
from retrieval.search.opening import find_model


def embed_photos(photos: Sequence[AnyImage], *, model: str | Path | Checkpoint | None = None) -> EncodedTouches:
    """Return the unit embeddings and partial activations of photos.

    An index finds candidates by the inner product of a touch's embedding (`Searcher.encode`) with a photo's.

    Args:
        photos: N photos: paths, bytes of files, Pillow images or uint8 arrays (height, width, 3), red first.
        model: A checkpoint or its file; None for the default of `retrieve build-index`.

    Returns:
        Embeddings (N, embedding_dim) and partial activations (N, partial_width), float32, in the order of the photos.

    Raises:
        ImageError: A photo cannot be read.
        BadInput: There is no photo.
        CheckpointError: The checkpoint is missing or damaged.

    >>> photos = ["catalog/mug/1.jpg", "catalog/tin/1.jpg"]
    >>> embeddings, partials = retrieval.embed_photos(photos, model="model.safetensors")
    >>> with retrieval.open("index") as searcher:
    ...     touch = searcher.encode(["a.png", "b.png"])
    ...     logits = searcher.scorer.logits(touch.partials, partials)
    >>> scores = touch.embeddings @ embeddings.T  # a row for each grasp
    >>> scores.shape, logits.shape
    ((1, 2), (2,))
    """
    if isinstance(photos, str | bytes | os.PathLike):  # each letter would be read as a path
        raise BadInput("photos must be a list; put a single photo into [ ]")
    if not photos:
        raise BadInput("photos must contain at least one photo; got none")
    if not isinstance(model, Checkpoint):
        model = load_checkpoint(find_model(None)[0] if model is None else Path(model))
    settings = model.config.preprocessing
    images = (_preprocess(photo, f"photo {number}", settings) for number, photo in enumerate(photos, start=1))
    code = encode_photos(model.matcher, images)
    return EncodedTouches(code.embedding.numpy(), code.partial.numpy())


def _preprocess(photo: AnyImage, name: str, settings: Preprocessing) -> RgbImage:
    """Return the photo tower's input for a photo."""
    if isinstance(photo, str | os.PathLike):
        return settings.load_photo(os.fspath(photo))
    if isinstance(photo, bytes | bytearray | memoryview):
        return settings.photo_from_bytes(bytes(photo), name)
    return settings.photo(read_image(photo, name))
