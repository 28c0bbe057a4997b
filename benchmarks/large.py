"""Large photos, decoded at full size and at reduced size: CPU time of one thread, and the change of answers.

    python -m benchmarks.large --photos 12

Scenes of the simulated rig are photographed at 2,048 pixels a side and saved as JPEG files of several sizes. The
shipped model's touches of validation objects score both. As a scale for the differences, the same photos are saved once
more at a lower quality.
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
    """Yield a line for each (width, height), and one for photos of the first side that were saved again."""
    checkpoint = load_checkpoint(shipped_model())
    tower, reduced = checkpoint.config.matcher.tower, checkpoint.config.preprocessing
    plain = dataclasses.replace(reduced, reduced=False)
    pictures = [photographed(number, side) for number in range(photos)]
    with one_thread():
        for size in sizes:
            files = [as_jpeg(picture.resize(size, Image.Resampling.LANCZOS), QUALITY) for picture in pictures]
            (full, full_s), (small, small_s) = (_load(files, settings) for settings in (plain, reduced))
            change = _compare(checkpoint, full, small)
            ratio = full_s / small_s
            text = (
                f"{size[0]} x {size[1]}: decoded and cropped in {1e3 * full_s:.0f} ms at full size, in "
                f"{1e3 * small_s:.0f} ms reduced ({ratio:.1f} times faster); {_describe(change)}"
            )
            yield ResultLine("large", tower, text, {"whole_s": full_s, "reduced_s": small_s, "ratio": ratio, **change})
        files = [[as_jpeg(picture, quality) for picture in pictures] for quality in (QUALITY, LOWER)]
        change = _compare(checkpoint, *(_load(each, plain)[0] for each in files))
        yield ResultLine(
            "large", tower, f"{side} x {side}, saved again at quality {LOWER}: {_describe(change)}", change
        )


def _load(files: list[bytes], settings: Preprocessing) -> tuple[list[RgbImage], float]:
    """Return the towers' views of photos, and the median CPU time of one in seconds."""
    images, seconds = [], []
    for file in files:
        start = time.process_time()
        images.append(settings.photo_from_bytes(file, "a photo"))
        seconds.append(time.process_time() - start)
    return images, float(np.median(seconds))


def _compare(checkpoint: Checkpoint, before: list[RgbImage], after: list[RgbImage]) -> dict[str, float]:
    """Compare grey levels, embeddings, match logits and the best photo of each touch."""
    assert checkpoint.queries is not None
    scorer, touches = scorer_of(checkpoint.matcher.head), torch.from_numpy(checkpoint.queries).float().numpy()
    codes = [encode_photos(checkpoint.matcher, images) for images in (before, after)]
    logits = [np.stack([scorer.logits(touch[None], code.partial.numpy()) for touch in touches]) for code in codes]
    difference = np.abs(logits[0] - logits[1])
    return {
        "grey_levels": float(255 * np.abs(np.array(before) - np.array(after)).mean()),
        "least_cosine": float((codes[0].embedding * codes[1].embedding).sum(1).min()),
        "logit": float(difference.mean()),
        "most_logit": float(difference.max()),
        "spread": float(logits[0].std()),
        "same_top1": float((logits[0].argmax(1) == logits[1].argmax(1)).mean()),
    }


def _describe(change: dict[str, float]) -> str:
    return (
        f"mean difference of {change['grey_levels']:.2f} grey levels, embeddings' cosine at least "
        f"{change['least_cosine']:.4f}, logits differ by {change['logit']:.2f} in the mean and at most "
        f"{change['most_logit']:.2f} (their spread is {change['spread']:.1f}), the same best photo for "
        f"{change['same_top1']:.1%} of touches"
    )


def main() -> None:
    """Print the lines; with --json one document per line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.large", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=int, default=PHOTOS)
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    for line in measure(arguments.photos):
        print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
