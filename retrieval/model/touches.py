"""Gel images however they are given, and what the matcher makes of them: halves, embeddings and readings.

Files, bytes, Pillow images or arrays, one grasp or several.

How deep the lists are nested says what is meant, so nothing is guessed:

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
"""A path (text is one), the bytes of a file, a Pillow image, an array (H, W, 3) uint8, red first, or a gel image that
another process read."""
AnyTouches: TypeAlias = AnyImage | Sequence[AnyImage] | Sequence[Sequence[AnyImage]]
"""One grasp or several, as the text above says. An array of 4 or 5 axes is a list of those below it."""

_IMAGE_TYPES = "a path, the bytes of a file, a Pillow image or a uint8 array (height, width, 3)"
_NESTING_HINT = "one grasp is a list with an image for each finger, several grasps are a list of such lists"


@dataclass(frozen=True, eq=False)
class InputImage:
    """An image as it was given, not read yet. name: how answers and messages call it, a file by its path."""

    image: AnyImage
    name: str

    def read(self) -> RgbImage:
        """(H, W, 3) float32 RGB in 0..1; the same numbers however a picture is given. Raises ImageError."""
        return read_image(self.image, self.name)


def read_image(image: AnyImage, name: str) -> RgbImage:
    """An image however it is given as (H, W, 3) float32 RGB in 0..1; `name` stands for it where it is no file.

    Raises ImageError. Arrays must be uint8: of other types the range would have to be guessed.
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
            f"an array must hold uint8 samples in 0..255, got {image.dtype}; make them of samples in 0..1 by "
            "np.rint(255 * image).astype(np.uint8)",
        )
    if image.ndim != 3 or image.shape[2] != 3:
        raise ImageError(
            name,
            f"an array must be (height, width, 3), red first, got {image.shape}; repeat a grey image by "
            "np.stack([image] * 3, axis=-1), leave an alpha channel out, and put channels last",
        )
    check_pixels((image.shape[1], image.shape[0]), name)
    return np.ascontiguousarray(to_float(np.asarray(image)))


def parse_grasps(given: AnyTouches, fingers: int, *, what: str = "touch", of: str = "") -> list[list[InputImage]]:
    """The grasps in what was given for one object, each with an image for each finger; no image is read.

    what: how one grasp is called in messages. of: what they begin with, such as "object 3, ". Raises BadInput where
    the nesting or the number of images is not as the text above says.
    """
    if _is_image(given):
        grasps: list[list[Any]] = [[given]]
    else:
        items = _items(given, of)
        images = [_is_image(item) for item in items]
        if any(images) and not all(images):
            raise BadInput(f"{of}images and lists of images stand side by side; {_NESTING_HINT}")
        grasps = [items] if any(images) else [_items(item, of) for item in items]
    if wrong := [image for grasp in grasps for image in grasp if not _is_image(image)]:
        raise BadInput(
            f"{of}an image must be {_IMAGE_TYPES}, got {type(wrong[0]).__name__}; {_NESTING_HINT}; several objects go to "
            "query_many"
        )
    if not grasps:
        raise BadInput(f"{of}give at least one {what}: {_NESTING_HINT}")
    named = [
        [InputImage(image, _name(image, f"{of}grasp {g}, finger", f)) for f, image in enumerate(grasp)]
        for g, grasp in enumerate(grasps, start=1)
    ]
    for grasp in named:
        if len(grasp) != fingers:
            raise BadInput(
                f"{of}this model takes {fingers} gel image(s) for one {what}; got {len(grasp)}: "
                f"{', '.join(image.name for image in grasp)} ({_NESTING_HINT}; on the command line each grasp has a "
                "--gelsight of its own)"
            )
    return named


def _is_image(item: object) -> bool:
    if isinstance(item, np.ndarray):
        return item.ndim <= 3
    return isinstance(item, str | os.PathLike | bytes | bytearray | memoryview | Image.Image | GelImage)


