"""Number formats: of the towers' arithmetic, and of the halves that an index keeps."""

import copy
import dataclasses
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
from retrieval.frontier.pixels import load_touch
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point, smallest_error
from retrieval.frontier.sample import Array, Sample
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import batches, for_inference, has_fast_bfloat16, touch_batch
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.fusion import Matcher
from retrieval.model.onnx_encoder import OnnxEncoder, with_checksum

LOGIT_TOLERANCE = 0.05
"""Largest error of a match logit that nobody will see: the probability moves by a percent at most."""
FLIP_TOLERANCE = 1.0
MAX_TOUCHES = 20
"""EncodedTouches in every format of the towers: bfloat16 is emulated, slowly, where the processor has none."""
_BATCH = 16

# Towers ----------------------------------------------------------------------------------------------------


def towers(sample: Sample) -> ApproximationResult:
    """Formats of the touch tower: errors of match logits against float64, and the time of one touch."""
    asked = sample.touch_rows[: 2 if sample.scale.quick else min(MAX_TOUCHES, sample.scale.touches)]
    settings = sample.checkpoint.config.preprocessing
    images = [load_touch(settings, sample.grasps[row]) for row in asked]
    photos = sample.real_photo_codes["partial"]
    whole = copy.deepcopy(sample.checkpoint.matcher).double()
    exact = _logits(sample, np.concatenate([_halves(whole, part) for part in batches(images, _BATCH)]), photos)
    errors, flips, works = list[Tradeoff](), list[Tradeoff](), list[Callable[[], object]]()
    for name, encode, is_default in encoders(sample.checkpoint):
        logits = _logits(sample, np.concatenate([encode(part) for part in batches(images, _BATCH)]), photos)
        errors.append(Tradeoff(name, "", float(np.abs(logits - exact).max()), is_default=is_default))
        flips.append(miss_rate_point(name, "", logits.argmax(1) != exact.argmax(1), is_default))
        works.append(partial(encode, images[:1]))
    return ApproximationResult(
        "Number format of the towers",
        f"{len(images)} touches, each with {len(photos)} photos, whose halves stay as they are. A query encodes with "
        "ONNX Runtime instead where `retrieve export` has put its file beside the model.",
        _panels(
            sample, errors, flips, works, len(images), ("the touch tower in float64", "encoding one touch, one thread")
        ),
    )


def _panels(
    sample: Sample,
    errors: list[Tradeoff],
    flips: list[Tradeoff],
    works: list[Callable[[], object]],
    queries: int,
    words: tuple[str, str],
) -> tuple[Panel, Panel]:
    """words: the reference, and what takes the time."""
    reference, time = words
    of_errors = time_points(errors, works, sample.scale.repeats)
    of_flips = tuple(
        dataclasses.replace(flip, seconds=point.seconds) for flip, point in zip(flips, of_errors, strict=True)
    )
    return (
        Panel(
            "largest error of a match logit",
            time,
            "nats",
            reference,
            LOGIT_TOLERANCE,
            of_errors,
            smallest_error(errors),
        ),
        Panel("another photo first", time, "% of touches", reference, FLIP_TOLERANCE, of_flips, 100 / queries),
    )


Encode = Callable[[list[Any]], Array]


def encoders(checkpoint: Checkpoint) -> Iterator[tuple[str, Encode, bool]]:
    """(name, touches to halves, whether a query encodes so); ONNX Runtime only where it is installed."""
    matcher = checkpoint.matcher
    fast = for_inference(matcher)
    yield "float32, as trained", partial(_halves, matcher), False
    yield "float32, folded", partial(_halves, fast), True
    emulated = "" if has_fast_bfloat16(torch.device("cpu")) else " (emulated here)"
    yield f"bfloat16, folded{emulated}", partial(_bfloat16, fast), False
    if all(find_spec(name) for name in ("onnx", "onnxruntime")):
        yield "float32, ONNX Runtime", _onnx(checkpoint), False


def _onnx(checkpoint: Checkpoint) -> Encode:
    """What `retrieve export` writes, on one thread."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "model.onnx")
        path.write_bytes(with_checksum(touch_encoder_to_onnx(checkpoint)))
        encoder = OnnxEncoder(path, checkpoint.digest, threads=1)
    return lambda images: encoder.encode(images)[0]


@torch.inference_mode()
def _halves(matcher: Matcher, images: list[Any]) -> Array:
    """Partials (B, half) of touches, the arithmetic in the type of the matcher's weights."""
    features: Tensor = matcher.touch_tower(touch_batch(images).flatten(0, 1))
    return matcher.touch_encoding(features.reshape(len(images), -1)).partial.float().numpy()


@torch.inference_mode()
def _bfloat16(matcher: Matcher, images: list[Any]) -> Array:
    """The tower in bfloat16, what comes after it in float32."""
    with torch.autocast("cpu", torch.bfloat16):
        features: Tensor = matcher.touch_tower(touch_batch(images).flatten(0, 1))
    return matcher.touch_encoding(features.float().reshape(len(images), -1)).partial.numpy()


def _logits(sample: Sample, partials: Array, photos: NDArray[Any]) -> Array:
    return np.array([sample.logits(partial_activation, photos) for partial_activation in partials])


# Partials ----------------------------------------------------------------------------------------------------


def partials(sample: Sample) -> ApproximationResult:
    """Formats of stored halves: errors of match logits against float32, and the time to judge a thousand photos."""
    asked = sample.touch_encodings(sample.touch_rows[: sample.scale.touches])["partial"]
    whole = sample.real_photo_codes["partial"]
    exact = _logits(sample, asked, whole)
    many = np.tile(whole, (1 + 1000 // len(whole), 1))[:1000]
    errors, flips, works = list[Tradeoff](), list[Tradeoff](), list[Callable[[], object]]()
    for name, store, read, is_default in FORMATS:
        logits = _logits(sample, asked, read(store(whole)))
        setting = f"{sum(part.nbytes for part in store(many)) // len(many)} bytes a photo"
        errors.append(Tradeoff(name, setting, float(np.abs(logits - exact).max()), is_default=is_default))
        flips.append(miss_rate_point(name, setting, logits.argmax(1) != exact.argmax(1), is_default))
        works.append(partial(lambda read, kept: sample.logits(asked[0], read(kept)), read, store(many)))
    return ApproximationResult(
        "Number format of stored halves",
        f"{len(asked)} touches, each with {len(whole)} photos. All are computed with in float32, so a small one "
        "saves memory and no time: an index keeps float16, half the bytes of float32, as long as no answer changes.",
        _panels(sample, errors, flips, works, len(asked), ("halves in float32", "judging 1,000 photos, one thread")),
    )


StoredArrays = tuple[NDArray[Any], ...]


def _as_float(kind: type[np.floating[Any]]) -> Callable[[Array], StoredArrays]:
    return lambda whole: (whole.astype(kind),)


def _as_int8(whole: Array) -> StoredArrays:
    """Whole numbers of -127..127 and a scale for each photo."""
    scale = np.abs(whole).max(1, keepdims=True) / 127
    return np.rint(whole / np.where(scale > 0, scale, 1)).astype(np.int8), scale.astype(np.float32)


FORMATS: tuple[tuple[str, Callable[[Array], StoredArrays], Callable[[StoredArrays], NDArray[Any]], bool], ...] = (
    ("float32", _as_float(np.float32), lambda kept: kept[0], False),
    ("float16", _as_float(np.float16), lambda kept: kept[0], True),
    ("int8, a scale for each photo", _as_int8, lambda kept: kept[0] * kept[1], False),
)
"""(name, how halves are stored, how they are read again, whether an index keeps them so)."""
