"""The touch encoder on ONNX Runtime, as `retrieve export` writes it beside a checkpoint: a query without PyTorch.

The file is ONNX with the checkpoint's digest among its metadata. The last entry of these is a SHA-256 of everything
before it, since ONNX itself takes a flipped bit in a weight for what it is.
"""

import hashlib
import logging
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import CheckpointError
from retrieval.resize import RgbImage
from retrieval.stored import Stored

log = logging.getLogger(__name__)
ENDING = ".onnx"
CHECKPOINT = "touch_retrieval.checkpoint"
_SEAL = b"touch_retrieval.sha256"
_SEAL_BYTES = 2 + 2 + len(_SEAL) + 2 + 64
Floats = NDArray[np.float32]


class OnnxEncoder:
    """An exported touch encoder, opened."""

    name = "onnx"

    def __init__(self, path: Path, checkpoint: str, threads: int | None = None) -> None:
        """Open `path`, which must be the export of the checkpoint with that digest. threads: None leaves the choice
        to ONNX Runtime. Raises CheckpointError for another or a damaged one."""
        import onnxruntime

        model = unsealed(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or 0
        # Its threads would spin after a run, on the cores that decode the next images or judge candidates.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its errors have no common base
            raise CheckpointError(f"{path} cannot be opened by ONNX Runtime ({type(error).__name__})") from error
        made_from = self._session.get_modelmeta().custom_metadata_map.get(CHECKPOINT, "unknown")
        if made_from != checkpoint:
            raise CheckpointError(f"{path} is the export of another checkpoint ({made_from[:12]})")

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> tuple[Floats, Floats]:
        """Halves (B, hidden) and embeddings (B, embedding_dim) of touches, each its fingers' images in 0..1."""
        images = np.stack([np.stack(fingers) for fingers in touches])
        half, embedding = self._session.run(None, {"images": images})
        return half, embedding


def exported_beside(checkpoint: Stored) -> OnnxEncoder | None:
    """The export that lies beside a checkpoint, where it is of this checkpoint and ONNX Runtime is installed.

    One that is stale or damaged is not used, and a warning says so.
    """
    path = checkpoint.path.with_suffix(ENDING)
    if not path.is_file() or find_spec("onnxruntime") is None:
        return None
    try:
        return OnnxEncoder(path, checkpoint.digest)
    except CheckpointError as error:
        log.warning("%s; PyTorch is used instead (slower to start): run `retrieve export` again", error)
        return None


def sealed(model: bytes) -> bytes:
    """`model` with one more entry of metadata: `metadata_props` is field 14 of ONNX's ModelProto, a map entry has its
    key in field 1 and its value in field 2, and what stands last in a protocol buffer is merged with the rest."""
    entry = _field(1, _SEAL) + _field(2, hashlib.sha256(model).hexdigest().encode())
    return model + _field(14, entry)


def unsealed(path: Path) -> bytes:
    """The bytes of a sealed file. Raises CheckpointError where one of them changed."""
    data = path.read_bytes()
    if len(data) <= _SEAL_BYTES or sealed(data[:-_SEAL_BYTES]) != data:
        raise CheckpointError(f"{path} is damaged or no export of `retrieve export`")
    return data


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited field of a protocol buffer; for contents under 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content
