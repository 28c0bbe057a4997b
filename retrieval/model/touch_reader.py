"""Read touches and encode them by the matcher: partial activations, embeddings and readings."""

import hashlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, resize
from retrieval.errors import BadInput, IncompleteSearch, NumericalError
from retrieval.model.config import Config
from retrieval.model.gel_check import contact_level
from retrieval.model.touches import AnyImage, GelImage, InputImage, parse_grasps, read_image

BATCH = 8
"""Largest number of grasps whose images are in memory, and in the encoder, at once."""
DECODERS = 2  # a touch has two images
Floats = NDArray[np.float32]


class TouchEncodings(NamedTuple):
    """Encoding of G grasps, float32.

    Attributes:
        partials: (G, partial) partial activations.
        embeddings: (G, embedding_dim) unit embeddings.
        readings: (G, fingers, 2) log-odds of the gel head, if the model has one (`retrieval.model.fusion_scorer`).
        levels: (G, fingers) differences in grey levels from the no-contact frames, if given.
        pictures: A digest of the pixels of each finger's image, for each grasp.
    """

    partials: Floats
    embeddings: Floats
    readings: Floats | None = None
    levels: Floats | None = None
    pictures: Sequence[Sequence[bytes]] = ()


class TouchEncoder(Protocol):
    """Encoder of touches: PyTorch or ONNX Runtime."""

    @property
    def name(self) -> str:
        """Its name in the answer."""

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchEncodings:
        """Encode grasps, each a sequence of its fingers' images."""


class EncodedTouches(NamedTuple):
    """Encoding of images, one row each, float32.

    Attributes:
        embeddings: (N, embedding_dim) unit vectors for candidate search.
        partials: (N, partial) partial activations, from which pairs are scored.

    >>> with retrieval.open("index") as searcher:
    ...     embeddings, partials = searcher.encode([["a.png", "b.png"], ["a2.png", "b2.png"]])
    >>> len(embeddings), len(partials), embeddings.dtype.name
    (2, 2, 'float32')
    """

    embeddings: Floats
    partials: Floats


class EncodedQuery(NamedTuple):
    """The grasps of a query.

    Attributes:
        embeddings: As in `EncodedTouches`.
        partials: As in `EncodedTouches`.
        openings_mm: (G,) float64 openings of the jaws, NaN where none was measured.
    """

    embeddings: Floats
    partials: Floats
    openings_mm: NDArray[np.float64]


class Stopwatch:
    """Milliseconds of named stages and the total."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the block as part of `stage`."""
        start = time.perf_counter()
        yield
        self.add({stage: 1e3 * (time.perf_counter() - start)})

    def add(self, timing_ms: Mapping[str, float]) -> None:
        """Add stages that another stopwatch timed."""
        for stage, ms in timing_ms.items():
            self._stages[stage] = self._stages.get(stage, 0.0) + ms

    def finish(self, parts: int) -> dict[str, float]:
        """Return the stages in their order and the "total" since construction, each divided by `parts`."""
        everything = {**self._stages, "total": 1e3 * (time.perf_counter() - self._start)}
        return {stage: ms / parts for stage, ms in everything.items()}


class TouchReader:
    """Reads and encodes touches for a model."""

    def __init__(self, config: Config, encoder: TouchEncoder, compares_contact: bool = False) -> None:
        """Prepare a reader for a model; `compares_contact`: each touch is compared with its no-contact frame."""
        self.encoder, self.fingers, self._preprocessing = encoder, config.matcher.fingers, config.preprocessing
        self.takes_background = compares_contact or self._preprocessing.background != "none"

    def no_contact_frames(self, background: Sequence[AnyImage] | None) -> Sequence[RgbImage | None]:
        """Return the no-contact frame (px, px, 3) of each finger, None for a model that uses none.

        Raises BadInput if the frames are missing, or given to a model that would ignore them.
        """
        policy = self._preprocessing.background
        if background is None and policy != "none":
            raise BadInput(
                f'this model subtracts the no-contact gel (background = "{policy}"): give a no-contact frame for each '
                "finger with --background"
            )
        if background is None:
            return [None] * self.fingers
        if not self.takes_background:
            raise BadInput("this model uses gel images unchanged and would ignore --background; leave it out")
        frames = parse_grasps(background, self.fingers, noun="background")
        if len(frames) != 1:
            raise BadInput(f"give one background, with a no-contact frame for each finger; got {len(frames)}")
        return [self._resized(frame) for frame in frames[0]]

    def encode(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[RgbImage | None], clock: Stopwatch
    ) -> TouchEncodings:
        """Encode grasps in batches; `clock` times the stages "decode" and "encode"."""
        parts, levels, pictures = [], [], []
        for start in range(0, len(grasps), BATCH):
            with clock("decode"):
                views = self._preprocessed(grasps[start : start + BATCH], no_contact_frames)
                levels += [[level for _, level, _ in grasp] for grasp in views]
                pictures += [[picture for *_, picture in grasp] for grasp in views]
            with clock("encode"):
                parts.append(self.encoder.encode([[view for view, *_ in grasp] for grasp in views]))
        partials, embeddings = (np.concatenate([part[place] for part in parts]) for place in (0, 1))
        readings = [part.readings for part in parts if part.readings is not None]
        return TouchEncodings(
            _finite(partials, "partial activation"),
            _finite(embeddings, "embedding"),
            np.concatenate(readings) if readings else None,
            None if no_contact_frames[0] is None else np.array(levels, dtype=np.float32),
            pictures,
        )

    def _preprocessed(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[RgbImage | None]
    ) -> list[list[tuple[RgbImage, float, bytes]]]:
        """Return the preprocessed images of grasps, their differences from the no-contact frames, and pixel digests.

        Of several bad images, the first is reported.
        """

        def view(source: InputImage, reference: RgbImage | None) -> tuple[RgbImage, float, bytes]:
            image = self._resized(source)
            level = 0.0 if reference is None else contact_level(image, reference)
            picture = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
            return self._preprocessing.touch(image, reference), level, picture

        with ThreadPoolExecutor(DECODERS, "decode") as threads:
            views = [threads.map(view, grasp, no_contact_frames) for grasp in grasps]
            return list(map(list, views))

    def _resized(self, source: InputImage) -> RgbImage:
        """Return an image (px, px, 3) in 0..1. Raises ImageError; IncompleteSearch if it was read for another model."""
        px = self._preprocessing.touch_px
        if not isinstance(source.image, GelImage):
            return resize(read_image(source.image, source.name), (px, px))
        if source.image.touch.shape != (px, px, 3):
            raise IncompleteSearch("an index of another model was opened in the meantime; repeat the query")
        return source.image.touch


def require_distinct(grasps: Iterable[Sequence[InputImage]], pictures: Iterable[Sequence[bytes]]) -> None:
    """Raise BadInput if two images of an object's grasps are the same picture, which would count as evidence twice."""
    first: dict[bytes, str] = {}
    for image, picture in zip(chain.from_iterable(grasps), chain.from_iterable(pictures), strict=True):
        if picture in first:
            same = "given twice" if first[picture] == image.name else f"the same picture as {first[picture]}"
            raise BadInput(f"{image.name}: {same}; a picture counts once, so leave the repetition out")
        first[picture] = image.name


def _finite(values: Floats, name: str) -> Floats:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise NumericalError(f"the {name} of touch {bad[0] + 1} contains a NaN or infinite number; use another model")
    return values
