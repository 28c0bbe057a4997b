"""Pictures as PNG or JPEG content, appended lines, and refusals of the disk as errors of `robot`."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from io import FileIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from _touch_retrieval.files import open_regular
from robot.errors import RecordingError, RobotError, StorageError

PART_SUFFIX = ".part"
ImageSource = npt.NDArray[Any] | bytes | str | Path
"""Pixels, or the content or path of a PNG or JPEG file. Pixels: (H, W, 3) uint8 RGB; depth: (H, W) uint16."""

_SUFFIXES = {b"\x89PNG\r\n\x1a\n": ".png", b"\xff\xd8\xff": ".jpg"}


@contextlib.contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Turn what the disk refuses into a StorageError that names the file, or the folder."""
    try:
        yield
    except BlockingIOError as error:
        raise StorageError(f"{folder} is being written by another process; wait for it or stop it") from error
    except OSError as error:
        reason = (error.strerror or str(error)).removeprefix("cannot be written: ")
        where = error.filename or folder
        raise StorageError(f"{where} could not be written: {reason}; what was appended before is whole") from error


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write each file so that it holds all of its bytes or is untouched; sync their folder then, and their names last.

    The disk is asked to keep them when all are written: it takes fewer turns for it than file by file.
    """
    parts = {path: path.with_name(path.name + PART_SUFFIX) for path in contents}
    path: Path | None = None
    try:
        with contextlib.ExitStack() as files:
            opened = {}
            for path, data in contents.items():
                opened[path] = files.enter_context(open(parts[path], "wb"))
                opened[path].write(data)
                opened[path].flush()
            for path in contents:
                os.fsync(opened[path].fileno())
        for path, part in parts.items():
            os.replace(part, path)
    except BaseException as error:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
        if isinstance(error, OSError):  # a write alone does not tell its file
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def append_line(file: FileIO, end: int, line: bytes) -> int:
    """Write `line` at offset `end` and sync it; returns the new end. Whatever fails, no half of the line stays."""
    rest = line
    try:
        file.seek(end)
        while rest:
            rest = rest[file.write(rest) :]
        os.fsync(file.fileno())
    except BaseException:
        with contextlib.suppress(OSError, ValueError):
            file.truncate(end)
        raise
    return end + len(line)


def file_content(column: str, source: ImageSource) -> tuple[bytes, str]:
    """Return (file content, suffix): pixels as PNG, a file's own bytes as they are. Raises RecordingError."""
    if isinstance(source, np.ndarray):
        return _png(column, source), ".png"
    if not isinstance(source, bytes | str | Path):
        raise RecordingError(
            f"{column} must be pixels as a NumPy array, or the bytes or the path of a PNG or JPEG file; got "
            f"{type(source).__name__}"
        )
    try:
        data = source if isinstance(source, bytes) else read_content(source, RecordingError)
    except RecordingError as error:
        raise RecordingError(f"{column}: {error}") from error
    for magic, suffix in _SUFFIXES.items():
        if data.startswith(magic):
            return data, suffix
    raise RecordingError(f"{column} must be a PNG or JPEG file; its first bytes are {data[:4]!r}")


def decode_picture(data: bytes, flags: int | None = None) -> npt.NDArray[Any] | None:
    """The pixels of a picture file's content, colours blue first; None for what is no picture. way: as cv2.imdecode
    takes it, colours with 8 bits each where it is left out.
    """
    import cv2

    pixels: npt.NDArray[Any] | None = None
    with contextlib.suppress(cv2.error):  # of no bytes at all, and of a header that claims too many pixels
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR if flags is None else flags)
    return pixels


def read_content(path: str | Path, error_type: type[RobotError]) -> bytes:
    """The bytes of a regular file. Raises `error_type`, which names it and what keeps it from being read."""
    try:
        with open_regular(path) as file:
            return file.read()
    except (OSError, ValueError) as error:  # ValueError of a name that holds a zero
        raise error_type(f"{path!s} cannot be read: {getattr(error, 'strerror', error)}") from error


def parse_object(text: bytes, error_type: type[RobotError]) -> dict[str, Any]:
    """The JSON object of a line or file. Raises `error_type` for anything else, NaN and infinity too."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.ValidationError as error:
        raise error_type(f"must be one JSON object in braces, of finite numbers: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise error_type(f"must be JSON in UTF-8, without NaN and Infinity: {error}") from error


def read_json_object(path: str | Path, error_type: type[RobotError]) -> dict[str, Any]:
    """The JSON object that a file holds. Raises `error_type`, which names the file."""
    data = read_content(path, error_type)
    try:
        return parse_object(data, error_type)
    except RobotError as error:
        raise error_type(f"{path}: {error}") from error


def _png(column: str, pixels: npt.NDArray[Any]) -> bytes:
    import cv2

    colour = column != "depth"
    good = pixels.dtype == (np.uint8 if colour else np.uint16) and pixels.size > 0
    if not good or (pixels.ndim != 3 or pixels.shape[2] != 3 if colour else pixels.ndim != 2):
        shape = "H x W x 3 uint8 RGB" if colour else "H x W uint16 in millimetre"
        raise RecordingError(f"{column} must be {shape}, got {pixels.shape} {pixels.dtype}")
    try:
        plain = np.ascontiguousarray(pixels)
        done, data = cv2.imencode(".png", cv2.cvtColor(plain, cv2.COLOR_RGB2BGR) if colour else plain)
    except cv2.error:
        done = False
    if not done:
        raise RecordingError(f"{column} cannot be written as PNG; its shape is {pixels.shape}")
    return data.tobytes()
