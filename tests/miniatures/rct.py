"""RCT: three materials, two positions, two sensors, three frames of each press; pictures at the default paths.

One row has no picture, one has no sensor.
"""

from collections.abc import Sequence
from pathlib import Path

from tests.miniatures import picture

MATERIALS, POSITIONS, SENSORS, FRAMES = ("ABS-01", "PTFE-02", "Cork 03"), (0, 1), ("D20011", "D20045"), (3, 4, 10)
GRASPS = len(MATERIALS) * len(POSITIONS) * len(SENSORS) * len(FRAMES)


def write(folder: Path, materials: Sequence[str] = MATERIALS) -> None:
    lines = ["material_id,position,sensor,z_frame,raw_fz"]
    seed = 0
    for material in materials:
        seed += 1
        picture(folder / "rgb" / f"{material}.jpg", 5000 + seed, (20, 30))
        for position in POSITIONS:
            for sensor in SENSORS:
                for frame in FRAMES:
                    seed += 1
                    picture(folder / "tactile" / material / str(position) / sensor / f"{frame}.png", seed)
                    lines.append(f"{material},{position},{sensor},{frame},{-0.5 * frame}")
    lines += ["ABS-01,7,D20011,3,-1.0", "ABS-01,0,,3,-1.0"]
    (folder / "metadata").mkdir()
    (folder / "metadata" / "force_metadata.csv").write_text("\n".join(lines) + "\n")
