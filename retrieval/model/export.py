"""Encoders as ONNX: that of touches for queries without PyTorch (`retrieve export`), that of photos for long builds."""

import json
import logging
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor, nn

from _touch_retrieval.files import write_atomically
from retrieval.console.files import require_output
from retrieval.data.dataset import LICENCES
from retrieval.errors import BadInput, CheckpointError, RetrievalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import (
    Image,
    PhotoEncoder,
    TorchEncoder,
    for_inference,
    torch_photo_encoder,
)
from retrieval.model.fusion import Matcher
from retrieval.model.onnx_encoder import (
    CHECKPOINT_KEY,
    EXPORT_SUFFIX,
    LICENCES_KEY,
    OnnxEncoder,
    cached_export_path,
    open_session,
)
from retrieval.model.touch_reader import EncodedTouches, TouchEncodings

log = logging.getLogger(__name__)
TOLERANCE = 5e-4
"""Largest accepted difference from PyTorch: of partial activations relative to the largest, of embeddings absolute.
Storage as float16 rounds by as much."""


def export(checkpoint: Checkpoint, out: Path | None = None) -> Path:
    """Write the touch encoder of a checkpoint as ONNX, and return the file.

    Args:
        checkpoint: The model.
        out: The file to write; by default the name next to the checkpoint that `retrieve query` looks up.

    Raises:
        BadInput: `onnx` or `onnxruntime` is missing, or the file has another suffix.
        RetrievalError: The results of ONNX Runtime differ from PyTorch's. Nothing is written.
    """
    lacking = [name for name in ("onnx", "onnxruntime") if find_spec(name) is None]
    if lacking:
        raise BadInput(f"export needs {lacking[0]}; install it with `pip install 'touch-retrieval[onnx]'`")
    path = out or checkpoint.path.with_suffix(EXPORT_SUFFIX)
    require_output(path, EXPORT_SUFFIX)
    model = touch_encoder_to_onnx(checkpoint)
    side, fingers = checkpoint.config.preprocessing.touch_px, checkpoint.config.matcher.fingers
    touch = list(np.random.default_rng(0).random((fingers, side, side, 3), dtype=np.float32))
    encoders = TorchEncoder(checkpoint.matcher), OnnxEncoder(model, checkpoint.digest)
    difference = _difference(*(encoder.encode([touch]) for encoder in encoders))
    if not difference <= TOLERANCE:
        raise RetrievalError(
            f"nothing is exported, because ONNX Runtime gives other numbers than PyTorch: they differ by "
            f"{difference:.1g}, and {TOLERANCE:g} is accepted"
        )
    write_atomically(path, model)
    return path


def export_to_cache(checkpoint: Checkpoint) -> Path | None:
    """Export a checkpoint of an installed package to the user's cache, where queries also look.

    Returns:
        The file; None if an export exists already or cannot be written. Queries work without it.
    """
    path = cached_export_path(checkpoint.digest)
    if path.is_file() or checkpoint.path.with_suffix(EXPORT_SUFFIX).is_file():
        return None
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        return export(checkpoint, path)
    except (OSError, RetrievalError) as error:
        log.info("no export for queries: %s", error)
        return None


def choose_photo_encoder(checkpoint: Checkpoint) -> PhotoEncoder:
    """Return the photo encoder of a long build: ONNX Runtime's if it is installed and agrees with PyTorch's on the CPU.

    Do not call this while other threads encode: the export would also record their operations.
    """
    encode = torch_photo_encoder(checkpoint.matcher)
    is_installed = all(find_spec(name) for name in ("onnx", "onnxruntime"))
    if not is_installed or next(checkpoint.matcher.parameters()).device.type != "cpu":
        return encode
    try:
        session = open_session(photo_encoder_to_onnx(checkpoint), checkpoint.digest, threads=1)
    except CheckpointError as error:
        log.warning("%s; PyTorch encodes the photos", error)
        return encode

    def encode_by_onnx(images: Sequence[Image]) -> EncodedTouches:
        partials, embeddings = session.run(None, {"images": np.stack(images)})
        return EncodedTouches(embeddings, partials)

    settings = checkpoint.config.preprocessing
    shape = settings.photo_px, len(settings.views) * settings.photo_px, 3
    images = list(np.random.default_rng(0).random((4, *shape), dtype=np.float32))
    if not _difference(encode(images), encode_by_onnx(images)) <= TOLERANCE:
        log.warning("ONNX Runtime gives other partial activations than PyTorch; PyTorch encodes the photos")
        return encode
    return encode_by_onnx


def touch_encoder_to_onnx(checkpoint: Checkpoint) -> bytes:
    """Return the touch encoder as an ONNX model with the checkpoint's digest, for any number of touches at once."""
    matcher, side = for_inference(checkpoint.matcher, "touch_tower"), checkpoint.config.preprocessing.touch_px
    outputs = ["partial", "embedding"] + (["readings"] if matcher.gel_head else [])
    encoder = _Encoder(matcher, lambda images: matcher.encode_touches(images.permute(0, 1, 4, 2, 3)))
    return _trace(encoder, (matcher.config.fingers, side, side, 3), outputs, checkpoint)


def photo_encoder_to_onnx(checkpoint: Checkpoint) -> bytes:
    """Return the photo encoder as ONNX: images (B, H, views * W, 3) to partial activations and embeddings."""
    matcher, side = for_inference(checkpoint.matcher, "photo_tower"), checkpoint.config.preprocessing.photo_px
    encoder = _Encoder(
        matcher, lambda images: matcher.photo_search_encoding(matcher.photo_features(images.permute(0, 3, 1, 2)))
    )
    return _trace(encoder, (side, matcher.views * side, 3), ["partial", "embedding"], checkpoint)


class _Encoder(nn.Module):
    """A matcher whose forward pass is a function of images with channels last."""

    def __init__(self, matcher: Matcher, encode: Callable[[Tensor], tuple[Tensor, ...]]) -> None:
        super().__init__()
        self.matcher, self.encode = matcher, encode

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return self.encode(images)


def _trace(encoder: nn.Module, shape: tuple[int, ...], outputs: list[str], checkpoint: Checkpoint) -> bytes:
    import onnx

    with TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the tracing exporter is deprecated; the new one needs one more package
        torch.onnx.export(
            encoder.eval(),  # the exporter leaves all modules, shared ones too, in the mode of this one
            (torch.zeros(1, *shape),),
            str(Path(folder, "model.onnx")),
            input_names=["images"],
            output_names=outputs,
            dynamic_axes={name: {0: "items"} for name in ("images", *outputs)},
            opset_version=18,
            dynamo=False,
        )
        model = onnx.load_model(str(Path(folder, "model.onnx")))
    licences = json.dumps(checkpoint.provenance.get(LICENCES, []))
    onnx.helper.set_model_props(model, {CHECKPOINT_KEY: checkpoint.digest, LICENCES_KEY: licences})
    return bytes(model.SerializeToString())


def _difference(by_torch: TouchEncodings | EncodedTouches, by_onnx: TouchEncodings | EncodedTouches) -> float:
    """Return the largest difference of two encodings, as `TOLERANCE` states it."""
    relative = np.abs(by_torch.partials - by_onnx.partials).max() / np.abs(by_torch.partials).max()
    return float(max(relative, np.abs(by_torch.embeddings - by_onnx.embeddings).max()))
