"""Gel images in any form, and their encoding by the matcher: partial activations, embeddings and readings.

An image is a file, bytes, a Pillow image or an array. A query has one grasp or several.

The nesting of the lists determines which:

    [a, b]             one grasp: an image for each finger of the model
    [[a, b], [a, b]]   several grasps of one object
    a                  one grasp of a model with one finger
"""

import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from retrieval.data.images import check_pixels, decode_rgb, pillow_rgb, read_rgb, to_float
from retrieval.data.resize import RgbImage
from retrieval.errors import BadInput, ImageError, IncompleteSearch, NumericalError
from retrieval.model.config import Config
from retrieval.model.fusion_scorer import contact_level
from retrieval.model.gel_images import GelImage

AnyImage: TypeAlias = str | os.PathLike[str] | bytes | bytearray | memoryview | Image.Image | NDArray[Any] | GelImage
"""A path (as text or `PathLike`), the bytes of a file, a Pillow image, an array (H, W, 3) uint8 in RGB order, or a gel
image that another process read."""
AnyTouches: TypeAlias = AnyImage | Sequence[AnyImage] | Sequence[Sequence[AnyImage]]
"""One grasp or several, nested as described above. An array with 4 or 5 axes is a list of its entries."""

_IMAGE_TYPES = "a path, the bytes of a file, a Pillow image or a uint8 array (height, width, 3)"
_NESTING_HINT = "one grasp is a list with an image for each finger, several grasps are a list of such lists"


@dataclass(frozen=True, eq=False)
class InputImage:
    """An input image that is not read yet.

    Attributes:
        image: The image.
        name: Its name in answers and messages; for a file, the path.
    """

    image: AnyImage
    name: str

    def read(self) -> RgbImage:
        """Return (H, W, 3) float32 RGB in 0..1, the same for all forms of a picture. Raises ImageError."""
        return read_image(self.image, self.name)


def read_image(image: AnyImage, name: str) -> RgbImage:
    """Return an image of any form as (H, W, 3) float32 RGB in 0..1.

    Args:
        image: The image. Arrays must be uint8: the range of other types would have to be guessed.
        name: Its name in messages, if it is not a file.

    Raises:
        ImageError: The image is not readable.
    """
    if isinstance(image, str | os.PathLike):
        return read_rgb(os.fspath(image))
    if isinstance(image, bytes | bytearray | memoryview):
        return decode_rgb(bytes(image), name)
    if isinstance(image, Image.Image):
        return pillow_rgb(image, name)
    if not isinstance(image, np.ndarray):
        raise ImageError(name, f"an image must be {_IMAGE_TYPES}, got {type(image).__name__}")
    if image.dtype != np.uint8:
        raise ImageError(
            name,
            f"an array must contain uint8 samples in 0..255, got {image.dtype}; convert samples in 0..1 with "
            "np.rint(255 * image).astype(np.uint8)",
        )
    if image.ndim != 3 or image.shape[2] != 3:
        raise ImageError(
            name,
            f"an array must be (height, width, 3) in RGB order, got {image.shape}; repeat a grey image with "
            "np.stack([image] * 3, axis=-1), drop an alpha channel, and put channels last",
        )
    check_pixels((image.shape[1], image.shape[0]), name)
    return np.ascontiguousarray(to_float(np.asarray(image)))


