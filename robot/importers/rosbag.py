"""ROS bags of a lab: gel images, camera and gripper as topics of ROS 1 bags and ROS 2 bags (SQLite, MCAP).

    <name>.bag                                        ROS 1
    <name>/metadata.yaml    <name>/<name>_0.mcap      ROS 2, or .db3 (SQLite)
    <name>.mcap             <name>.db3                ROS 2, a file without its folder

The package rosbags (extra `importers`) reads them without ROS. The source is a bag or a folder of bags. Decompress a
file that was compressed without its folder first (`zstd -d`). A bag is a sequence; with a topic of names (`object`) the
grasps of one object in a bag are. The options name its topics; `touch_b` is empty for a sensor with one finger. Images
are sensor_msgs/Image (rgb8, bgr8, mono8, rgba8, bgra8) or CompressedImage, whose files are stored unchanged.

A grasp lasts while the gel of any finger differs from the first usable image of its bag (black, dim or blue first
images of a camera are left out and counted) over the fraction `contact` of its area, by the rule of the contact-area
gate. If a topic marks the grasps, the option `grasp` names it (std_msgs/Bool, true while a grasp is held), and its
marks decide instead. Interruptions shorter than `settle_s` are ignored, and then grasps shorter than it. The touch is
the gel image with the strongest change in the grasp, the photo the last camera image before it began, and the
no-contact frame the gel image in the middle between the previous grasp and this one. Messages are ordered by the times
at which the bag recorded them.

`object` names a topic with the name of the object (std_msgs/String); without it the bag's name is the object. `gripper`
names a sensor_msgs/JointState: the sum of positions, in metre, is the opening, and the mean absolute effort, in newton,
the force.

Repair a bag whose recording was cut off before you import it: `rosbag reindex` (ROS 1), `mcap recover` (MCAP).
"""

import contextlib
import re
from array import array
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from string import ascii_lowercase
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import NonNegative, typed
from _touch_retrieval.names import is_system_name
from robot.errors import ImporterError
from robot.extras import import_extra
from robot.grasping.gates import ContactAreaGate, GraspFrames
from robot.importers.episodes import NO_USABLE_FRAME, first_usable, thumbnail
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    Source,
    import_items,
    numbered_files,
)
from robot.recording.folder import Recording, safe_name
from robot.storage import decode_picture

DATA_SET = DataSet(
    source="ROS bags",
    licence="set by you",
    citation="set by you",
    sensor="set by you",
    rig="see the bags",
    expects="`<name>.bag`, `<name>.mcap`, `<name>.db3` or folders of ROS 2 bags, or be a bag itself",
    fingers=0,
    background="between the previous grasp and each grasp",
    caveats=(
        "Without a topic of marks, a bag must begin without contact, and a change of light can count as contact.",
        "Without a topic of names, a bag counts as one object.",
        "Times are those at which the bag recorded the messages: a slow topic gets older images.",
    ),
)
_Contact = Annotated[float, Meta(gt=0, le=1)]
_SUFFIXES = (".bag", ".mcap", ".db3")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_RGB_OF = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "mono8": [0, 0, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0]}
"""Channels of red, green and blue in each encoding."""
_REPAIR = (
    "if its recording was cut off, repair it: rosbag reindex (ROS 1), mcap recover (MCAP), ros2 bag reindex (folder); "
    "if the file is compressed, decompress it: zstd -d"
)


