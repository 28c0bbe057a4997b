"""A pack of the benchmark: four real objects (10 precedes 100), and a split by objects.

`write_samples`: two samples of ObjectFolder Real.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.miniatures import picture

OBJECTS = ("2", "10", "31", "100")
INSTANCES = (1, 2, 10)
GRASPS = len(OBJECTS) * len(INSTANCES)
SPLIT = {"train": ["2", "31"], "val": ["10"], "test": ["100"]}


def write(
    folder: Path,
    width: int = 32,
    objects: Sequence[str] = OBJECTS,
    split: Mapping[str, Sequence[str]] = SPLIT,
) -> None:
    for number, name in enumerate(objects):
        for instance in INSTANCES:
            picture(folder / "touch" / name / f"{instance}.png", 100 * number + instance, (24, width))
            picture(folder / "vision" / name / f"{instance}.png", 100 * number + 50 + instance, (16, 16))
    (folder / "audio_spectrogram/2").mkdir(parents=True)
    (folder / "audio_spectrogram/2/1.npy").write_bytes(b"\x93NUMPY")
    parts = {part: {name: list(INSTANCES) for name in names} for part, names in split.items()}
    (folder / "split.json").write_text(json.dumps(parts))


def write_samples(folder: Path) -> None:
    for number in (3, 20):
        picture(folder / str(number) / "visual/0.png", number, (27, 48))
        picture(folder / str(number) / "tactile/0.png", 50 + number, (24, 32))
        (folder / str(number) / "audio").mkdir()
