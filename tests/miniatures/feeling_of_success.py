"""Two files of the published form: twelve grasps, so that i10 comes after i9, and one. A grasp slips."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.miniatures import pixels

GRASPS = 13
FILES = (12, 1)
NAMES = ("soda_can", "lemon")


def write(folder: Path, files: Sequence[int] = FILES, of_an_object: int = 10) -> None:
    """Objects follow each other, each with so many grasps; the first two have names."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, count in enumerate(files):
        with h5py.File(folder / f"calandra_corl2017_{number:03}.h5", "w") as file:
            file.attrs["DEEPDISH_IO_VERSION"] = 10
            file.attrs["DEEPDISH_IO_DEEPDISH_IO_UNPACK"] = 1
            data = file.create_group("data")
            data.attrs["TITLE"] = np.bytes_(f"list:{count}")
            for grasp in range(count):
                place = grasp // of_an_object
                name = NAMES[place] if place < len(NAMES) else f"object_{place}"
                write_grasp(data, f"i{grasp}", 1000 * number + 20 * grasp, name=name.encode())


def write_grasp(data: Any, group: str, seed: int, name: bytes, **compression: Any) -> Any:
    """One grasp; those of a seed that 100 divides slipped."""
    made = data.create_group(group)
    made.attrs["TITLE"] = np.bytes_("dict:11")
    made.attrs["object_name"] = np.bytes_(name)
    made.attrs["is_gripping"] = np.bool_(seed % 100 != 0)
    for moment, shift in (("before", 0), ("during", 1), ("after", 2)):
        made.create_dataset(f"kinectA_rgb_{moment}", data=pixels(seed + shift, (18, 32)), **compression)
        for gel, more in (("A", 5), ("B", 10)):
            picture = pixels(seed + shift + more, (32, 24))
            made.create_dataset(f"gelsight{gel}_{moment}", data=picture, **compression)
    return made