def parse_grasps(touches: AnyTouches, fingers: int, *, noun: str = "touch", of: str = "") -> list[list[InputImage]]:
    """Return the grasps of one object, each with an image per finger. No image is read.

    Args:
        touches: One grasp or several, nested as described above.
        fingers: Images per grasp.
        noun: Noun for one grasp in messages.
        of: Prefix of messages, such as "object 3, ".

    Raises:
        BadInput: The nesting or the number of images is wrong.
    """
    if _is_image(touches):
        grasps: list[list[Any]] = [[touches]]
    else:
        items = _items(touches, of)
        images = [_is_image(item) for item in items]
        if any(images) and not all(images):
            raise BadInput(f"{of}a list mixes images with lists of images; {_NESTING_HINT}")
        grasps = [items] if any(images) else [_items(item, of) for item in items]
    if wrong := [image for grasp in grasps for image in grasp if not _is_image(image)]:
        raise BadInput(
            f"{of}an image must be {_IMAGE_TYPES}, got {type(wrong[0]).__name__}; {_NESTING_HINT}; query several "
            "objects with query_many"
        )
    if not grasps:
        raise BadInput(f"{of}give at least one {noun}: {_NESTING_HINT}")
    named = [
        [InputImage(image, _name(image, f"{of}grasp {g}, finger", f)) for f, image in enumerate(grasp)]
        for g, grasp in enumerate(grasps, start=1)
    ]
    for grasp in named:
        if len(grasp) != fingers:
            raise BadInput(
                f"{of}this model takes {fingers} gel image(s) for one {noun}; got {len(grasp)}: "
                f"{', '.join(image.name for image in grasp)} ({_NESTING_HINT}; on the command line, use one --gelsight "
                "for each grasp)"
            )
    return named


def _is_image(item: object) -> bool:
    if isinstance(item, np.ndarray):
        return item.ndim <= 3
    return isinstance(item, str | os.PathLike | bytes | bytearray | memoryview | Image.Image | GelImage)


def _items(value: object, of: str) -> list[Any]:
    if isinstance(value, Sequence | np.ndarray):
        return list(value)
    raise BadInput(f"{of}an image must be {_IMAGE_TYPES}, got {type(value).__name__}; {_NESTING_HINT}")


def _name(image: AnyImage, place: str, finger: int) -> str:
    if isinstance(image, str | os.PathLike):
        return os.fspath(image)
    if isinstance(image, np.ndarray):
        kind = f"array {' x '.join(map(str, image.shape))} {image.dtype}"
    elif isinstance(image, Image.Image):
        kind = f"Pillow image {image.width} x {image.height} {image.mode}"
    else:
        kind = f"{image.file_bytes if isinstance(image, GelImage) else len(bytes(image))} bytes"
    letter = ascii_lowercase[finger] if finger < len(ascii_lowercase) else str(finger + 1)
    return f"{place} {letter} ({kind})"


BATCH = 32
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
    """

    partials: Floats
    embeddings: Floats
    readings: Floats | None = None
    levels: Floats | None = None


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


MAX_FORK_WAIT_S = 10.0
"""Longest wait for computations to end before a fork. A process forked later may wait for a lock for ever."""


class _ForkGuard:
    """Delays a fork until no touch is read or encoded.

    A fork copies the locks of the computing libraries in their current state. In the child nobody releases a lock that
    another thread held. Threads that computed must also be gone: a thread that Python has joined still returns its
    memory for a while, under an allocator's lock.
    """

    def __init__(self) -> None:
        self._idle, self._computing, self._threads = threading.Condition(), 0, set[int]()

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Mark a block during which no fork may happen."""
        with self._idle:
            self._computing += 1
            self._threads.add(threading.get_native_id())
        try:
            yield
        finally:
            with self._idle:
                self._computing -= 1
                self._idle.notify_all()

    def before(self) -> None:
        """Wait for computations to end, and block new ones until the fork is done."""
        self._idle.acquire()
        deadline = time.monotonic() + MAX_FORK_WAIT_S
        self._idle.wait_for(lambda: self._computing == 0, MAX_FORK_WAIT_S)
        alive = {thread.native_id for thread in threading.enumerate()}
        for ended in self._threads - alive:
            while os.path.exists(f"/proc/self/task/{ended}") and time.monotonic() < deadline:
                time.sleep(1e-3)
        self._threads &= alive

    def after_in_parent(self) -> None:
        """Let other threads continue."""
        self._idle.release()

    def after_in_child(self) -> None:
        """Reset the state: the child has no thread of the parent and computes nothing yet."""
        self._idle, self._computing, self._threads = threading.Condition(), 0, set()


_fork_guard = _ForkGuard()
os.register_at_fork(
    before=_fork_guard.before, after_in_parent=_fork_guard.after_in_parent, after_in_child=_fork_guard.after_in_child
)


