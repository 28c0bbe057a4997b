"""Images however they are given, to what the matcher keeps of them: halves and embeddings."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage
from retrieval.data.touches import AnyImage, AnyTouches, GivenImage, read_grasps
from retrieval.errors import BadInput, NumericalError
from retrieval.model.config import Config
from retrieval.model.gel_check import contact_level
from retrieval.model.stopwatch import Stopwatch

BATCH = 32
"""Grasps whose images are in memory, and in the encoder, at once."""
DECODERS = 2  # a touch has as many images
Floats = NDArray[np.float32]


class TouchCodes(NamedTuple):
    """What is made of G grasps, float32: halves (G, hidden), embeddings (G, embedding_dim), and what tells whether they
    are touches: readings (G, fingers, 2) of a model with a gel head, levels (G, fingers) of grey by which images differ
    from their no-contact frames, where these were given (`retrieval.model.gel_check`)."""

    halves: Floats
    embeddings: Floats
    readings: Floats | None = None
    levels: Floats | None = None


class Encoder(Protocol):
    """What makes codes of touches: PyTorch or ONNX Runtime."""

    @property
    def name(self) -> str:
        """How it is called in the answer."""

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchCodes:
        """Encode grasps, each its fingers' images."""


class Encoded(NamedTuple):
    """What the matcher keeps of images, a row each: unit `embeddings` (N, embedding_dim), by which candidates are
    found, and `halves` (N, hidden), by which it judges pairs. float32.

    >>> with retrieval.open("index") as searcher:
    ...     embeddings, halves = searcher.encode([["a.png", "b.png"], ["a2.png", "b2.png"]])
    >>> len(embeddings), len(halves), embeddings.dtype.name
    (2, 2, 'float32')
    """

    embeddings: Floats
    halves: Floats


class TouchReader:
    """Reads and encodes the touches of a model."""

    def __init__(self, config: Config, encoder: Encoder, compares: bool = False) -> None:
        """compares: whether a touch is compared with its no-contact frame, to see if there is a contact."""
        self.encoder, self.fingers, self._compares = encoder, config.matcher.fingers, compares
        self._preprocessing = config.preprocessing

    def grasps(self, touches: AnyTouches, of: str = "") -> list[list[GivenImage]]:
        """The grasps of one object, by `retrieval.data.touches.read_grasps`; no image is read."""
        return read_grasps(touches, self.fingers, of=of)

    def references(self, background: Sequence[AnyImage] | None) -> Sequence[RgbImage | None]:
        """The no-contact frame of each finger, None for a model that looks at no such frame. Raises BadInput for one
        that is missing, and for one that would not be looked at."""
        policy = self._preprocessing.background
        if background is None and policy != "none":
            raise BadInput(
                f'this model subtracts the untouched gel (background = "{policy}"): give a no-contact frame for each '
                "finger with --background"
            )
        if background is None:
            return [None] * self.fingers
        if policy == "none" and not self._compares:
            raise BadInput("this model takes gel images as they are and would not look at --background; leave it out")
        frames = read_grasps(background, self.fingers, what="background")
        if len(frames) != 1:
            raise BadInput(f"give one background, with a no-contact frame for each finger; got {len(frames)}")
        return [frame.read() for frame in frames[0]]

    def encode(
        self, grasps: Sequence[Sequence[GivenImage]], references: Sequence[RgbImage | None], clock: Stopwatch
    ) -> TouchCodes:
        """Of all grasps, in batches, with stages "decode" and "encode" on the clock."""
        parts, levels = [], []
        for start in range(0, len(grasps), BATCH):
            with clock("decode"):
                views = self._views(grasps[start : start + BATCH], references)
                levels += [[level for _, level in grasp] for grasp in views]
            with clock("encode"):
                parts.append(self.encoder.encode([[view for view, _ in grasp] for grasp in views]))
        halves, embeddings = (np.concatenate([part[place] for part in parts]) for place in (0, 1))
        readings = [part.readings for part in parts if part.readings is not None]
        return TouchCodes(
            _finite(halves, "half"),
            _finite(embeddings, "embedding"),
            np.concatenate(readings) if readings else None,
            None if references[0] is None else np.array(levels, dtype=np.float32),
        )

    def _views(
        self, grasps: Sequence[Sequence[GivenImage]], references: Sequence[RgbImage | None]
    ) -> list[list[tuple[RgbImage, float]]]:
        """The images of grasps as the tower sees them, and how far each is from its no-contact frame (0 without one);
        made side by side; of several bad ones the first is told.

        The threads end with the call, for a fork of the process would not have them.
        """

        subtracts = self._preprocessing.background != "none"

        def view(given: GivenImage, reference: RgbImage | None) -> tuple[RgbImage, float]:
            image = given.read()
            level = 0.0 if reference is None else contact_level(image, reference)
            return self._preprocessing.touch(image, reference if subtracts else None), level

        with ThreadPoolExecutor(DECODERS, "decode") as threads:
            jobs = [
                [threads.submit(view, given.loaded(), frame) for given, frame in zip(grasp, references, strict=True)]
                for grasp in grasps
            ]
            return [[job.result() for job in grasp] for grasp in jobs]


def _finite(values: Floats, name: str) -> Floats:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise NumericalError(f"the {name} of touch {bad[0] + 1} holds a NaN or infinite number; the model is unfit")
    return values
