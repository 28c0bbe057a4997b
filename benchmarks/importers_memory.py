"""Memory of each importer for many rows: `python -m benchmarks.importers_memory`.

    python -m benchmarks.importers_memory                       every importer, 10,000 and 100,000 rows
    python -m benchmarks.importers_memory tvl --rows 1000 5000

Rows are written in the layout of each data set, in folders of the same size, with links to a few small pictures. An
import runs in a separate process. Its peak is read before the recording is returned and after, because the returned
recording contains one line per grasp. Only the memory for names may grow with the rows, by at most MAX_KB per row.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import Any

from tests.miniatures import encoded, picture

MAX_KB = {"importing": 1.0, "in all": 3.0}
"""Maximum kB per row: during the import, and after the recording was read back."""
Options = dict[str, Any]


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", choices=[*WIDE, []], metavar="NAME")
    parser.add_argument("--rows", nargs=2, type=int, default=(10_000, 100_000))
    arguments = parser.parse_args(words)
    few, many = arguments.rows
    heads = (f"{what}, {few:,} rows, MB | {many:,} | kB a row" for what in MAX_KB)
    print(f"| importer | {' | '.join(heads)} |\n|{'---|' * (1 + 3 * len(MAX_KB))}")
    within_limits = True
    for name in arguments.names or WIDE:
        peaks = {rows: peak_mb(name, rows) for rows in arguments.rows}
        cells = []
        for what, limit_kb in MAX_KB.items():
            kb = growth_kb(peaks, what)
            within_limits &= kb <= limit_kb
            cells.append(f"{peaks[few][what]:.0f} | {peaks[many][what]:.0f} | {kb:.2f}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    return 0 if within_limits else 1


def growth_kb(peaks: Mapping[int, Mapping[str, float]], phase: str) -> float:
    """Return the growth per row, from fewer rows to more."""
    few, many = sorted(peaks)
    return 1000 * (peaks[many][phase] - peaks[few][phase]) / (many - few)


def peak_mb(name: str, rows: int) -> dict[str, float]:
    """Return the peaks of an import of this many rows, in a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "src"
        source.mkdir()
        options = WIDE[name](source, rows)
        task = json.dumps([name.partition(" ")[0], str(source), f"{folder}/out", rows, options])
        finished = subprocess.run(
            [sys.executable, "-m", "benchmarks.importers_memory", "--child", task], check=True, capture_output=True
        )
        return dict(json.loads(finished.stdout))


def measure(name: str, source: str, out: str, rows: int, options: Options) -> dict[str, float]:
    """Import in this process and read its peaks."""
    import os

    from robot.importers import load_importer

    setattr(os, "fsync", lambda descriptor: None)  # not a benchmark of the disk  # noqa: B010
    last: dict[str, float] = {}

    def progress(done: int, total: int) -> None:
        if done == rows:
            last["importing"] = _peak_mb()

    recording = load_importer(name)(Path(source), Path(out), progress, **options)
    assert len(recording.grasps) == rows, (len(recording.grasps), recording.notes)
    return {**last, "in all": _peak_mb()}


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


# Layouts ---------------------------------------------------------------------------------------------------


