"""`retrieve export`: the touch encoder as ONNX, if it is faster so on this machine."""

import logging
import stat
import statistics
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor, nn

from _touch_retrieval.files import write_atomically
from retrieval.console.files import EXPORT, make_cache_folder, require_folder, require_ours, require_private
from retrieval.errors import BadInput, CheckpointError, RetrievalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import TorchEncoder, for_inference
from retrieval.model.fusion import Matcher, Standardise
from retrieval.model.onnx_encoder import (
    CHECKPOINT_KEY,
    EXPORT_SUFFIX,
    OnnxEncoder,
    cached_export_path,
    read_checked_export,
    with_checksum,
)

log = logging.getLogger(__name__)
ROUNDS = 9
TOLERANCE = 1e-3
"""Largest difference of a half from PyTorch's, relative to the largest half, and of an embedding's component."""


@dataclass(frozen=True)
class ExportReport:
    """What came of an export. Times are medians for one touch; differences are the largest, of halves relative to the
    largest half.
    """

    path: str
    torch_ms: float
    onnx_ms: float
    partial_difference: float
    embedding_difference: float

    def __str__(self) -> str:
        return (
            f"{self.path}: a touch is encoded in {self.onnx_ms:.1f} ms by ONNX Runtime, in {self.torch_ms:.1f} ms by "
            f"PyTorch ({self.torch_ms / self.onnx_ms:.2f} times); halves differ by {self.partial_difference:.1g} of the "
            f"largest, embeddings by {self.embedding_difference:.1g}"
        )


def export(checkpoint: Checkpoint, out: Path | None = None) -> ExportReport:
    """Write the touch encoder of a checkpoint as ONNX: beside the checkpoint, where `retrieve query` looks for it, or
    to `out`.

    Raises BadInput where `onnx` or `onnxruntime` is missing; RetrievalError, and nothing is written, where ONNX
    Runtime is not the faster one here or gives other numbers than PyTorch.
    """
    lacking = [name for name in ("onnx", "onnxruntime") if find_spec(name) is None]
    if lacking:
        raise BadInput(f"export needs {lacking[0]}; install it with `pip install 'touch-retrieval[onnx]'`")
    path = out or checkpoint.path.with_suffix(EXPORT_SUFFIX)
    if path.suffix != EXPORT_SUFFIX:
        raise BadInput(f"an export must be named *{EXPORT_SUFFIX}; got {path}")
    require_ours(path, EXPORT)
    require_folder(path)
    unverified = path.with_name(f".{path.name}.unsettled")
    try:
        write_atomically(unverified, with_checksum(touch_encoder_to_onnx(checkpoint)))
        unverified.chmod(unverified.stat().st_mode & ~(stat.S_IWGRP | stat.S_IWOTH))  # else no query takes it
        result = compare(checkpoint, unverified, path)
        if not max(result.partial_difference, result.embedding_difference) <= TOLERANCE:
            raise RetrievalError(f"nothing is exported, as ONNX Runtime gives other numbers. {result}")
        if result.onnx_ms >= result.torch_ms:
            raise RetrievalError(f"nothing is exported, as PyTorch is as fast on this machine. {result}")
        unverified.replace(path)
    finally:
        unverified.unlink(missing_ok=True)
    return result


def export_to_cache(checkpoint: Checkpoint) -> ExportReport | None:
    """Write the export of a checkpoint to the user's cache, where queries look for it too: once, and only where none
    lies beside the checkpoint. For a checkpoint in the folder of an installed package, which is not ours to write to.

    None where there is nothing to do, or nothing can be done: a query works without it. A folder that is open to other
    users is left alone, and a warning says so.
    """
    path = cached_export_path(checkpoint.digest)
    if path is None or checkpoint.path.with_suffix(EXPORT_SUFFIX).is_file():
        return None
    try:
        make_cache_folder(path.parent)
        require_private(path.parent, path.parent.stat())
    except BadInput as error:
        log.warning("%s; no export for queries is kept there", error)
        return None
    except OSError as error:
        log.info("no export for queries: %s", error)
        return None
    with suppress(CheckpointError):  # none yet, a damaged one, or one that others could write to
        read_checked_export(path)
        return None
    try:
        path.unlink(missing_ok=True)  # of the cache everything is ours, whatever it holds by now
        return export(checkpoint, path)
    except (OSError, RetrievalError) as error:
        log.info("no export for queries: %s", error)
        return None