def import_rosbag(
    src: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    touch_a: str = "/gel/a",
    touch_b: str = "/gel/b",
    photo: str = "/camera/color",
    gripper: str = "",
    grasp: str = "",
    object: str = "",
    contact: float = 0.01,
    settle_s: float = 0.2,
    sensor: str = "unknown",
    licence: str = NOT_STATED,
) -> Recording:
    """Import the grasps of the bag `src`, or of the bags in the folder `src`.

    Raises:
        ImporterError: There is no bag, rosbags is missing, or no bag can be read.
    """
    typed(contact, _Contact, "contact", error=ImporterError)
    typed(settle_s, NonNegative, "settle_s", error=ImporterError)
    paths = _bag_paths(src)
    if not paths:
        raise DATA_SET.mismatch_error(src, "there is no such bag")
    import_extra("rosbags", "a ROS bag")
    topics = _Topics(tuple(filter(None, (touch_a, touch_b))), photo, gripper, grasp, object)
    scans: dict[Path, _Scan] = {}
    skips: list[Skip] = []
    for path in paths:
        try:
            with Bag(path) as bag:
                scans[path] = _scan_bag(bag, topics)
        except ImporterError as error:
            skips.append(Skip(str(error), path.name))
    if not scans:
        raise ImporterError(f"{paths[0]}: {skips[0].reason}")
    grasps = {path: _find_grasps(scan, topics, contact, settle_s) for path, scan in scans.items()}
    lost = sum(scan.unreadable for scan in scans.values())
    facts = replace(
        DATA_SET,
        fingers=len(topics.touch),
        sensor=sensor,
        licence=licence,
        caveats=(*([f"{lost} gel image(s) cannot be decoded, or differ in size"] if lost else []), *DATA_SET.caveats),
    )
    start_ns = min(scan.first_ns for scan in scans.values())
    items = (item for path, scan in scans.items() for item in _items(path, scan, grasps[path], topics, start_ns))
    total = len(skips) + sum(map(len, grasps.values()))
    return import_items(
        facts,
        chain(skips, items),
        out,
        total=total,
        progress=progress,
        source=src,
        options={
            "touch_a": touch_a,
            "touch_b": touch_b,
            "photo": photo,
            "gripper": gripper,
            "grasp": grasp,
            "object": object,
            "contact": contact,
            "settle_s": settle_s,
            "sensor": sensor,
            "licence": licence,
        },
    )


def _bag_paths(source: Path) -> list[Path]:
    """Return the bags of a source, in natural order: the source itself, or those in the folder.

    A folder with metadata.yaml, or within `source` one with files of ROS 2 bags, is one ROS 2 bag.
    """
    if source.is_file() or _has_metadata(source):
        return [source]
    inside = [path for _, path in numbered_files(source, re.compile(".*", re.DOTALL)) if not is_system_name(path.name)]
    return [path for path in inside if (_is_bag(path) if path.is_file() else bool(_storage_files(path)))]


def _has_metadata(folder: Path) -> bool:
    """Whether a folder has the metadata.yaml of a ROS 2 bag; a crash, or a repair, can leave it without the storage."""
    path = folder / "metadata.yaml"
    return path.is_file() and bool(re.search(rb"storage_identifier: *[\"']?\w", path.read_bytes()))


def _storage_files(path: Path) -> list[Path]:
    """Return the files of a bag with messages, in natural order."""
    if path.is_file():
        return [path]
    inside = (file for _, file in numbered_files(path, re.compile(".*", re.DOTALL)) if file.is_file())
    return [file for file in inside if _is_bag(file) and ".bag" not in file.suffixes]


def _is_bag(path: Path) -> bool:
    """Whether a file is named like a bag; one that rosbags cannot read, such as a compressed one, is reported."""
    return not set(_SUFFIXES).isdisjoint(path.suffixes)


