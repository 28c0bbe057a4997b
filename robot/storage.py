"""Files of recordings: appended lines, PNG and JPEG content, JSON objects, and disk errors as StorageError."""

import contextlib
import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, wait
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from _touch_retrieval.files import open_regular
from _touch_retrieval.text import decode_text
from robot.errors import RecordingError, RobotError, StorageError

ImageSource = npt.NDArray[Any] | bytes | str | Path
"""Pixels, or the content or path of a PNG or JPEG file. Pixels: (H, W, 3) uint8 RGB; depth: (H, W) uint16."""

_SUFFIXES = {b"\x89PNG\r\n\x1a\n": ".png", b"\xff\xd8\xff": ".jpg"}


@contextlib.contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Convert each OSError into a StorageError that names the file or the folder."""
    try:
        yield
    except BlockingIOError as error:
        raise StorageError(f"{folder} is being written by another process; wait for it or stop it") from error
    except OSError as error:
        reason = (error.strerror or str(error)).removeprefix("cannot be written: ")
        raise StorageError(
            f"{error.filename or folder} could not be written: {reason}; earlier grasps are complete"
        ) from error


SYNC_THREADS = 8
"""Number of threads for `write_files`: about as many as a grasp has files."""


def write_files(contents: Mapping[Path, bytes], threads: Executor) -> None:
    """Write each file completely or leave it untouched: write a temporary file, sync it, then rename it.

    All files are written before the first is synced, and they are synced at the same time: the file system then writes
    its journal once, not file by file. The caller syncs the folder. An OSError names the file.
    """
    parts = {path: path.with_name(f"{path.name}.part") for path in contents}
    path: Path | None = None
    try:
        with contextlib.ExitStack() as files:
            opened = {}
            for path, data in contents.items():
                opened[path] = files.enter_context(open(parts[path], "wb"))
                opened[path].write(data)
                opened[path].flush()
            syncs = {path: threads.submit(os.fsync, file.fileno()) for path, file in opened.items()}
            wait(syncs.values())
            for path in syncs:
                syncs[path].result()
        for path, part in parts.items():
            os.replace(part, path)
    except BaseException as error:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
        if isinstance(error, OSError):  # the error of a write lacks the file name
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def complete_lines(content: bytes) -> bytes:
    """Return lines without an incomplete last one, which a crash leaves; a newline that is lacking is added."""
    last = content[content.rfind(b"\n") + 1 :]
    try:
        json.loads(last)
    except ValueError:
        return content.removesuffix(last)
    return content + b"\n"


class LineFile(contextlib.AbstractContextManager["LineFile"]):
    """A file of lines, locked while it is open; after a crash it contains complete lines only.

    Opening creates a missing file; it raises BlockingIOError if another process has it open.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o644), "r+b", buffering=0)
        try:
            open_regular(path).close()
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException:
            self._file.close()
            raise

    def read(self) -> bytes:
        """Return the complete lines."""
        self._file.seek(0)
        return complete_lines(self._file.read())

    def keep(self, size: int) -> None:
        """Cut the file off after the first `size` bytes of its lines; lines can be appended afterwards."""
        self._end = max(size - 1, 0)
        self._file.truncate(self._end)
        if size:
            self.append(b"")  # the newline, which the file may lack

    def append(self, line: bytes) -> None:
        """Write a line, sync the file; on failure, remove the partial line."""
        rest = data = line + b"\n"
        try:
            self._file.seek(self._end)
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except BaseException:
            with contextlib.suppress(OSError, ValueError):
                self._file.truncate(self._end)
            raise
        self._end += len(data)

    def close(self) -> None:
        """Close the file and release its lock; a second call does nothing."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def file_content(column: str, source: ImageSource) -> tuple[bytes, str]:
    """Return the file content and its suffix: pixels encoded as PNG, PNG and JPEG files unchanged.

    Args:
        column: The image column; "depth" requires uint16 pixels.
        source: The image.

    Raises:
        RecordingError: The source is neither valid pixels nor a PNG or JPEG file.
    """
    if isinstance(source, np.ndarray):
        import cv2

        colour = column != "depth"
        good = source.dtype == (np.uint8 if colour else np.uint16) and source.ndim > 1 and source.size > 0
        if not good or source.shape[2:] != ((3,) if colour else ()):
            shape = "H x W x 3 uint8 RGB" if colour else "H x W uint16 in millimetres"
            raise RecordingError(f"{column} must be {shape}, got {source.shape} {source.dtype}")
        pixels = np.ascontiguousarray(source)
        return cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if colour else pixels)[1].tobytes(), ".png"
    data = source if isinstance(source, bytes) else read_content(source, RecordingError)
    for magic, suffix in _SUFFIXES.items():
        if data.startswith(magic):
            return data, suffix
    raise RecordingError(f"{column} must be a PNG or JPEG file; its first bytes are {data[:4]!r}")


def decode_picture(data: bytes) -> npt.NDArray[np.uint8] | None:
    """Return (H, W, 3) RGB of an image file's content, transparent on white; None if it cannot be decoded.

    `retrieval.data.images.decode` returns the same for a picture of 8 bits.
    """
    import cv2
    from PIL import Image

    try:
        if not data.startswith(b"\xff\xd8"):  # not JPEG, which is opaque
            with Image.open(io.BytesIO(data)) as image:
                if image.has_transparency_data and not image.mode.startswith("I"):
                    return _on_white(image)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return None if pixels is None else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)
    except (cv2.error, OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # damaged, empty or too large
        return None


def _on_white(image: Any) -> npt.NDArray[np.uint8]:
    from PIL import ImageOps

    samples = np.asarray(ImageOps.exif_transpose(image).convert("RGBA"), np.float32) / 255
    rgb, alpha = samples[..., :3], samples[..., 3:]
    return np.rint(255 * (rgb * alpha + (1 - alpha))).astype(np.uint8)


def read_content(path: str | Path, error_type: type[RobotError]) -> bytes:
    """Return the bytes of a regular file; raise `error_type` with its name and the reason if it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read()
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise error_type(f"{path!s} cannot be read: {getattr(error, 'strerror', error)}") from error


def parse_object(text: bytes, error_type: type[RobotError], name: str = "it") -> dict[str, Any]:
    """Parse the JSON object of a line or file; raise `error_type` for anything else, NaN and infinity included."""
    try:
        return msgspec.json.decode(decode_text(text), type=dict[str, Any])
    except ValueError as error:
        raise error_type(f"{name} must be one JSON object in UTF-8, without NaN and Infinity: {error}") from error


def read_json_object(path: str | Path, error_type: type[RobotError]) -> dict[str, Any]:
    """Read the JSON object of a file; raise `error_type` with the file's name if this fails."""
    return parse_object(read_content(path, error_type), error_type, str(path))
