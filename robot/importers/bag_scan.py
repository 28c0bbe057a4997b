"""First pass over a bag: when grasps begin and end, and whether the time stamps of its topics are regular.

Images are decoded one by one and compared with the first one of their topic; only times and numbers stay in memory.
"""

from array import array
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.grasping.gates import ContactAreaGate, GraspFrames
from robot.importers.bag_reader import IMAGE_TYPES, Bag, picture_of, stamp_ns
from robot.storage import decode_picture

Times = NDArray[np.int64]
_GAP_INTERVALS = 3


@dataclass(frozen=True)
class BagTopics:
    """Topics of the options; empty if not used.

    Attributes:
        touch: Gel images, one topic per finger.
        photo: Camera images.
        gripper: JointState of the gripper.
        grasp: Bool, whether a grasp is held.
        object: String, name of the object.
    """

    touch: tuple[str, ...]
    photo: str
    gripper: str = ""
    grasp: str = ""
    object: str = ""

    def types(self) -> dict[str, tuple[str, ...]]:
        """Return the accepted message types of each topic in use."""
        images = dict.fromkeys((*self.touch, self.photo), IMAGE_TYPES)
        others = {
            self.gripper: ("sensor_msgs/msg/JointState",),
            self.grasp: ("std_msgs/msg/Bool",),
            self.object: ("std_msgs/msg/String",),
        }
        return images | {topic: types for topic, types in others.items() if topic}

    def check(self, bag: Bag) -> None:
        """Raise ImporterError if a topic is missing in the bag, or of another type."""
        for topic, types in self.types().items():
            if bag.topics.get(topic) not in types:
                known = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.topics.items()))
                raise ImporterError(
                    f"its bag must have the topic {topic} of type {' or '.join(types)}; choose topics with --option "
                    f"touch_a=... touch_b=... photo=... from: {known or 'none'}"
                )


@dataclass
class BagScan:
    """Times and numbers from one bag.

    Attributes:
        times: Topic -> when the bag recorded its messages, in ns; images that cannot be decoded are left out.
        stamps: Topic -> time stamps of all its messages, in ns.
        values: Topic of grasp or object -> its messages' values.
        openings_mm: Opening in each message of the gripper; NaN if it has no positions.
        forces_n: Force in each message of the gripper; NaN if it has no efforts.
        changes: Topic of a finger -> mean change of each gel image from the first one, in grey levels.
        changed: The same as the fraction of the gel's area that changed; empty if a topic marks the grasps.
        unreadable: Topic -> number of images that cannot be decoded or have another size.
        first_ns: When the first message was recorded.
        last_ns: When the last message was recorded.
        is_cut_off: Whether the end of the bag is missing.
    """

    times: dict[str, "array[int]"] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    stamps: dict[str, "array[int]"] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    values: dict[str, list[bool | str]] = field(default_factory=lambda: defaultdict(list))
    openings_mm: "array[float]" = field(default_factory=lambda: array("d"))
    forces_n: "array[float]" = field(default_factory=lambda: array("d"))
    changes: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    changed: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    unreadable: Counter[str] = field(default_factory=Counter)
    first_ns: int = 0
    last_ns: int = 0
    is_cut_off: bool = False

    def latest(self, topic: str, time_ns: int) -> int | None:
        """Return the number of the last message of a topic at or before a time; None if there is none."""
        after = int(np.searchsorted(self.times[topic], time_ns, "right"))
        return after - 1 if after else None

    def latest_value(self, topic: str, time_ns: int) -> bool | str | None:
        """Return the value of this message of grasp or object."""
        number = self.latest(topic, time_ns)
        return None if number is None else self.values[topic][number]


def scan_bag(bag: Bag, topics: BagTopics) -> BagScan:
    """Read all messages of the topics once.

    Args:
        bag: The bag.
        topics: Its topics.

    Raises:
        ImporterError: A topic is missing, or its images have another encoding.
    """
    topics.check(bag)
    scan = BagScan()
    gate = None if topics.grasp else ContactAreaGate()
    first: dict[str, NDArray[np.uint8]] = {}
    for topic, time_ns, decode in bag.messages(topics.types()):
        message = decode()
        scan.first_ns, scan.last_ns = scan.first_ns or time_ns, time_ns
        scan.stamps[topic].append(stamp_ns(message, time_ns))
        if topic in topics.touch:
            picture = picture_of(message)
            gel = decode_picture(picture) if isinstance(picture, bytes) else picture
            if gel is None or gel.shape != first.setdefault(topic, gel.copy()).shape:
                scan.unreadable[topic] += 1
                continue
            scan.changes[topic].append(float(np.mean(np.abs(np.subtract(gel, first[topic], dtype=np.int16)))))
            if gate is not None:
                scan.changed[topic].append(gate.changed_fractions({"": GraspFrames(first[topic], gel)})[""])
        elif topic == topics.photo:
            picture_of(message)  # its encoding is checked
        elif topic == topics.gripper:
            scan.openings_mm.append(1000 * float(np.sum(message.position)) if len(message.position) else np.nan)
            scan.forces_n.append(float(np.mean(np.abs(message.effort))) if len(message.effort) else np.nan)
        else:
            scan.values[topic].append(message.data)
        scan.times[topic].append(time_ns)
    scan.is_cut_off = bag.is_cut_off
    return scan