class Bag(contextlib.AbstractContextManager["Bag"]):
    """An open bag: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.

    Attributes:
        name: File name without its suffix.
        topics: Topic -> message type, such as "std_msgs/msg/Bool".

    Raises:
        ImporterError: The package rosbags is missing, or the bag is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.stem if path.is_file() else path.name
        reader = import_extra("rosbags.highlevel", "a ROS bag").AnyReader
        types = import_extra("rosbags.typesys", "a ROS bag")
        files = [path] if path.is_dir() and _has_metadata(path) else _storage_files(path)
        for file in _storage_files(path):
            log = file.with_name(f"{file.name}-wal")
            if log.is_file() and log.stat().st_size:
                raise ImporterError(
                    f"its bag is incomplete: a crash left messages in {log.name}; add them: sqlite3 {file.name} "
                    "'PRAGMA wal_checkpoint(TRUNCATE)'"
                )
        try:
            # The types are for older bags, which do not contain their definitions.
            self._reader = reader(files, default_typestore=types.get_typestore(types.Stores.LATEST))
            self._reader.open()
        except Exception as error:  # rosbags raises many types for damaged files
            raise ImporterError(f"its bag cannot be read: {error}; {_REPAIR}") from error
        self.topics = {connection.topic: connection.msgtype for connection in self._reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Yield topic, time in ns and decoder of the messages of some topics, in the order of recording."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        try:
            for connection, time_ns, data in self._reader.messages(connections):
                yield connection.topic, time_ns, partial(self._decode, data, connection)
        except Exception as error:
            raise ImporterError(f"its bag is damaged: {error}; {_REPAIR}") from error

    def _decode(self, data: bytes, connection: Any) -> Any:
        try:
            return self._reader.deserialize(data, connection.msgtype)
        except Exception as error:
            raise ImporterError(f"a message of {connection.topic} cannot be decoded: {error}") from error

    def __exit__(self, *_: object) -> None:
        self._reader.close()


def picture_of(message: Any) -> NDArray[np.uint8] | bytes:
    """Return (H, W, 3) RGB of a sensor_msgs/Image, or the file in a CompressedImage, of rosbags or rclpy.

    Raises:
        ImporterError: The encoding is not supported, or bytes are missing.
    """
    if not hasattr(message, "encoding"):
        return bytes(message.data)
    if message.encoding not in _RGB_OF:
        raise ImporterError(f"the encoding of its images must be {', '.join(_RGB_OF)}, got {message.encoding!r}")
    red_green_blue = _RGB_OF[message.encoding]
    channels = 4 if "a8" in message.encoding else len(set(red_green_blue))
    data = np.frombuffer(message.data, np.uint8)  # rclpy: array.array
    if data.size != message.height * message.step or message.step < message.width * channels:
        raise ImporterError(
            f"an image of {message.height} x {message.width} pixels has {data.size} bytes, {message.step} in a row"
        )
    rows = data.reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return pixels[..., red_green_blue]


@dataclass(frozen=True)
class _Topics:
    """Topics of the options; `touch` has one per finger, the others are empty if not used."""

    touch: tuple[str, ...]
    photo: str
    gripper: str
    grasp: str
    object: str

    def types(self) -> dict[str, tuple[str, ...]]:
        """Return the accepted message types of each topic in use."""
        kinds = {self.gripper: "sensor_msgs/msg/JointState", self.grasp: "std_msgs/msg/Bool"}
        kinds[self.object] = "std_msgs/msg/String"
        return dict.fromkeys((*self.touch, self.photo), _IMAGES) | {
            topic: (kind,) for topic, kind in kinds.items() if topic
        }


@dataclass
class _Scan:
    """Times and numbers from one bag, by topic and message.

    Attributes:
        times: When the bag recorded each message, in ns; images that cannot be decoded are left out.
        values: Messages of the topics grasp and object.
        openings_mm: Opening in each message of the gripper; NaN if it has no positions.
        forces_n: Force in each message of the gripper; NaN if it has no efforts.
        changes: Mean change of each gel image from the first one, in grey levels.
        changed: The same as a fraction of the area; empty if a topic marks the grasps.
        unreadable: Number of gel images that cannot be decoded or have another size.
        left_out: Topic -> number of its first gel images that are unusable, such as black ones.
    """

    times: dict[str, "array[int]"] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    values: dict[str, list[bool | str]] = field(default_factory=lambda: defaultdict(list))
    openings_mm: "array[float]" = field(default_factory=lambda: array("d"))
    forces_n: "array[float]" = field(default_factory=lambda: array("d"))
    changes: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    changed: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    unreadable: int = 0
    left_out: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0

    def latest(self, topic: str, time_ns: int) -> int | None:
        """Return the number of the last message of a topic at or before a time; None if there is none."""
        after = int(np.searchsorted(self.times[topic], time_ns, "right"))
        return after - 1 if after else None

    def latest_value(self, topic: str, time_ns: int) -> bool | str | None:
        """Return the value of this message of grasp or object."""
        number = self.latest(topic, time_ns)
        return None if number is None else self.values[topic][number]


def _scan_bag(bag: Bag, topics: _Topics, left_out: Mapping[str, int] | None = None) -> _Scan:
    """Read all messages of the topics; each gel image is compared with the first usable one of its topic.

    They are read once, or twice if first images turn out to be unusable.
    """
    for topic, types in topics.types().items():
        if bag.topics.get(topic) not in types:
            known = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.topics.items()))
            raise ImporterError(
                f"its bag must have the topic {topic} of type {' or '.join(types)}; choose topics with --option "
                f"touch_a=... touch_b=... photo=... from: {known or 'none'}"
            )
    scan = _Scan(left_out=dict(left_out or {}))
    gate = None if topics.grasp else ContactAreaGate()
    first: dict[str, NDArray[np.uint8]] = {}
    thumbnails: dict[str, list[NDArray[np.uint8]]] = defaultdict(list)
    for topic, time_ns, decode in bag.messages(topics.types()):
        message = decode()
        scan.first_ns = scan.first_ns or time_ns
        if topic in topics.touch:
            picture = picture_of(message)
            gel = decode_picture(picture) if isinstance(picture, bytes) else picture
            if gel is None or gel.shape != first.setdefault(topic, gel.copy()).shape:
                scan.unreadable += 1
                continue
            thumbnails[topic].append(thumbnail(gel))
            if len(thumbnails[topic]) <= scan.left_out.get(topic, 0):
                del first[topic]
                continue
            scan.changes[topic].append(float(np.mean(np.abs(np.subtract(gel, first[topic], dtype=np.int16)))))
            if gate is not None:
                scan.changed[topic].append(gate.changed_fraction(GraspFrames(first[topic], gel)))
        elif topic == topics.photo:
            picture_of(message)  # its encoding is checked
        elif topic == topics.gripper:
            scan.openings_mm.append(1000 * float(np.sum(message.position)) if len(message.position) else np.nan)
            scan.forces_n.append(float(np.mean(np.abs(message.effort))) if len(message.effort) else np.nan)
        else:
            scan.values[topic].append(message.data)
        scan.times[topic].append(time_ns)
    usable = {topic: first_usable(frames) for topic, frames in thumbnails.items()}
    if None in usable.values() and not topics.grasp:
        raise ImporterError(f"{NO_USABLE_FRAME}; cut the bag, or name a topic of marks with --option grasp=...")
    if left_out is None and (unusable := {topic: number for topic, number in usable.items() if number}):
        return _scan_bag(bag, topics, unusable)
    return scan


class _Grasp(NamedTuple):
    """When the images of one grasp were recorded, in ns; the gel images of each finger."""

    photo: int
    no_contact: tuple[int, ...]
    touch: tuple[int, ...]


def _find_grasps(scan: _Scan, topics: _Topics, contact: float, settle_s: float) -> list[_Grasp | str]:
    """Return the grasps of a bag in order of time; a text is the reason why one is not usable."""
    times = [np.array(scan.times[topic], np.int64) for topic in topics.touch]
    if not times or not all(map(len, times)):
        return []
    # Everything is on the clock of the first finger: the other fingers' images nearest in time belong to its images.
    first = times[0]
    numbers = [_nearest(of_finger, first) for of_finger in times]
    fingers = list(zip(topics.touch, numbers, strict=True))
    if topics.grasp:
        is_held = np.array([bool(scan.latest_value(topics.grasp, time_ns)) for time_ns in first.tolist()])
    else:
        changed = np.array([np.array(scan.changed[topic])[number] for topic, number in fingers])
        is_held = np.any(changed >= contact, axis=0)
        if reason := _reference_error(changed, is_held):
            return [reason]
    strength = np.sum([np.array(scan.changes[topic])[number] for topic, number in fingers], axis=0)
    photos = np.array(scan.times[topics.photo], np.int64)
    clocks = [of_finger[number] for of_finger, number in zip(times, numbers, strict=True)]
    grasps: list[_Grasp | str] = []
    released = 0
    for start, stop in _intervals(first, is_held, int(settle_s * 1e9)):
        before = photos[(photos < first[start]) & ((photos >= first[released]) | (released == 0))]
        if start == released:
            grasps.append("there is no gel image before its contact")
        elif not len(before):
            grasps.append("there is no camera image between the previous grasp and its contact")
        else:
            middle = (first[released] + first[start]) // 2
            rest = max(int(np.searchsorted(first, middle, "right")) - 1, released)
            peak = start + int(np.argmax(strength[start:stop]))
            no_contact, touch = (tuple(int(clock[at]) for clock in clocks) for at in (rest, peak))
            grasps.append(_Grasp(int(before[-1]), no_contact, touch))
        released = stop
    return grasps


def _reference_error(changed: NDArray[np.float64], is_held: NDArray[np.bool_]) -> str:
    """Return why the first gel image cannot be the no-contact frame: the gel nearly always differs, or all of it."""
    share = float(is_held.mean())
    later = slice(int(np.argmax(is_held)), None)
    if share < 0.9 and not (share and is_held[later].mean() > 0.98 and np.median(changed[:, later].max(0)) > 0.5):
        return ""
    return (
        f"its gel differs from the first usable image in {share:.0%} of its images and does not return to it, so that "
        "image may not be without contact; cut the bag, or name a topic of marks with --option grasp=..."
    )


def _nearest(times: NDArray[np.int64], to: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the number of the time that is nearest to each of the others."""
    after = np.clip(np.searchsorted(times, to), 1, max(len(times) - 1, 1))
    is_before = to - times[after - 1] <= times[np.minimum(after, len(times) - 1)] - to
    return np.where(is_before | (len(times) == 1), after - 1, after)