def link(path: Path, to: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(to)


def pictures(folder: Path, names: Sequence[str]) -> Path:
    """Link one picture under many names."""
    one = picture(folder.with_name(f".{folder.name}-one{Path(names[0]).suffix}"), len(names))
    for name in names:
        link(folder / name, one)
    return folder


def billets(src: Path, rows: int) -> Options:
    names = [f"{place:02}_{kind}" for place in range(16) for kind in ("touch.png", "photo.png")]
    one = pictures(src / ".billet", names)
    for number in range(rows // 16):
        link(src / f"welded{number}", one)
    pictures(src / "rest", names[: 2 * (rows % 16)] or ["notes.png"])
    return {}


def feeling_of_success(src: Path, rows: int) -> Options:
    from tests.miniatures.feeling_of_success import write

    write(src / ".one", (250,), of_an_object=10)
    for number in range(ceil(rows / 250)):
        link(src / f"calandra_corl2017_{number:03}.h5", src / ".one" / "calandra_corl2017_000.h5")
    return {}


def folder(src: Path, rows: int) -> Options:
    one = pictures(src / ".object", [f"touch_{k}.png" for k in range(50)] + [f"photo_{k}.png" for k in range(10)])
    for number in range(rows // 50):
        # The walk does not follow links to folders.
        for name in (path.name for path in one.iterdir()):
            link(src / f"object-{number}" / name, one / name)
    return {}


def folder_pairs(src: Path, rows: int) -> Options:
    picture(src / "touch.png", 1)
    picture(src / "photo.png", 2)
    with open(src / "pairs.csv", "w") as file:
        file.write("object,photo,touch\n")
        file.writelines(f"object-{row // 50},photo.png,touch.png\n" for row in range(rows))
    return {"pairs": "pairs.csv"}


def hapticmatch(src: Path, rows: int) -> Options:
    from tests.miniatures.hapticmatch import write_sample

    material = src / ".material"
    for k in range(100):
        write_sample(material, k, seed=k)
    for number in range(rows // 100):
        link(src / "Texture" / f"M{number}", material)
    return {}


def lerobot(src: Path, rows: int) -> Options:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from tests.miniatures.lerobot import LEFT, WRIST, write

    write(src / ".small")
    for key in (WRIST, LEFT):
        link(src / f"videos/{key}/chunk-000/file-000.mp4", src / f".small/videos/{key}/chunk-000/file-000.mp4")
    info = json.loads((src / ".small/meta/info.json").read_text())
    info["features"] = {key: info["features"][key] for key in (WRIST, LEFT)}
    place = {
        f"{what}/{key}": 0
        for what in ("data", f"videos/{WRIST}", f"videos/{LEFT}")
        for key in ("chunk_index", "file_index")
    }
    started = {f"videos/{key}/from_timestamp": 0.0 for key in (WRIST, LEFT)}
    row = {"tasks": ["pick the mug"], "length": 3, **place, **started}
    (src / "meta/episodes/chunk-000").mkdir(parents=True)
    for number, first in enumerate(range(0, rows, 1000)):
        those = [{"episode_index": at, **row} for at in range(first, min(first + 1000, rows))]
        pq.write_table(pa.Table.from_pylist(those), src / f"meta/episodes/chunk-000/file-{number:03}.parquet")
    (src / "meta/info.json").write_text(json.dumps({**info, "splits": {"train": f"0:{rows}"}}))
    return {}


def objectfolder(src: Path, rows: int) -> Options:
    for kind in ("touch", "vision"):
        one = pictures(src / f".{kind}", [f"{k}.png" for k in range(100)])
        for number in range(1, rows // 100 + 1):
            link(src / kind / str(number), one)
    split = {"train": {str(number): list(range(100)) for number in range(1, rows // 100 + 1)}}
    (src / "split.json").write_text(json.dumps(split))
    return {}


def open_x_tactile(src: Path, rows: int) -> Options:
    import numpy as np
    import zarr

    root = zarr.open_group(str(src / "wipe.zarr"), mode="w", zarr_format=2)
    steps = np.zeros((2 * rows, 1, 8, 8, 3), np.uint8)
    steps[1::2, :, 2:6] = 200
    arrays: dict[str, Any] = {
        "meta/episode_ends": np.arange(2, 2 * rows + 1, 2),
        "data/camera_main_rgb": steps[:, 0],
        "data/right_tactile_data_0": steps,
    }
    for name, values in arrays.items():
        group = root.require_group(name.split("/")[0])
        chunks = (min(100, len(values)), *values.shape[1:]) if values.ndim > 1 else values.shape
        group.create_array(name.split("/")[1], shape=values.shape, chunks=chunks, dtype=values.dtype)[...] = values
    return {}


def physiclear(src: Path, rows: int) -> Options:
    from tests.miniatures.physiclear import presses, write_video

    video = src / ".press.mov"
    write_video(video, presses(0, 0, frames=130))
    for number in range(rows // 100):
        link(src / f"part{number // 5}_{number % 5}.mov", video)
    return {"frames": 100}


def rct(src: Path, rows: int) -> Options:
    press = pictures(src / ".press" / "D20011", [f"{k}.png" for k in range(100)]).parent
    picture(src / "photo.png", 2)
    (src / "metadata").mkdir()
    with open(src / "metadata" / "force_metadata.csv", "w") as file:
        file.write("material_id,position,sensor,z_frame,raw_fz\n")
        for number in range(rows // 100):
            material, position = f"M{number % 100}", number // 100
            link(src / "tactile" / material / str(position), press)
            file.writelines(f"{material},{position},D20011,{k},-1.5\n" for k in range(100))
    return {"photo": "photo.*"}


def rosbag(src: Path, rows: int) -> Options:
    """Bags of 100 grasps, one every 0.4 s."""
    from tests.miniatures.rosbag import CAMERA, GEL_A, START_NS, gel, image_fields, write_bag

    images = [image_fields(gel("a", number), "rgb8") for number in (1, 27)]

    def messages() -> Iterator[Any]:
        for number in range(801):
            time_ns = START_NS + number * 50_000_000
            yield time_ns, GEL_A, "sensor_msgs/Image", images[number // 4 % 2]
            if number % 8 == 0:
                yield time_ns, CAMERA, "sensor_msgs/Image", images[0]

    bag = write_bag(src.with_name("one.bag"), messages())
    for number in range(rows // 100):
        link(src / f"mug{number}.bag", bag)
    return {"touch_b": ""}


def ssvtp(src: Path, rows: int) -> Options:
    for folder, kind in (("images_tac", "tac"), ("images_rgb", "rgb")):
        pictures(src / folder, [f"image_{number}_{kind}.jpg" for number in range(rows)])
    with open(src / "train.csv", "w") as file:
        file.write("url,tactile,caption\n")
        for row in range(rows):
            file.write(f'images_rgb/image_{row}_rgb.jpg,images_tac/image_{row}_tac.jpg,"soft, fuzzy, {row % 500}"\n')
    return {}


def touch_and_go(src: Path, rows: int) -> Options:
    """Runs of 20 frames, each followed by 5 without contact; 1,000 frames per video."""
    names = [f"{frame:010}.jpg" for frame in range(1250)]
    video = pictures(src / ".video" / "gelsight_frame", names).parent
    pictures(video / "video_frame", names)
    lines = (
        f"20220601_{row // 1000:06}/{row % 1000 // 20 * 25 + row % 20:010}.jpg,{row // 20 % 19}\n"
        for row in range(rows)
    )
    with open(src / "label.txt", "w") as labels, open(src / "train.txt", "w") as train:
        for line in lines:
            labels.write(line)
            train.write(line)
    (src / "test.txt").write_text("20220601_000000/0000000000.jpg,0\n")
    for number in range(ceil(rows / 1000)):
        link(src / "dataset" / f"20220601_{number:06}", video)
    return {"frames": 0}


def tvl(src: Path, rows: int) -> Options:
    names = [f"{frame}-0.{frame:017}.jpg" for frame in range(100)]
    contact = pictures(src / ".contact" / "tactile", names).parent
    pictures(contact / "vision", names)
    root = src / "hct" / "data1"
    contacts = [f"{number}-{1702507215.615537 + number}" for number in range(rows // 100)]
    for each in contacts:
        link(root / each, contact)
    listed = {kind: [f"{each}/{kind}/{name}" for each in contacts for name in names] for kind in ("vision", "tactile")}
    (root / "contact.json").write_text(json.dumps(listed))
    with open(root / "train.csv", "w") as file:
        file.write("url,tactile,tactile_background,caption\n")
        for vision, tactile in zip(*listed.values(), strict=True):
            file.write(f'{vision}, {tactile}, {vision.split("/")[0]}/tactile_bg_latent.jpg, "smooth, hard"\n')
    return {}


def visgel(src: Path, rows: int) -> Options:
    for kind in ("touch", "vision"):
        recording = src / f".{kind}"
        recording.mkdir()
        for frame in range(2):
            (recording / f"frame{frame:04}.jpg").write_bytes(encoded(".jpg", frame, (32, 40)))
        for number in range(rows):
            link(src / "data_seen" / kind / str(number // 100) / f"rec_{number % 100:05}", recording)
    return {}


def vt60(src: Path, rows: int) -> Options:
    picture(src / "touch/baselineForCalibration.jpg", 0, grey=True)
    names = {
        "touch": [f"touch_1_img_{k}_name_ball_red_at_1_2_3.jpg" for k in range(125)],
        "vision": [f"IMG_inst_1_img_{k}_x.jpg" for k in range(40)],
    }
    for kind, those in names.items():
        one = pictures(src / f".{kind}", those)
        for number in range(rows // 125):
            link(src / kind / f"{number % 10:02}_class{number % 10}" / f"{number // 10:02}", one)
    return {}


def x_capture(src: Path, rows: int) -> Options:
    one = src / ".point"
    pictures(one, ["p_rgb.png", *(f"p_{newton}N_tactile.png" for newton in range(100))])
    for number in range(rows // 100):
        link(src / f"object{number // 10}" / str(number % 10), one)
    return {}


def ycb_slide(src: Path, rows: int) -> Options:
    names = [f"frame_{frame:07}.jpg" for frame in range(100)]
    log = pictures(src / ".log" / "frames", names).parent
    pictures(log / "webcam_frames", names)
    for number in range(rows // 100):
        link(src / "real" / f"{number % 10:03}_thing" / f"dataset_{number // 10}", log)
    return {"every": 1}


WIDE: Mapping[str, Callable[[Path, int], Options]] = {
    "billets": billets,
    "feeling-of-success": feeling_of_success,
    "folder": folder,
    "folder (pairs)": folder_pairs,
    "hapticmatch": hapticmatch,
    "lerobot": lerobot,
    "objectfolder": objectfolder,
    "open-x-tactile": open_x_tactile,
    "physiclear": physiclear,
    "rct": rct,
    "rosbag": rosbag,
    "ssvtp": ssvtp,
    "touch-and-go": touch_and_go,
    "tvl": tvl,
    "visgel": visgel,
    "vt60": vt60,
    "x-capture": x_capture,
    "ycb-slide": ycb_slide,
}
"""Importer -> function that writes rows in a folder and returns import options. Folders have 1,000 rows each."""


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(measure(*json.loads(sys.argv[2]))))
    else:
        sys.exit(main(sys.argv[1:]))
