"""Bags like those of a lab, written by the package rosbags: a ROS 1 bag, and ROS 2 bags with SQLite and MCAP files.

Each has two gels at 20 Hz, a camera at 10 Hz and a gripper, 4 s long, with two grasps: gel images 20 to 29 and 50 to
65. The strongest contact is in images 27 and 61. Gel b is recorded 10 ms after gel a, the camera 20 ms after gel a.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

GRASPS = 6
PEAKS = (27, 58)
CONTACTS = ((20, 30), (50, 66))
FRAMES, INTERVAL_NS, START_NS = 80, 50_000_000, 1_700_000_000 * 10**9
GEL_A, GEL_B, CAMERA = "/gel/a", "/gel/b", "/camera/color"
GRIPPER, GRASP, OBJECT = "/gripper/state", "/grasp", "/object"

Message = tuple[int, str, str, dict[str, Any]]
"""Time of recording in ns, topic, short type such as "std_msgs/Bool", fields besides the header."""


def gel(finger: str, number: int) -> Any:
    """Return (12, 16, 3) uint8: images differ by up to 4 grey levels, and in contact by a bright square."""
    image = np.full((12, 16, 3), (60 if finger == "a" else 90) + number % 5, np.uint8)
    for (start, stop), peak in zip(CONTACTS, PEAKS, strict=True):
        if start <= number < stop:
            image[2:9, 3:12] += np.uint8(150 - 13 * abs(number - peak))
    return image


def photo(number: int) -> Any:
    """Return (12, 16, 3) uint8, red first; the number of the image is its red."""
    image = np.full((12, 16, 3), (0, 40, 80), np.uint8)
    image[..., 0] = number
    return image


def messages() -> Iterator[Message]:
    """Yield the messages of a bag in order of time."""
    for number in range(FRAMES):
        time_ns = START_NS + number * INTERVAL_NS
        yield time_ns, GEL_A, "sensor_msgs/Image", image_fields(gel("a", number)[..., ::-1], "bgr8")
        joints = {"name": ["left", "right"], "position": np.full(2, 0.001 * number)}
        joints |= {"velocity": np.array([]), "effort": np.array([-4.0, 6.0])}
        yield time_ns, GRIPPER, "sensor_msgs/JointState", joints
        yield time_ns + 10_000_000, GEL_B, "sensor_msgs/Image", image_fields(gel("b", number)[..., :1], "mono8")
        if number % 2 == 0:
            yield time_ns + 20_000_000, CAMERA, "sensor_msgs/CompressedImage", png_fields(photo(number))


def image_fields(image: Any, encoding: str) -> dict[str, Any]:
    """Return the fields of an Image whose rows end with 3 unused bytes."""
    height, width, channels = image.shape
    rows = np.pad(image.reshape(height, width * channels), ((0, 0), (0, 3)))
    fields = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": rows.shape[1]}
    return {**fields, "data": rows.ravel()}


def png_fields(image: Any) -> dict[str, Any]:
    return {"format": "png", "data": np.frombuffer(cv2.imencode(".png", image[..., ::-1])[1].tobytes(), np.uint8)}


def write_bag(path: Path, content: Iterable[Message], chunk_bytes: int = 20_000) -> Path:
    """Write a bag: ROS 1 if the name ends in .bag, else a folder with an .mcap (if the name begins so) or .db3 file."""
    is_ros1 = path.suffix == ".bag"
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if path.name.startswith("mcap") else StoragePlugin.SQLITE3
    writer: Any = Rosbag1Writer(path) if is_ros1 else Rosbag2Writer(path, version=9, storage_plugin=plugin)
    if is_ros1:
        writer.chunk_threshold = chunk_bytes
    serialize = types.serialize_ros1 if is_ros1 else types.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for time_ns, topic, short, fields in content:
            kind = short.replace("/", "/msg/")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            message = types.types[kind](**_with_header(types, kind, time_ns, fields))
            writer.write(connections[topic], time_ns, serialize(message, kind))
            if path.name.startswith("mcap") and writer.storage.chunk.bio.tell() > chunk_bytes:
                writer.storage.close_chunk()
    return path


def _with_header(types: Any, kind: str, time_ns: int, fields: dict[str, Any]) -> dict[str, Any]:
    """Add a header to the types that have one."""
    if kind.startswith("std_msgs"):
        return fields
    stamp = types.types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    header = types.types["std_msgs/msg/Header"]
    of_ros1 = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    return {"header": header(**of_ros1, stamp=stamp, frame_id=""), **fields}


def write(folder: Path) -> None:
    folder.mkdir()
    for name in ("mug.bag", "tin", "mcap_pen"):
        write_bag(folder / name, messages())
