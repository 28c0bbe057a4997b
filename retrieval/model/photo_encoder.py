"""The photo encoder of a long build: ONNX Runtime if it is installed and agrees with PyTorch."""

import logging
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import Image, encode_photos, one_thread
from retrieval.model.onnx_encoder import open_session

log = logging.getLogger(__name__)
Floats = NDArray[np.float32]
SAMPLE = 4
TOLERANCE = 2e-4
"""Largest accepted difference of a partial activation from PyTorch's, relative to the largest. Storage as float16
rounds by more."""


class PhotoEncodings(NamedTuple):
    """Encoding of photos as an index stores it, float32.

    Attributes:
        partial: (B, partial) partial activations.
        embedding: (B, embedding_dim) unit embeddings.
    """

    partial: Floats
    embedding: Floats


PhotoEncoder = Callable[[Sequence[Image]], PhotoEncodings]
"""Encodes images (H, views * W, 3) on the calling thread; several threads may call it at once."""


def torch_photo_encoder(checkpoint: Checkpoint) -> PhotoEncoder:
    """Return an encoder by the checkpoint's own towers."""

    def encode(images: Sequence[Image]) -> PhotoEncodings:
        with one_thread():
            encoding = encode_photos(checkpoint.matcher, images, len(images))
        return PhotoEncodings(encoding.partial.numpy(), encoding.embedding.numpy())

    return encode


def choose_photo_encoder(checkpoint: Checkpoint) -> PhotoEncoder:
    """Return an encoder by ONNX Runtime, or PyTorch's on a GPU, without `onnx`, or if the partial activations differ.

    Do not call this while other threads encode: the export would also record their operations.
    """
    encode = torch_photo_encoder(checkpoint)
    is_installed = all(find_spec(name) for name in ("onnx", "onnxruntime"))
    if not is_installed or next(checkpoint.matcher.parameters()).device.type != "cpu":
        return encode
    from retrieval.model.export import photo_encoder_to_onnx

    try:
        session = open_session(photo_encoder_to_onnx(checkpoint), "the photo encoder", checkpoint.digest, threads=1)
    except CheckpointError as error:
        log.warning("%s; PyTorch encodes the photos", error)
        return encode

    def encode_by_onnx(images: Sequence[Image]) -> PhotoEncodings:
        return PhotoEncodings(*session.run(None, {"images": np.stack(images)}))

    settings = checkpoint.config.preprocessing
    shape = SAMPLE, settings.photo_px, len(settings.views) * settings.photo_px, 3
    images = list(np.random.default_rng(0).random(shape, dtype=np.float32))
    partial, other = encode(images).partial, encode_by_onnx(images).partial
    if not np.abs(partial - other).max() <= TOLERANCE * np.abs(partial).max():
        log.warning("ONNX Runtime gives other partial activations than PyTorch; PyTorch encodes the photos")
        return encode
    return encode_by_onnx
