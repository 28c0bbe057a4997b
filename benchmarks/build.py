"""Build an index from JPEG files end to end, compared with encoding prepared images and with an unchanged rebuild.

The bare arm is `encode_photos`, which the build also uses, batch by batch, with PyTorch's own threads. With a large
tower, the difference to 1 is reading, decoding and resizing. With a small tower these are most of the work, and no
schedule hides them.
"""

import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import torch

from benchmarks.common import ResultLine, Times, as_text, duration, in_turns, matcher_of
from retrieval.data.images import read_bytes
from retrieval.data.resize import RgbImage
from retrieval.indexing.build import build_index
from retrieval.indexing.codes import BATCH, MIN_PHOTOS_FOR_ONNX, map_ahead
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import batches, encode_photos, one_thread
from retrieval.model.export import choose_photo_encoder
from retrieval.model.shipped import shipped_model
from tests import synthetic

PHOTOS = {"small": 256}
DRAWN = 16


def measure(
    config: Config, photos: int | None = None, photo_px: int = 512, repetitions: int = 3
) -> Iterator[ResultLine]:
    """Yield one line for `photos` JPEG files of `photo_px` x `photo_px` pixels, made of `DRAWN` different pictures."""
    number = photos or PHOTOS.get(config.matcher.tower, 64)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        provenance = {"source": "random weights", "step": 0, "data_digest": "0" * 64, "metrics": {}}
        model, matcher = folder / "random.safetensors", matcher_of(config)
        store_checkpoint(Checkpoint(model, "", config, provenance, matcher=matcher), model)
        checkpoint = load_checkpoint(model)
        images, build = _ready(folder, checkpoint, number, photo_px)

        def bare() -> None:
            encode_photos(checkpoint.matcher, images, BATCH)

        build("index")
        arms = {"build": build, "bare": bare, "again": lambda: build("index")}
        times = in_turns(arms, repetitions)
    ours, other, ratio = number / times.median("build"), number / times.median("bare"), times.ratio("bare", "build")
    again = times.ratio("build", "again")
    yield ResultLine(
        "build",
        config.matcher.tower,
        f"{ours:.3g} photos per second end to end ({number} JPEG files of {photo_px} px), {other:.3g} through the bare "
        f"tower: {as_text(ratio)} its rate; an unchanged rebuild is {as_text(again)} as fast",
        {"photos": number, "build_per_s": ours, "bare_per_s": other, "ratio": ratio[0], "ratio_again": again[0]},
        times.seconds,
    )


def measure_shipped(photos: int = 768, photo_px: int = 512, repetitions: int = 3) -> Iterator[ResultLine]:
    """Yield one line for the shipped model, with enough photos for the build to choose a faster encoder.

    The time of this choice is listed separately. The bare arm is only that encoder, on as many threads, with prepared
    images. The work arm decodes, crops and encodes, without an index.
    """
    checkpoint = load_checkpoint(shipped_model())
    photo_from_bytes = checkpoint.config.preprocessing.photo_from_bytes

    def load(path: Path) -> RgbImage:
        return photo_from_bytes(read_bytes(path), path)

    with tempfile.TemporaryDirectory() as name:
        images, build = _ready(Path(name), checkpoint, photos, photo_px)
        paths = sorted((Path(name) / "catalog").rglob("*.jpg"))
        encode, threads = choose_photo_encoder(checkpoint), torch.get_num_threads()

        def on_threads(work: Callable[[Any], object], items: Iterable[Any]) -> None:
            with one_thread():
                deque(map_ahead(work, batches(items, BATCH), threads, 2 * threads), maxlen=0)

        arms = {
            "build": build,
            "bare": lambda: on_threads(encode, images),
            "work": lambda: on_threads(lambda some: encode([load(path) for path in some]), paths),
            "looking": lambda: choose_photo_encoder(checkpoint),
        }
        taken = in_turns(arms, repetitions).seconds
    if photos < MIN_PHOTOS_FOR_ONNX:
        taken["looking"] = [0.0] * repetitions
    without_tuning = [build_s - tuning for build_s, tuning in zip(taken["build"], taken["looking"], strict=True)]
    times = Times({**taken, "beyond": without_tuning})
    rate = {arm: photos / times.median(arm) for arm in ("beyond", "bare", "work", "build")}
    ratio, work_ratio = times.ratio("bare", "beyond"), times.ratio("work", "beyond")
    yield ResultLine(
        "build",
        "shipped",
        f"{rate['beyond']:.3g} photos per second end to end ({photos} JPEG files of {photo_px} px) without the choice "
        f"of a faster encoder, which takes {duration(times.median('looking'))}; {rate['bare']:.3g} through it alone: "
        f"{as_text(ratio)} its rate; {rate['work']:.3g} decoded and encoded alone: {as_text(work_ratio)}",
        {"photos": photos, "ratio": ratio[0], "ratio_work": work_ratio[0]}
        | {f"{arm}_per_s": one for arm, one in rate.items()},
        times.seconds,
    )


def _ready(
    folder: Path, checkpoint: Checkpoint, photos: int, photo_px: int
) -> tuple[list[RgbImage], Callable[..., None]]:
    """Return the towers' views of a synthetic catalogue, and a function that builds a new index of it."""
    catalogue, fresh = _write_catalogue(folder / "catalog", photos, photo_px), count()

    def build(out: str | None = None) -> None:
        build_index(catalogue, checkpoint, folder / (out or f"index{next(fresh)}"), quiet=True)

    return [checkpoint.config.preprocessing.load_photo(path) for path in sorted(catalogue.rglob("*.jpg"))], build


def _write_catalogue(folder: Path, photos: int, px: int) -> Path:
    drawn = [synthetic.draw_photo(synthetic.make_object(seed), 0, px) for seed in range(min(DRAWN, photos))]
    for number in range(photos):
        path = folder / f"object{number % 16:02}" / f"{number}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), drawn[number % len(drawn)][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    return folder