def _items(given: object, of: str) -> list[Any]:
    if isinstance(given, Sequence | np.ndarray):
        return list(given)
    raise BadInput(f"{of}an image must be {_IMAGE_TYPES}, got {type(given).__name__}; {_NESTING_HINT}")


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
"""Grasps whose images are in memory, and in the encoder, at once."""
DECODERS = 2  # a touch has as many images
Floats = NDArray[np.float32]


class TouchEncodings(NamedTuple):
    """What is made of G grasps, float32: halves (G, half), embeddings (G, embedding_dim), and what tells whether they
    are touches: readings (G, fingers, 2) of a model with a gel head, levels (G, fingers) of grey by which images differ
    from their no-contact frames, where these were given (`retrieval.model.fusion_scorer`).
    """

    partials: Floats
    embeddings: Floats
    readings: Floats | None = None
    levels: Floats | None = None


class TouchEncoder(Protocol):
    """What makes codes of touches: PyTorch or ONNX Runtime."""

    @property
    def name(self) -> str:
        """How it is called in the answer."""

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchEncodings:
        """Encode grasps, each its fingers' images."""


class EncodedTouches(NamedTuple):
    """What the matcher keeps of images, a row each: unit `embeddings` (N, embedding_dim), by which candidates are
    found, and `partials` (N, half), by which it judges pairs. float32.

    >>> with retrieval.open("index") as searcher:
    ...     embeddings, partials = searcher.encode([["a.png", "b.png"], ["a2.png", "b2.png"]])
    >>> len(embeddings), len(partials), embeddings.dtype.name
    (2, 2, 'float32')
    """

    embeddings: Floats
    partials: Floats


class Stopwatch:
    """Milliseconds of named stages and in total."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.add({stage: 1e3 * (time.perf_counter() - start)})

    def add(self, timing_ms: Mapping[str, float]) -> None:
        """Count stages that another watch took."""
        for stage, ms in timing_ms.items():
            self._stages[stage] = self._stages.get(stage, 0.0) + ms

    def finish(self, shares: int) -> dict[str, float]:
        """One of so many equal shares: of the stages in their order, and of "total" since it was made."""
        everything = {**self._stages, "total": 1e3 * (time.perf_counter() - self._start)}
        return {stage: ms / shares for stage, ms in everything.items()}


MAX_FORK_WAIT_S = 10.0
"""For computations to end before a fork; one that is forked all the same may wait for a lock for ever."""


class _ForkGuard:
    """A fork copies the locks of the libraries that compute as they are, and nobody in it opens one that another thread
    held. So a process that forks waits until no touch is read or encoded, and until threads that did so are gone: one
    that Python has joined still gives back its memory for a while, under an allocator's lock.
    """

    def __init__(self) -> None:
        self._idle, self._computing, self._threads = threading.Condition(), 0, set[int]()

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Around what a fork must not come between."""
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
        """Wait, and keep others from beginning until the fork is made."""
        self._idle.acquire()
        deadline = time.monotonic() + MAX_FORK_WAIT_S
        self._idle.wait_for(lambda: self._computing == 0, MAX_FORK_WAIT_S)
        alive = {thread.native_id for thread in threading.enumerate()}
        for ended in self._threads - alive:
            while os.path.exists(f"/proc/self/task/{ended}") and time.monotonic() < deadline:
                time.sleep(1e-3)
        self._threads &= alive

    def after_in_parent(self) -> None:
        """Let other threads go on."""
        self._idle.release()

    def after_in_child(self) -> None:
        """Begin anew: no thread of the parent is here, and nothing is computed yet."""
        self._idle, self._computing, self._threads = threading.Condition(), 0, set()


_fork_guard = _ForkGuard()
os.register_at_fork(
    before=_fork_guard.before, after_in_parent=_fork_guard.after_in_parent, after_in_child=_fork_guard.after_in_child
)