def touch_encoder_to_onnx(checkpoint: Checkpoint) -> bytes:
    """The touch encoder as an ONNX model that carries the checkpoint's digest; any number of touches at once."""
    side, fingers = checkpoint.config.preprocessing.touch_px, checkpoint.config.matcher.fingers
    outputs = ["partial", "embedding"] + (["readings"] if checkpoint.matcher.gel_head else [])
    return _trace(_TouchEncoder(checkpoint.matcher), (fingers, side, side, 3), outputs, checkpoint.digest)


def photo_encoder_to_onnx(checkpoint: Checkpoint) -> bytes:
    """The same of the photo encoder: images (B, H, views * W, 3) to halves and embeddings."""
    side, views = checkpoint.config.preprocessing.photo_px, checkpoint.matcher.views
    encoder = _PhotoEncoder(checkpoint.matcher)
    return _trace(encoder, (side, views * side, 3), ["partial", "embedding"], checkpoint.digest)


def _trace(encoder: nn.Module, shape: tuple[int, ...], outputs: list[str], digest: str) -> bytes:
    import onnx

    with TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter by tracing is the old one; the new one needs one more package
        torch.onnx.export(
            encoder.eval(),  # the exporter leaves modules, shared ones too, as it found this
            (torch.zeros(1, *shape),),
            str(Path(folder, "model.onnx")),
            input_names=["images"],
            output_names=outputs,
            dynamic_axes={name: {0: "items"} for name in ("images", *outputs)},
            opset_version=18,
            dynamo=False,
        )
        model = onnx.load_model(str(Path(folder, "model.onnx")))
    onnx.helper.set_model_props(model, {CHECKPOINT_KEY: digest})
    return bytes(model.SerializeToString())


class _TouchEncoder(nn.Module):
    """Images (B, fingers, H, W, 3) to halves, embeddings and what the gel head reads, where the matcher has one;
    without the checks of values, which ONNX has not.
    """

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.matcher = _exportable_matcher(matcher, "touch")

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        tower = self.matcher.touch_tower
        pictures = images.permute(0, 1, 4, 2, 3).flatten(0, 1)
        features = tower._encode((pictures - tower.mean) / tower.std)
        features = features.reshape(-1, self.matcher.config.fingers * tower.feature_count)
        code, readings = self.matcher.touch_search_encoding(features), self.matcher.gel_readings(features)
        return (code.partial, code.embedding) if readings is None else (code.partial, code.embedding, readings)


class _PhotoEncoder(nn.Module):
    """Images (B, H, views * W, 3) to halves and embeddings."""

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.matcher = _exportable_matcher(matcher, "photo")

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        tower, views = self.matcher.photo_tower, self.matcher.views
        side = images.shape[1]
        pictures = images.reshape(-1, side, views, side, 3).permute(0, 2, 4, 1, 3).flatten(0, 1)
        features = tower._encode((pictures - tower.mean) / tower.std)
        code = self.matcher.photo_search_encoding(features.reshape(-1, views * tower.feature_count))
        return code.partial, code.embedding


def _exportable_matcher(matcher: Matcher, side: str) -> Matcher:
    """A matcher whose tower is folded, and whose normalisation of features is plain arithmetic."""
    fast = for_inference(matcher, [f"{side}_tower"])
    norm = matcher.get_submodule(f"{side}_norm")
    if isinstance(norm, Standardise):
        fast.add_module(f"{side}_norm", _FrozenNorm(norm))
    return fast


class _FrozenNorm(nn.Module):
    """Normalisation of features in evaluation mode: the exporter wants to know the width of its input."""

    def __init__(self, norm: Standardise) -> None:
        super().__init__()
        self.mean, self.scale = norm.mean_and_scale()

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) * self.scale


def compare(checkpoint: Checkpoint, written: Path, path: Path) -> ExportReport:
    """Encode the same touch by both in turns; `path` is what `written` will be called."""
    ours, theirs = TorchEncoder(checkpoint.matcher), OnnxEncoder(written, checkpoint.digest)
    side, fingers = checkpoint.config.preprocessing.touch_px, checkpoint.config.matcher.fingers
    touch = list(np.random.default_rng(0).random((fingers, side, side, 3), dtype=np.float32))
    (partial, embedding, *_), (other_partial, other_embedding, *_) = ours.encode([touch]), theirs.encode([touch])
    times = [(_ms(lambda: ours.encode([touch])), _ms(lambda: theirs.encode([touch]))) for _ in range(ROUNDS)]
    torch_ms, onnx_ms = (statistics.median(arm) for arm in zip(*times, strict=True))
    partial_difference = float(np.abs(partial - other_partial).max() / np.abs(partial).max())
    return ExportReport(
        str(path), torch_ms, onnx_ms, partial_difference, float(np.abs(embedding - other_embedding).max())
    )


def _ms(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - start)