# Grasps ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BagGrasp:
    """When the images of one grasp were recorded, in ns.

    Attributes:
        photo: The last camera image before the contact.
        no_contact: Gel image of each finger, in the middle between the previous grasp and this one.
        touch: Gel image of each finger at the strongest contact.
    """

    photo: int
    no_contact: tuple[int, ...]
    touch: tuple[int, ...]


def find_grasps(scan: BagScan, topics: BagTopics, contact: float, settle_s: float) -> list[BagGrasp | str]:
    """Return the grasps of a bag in order of time; a text is the reason why one is not usable.

    A grasp lasts while a message of `topics.grasp` marks it. Without this topic it lasts while the gel of any finger
    differs from its first image over the fraction `contact` of its area.

    Args:
        scan: Times and numbers from the bag.
        topics: Its topics.
        contact: Smallest fraction of changed area, 0 to 1.
        settle_s: Shorter interruptions are ignored, and then shorter grasps, in seconds.
    """
    first, *others = (np.array(scan.times[topic], np.int64) for topic in topics.touch)
    if not len(first) or not all(map(len, others)):
        return []
    # Everything is on the clock of the first finger: the other fingers' images nearest in time belong to its images.
    numbers = [np.arange(len(first)), *(_nearest(times, first) for times in others)]
    if topics.grasp:
        is_held = np.array([bool(scan.latest_value(topics.grasp, time_ns)) for time_ns in first.tolist()])
    else:
        fingers = zip(topics.touch, numbers, strict=True)
        is_held = np.any([np.array(scan.changed[topic])[number] >= contact for topic, number in fingers], axis=0)
    strength = np.sum(
        [np.array(scan.changes[topic])[number] for topic, number in zip(topics.touch, numbers, strict=True)], axis=0
    )
    photos = np.array(scan.times[topics.photo], np.int64)
    clocks = [clock[number] for clock, number in zip((first, *others), numbers, strict=True)]
    found: list[BagGrasp | str] = []
    released = 0
    for start, stop in _intervals(first, is_held, int(settle_s * 1e9)):
        before = photos[(photos < first[start]) & ((photos >= first[released]) | (released == 0))]
        if stop == len(first) and scan.is_cut_off:
            found.append("the bag is cut off during the grasp")
        elif start == released:
            found.append("there is no gel image before its contact")
        elif not len(before):
            found.append("there is no camera image between the previous grasp and its contact")
        else:
            middle = (first[released] + first[start]) // 2
            rest = max(int(np.searchsorted(first, middle, "right")) - 1, released)
            peak = start + int(np.argmax(strength[start:stop]))
            no_contact, touch = (tuple(int(clock[at]) for clock in clocks) for at in (rest, peak))
            found.append(BagGrasp(int(before[-1]), no_contact, touch))
        released = stop
    return found


def _nearest(times: Times, to: Times) -> NDArray[np.intp]:
    """Return the number of the time that is nearest to each of the others."""
    after = np.clip(np.searchsorted(times, to), 1, max(len(times) - 1, 1))
    is_before = to - times[after - 1] <= times[np.minimum(after, len(times) - 1)] - to
    return np.where(is_before | (len(times) == 1), after - 1, after)


def _intervals(times: Times, is_held: NDArray[np.bool_], settle_ns: int) -> list[tuple[int, int]]:
    """Return first and end number of each run of true values, after joining near runs and leaving out short ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_held, [False]]).astype(np.int8)))
    joined: list[tuple[int, int]] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        if joined and times[start] - times[joined[-1][1]] < settle_ns:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))
    return [(start, stop) for start, stop in joined if times[min(stop, len(times) - 1)] - times[start] >= settle_ns]


# Time stamps -------------------------------------------------------------------------------------------------


def time_stamp_report(scans: Mapping[str, BagScan], topics: Sequence[str]) -> list[str]:
    """Return a line on the time stamps of each topic, over all bags.

    Args:
        scans: Name of the bag -> its times.
        topics: Topics with regular messages.
    """
    return [_topic_line(topic, scans) for topic in topics]


def _topic_line(topic: str, scans: Mapping[str, BagScan]) -> str:
    intervals = {name: np.diff(np.array(scan.stamps[topic], np.int64)) / 1e9 for name, scan in scans.items()}
    every = np.concatenate(list(intervals.values()))
    count = sum(len(scan.stamps[topic]) for scan in scans.values())
    line = f"{topic}: {count} messages"
    if (every > 0).any():
        nominal = float(np.median(every[every > 0]))
        line += f" at {1 / nominal:.1f} Hz"
        longest = max(intervals, key=lambda name: float(intervals[name].max(initial=0)))
        gaps = int((every > _GAP_INTERVALS * nominal).sum())
        line += f", {gaps or 'no'} gap(s) of more than {_GAP_INTERVALS} intervals"
        line += f", the longest {every.max():.2f} s in {longest}" if gaps else ""
    for words, number in (
        ("repeated time stamp(s)", int((every == 0).sum())),
        ("time stamp(s) that go backwards", int((every < 0).sum())),
        ("image(s) that cannot be decoded", sum(scan.unreadable[topic] for scan in scans.values())),
    ):
        line += f", {number} {words}" if number else ""
    return line