class TouchReader:
    """Reads and encodes touches for a model."""

    def __init__(self, config: Config, encoder: TouchEncoder, compares_contact: bool = False) -> None:
        """Prepare a reader.

        Args:
            config: Settings of the model.
            encoder: Its touch encoder.
            compares_contact: Compare each touch with its no-contact frame to decide whether there is a contact.
        """
        self.encoder, self.fingers, self._preprocessing = encoder, config.matcher.fingers, config.preprocessing
        self.takes_background = compares_contact or self._preprocessing.background != "none"

    def no_contact_frames(self, background: Sequence[AnyImage] | None) -> Sequence[GelImage | None]:
        """Return the no-contact frame of each finger, None for a model that uses none.

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
        return [self._gel_image(frame, True) for frame in frames[0]]

    def encode(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[GelImage | None], clock: Stopwatch
    ) -> TouchEncodings:
        """Encode grasps in batches.

        Args:
            grasps: The images of each grasp.
            no_contact_frames: The no-contact frame of each finger, or None.
            clock: Times the stages "decode" and "encode".
        """
        parts, levels = [], []
        for start in range(0, len(grasps), BATCH):
            with clock("decode"):
                views = self._preprocessed(grasps[start : start + BATCH], no_contact_frames)
                levels += [[level for _, level in grasp] for grasp in views]
            with clock("encode"), _fork_guard.computing():
                parts.append(self.encoder.encode([[view for view, _ in grasp] for grasp in views]))
        partials, embeddings = (np.concatenate([part[place] for part in parts]) for place in (0, 1))
        readings = [part.readings for part in parts if part.readings is not None]
        return TouchEncodings(
            _finite(partials, "partial activation"),
            _finite(embeddings, "embedding"),
            np.concatenate(readings) if readings else None,
            None if no_contact_frames[0] is None else np.array(levels, dtype=np.float32),
        )

    def _preprocessed(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[GelImage | None]
    ) -> list[list[tuple[RgbImage, float]]]:
        """Return the preprocessed images of grasps, each with its difference from its no-contact frame (0 without one).

        The images are decoded in parallel. Of several bad ones, the first is reported. The threads end with the call,
        because a forked process would not have them.
        """
        subtracts = self._preprocessing.background != "none"
        for source in (source for grasp in grasps for source in grasp):
            # A Pillow image reads its file on the first access to its pixels, which two threads must not do at once.
            if isinstance(source.image, Image.Image):
                with suppress(Exception):  # `read` reports it
                    source.image.load()

        def view(source: InputImage, reference: GelImage | None) -> tuple[RgbImage, float]:
            with _fork_guard.computing():
                image = self._gel_image(source, reference is not None)
                if reference is None:
                    return self._preprocessing.touch(image.touch), 0.0
                level = contact_level(_blocks(image), _blocks(reference))
                return self._preprocessing.touch(image.touch, reference.touch if subtracts else None), level

        with ThreadPoolExecutor(DECODERS, "decode") as threads:
            jobs = [
                [threads.submit(view, source, frame) for source, frame in zip(grasp, no_contact_frames, strict=True)]
                for grasp in grasps
            ]
            return [[job.result() for job in grasp] for grasp in jobs]

    def _gel_image(self, source: InputImage, compares_contact: bool) -> GelImage:
        """Return an image at this model's sizes. Raises ImageError; IncompleteSearch if read for another model."""
        px = self._preprocessing.touch_px
        if not isinstance(source.image, GelImage):
            return GelImage.of(source.read(), px, compares_contact)
        if source.image.touch.shape != (px, px, 3):
            raise IncompleteSearch("an index of another model was opened in the meantime; repeat the query")
        return source.image


def _blocks(image: GelImage) -> RgbImage:
    if image.blocks is None:
        raise BadInput("a gel image was read without the blocks for the comparison with a no-contact frame")
    return image.blocks


def _finite(values: Floats, name: str) -> Floats:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise NumericalError(f"the {name} of touch {bad[0] + 1} contains a NaN or infinite number; use another model")
    return values
