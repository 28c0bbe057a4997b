"""ROS bags of a lab: gel images, camera and gripper as topics of ROS 1 bags and ROS 2 bags (SQLite, MCAP).

    <name>.bag                                        ROS 1
    <name>/metadata.yaml    <name>/<name>_0.mcap      ROS 2, or .db3 (SQLite)
    <name>.mcap             <name>.db3                ROS 2, a file without its folder

The package rosbags (extra `importers`) reads them without ROS. The source is a bag or a folder of bags. A bag is a
sequence; with a topic of names (`object`) the grasps of one object in a bag are. The options name its topics; `touch_b`
is empty for a sensor with one finger. Images are sensor_msgs/Image (rgb8, bgr8, mono8) or CompressedImage, whose files
are stored unchanged.

A grasp lasts while the gel of any finger differs from the first image of its bag over the fraction `contact` of its
area, by the rule of the contact-area gate. If a topic marks the grasps, the option `grasp` names it (std_msgs/Bool,
true while a grasp is held), and its marks decide instead. Interruptions shorter than `settle_s` are ignored, and then
grasps shorter than it. The touch is the gel image with the strongest change in the grasp, the photo the last camera
image before it began, and the no-contact frame the gel image in the middle between the previous grasp and this one.
Messages are ordered by the times at which the bag recorded them.

`object` names a topic with the name of the object (std_msgs/String); without it the bag's name is the object. `gripper`
names a sensor_msgs/JointState: the sum of positions, in metre, is the opening, and the mean absolute effort, in newton,
the force.

The import prints a line on each topic: its rate (from the median interval), gaps of more than 3 intervals, and time
stamps that repeat or go backwards. From a bag that is cut off, whole messages are imported. A bag is read twice, one
message at a time; only times and numbers of its messages stay in memory, 0.9 kB for a grasp of 9 messages.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np

from robot.errors import ImporterError
from robot.importers.bag_reader import Bag, BagMessage, bag_paths, picture_of
from robot.importers.bag_scan import BagGrasp, BagScan, BagTopics, find_grasps, scan_bag, time_stamp_report
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    Source,
    import_extra,
    import_items,
    safe_name,
)
from robot.recording.folder import Recording

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

    Args:
        src: A bag, or a folder of bags.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        touch_a: Topic of the first finger's gel images.
        touch_b: Topic of the second finger's gel images; empty for one finger.
        photo: Topic of the camera images.
        gripper: Topic of the gripper's JointState; empty for none.
        grasp: Topic that marks the grasps; empty to find them by contact.
        object: Topic with the name of the object; empty for the bag's name.
        contact: Smallest fraction of a gel's area that changes in a grasp.
        settle_s: Shortest grasp and shortest time between two grasps, in seconds.
        sensor: Tactile sensor.
        licence: Licence of the data.

    Raises:
        ImporterError: There is no bag, rosbags is missing, or no bag can be read.
    """
    src = Path(src)
    if not 0 < contact <= 1:
        raise ImporterError(f"contact must be above 0 and at most 1, got {contact}")
    paths = bag_paths(src)
    if not paths:
        raise DATA_SET.mismatch_error(src, "there is no such bag")
    import_extra("rosbags", "a ROS bag")
    topics = BagTopics(tuple(filter(None, (touch_a, touch_b))), photo, gripper, grasp, object)
    scans: dict[Path, BagScan] = {}
    skips: list[Skip] = []
    for path in paths:
        try:
            with Bag(path) as bag:
                scans[path] = scan_bag(bag, topics)
        except ImporterError as error:
            skips.append(Skip(str(error), path.name))
    if not scans:
        raise ImporterError(f"{paths[0]}: {skips[0].reason}")
    grasps = {path: find_grasps(scan, topics, contact, settle_s) for path, scan in scans.items()}
    regular = [topic for topic in topics.types() if topic not in (grasp, object)]
    report = time_stamp_report({path.name: scan for path, scan in scans.items()}, regular)
    losses = [
        f"{path.name} is cut off or damaged: imported its whole messages, the first "
        f"{(scan.last_ns - scan.first_ns) / 1e9:.1f} s"
        for path, scan in scans.items()
        if scan.is_cut_off
    ]
    caveats = (*report, *losses, *DATA_SET.caveats)
    facts = replace(DATA_SET, fingers=len(topics.touch), sensor=sensor, licence=licence, caveats=caveats)
    start_ns = min(scan.first_ns for scan in scans.values())
    items = (item for path, scan in scans.items() for item in _items(path, scan, grasps[path], topics, start_ns))
    total = len(skips) + sum(map(len, grasps.values()))
    return import_items(facts, chain(skips, items), out, total=total, progress=progress)


def _items(
    path: Path, scan: BagScan, grasps: Sequence[BagGrasp | str], topics: BagTopics, start_ns: int
) -> Iterator[Item | Skip]:
    """Yield the grasps of a bag, in one more pass over its images; only those of one grasp are in memory."""
    places: dict[tuple[str, int], list[tuple[str, str]]] = defaultdict(list)
    fields: dict[str, dict[str, Any]] = {}
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
            time_s = (grasp.touch[0] - start_ns) / 1e9
            sequence = f"{bag.name}-{object_id}" if topics.object else bag.name
            facts = {"object_id": object_id, "sequence_id": sequence, "time_s": time_s}
            fields[name] = {**facts, **_fields(grasp, scan, topics)}
            for column, place in _places(grasp, topics).items():
                places[place].append((name, column))
        images: dict[str, dict[str, Source]] = defaultdict(dict)
        for message in bag.messages((*topics.touch, topics.photo)):
            for name, column in places.pop((message.topic, message.time_ns), ()):
                images[name][column] = partial(_picture, message)
                if len(images[name]) == 1 + 2 * len(topics.touch):
                    facts = fields.pop(name)
                    yield Item(name, str(facts.pop("object_id")), images.pop(name), facts)


def _places(grasp: BagGrasp, topics: BagTopics) -> dict[str, tuple[str, int]]:
    """Return topic and time of the image of each column."""
    found = {"photo": (topics.photo, grasp.photo)}
    for finger, topic, rest, touch in zip(ascii_lowercase, topics.touch, grasp.no_contact, grasp.touch, strict=False):
        found |= {f"touch_{finger}": (topic, touch), f"touch_{finger}_before": (topic, rest)}
    return found


def _fields(grasp: BagGrasp, scan: BagScan, topics: BagTopics) -> dict[str, float]:
    """Return the time between the fingers' images, and opening and force at the touch, as far as they were recorded."""
    found = {"touch_skew_s": (max(grasp.touch) - min(grasp.touch)) / 1e9} if len(grasp.touch) > 1 else {}
    number = scan.latest(topics.gripper, grasp.touch[0])
    if number is not None:
        found |= {"opening_mm": scan.openings_mm[number], "force_n": scan.forces_n[number]}
    return {key: value for key, value in found.items() if not np.isnan(value)}


def _picture(message: BagMessage) -> Any:
    return picture_of(message.decode())
