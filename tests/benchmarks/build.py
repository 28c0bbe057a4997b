"""Building an index from JPEG files end to end, against encoding images that are ready, and against building again.

Bare is what the build itself uses: `encode_photos`, batch by batch, with PyTorch's own team of threads. What is left
of 1 is reading, decoding and resizing, where the tower is large; where it is small these are most of the work, and no
order of doing them hides them.
"""

import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import cv2

from retrieval.model.checkpoint import load_checkpoint, save_checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import encode_photos
from retrieval.search.build import build_index
from retrieval.search.embed import BATCH
from tests import synthetic
from tests.benchmarks.common import Line, as_text, in_turns, matcher_of

PHOTOS = {"small": 256}
DRAWN = 16


def measure(config: Config, photos: int | None = None, photo_px: int = 512, repetitions: int = 3) -> Iterator[Line]:
    """One line. Files: `photos` JPEG of `photo_px` x `photo_px` pixels, of `DRAWN` different pictures."""
    number = photos or PHOTOS.get(config.matcher.tower, 64)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        catalogue = _write_catalogue(folder / "catalog", number, photo_px)
        provenance = {"source": "random weights", "step": 0, "data_digest": "0" * 64, "metrics": {}}
        model, matcher = folder / "random.safetensors", matcher_of(config)
        save_checkpoint(model, matcher, config, split=None, provenance=provenance)
        checkpoint, fresh = load_checkpoint(model), count()
        images = [config.preprocessing.load_photo(path) for path in sorted(catalogue.rglob("*.jpg"))]

        def bare() -> None:
            encode_photos(checkpoint.matcher, images, BATCH)

        def build(out: str) -> None:
            build_index(catalogue, checkpoint, folder / out, quiet=True)

        build("index")
        arms = {"build": lambda: build(f"index{next(fresh)}"), "bare": bare, "again": lambda: build("index")}
        times = in_turns(arms, repetitions)
    ours, other, ratio = number / times.median("build"), number / times.median("bare"), times.ratio("bare", "build")
    again = times.ratio("build", "again")
    yield Line(
        "build",
        config.matcher.tower,
        f"{ours:.3g} photos per second end to end ({number} JPEG files of {photo_px} px), {other:.3g} through the bare "
        f"tower: {as_text(ratio)} its rate; building again with nothing changed is faster {as_text(again)}",
        {"photos": number, "build_per_s": ours, "bare_per_s": other, "ratio": ratio[0], "ratio_again": again[0]},
    )


def _write_catalogue(folder: Path, photos: int, px: int) -> Path:
    drawn = [synthetic.draw_photo(synthetic.make_object(seed), 0, px) for seed in range(min(DRAWN, photos))]
    for number in range(photos):
        path = folder / f"object{number % 16:02}" / f"{number}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), drawn[number % len(drawn)][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    return folder
