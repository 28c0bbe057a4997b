"""Large photos, decoded whole and no larger than their views need: CPU time of one thread, and how far answers move.

    python -m benchmarks.large --photos 12

Scenes of the simulated rig are photographed at 2,048 pixels a side and saved as JPEG files of several sizes; the
shipped model's touches of validation objects judge both. As a measure of what a difference means, the same photos are
saved once more at a lower quality.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator

import numpy as np
import torch
from PIL import Image

from benchmarks.common import ResultLine
from benchmarks.frontier.large_photos import LOWER, PHOTOS, QUALITY, SIDE, as_jpeg, photographed
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import encode_photos, one_thread
from retrieval.model.fusion import scorer_of
from retrieval.search.defaults import shipped_model

SIZES = ((1024, 1024), (2048, 2048), (4000, 3000))


def measure(photos: int = PHOTOS, side: int = SIDE, sizes: tuple[tuple[int, int], ...] = SIZES) -> Iterator[ResultLine]:
    """A line for each (width, height), and one for photos of the first side that were saved again."""
    checkpoint = load_checkpoint(shipped_model())
    tower, plain = checkpoint.config.matcher.tower, checkpoint.config.preprocessing
    reduced = dataclasses.replace(plain, reduced=True)
    pictures = [photographed(number, side) for number in range(photos)]
    with one_thread():
        for size in sizes:
            files = [as_jpeg(picture.resize(size, Image.Resampling.LANCZOS), QUALITY) for picture in pictures]
            (whole, whole_s), (less, less_s) = (_seen(files, settings) for settings in (plain, reduced))
            moved = _moved(checkpoint, whole, less)
            ratio = whole_s / less_s
            text = (
                f"{size[0]} x {size[1]}: decoded and cut in {1e3 * whole_s:.0f} ms whole, in {1e3 * less_s:.0f} ms "
                f"reduced ({ratio:.1f} times faster); {_said(moved)}"
            )
            yield ResultLine("large", tower, text, {"whole_s": whole_s, "reduced_s": less_s, "ratio": ratio, **moved})
        files = [[as_jpeg(picture, quality) for picture in pictures] for quality in (QUALITY, LOWER)]
        moved = _moved(checkpoint, *(_seen(each, plain)[0] for each in files))
        yield ResultLine("large", tower, f"{side} x {side}, saved again at quality {LOWER}: {_said(moved)}", moved)


def _seen(files: list[bytes], settings: Preprocessing) -> tuple[list[RgbImage], float]:
    """What towers see of photos, and the median CPU time for one, in seconds."""
    images, seconds = [], []
    for file in files:
        start = time.process_time()
        images.append(settings.photo_from_bytes(file, "a photo"))
        seconds.append(time.process_time() - start)
    return images, float(np.median(seconds))


def _moved(checkpoint: Checkpoint, before: list[RgbImage], after: list[RgbImage]) -> dict[str, float]:
    """How far grey levels, embeddings and match logits lie apart, and how often another photo is the best one."""
    assert checkpoint.queries is not None
    scorer, touches = scorer_of(checkpoint.matcher.head), torch.from_numpy(checkpoint.queries).float().numpy()
    codes = [encode_photos(checkpoint.matcher, images) for images in (before, after)]
    logits = [np.stack([scorer.logits(touch[None], code.partial.numpy()) for touch in touches]) for code in codes]
    apart = np.abs(logits[0] - logits[1])
    return {
        "grey_levels": float(255 * np.abs(np.array(before) - np.array(after)).mean()),
        "least_cosine": float((codes[0].embedding * codes[1].embedding).sum(1).min()),
        "logit": float(apart.mean()),
        "most_logit": float(apart.max()),
        "spread": float(logits[0].std()),
        "same_top1": float((logits[0].argmax(1) == logits[1].argmax(1)).mean()),
    }


def _said(moved: dict[str, float]) -> str:
    return (
        f"{moved['grey_levels']:.2f} grey levels apart in the mean, embeddings' cosine {moved['least_cosine']:.4f} or "
        f"more, logits {moved['logit']:.2f} in the mean and {moved['most_logit']:.2f} at most (their spread is "
        f"{moved['spread']:.1f}), the same best photo for {moved['same_winner']:.1%} of touches"
    )


def main() -> None:
    """Print the lines; with --json one document a line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.large", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=int, default=PHOTOS)
    parser.add_argument("--json", action="store_true", help="one JSON document a line")
    arguments = parser.parse_args()
    for line in measure(arguments.photos):
        print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