def _intervals(times: NDArray[np.int64], is_held: NDArray[np.bool_], settle_ns: int) -> list[tuple[int, int]]:
    """Return first and end number of each run of true values, after joining near runs and leaving out short ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_held, [False]]).astype(np.int8)))
    joined: list[tuple[int, int]] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        if joined and times[start] - times[joined[-1][1]] < settle_ns:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))
    return [(start, stop) for start, stop in joined if times[min(stop, len(times) - 1)] - times[start] >= settle_ns]


def _items(
    path: Path, scan: _Scan, grasps: Sequence[_Grasp | str], topics: _Topics, start_ns: int
) -> Iterator[Item | Skip]:
    """Yield the grasps of a bag, in one more pass over its images; only those of one grasp are in memory."""
    places: dict[tuple[str, int], list[tuple[str, str]]] = defaultdict(list)
    facts_of: dict[str, tuple[str, dict[str, Any]]] = {}  # object and fields of a grasp
    with Bag(path) as bag:
        for number, grasp in enumerate(grasps, start=1):
            name = safe_name(bag.name, f"{number:03}")
            if isinstance(grasp, str):
                yield Skip(grasp, name)
                continue
            object_id = scan.latest_value(topics.object, grasp.touch[0]) if topics.object else bag.name
            if object_id is None:
                yield Skip(f"there is no message of {topics.object} before it", name)
                continue
            sequence = f"{bag.name}-{object_id}" if topics.object else bag.name
            facts = {"sequence_id": sequence, "time_s": (grasp.touch[0] - start_ns) / 1e9}
            facts_of[name] = str(object_id), {**facts, **_fields(grasp, scan, topics)}
            places[topics.photo, grasp.photo].append((name, "photo"))
            for finger, topic, rest, touch in zip(ascii_lowercase, topics.touch, *grasp[1:], strict=False):
                places[topic, touch].append((name, f"touch_{finger}"))
                places[topic, rest].append((name, f"touch_{finger}_before"))
        images: dict[str, dict[str, Source]] = defaultdict(dict)
        left_out = {f"{bag.name}{topic}": number for topic, number in scan.left_out.items()}
        for topic, time_ns, decode in bag.messages((*topics.touch, topics.photo)):
            for name, column in places.pop((topic, time_ns), ()):
                images[name][column] = partial(lambda decode: picture_of(decode()), decode)
                if len(images[name]) == 1 + 2 * len(topics.touch):
                    object_id, fields = facts_of.pop(name)
                    yield Item(name, object_id, images.pop(name), fields, left_out)


def _fields(grasp: _Grasp, scan: _Scan, topics: _Topics) -> dict[str, float]:
    """Return the time between the fingers' images, and opening and force at the touch, as far as they were recorded."""
    fields = {"touch_skew_s": (max(grasp.touch) - min(grasp.touch)) / 1e9} if len(grasp.touch) > 1 else {}
    number = scan.latest(topics.gripper, grasp.touch[0])
    if number is not None:
        fields |= {"opening_mm": scan.openings_mm[number], "force_n": scan.forces_n[number]}
    return {key: value for key, value in fields.items() if not np.isnan(value)}
