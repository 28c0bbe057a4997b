"""Number formats of the towers' arithmetic, and of the partial activations in an index."""

import copy
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Array, Sample
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import for_inference, has_fast_bfloat16, touch_batch
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.fusion import Matcher
from retrieval.model.onnx_encoder import OnnxEncoder
from retrieval.training.batches import BatchImages

LOGIT_TOLERANCE = 0.05
"""Largest negligible error of a match logit: the probability changes by about one percentage point at most."""
MAX_TOUCHES = 20
"""Number of touches that each tower format encodes: emulated bfloat16 is slow on processors without it."""
Encode = Callable[[list[Any]], Array]

# Towers ----------------------------------------------------------------------------------------------------


def towers(sample: Sample) -> ApproximationResult:
    """Measure formats of the touch tower: errors of match logits against float64, and the time of one touch."""
    rows = sample.touch_rows[: min(MAX_TOUCHES, sample.scale.queries)]
    loader, photos = BatchImages(sample.checkpoint.config.preprocessing), sample.real_photo_codes["partial"]
    images = [loader.touch(sample.grasps[row]) for row in rows]
    exact = _logits(sample, _touch_partials(copy.deepcopy(sample.checkpoint.matcher).double(), images), photos)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    for name, encode, is_default in encoders(sample.checkpoint):
        error = float(np.abs(_logits(sample, encode(images), photos) - exact).max())
        points.append(Tradeoff(name, "", error, is_default=is_default))
        works.append(partial(encode, images[:1]))
    return ApproximationResult(
        "Number format of the towers",
        f"{len(images)} touches, each with {len(photos)} photos, whose partial activations do not change. A query "
        "encodes with ONNX Runtime instead if the file of `retrieve export` is next to the model.",
        (_panel(sample, points, works, "the touch tower in float64", "encoding one touch, one thread"),),
    )


def _logits(sample: Sample, touch_partials: Array, photos: NDArray[Any]) -> Array:
    return np.array([sample.logits(touch_partial, photos) for touch_partial in touch_partials])


def _panel(
    sample: Sample, points: list[Tradeoff], works: list[Callable[[], object]], reference: str, time: str
) -> Panel:
    timed = time_points(points, works, sample.scale.repeats)
    return Panel("largest error of a match logit", time, "nats", reference, LOGIT_TOLERANCE, timed)


def encoders(checkpoint: Checkpoint) -> Iterator[tuple[str, Encode, bool]]:
    """Yield (name, function from touches to partial activations, whether queries use it) of each tower format.

    ONNX Runtime is included if it is installed.
    """
    matcher = checkpoint.matcher
    fast = for_inference(matcher, "touch_tower")
    yield "float32, as trained", partial(_touch_partials, matcher), False
    yield "float32, folded", partial(_touch_partials, fast), True
    emulated = "" if has_fast_bfloat16(torch.device("cpu")) else " (emulated here)"
    yield f"bfloat16, folded{emulated}", partial(_touch_partials, fast, bfloat16=True), False
    if all(find_spec(name) for name in ("onnx", "onnxruntime")):
        with TemporaryDirectory() as folder:
            path = Path(folder, "model.onnx")
            path.write_bytes(touch_encoder_to_onnx(checkpoint))
            encoder = OnnxEncoder(path, checkpoint.digest, threads=1)
        yield "float32, ONNX Runtime", lambda images: encoder.encode(images)[0], False


@torch.inference_mode()
def _touch_partials(matcher: Matcher, images: list[Any], bfloat16: bool = False) -> Array:
    """Return partial activations (B, partial_width) of touches, computed in the dtype of the matcher's weights.

    With `bfloat16`, the tower runs in bfloat16 and the following layers in float32.
    """
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        features: Tensor = matcher.touch_tower(touch_batch(images).flatten(0, 1))
    features = features.float() if bfloat16 else features
    return matcher.touch_encoding(features.reshape(len(images), -1)).partial.float().numpy()


# Partial activations --------------------------------------------------------------------------------------

STORED = np.float16
"""Format of partial activations in an index."""


def partials(sample: Sample) -> ApproximationResult:
    """Measure formats of stored partial activations: logit errors against float32, and the time of 1,000 photos."""
    queries = sample.queries["partial"]
    whole = sample.real_photo_codes["partial"]
    exact = _logits(sample, queries, whole)
    many = np.tile(whole, (1 + 1000 // len(whole), 1))[:1000]
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    for kind in (np.float32, np.float16):
        stored = many.astype(kind)
        error = float(np.abs(_logits(sample, queries, whole.astype(kind)) - exact).max())
        setting = f"{stored[0].nbytes} bytes a photo"
        points.append(Tradeoff(kind.__name__, setting, error, is_default=kind is STORED))
        works.append(partial(sample.logits, queries[0], stored))
    return ApproximationResult(
        "Number format of stored partial activations",
        f"{len(queries)} touches, each with {len(whole)} photos. Arithmetic is in float32 for both formats. An index "
        "stores float16: half the bytes, and no answer changes.",
        (_panel(sample, points, works, "partial activations in float32", "scoring 1,000 photos, one thread"),),
    )
