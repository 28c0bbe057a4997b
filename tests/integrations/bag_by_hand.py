"""Write the first 200 grasps of a recording as an MCAP bag, for a check of the import by hand.

    python -m tests.integrations.bag_by_hand RECORDING BAGS
    retrieve import rosbag BAGS --out imported/ --option touch_a=/gel/a touch_b=/gel/b photo=/camera/color \
        gripper=/gripper/state object=/object
    retrieve train imported/ --config tiny --iterations 20 --out model.safetensors

Gels at 20 Hz, a gripper and a camera at 10 Hz; each grasp lasts 0.5 s, after 0.5 s without contact. The program prints
the topics. It also writes BAGS-cut-off with the first half of the bytes, for the import of a bag that is cut off.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from retrieval.data.dataset import Grasp, load_grasps
from tests.miniatures.rosbag import CAMERA, GEL_A, GEL_B, GRIPPER, INTERVAL_NS, OBJECT, START_NS, Message, write_bag

GRASPS, FRAMES = 200, 10


def main() -> None:
    """Write both bags."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("bags", type=Path)
    arguments = parser.parse_args()
    grasps = load_grasps(arguments.recording)[:GRASPS]
    arguments.bags.mkdir()
    bag = write_bag(arguments.bags / "mcap_lab", messages(grasps), chunk_bytes=4_000_000)
    (file,) = bag.glob("*.mcap")
    cut_off = arguments.bags.with_name(f"{arguments.bags.name}-cut-off")
    cut_off.mkdir()
    content = file.read_bytes()
    (cut_off / file.name).write_bytes(content[: len(content) // 2])
    print(
        f"{bag}: {len(grasps)} grasps of {len({grasp.object_id for grasp in grasps})} objects, {len(content):,} bytes"
    )


def messages(grasps: list[Grasp]) -> Iterator[Message]:
    """Yield the messages of all grasps, in order of time."""
    time_ns = START_NS
    for grasp in grasps:
        yield time_ns, OBJECT, "std_msgs/String", {"data": grasp.object_id}
        for frame in range(2 * FRAMES):
            files = grasp.touches if frame >= FRAMES else grasp.backgrounds
            for topic, file in zip((GEL_A, GEL_B), files, strict=True):
                yield time_ns, topic, "sensor_msgs/CompressedImage", jpeg_fields(file)
            joints = {"name": ["left", "right"], "position": [0.02, 0.02], "velocity": [], "effort": [-8.0, 8.0]}
            yield time_ns, GRIPPER, "sensor_msgs/JointState", joints
            if frame % 2 == 0:
                yield time_ns, CAMERA, "sensor_msgs/CompressedImage", jpeg_fields(grasp.photo)
            time_ns += INTERVAL_NS


def jpeg_fields(file: Path) -> dict[str, object]:
    """Return the fields of a CompressedImage with the content of a file."""
    return {"format": "jpeg", "data": np.frombuffer(file.read_bytes(), np.uint8)}


if __name__ == "__main__":
    main()
