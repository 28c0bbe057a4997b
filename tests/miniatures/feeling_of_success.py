"""Two files in the published layout: one with twelve grasps, so that i10 follows i9, and one with a single grasp."""

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
    """Write objects with `of_an_object` grasps each; the first two have names."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, count in enumerate(files):
        with h5py.File(folder / f"calandra_corl2017_{number:03}.h5", "w") as file:
            file.attrs["DEEPDISH_IO_VERSION"] = 10
            file.attrs["DEEPDISH_IO_DEEPDISH_IO_UNPACK"] = 1
            data = file.create_group("data")
            data.attrs["TITLE"] = np.bytes_(f"list:{count}")
            for grasp in range(count):
                index = grasp // of_an_object
                name = NAMES[index] if index < len(NAMES) else f"object_{index}"
                write_grasp(data, f"i{grasp}", 1000 * number + 20 * grasp, name=name.encode())


def write_grasp(data: Any, group: str, seed: int, name: bytes, **compression: Any) -> Any:
    """Write one grasp; it fails if 100 divides the seed."""
    created = data.create_group(group)
    created.attrs["TITLE"] = np.bytes_("dict:11")
    created.attrs["object_name"] = np.bytes_(name)
    created.attrs["is_gripping"] = np.bool_(seed % 100 != 0)
    for moment, shift in (("before", 0), ("during", 1), ("after", 2)):
        created.create_dataset(f"kinectA_rgb_{moment}", data=pixels(seed + shift, (18, 32)), **compression)
        for gel, offset in (("A", 5), ("B", 10)):
            picture = pixels(seed + shift + offset, (32, 24))
            created.create_dataset(f"gelsight{gel}_{moment}", data=picture, **compression)
    return created
