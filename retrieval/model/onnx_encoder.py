"""The touch encoder on ONNX Runtime, from a file of `retrieve export`: a query without PyTorch."""

import logging
import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.data.resize import RgbImage
from retrieval.errors import CheckpointError
from retrieval.model.checkpoint_info import CheckpointInfo
from retrieval.model.touch_reader import TouchEncodings

log = logging.getLogger(__name__)
EXPORT_SUFFIX = ".onnx"
CHECKPOINT_KEY = "touch_retrieval.checkpoint"
LICENCES_KEY = "touch_retrieval.licences"


class OnnxEncoder:
    """An exported touch encoder, open in ONNX Runtime."""

    name = "onnx"

    def __init__(self, model: Path | bytes, checkpoint: str, threads: int | None = None) -> None:
        """Open the export of the checkpoint with that digest; the arguments and errors are those of `open_session`."""
        self._session = open_session(model, checkpoint, threads)

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchEncodings:
        """Encode grasps, each a sequence of its fingers' images, float32 in 0..1."""
        images = np.stack([np.stack(fingers) for fingers in touches])
        try:
            partials, embedding, *more = self._session.run(None, {"images": images})
        except Exception as error:  # the exceptions of ONNX Runtime have no common base
            raise CheckpointError(f"the export of this checkpoint cannot be run ({error}); export it again") from error
        return TouchEncodings(partials, embedding, more[0] if more else None)


def open_session(model: Path | bytes, checkpoint: str, threads: int | None = None) -> Any:
    """Open ONNX Runtime on an export.

    Args:
        model: The ONNX file, or its bytes.
        checkpoint: SHA-256 (hexadecimal) of the file of the checkpoint that it must be exported from.
        threads: Threads of ONNX Runtime; None for its own choice.

    Raises:
        CheckpointError: The model cannot be opened, or is of another checkpoint.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # nothing is sent
    import onnxruntime

    name, source = ("the export", model) if isinstance(model, bytes) else (model, str(model))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or 0
    # Spinning threads would occupy the cores that decode the next images or score candidates.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the exceptions of ONNX Runtime have no common base
        raise CheckpointError(f"{name} cannot be opened by ONNX Runtime ({type(error).__name__})") from error
    exported_from = session.get_modelmeta().custom_metadata_map.get(CHECKPOINT_KEY, "unknown")
    if exported_from != checkpoint:
        raise CheckpointError(f"{name} is the export of another checkpoint ({exported_from[:12]})")
    return session


def cached_export_path(digest: str) -> Path:
    """Return the path of an automatic export of the checkpoint with this digest.

    It is `$XDG_CACHE_HOME/touch-retrieval/DIGEST.onnx`, by default under `~/.cache`.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(cache, "touch-retrieval", f"{digest}{EXPORT_SUFFIX}")


def find_export(checkpoint: CheckpointInfo, threads: int | None = None) -> OnnxEncoder | None:
    """Open the export of a checkpoint, if there is one and ONNX Runtime is installed.

    The file next to the checkpoint comes first, then the one in the user's cache. An export of another checkpoint is
    not used, and a warning is logged.
    """
    places = checkpoint.path.with_suffix(EXPORT_SUFFIX), cached_export_path(checkpoint.digest)
    files = [path for path in places if path.is_file()]
    if not files or find_spec("onnxruntime") is None:
        return None
    try:
        return OnnxEncoder(files[0], checkpoint.digest, threads)
    except CheckpointError as error:
        log.warning("%s; PyTorch encodes instead (slower to start): run `retrieve export` again", error)
        return None