class TouchReader:
    """Reads and encodes the touches of a model."""

    def __init__(self, config: Config, encoder: TouchEncoder, compares_contact: bool = False) -> None:
        """compares: whether a touch is compared with its no-contact frame, to see if there is a contact."""
        self.encoder, self.fingers, self._compares_contact = encoder, config.matcher.fingers, compares_contact
        self._preprocessing = config.preprocessing

    def no_contact_frames(self, background: Sequence[AnyImage] | None) -> Sequence[GelImage | None]:
        """The no-contact frame of each finger, None for a model that looks at no such frame. Raises BadInput for one
        that is missing, and for one that would not be looked at.
        """
        policy = self._preprocessing.background
        if background is None and policy != "none":
            raise BadInput(
                f'this model subtracts the untouched gel (background = "{policy}"): give a no-contact frame for each '
                "finger with --background"
            )
        if background is None:
            return [None] * self.fingers
        if policy == "none" and not self._compares_contact:
            raise BadInput("this model takes gel images as they are and would not look at --background; leave it out")
        frames = parse_grasps(background, self.fingers, what="background")
        if len(frames) != 1:
            raise BadInput(f"give one background, with a no-contact frame for each finger; got {len(frames)}")
        return [self._gel_image(frame, True) for frame in frames[0]]

    def encode(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[GelImage | None], clock: Stopwatch
    ) -> TouchEncodings:
        """The codes of grasps, made in batches; the clock counts the stages "decode" and "encode". references: the
        no-contact frame of each finger, or None.
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
            _finite(partials, "partial"),
            _finite(embeddings, "embedding"),
            np.concatenate(readings) if readings else None,
            None if no_contact_frames[0] is None else np.array(levels, dtype=np.float32),
        )

    def _preprocessed(
        self, grasps: Sequence[Sequence[InputImage]], no_contact_frames: Sequence[GelImage | None]
    ) -> list[list[tuple[RgbImage, float]]]:
        """The images of grasps as the tower sees them, and how far each is from its no-contact frame (0 without one);
        made side by side; of several bad ones the first is told.

        The threads end with the call, for a fork of the process would not have them.
        """
        subtracts = self._preprocessing.background != "none"
        for given in (given for grasp in grasps for given in grasp):
            # A Pillow image reads its file when it is first asked for pixels, which two threads must not do at once.
            if isinstance(given.image, Image.Image):
                with suppress(Exception):  # told by `read`
                    given.image.load()

        def view(given: InputImage, reference: GelImage | None) -> tuple[RgbImage, float]:
            with _fork_guard.computing():
                image = self._gel_image(given, reference is not None)
                if reference is None:
                    return self._preprocessing.touch(image.touch), 0.0
                level = contact_level(_blocks(image), _blocks(reference))
                return self._preprocessing.touch(image.touch, reference.touch if subtracts else None), level

        with ThreadPoolExecutor(DECODERS, "decode") as threads:
            jobs = [
                [threads.submit(view, given, frame) for given, frame in zip(grasp, no_contact_frames, strict=True)]
                for grasp in grasps
            ]
            return [[job.result() for job in grasp] for grasp in jobs]

    def _gel_image(self, given: InputImage, compares_contact: bool) -> GelImage:
        """An image at the sizes of this model. compares: with a no-contact frame. Raises ImageError, and IncompleteSearch for
        one that was read for another model.
        """
        px = self._preprocessing.touch_px
        if not isinstance(given.image, GelImage):
            return GelImage.of(given.read(), px, compares_contact)
        if given.image.touch.shape != (px, px, 3):
            raise IncompleteSearch("an index of another model was opened meanwhile; ask again")
        return given.image


def _blocks(image: GelImage) -> RgbImage:
    if image.blocks is None:
        raise BadInput("a gel image was read without the blocks that are compared with a no-contact frame")
    return image.blocks


def _finite(values: Floats, name: str) -> Floats:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise NumericalError(f"the {name} of touch {bad[0] + 1} holds a NaN or infinite number; the model is unfit")
    return values
