"""Messages of ROS bags, read one by one with the package rosbags: ROS 1, and ROS 2 with SQLite or MCAP files."""

import contextlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.importing import import_extra, natural_sort_key

SUFFIXES = (".bag", ".mcap", ".db3")
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_METADATA = "metadata.yaml"
_WHAT = "a ROS bag"
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def bag_paths(source: Path) -> list[Path]:
    """Return the bags of a source, in natural order: the source itself, or those in the folder.

    A folder with metadata.yaml, or within `source` one with .mcap or .db3 files, is one ROS 2 bag.
    """
    if source.is_file() or (source / _METADATA).is_file():
        return [source]
    inside = sorted(source.iterdir(), key=lambda path: natural_sort_key(path.name)) if source.is_dir() else []
    return [path for path in inside if (path.suffix in SUFFIXES if path.is_file() else _is_bag_folder(path))]


def _is_bag_folder(path: Path) -> bool:
    return (path / _METADATA).is_file() or bool(_storage_files(path))


def _storage_files(path: Path) -> list[Path]:
    """Return the files of a bag with messages, in natural order."""
    if path.is_file():
        return [path]
    files = (file for file in path.iterdir() if file.is_file() and file.suffix in SUFFIXES[1:])
    return sorted(files, key=lambda file: natural_sort_key(file.name))


class BagMessage(NamedTuple):
    """A message that is not yet decoded.

    Attributes:
        topic: Its topic.
        time_ns: When the bag recorded it.
        decode: Returns the message.
    """

    topic: str
    time_ns: int
    decode: Callable[[], Any]


class Bag(contextlib.AbstractContextManager["Bag"]):
    """An open bag.

    Attributes:
        name: File name without its suffix.
        topics: Topic -> message type, such as "std_msgs/msg/Bool".
        is_cut_off: Whether its end is missing or damaged. This may only be known after its messages were read.
    """

    def __init__(self, path: Path) -> None:
        """Open the bag.

        Args:
            path: .bag, .mcap or .db3 file, or folder of a ROS 2 bag.

        Raises:
            ImporterError: The package rosbags is missing, or the bag has no whole message.
        """
        self.name = path.stem if path.is_file() else path.name
        self.is_cut_off = False
        self._reader = self._open(path)
        self.topics = {connection.topic: connection.msgtype for connection in self._reader.connections}

    def _open(self, path: Path) -> Any:
        any_reader = import_extra("rosbags.highlevel", _WHAT).AnyReader
        typesys = import_extra("rosbags.typesys", _WHAT)
        types = typesys.get_typestore(typesys.Stores.LATEST)  # for older bags, which do not contain their definitions
        try:
            reader = any_reader([path], default_typestore=types)
            reader.open()
            return reader
        except Exception:  # rosbags raises many types for damaged files
            files = _storage_files(path)
        try:
            reader = any_reader(files, default_typestore=types)
            reader.readers = [self._reader_of(file) for file in files]
            reader.open()
        except Exception as error:
            raise ImporterError(f"its bag cannot be read: {error}") from error
        return reader

    def _reader_of(self, file: Path) -> Any:
        """Return the usual reader, or the one for files that are cut off."""
        name = "rosbags.rosbag1" if file.suffix == ".bag" else "rosbags.rosbag2"
        reader = import_extra(name, _WHAT).Reader(file)
        try:
            with reader:
                return reader
        except Exception:
            from robot.importers.cut_off_bags import cut_off_reader

            self.is_cut_off = True
            return cut_off_reader(file)

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order in which they were recorded, up to the first damaged one."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        try:
            for connection, time_ns, data in self._reader.messages(connections):
                yield BagMessage(connection.topic, time_ns, self._decoder(data, connection))
        except Exception:
            self.is_cut_off = True

    def _decoder(self, data: bytes, connection: Any) -> Callable[[], Any]:
        def decode() -> Any:
            try:
                return self._reader.deserialize(data, connection.msgtype)
            except Exception as error:
                raise ImporterError(f"a message of {connection.topic} cannot be decoded: {error}") from error

        return decode

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._reader.close()


def picture_of(message: Any) -> NDArray[np.uint8] | bytes:
    """Return the picture of an image message.

    Args:
        message: A sensor_msgs/Image or sensor_msgs/CompressedImage, as rosbags or rclpy returns it.

    Returns:
        (H, W, 3) red first, or the content of the PNG or JPEG file.

    Raises:
        ImporterError: The encoding is not supported, or bytes are missing.
    """
    if not hasattr(message, "encoding"):
        return bytes(message.data)
    if message.encoding not in _CHANNELS:
        raise ImporterError(f"the encoding of its images must be {', '.join(_CHANNELS)}, got {message.encoding!r}")
    channels = _CHANNELS[message.encoding]
    data = np.frombuffer(message.data, np.uint8)  # rclpy: array.array
    if data.size != message.height * message.step or message.step < message.width * channels:
        raise ImporterError(
            f"an image of {message.height} x {message.width} pixels has {data.size} bytes, {message.step} in a row"
        )
    rows = data.reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    return pixels if message.encoding == "rgb8" else pixels[..., ::-1]


def stamp_ns(message: Any, recorded_ns: int) -> int:
    """Return the time stamp of a message's header in nanoseconds, or when it was recorded if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return recorded_ns if stamp is None else (stamp.sec * 10**9 + stamp.nanosec) or recorded_ns
