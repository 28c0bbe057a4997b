"""The touch encoder on ONNX Runtime, as `retrieve export` writes it beside a checkpoint: a query without PyTorch.

The file is ONNX with the checkpoint's digest among its metadata. The last entry of these is a SHA-256 of everything
before it, since ONNX itself takes a flipped bit in a weight for what it is.
"""

import ctypes
import hashlib
import logging
import os
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import MAX_FILE_BYTES, open_regular
from retrieval.console.files import SEAL, cache_folder, require_private
from retrieval.data.resize import RgbImage
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.checkpoint_info import CheckpointInfo
from retrieval.model.touches import TouchEncodings

log = logging.getLogger(__name__)
EXPORT_SUFFIX = ".onnx"
CHECKPOINT_KEY = "touch_retrieval.checkpoint"
_SEAL_BYTES = 2 + 2 + len(SEAL) + 2 + 64
Floats = NDArray[np.float32]


class OnnxEncoder:
    """An exported touch encoder, opened."""

    name = "onnx"

    def __init__(self, path: Path, checkpoint: str, threads: int | None = None, owners: Sequence[int] = ()) -> None:
        """Open `path`, which must be the export of the checkpoint with that digest.

        Args:
            path: the file, which `read_checked_export` reads.
            checkpoint: SHA-256 of the checkpoint's file, in hexadecimal.
            threads: None leaves the choice to ONNX Runtime.
            owners: ids of users whose file this may be; this user and root are always among them.

        Raises:
            CheckpointError: the export is of another checkpoint, is damaged, or may have been written by others.
        """
        self._open = partial(_session, path, checkpoint, threads, owners)
        self._process, self._session = os.getpid(), self._open()

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchEncodings:
        """The codes of grasps, each given as its fingers' images, float32 in 0..1."""
        images = np.stack([np.stack(fingers) for fingers in touches])
        if self._process != os.getpid():  # a fork opens its own
            self._process, self._session = os.getpid(), self._open()
        try:
            half, embedding, *more = self._session.run(None, {"images": images})
        except Exception as error:  # its errors have no common base
            raise CheckpointError(f"the export of this checkpoint cannot be run ({error}); export it again") from error
        encodings = TouchEncodings(half, embedding, more[0] if more else None)
        for name, values, axes in (
            ("partial", half, 2),
            ("embedding", embedding, 2),
            ("reading", encodings.readings, 3),
        ):
            if values is None:
                continue
            if values.ndim != axes or len(values) != len(touches) or values.dtype != np.float32:
                raise CheckpointError(
                    f"the export must give a {name} of float32 for each touch, gives {values.dtype} {values.shape}; "
                    "export the checkpoint again"
                )
        return encodings


_sessions: WeakSet[Any] = WeakSet()


def _keep_sessions_alive() -> None:
    """A fork has none of the threads of the sessions it was born with, and would wait for them for ever, even to let
    go of one: here they are never let go of.
    """
    for session in _sessions:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))


os.register_at_fork(after_in_child=_keep_sessions_alive)


def _session(path: Path, checkpoint: str, threads: int | None, owners: Sequence[int]) -> Any:
    return open_session(read_checked_export(path, owners), str(path), checkpoint, threads)


def open_session(model: bytes, name: str, checkpoint: str, threads: int | None) -> Any:
    """ONNX Runtime on a model in memory, called `name` where it is of no use. Raises CheckpointError where it cannot be
    opened or is of another checkpoint.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # nothing is sent; and no fork waits for its thread at the end
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or 0
    # Its threads would spin after a run, on the cores that decode the next images or judge candidates.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common base
        raise CheckpointError(f"{name} cannot be opened by ONNX Runtime ({type(error).__name__})") from error
    exported_from = session.get_modelmeta().custom_metadata_map.get(CHECKPOINT_KEY, "unknown")
    if exported_from != checkpoint:
        raise CheckpointError(f"{name} is the export of another checkpoint ({exported_from[:12]})")
    _sessions.add(session)
    return session


def cached_export_path(digest: str) -> Path | None:
    """Where the export is kept of a checkpoint with that digest beside which none can be written: in the user's cache.
    None where the user has no home.
    """
    folder = cache_folder()
    return None if folder is None else folder / f"{digest}{EXPORT_SUFFIX}"


def find_export(checkpoint: CheckpointInfo, threads: int | None = None) -> OnnxEncoder | None:
    """The export that lies beside a checkpoint, else the one in the user's cache, where it is of this checkpoint and
    ONNX Runtime is installed.

    One that is stale, damaged or open to other users is not used, and a warning says so: its checksum and the digest in
    it tell damage, but anybody can write them. Beside a checkpoint the file may belong to the checkpoint's owner too.
    """
    beside = checkpoint.path.with_suffix(EXPORT_SUFFIX)
    path = beside if beside.is_file() else cached_export_path(checkpoint.digest)
    if path is None or not path.is_file() or find_spec("onnxruntime") is None:
        return None
    try:
        if path == beside:
            return OnnxEncoder(path, checkpoint.digest, threads, [checkpoint.path.stat().st_uid])
        require_private(path.parent, path.parent.stat())
        return OnnxEncoder(path, checkpoint.digest, threads)
    except (BadInput, OSError) as error:
        log.warning("%s; PyTorch is used instead (slower to start): run `retrieve export` again", error)
        return None


def with_checksum(model: bytes) -> bytes:
    """`model` with one more entry of metadata: `metadata_props` is field 14 of ONNX's ModelProto, a map entry has its
    key in field 1 and its value in field 2, and what stands last in a protocol buffer is merged with the rest.
    """
    entry = _field(1, SEAL) + _field(2, hashlib.sha256(model).hexdigest().encode())
    return model + _field(14, entry)


def read_checked_export(path: Path, owners: Sequence[int] = ()) -> bytes:
    """The bytes of a sealed file. Raises CheckpointError where one of them changed, or `require_private` refuses."""
    try:
        with open_regular(path) as file:
            require_private(path, os.fstat(file.fileno()), *owners)
            data = file.read(MAX_FILE_BYTES)
    except BadInput as error:
        raise CheckpointError(str(error)) from error
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror})") from error
    if len(data) <= _SEAL_BYTES or with_checksum(data[:-_SEAL_BYTES]) != data:
        raise CheckpointError(f"{path} is damaged or no export of `retrieve export`")
    return data


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited field of a protocol buffer; for contents under 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content
