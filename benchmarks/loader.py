"""Images per second that the loader decodes, compared with the rate of the towers.

    python -m benchmarks.loader --recording recording/ --config small

It measures threads, which training uses, and processes, all in turn, with one worker and more. Then it measures
training steps with decoded images in memory, and the ratio of both: below 1 the towers wait for the loader. Without
`--recording` it draws pictures of camera size.
"""

import argparse
import dataclasses
import json
import multiprocessing
import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import ResultLine, as_text, in_turns
from benchmarks.training import matching
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.loading import map_in_order, worker_count
from retrieval.data.preprocessing import Preprocessing
from retrieval.model.config import Config, load_config
from robot.recording.folder import RecordingWriter

REPETITIONS, MAX_IMAGES, STEPS = 5, 32, 2
PHOTO_PX, GEL_PX = (1280, 960), (640, 480)


def load(settings: Preprocessing, files: tuple[bool, tuple[Path, ...]]) -> tuple[int, ...]:
    """Decode one image; only its shape is returned, so that processes are not charged for copies."""
    is_photo, paths = files
    return (settings.load_photo if is_photo else settings.load_touch)(*paths).shape


def files_of(grasps: Sequence[Grasp], settings: Preprocessing) -> list[tuple[bool, tuple[Path, ...]]]:
    """Return photos and gel images of grasps, as arguments of `load`."""
    photos = [(True, (path,)) for path in dict.fromkeys(grasp.photo for grasp in grasps)]
    no_background = settings.background == "none"
    pairs = [((touch,) if no_background else (touch, before)) for grasp in grasps for touch, before in _frames(grasp)]
    gels = [(False, pair) for pair in pairs]
    return [each for pair in zip(photos, gels, strict=False) for each in pair][:MAX_IMAGES]


def _frames(grasp: Grasp) -> list[tuple[Path, Path]]:
    return list(zip(grasp.touches, grasp.backgrounds or grasp.touches, strict=True))


def decoding(
    grasps: Sequence[Grasp], config: Config, counts: Sequence[int]
) -> tuple[dict[str, float], list[ResultLine]]:
    """Return images per second for each kind and number of workers, with the lines to print."""
    settings, spawn = config.preprocessing, multiprocessing.get_context("spawn")
    files = files_of(grasps, settings)
    with ExitStack() as stack:
        pools: dict[str, Executor] = {}
        for count in counts:
            pools[f"{count} thread(s)"] = stack.enter_context(ThreadPoolExecutor(count))
            pools[f"{count} process(es)"] = stack.enter_context(ProcessPoolExecutor(count, spawn))
        arms = {name: partial(_all, pool, settings, files) for name, pool in pools.items()}
        times = in_turns(arms, REPETITIONS)
    rates = {name: len(files) / times.median(name) for name in arms}
    lines = []
    for kind in ("thread(s)", "process(es)"):
        first = f"{counts[0]} {kind}"
        for name in (f"{count} {kind}" for count in counts):
            ratio = times.ratio(first, name)
            text = f"{rates[name]:.0f} images/s, {as_text(ratio)} the rate of {first}"
            lines.append(ResultLine("decode", name, text, {"images_s": rates[name], "ratio": ratio[0]}))
    return rates, lines


def _all(pool: Executor, settings: Preprocessing, files: Sequence[tuple[bool, tuple[Path, ...]]]) -> None:
    for _ in map_in_order(pool, partial(load, settings), files, 32):
        pass


def lines(recording: Path, config: Config, counts: Sequence[int]) -> Iterator[ResultLine]:
    """Measure the loader and the towers; yield the lines to print."""
    rates, found = decoding(load_grasps(recording), config, counts)
    yield from found
    if config.training.freeze_towers:
        return
    with tempfile.TemporaryDirectory() as name, matching(config, recording, Path(name)) as (_, works):
        times = in_turns({"towers": partial(works["cached"].steps, STEPS)}, 3)
    towers = STEPS * works["cached"].images / times.median("towers")
    count = min(counts, key=lambda count: abs(count - worker_count()))
    ratio = rates[f"{count} thread(s)"] / towers
    text = f"the towers process {towers:.0f} images/s; {count} thread(s) decode {ratio:.2g} times as many"
    yield ResultLine("ratio", config.matcher.tower, text, {"towers_images_s": towers, "ratio": ratio})


def drawn(folder: Path, grasps: int = 48) -> Path:
    """Write a recording of noise at the resolution of a camera and of a sensor."""
    rng = np.random.default_rng(0)

    def picture(size: tuple[int, int]) -> np.ndarray:
        coarse = rng.integers(0, 256, (size[1] // 8, size[0] // 8, 3), dtype=np.uint8)
        return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))

    with RecordingWriter(folder, {"source": "drawn", "sensor": "none"}) as writer:
        for number in range(grasps):
            images = {"photo": picture(PHOTO_PX), "touch_a": picture(GEL_PX), "touch_b": picture(GEL_PX)}
            writer.append(f"{number:06d}", f"object-{number % 12}", images)
    return folder


def main() -> None:
    """Print each line as soon as it is available."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.loader", description=__doc__.split("\n\n")[0])
    parser.add_argument("--recording", type=Path, help="recording with the images to decode (default: random pictures)")
    parser.add_argument("--config", default="small", help="preset or TOML file: preprocessing and towers")
    parser.add_argument("--workers", nargs="+", type=int, default=sorted({1, 2, os.cpu_count() or 1}))
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    config = load_config(arguments.config).without_candidate_encoder()
    config = dataclasses.replace(config, training=dataclasses.replace(config.training, init="random"))
    with tempfile.TemporaryDirectory() as name:
        recording = arguments.recording or drawn(Path(name, "drawn"))
        for line in lines(recording, config, arguments.workers):
            print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
