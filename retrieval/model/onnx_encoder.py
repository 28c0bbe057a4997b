"""The touch encoder on ONNX Runtime, from a file of `retrieve export`: a query without PyTorch.

The file is ONNX with the checkpoint's digest in its metadata. The last metadata entry is a SHA-256 of everything before
it, because ONNX itself does not detect a flipped bit in a weight.
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
LICENCES_KEY = "touch_retrieval.licences"
_SEAL_BYTES = 2 + 2 + len(SEAL) + 2 + 64
Floats = NDArray[np.float32]


class OnnxEncoder:
    """An open ONNX session of an exported touch encoder."""

    name = "onnx"

    def __init__(self, path: Path, checkpoint: str, threads: int | None = None, owners: Sequence[int] = ()) -> None:
        """Open `path`, which must be the export of the checkpoint with that digest.

        Args:
            path: The file, as `read_checked_export` reads it.
            checkpoint: SHA-256 of the checkpoint's file, in hexadecimal.
            threads: Threads of ONNX Runtime; None for its own choice.
            owners: Ids of users that may own the file, in addition to this user and root.

        Raises:
            CheckpointError: The export is of another checkpoint, is damaged, or may have been written by others.
        """
        self._open = partial(_session, path, checkpoint, threads, owners)
        self._process, self._session = os.getpid(), self._open()

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> TouchEncodings:
        """Encode grasps, each a sequence of its fingers' images, float32 in 0..1."""
        images = np.stack([np.stack(fingers) for fingers in touches])
        if self._process != os.getpid():  # a forked process opens its own session
            self._process, self._session = os.getpid(), self._open()
        try:
            partials, embedding, *more = self._session.run(None, {"images": images})
        except Exception as error:  # the exceptions of ONNX Runtime have no common base
            raise CheckpointError(f"the export of this checkpoint cannot be run ({error}); export it again") from error
        encodings = TouchEncodings(partials, embedding, more[0] if more else None)
        for name, values, axes in (
            ("partial activation", partials, 2),
            ("embedding", embedding, 2),
            ("reading", encodings.readings, 3),
        ):
            if values is None:
                continue
            if values.ndim != axes or len(values) != len(touches) or values.dtype != np.float32:
                raise CheckpointError(
                    f"the export must return one float32 {name} per touch; got {values.dtype} {values.shape}; "
                    "export the checkpoint again"
                )
        return encodings


_sessions: WeakSet[Any] = WeakSet()


def _keep_sessions_alive() -> None:
    """Keep the sessions of the parent process alive in a forked one.

    A forked process has none of the sessions' threads and would wait for them for ever, even to close a session.
    """
    for session in _sessions:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))


os.register_at_fork(after_in_child=_keep_sessions_alive)


def _session(path: Path, checkpoint: str, threads: int | None, owners: Sequence[int]) -> Any:
    return open_session(read_checked_export(path, owners), str(path), checkpoint, threads)


def open_session(model: bytes, name: str, checkpoint: str, threads: int | None) -> Any:
    """Open ONNX Runtime on a model in memory.

    Args:
        model: The bytes of the ONNX file.
        name: Its name in messages.
        checkpoint: Digest of the checkpoint that it must be exported from.
        threads: Threads of ONNX Runtime; None for its own choice.

    Raises:
        CheckpointError: The model cannot be opened, or is of another checkpoint.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # nothing is sent, and no fork waits for its thread
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or 0
    # Spinning threads would occupy the cores that decode the next images or score candidates.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the exceptions of ONNX Runtime have no common base
        raise CheckpointError(f"{name} cannot be opened by ONNX Runtime ({type(error).__name__})") from error
    exported_from = session.get_modelmeta().custom_metadata_map.get(CHECKPOINT_KEY, "unknown")
    if exported_from != checkpoint:
        raise CheckpointError(f"{name} is the export of another checkpoint ({exported_from[:12]})")
    _sessions.add(session)
    return session


def cached_export_path(digest: str) -> Path | None:
    """Return the path of an export in the user's cache; None if the user has no home folder.

    The cache is for checkpoints whose folder is not writable.
    """
    folder = cache_folder()
    return None if folder is None else folder / f"{digest}{EXPORT_SUFFIX}"


def find_export(checkpoint: CheckpointInfo, threads: int | None = None) -> OnnxEncoder | None:
    """Open the export of a checkpoint, if there is a valid one and ONNX Runtime is installed.

    The file next to the checkpoint comes first, then the one in the user's cache. A stale or damaged file, or one that
    other users can write to, is not used, and a warning is logged: checksum and digest detect damage, but anybody can
    write them. A file next to the checkpoint may also belong to the checkpoint's owner.

    Args:
        checkpoint: The header of the checkpoint.
        threads: Threads of ONNX Runtime; None for its own choice.
    """
    adjacent = checkpoint.path.with_suffix(EXPORT_SUFFIX)
    path = adjacent if adjacent.is_file() else cached_export_path(checkpoint.digest)
    if path is None or not path.is_file() or find_spec("onnxruntime") is None:
        return None
    try:
        if path == adjacent:
            return OnnxEncoder(path, checkpoint.digest, threads, [checkpoint.path.stat().st_uid])
        require_private(path.parent, path.parent.stat())
        return OnnxEncoder(path, checkpoint.digest, threads)
    except (BadInput, OSError) as error:
        log.warning("%s; PyTorch encodes instead (slower to start): run `retrieve export` again", error)
        return None


def with_checksum(model: bytes) -> bytes:
    """Return `model` with a metadata entry that contains its SHA-256.

    `metadata_props` is field 14 of ONNX's ModelProto. A map entry has its key in field 1 and its value in field 2. A
    protocol buffer merges fields that are appended to it.
    """
    return model + _seal(model)


def _seal(model: bytes | memoryview) -> bytes:
    """Return the metadata entry with the SHA-256 of a model."""
    entry = _field(1, SEAL) + _field(2, hashlib.sha256(model).hexdigest().encode())
    return _field(14, entry)


def read_checked_export(path: Path, owners: Sequence[int] = ()) -> bytes:
    """Read an export and check its seal. Raises CheckpointError if a byte changed or `require_private` refuses it."""
    try:
        with open_regular(path) as file:
            require_private(path, os.fstat(file.fileno()), *owners)
            data = file.read(MAX_FILE_BYTES)
    except BadInput as error:
        raise CheckpointError(str(error)) from error
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror})") from error
    if len(data) <= _SEAL_BYTES or _seal(memoryview(data)[:-_SEAL_BYTES]) != data[-_SEAL_BYTES:]:
        raise CheckpointError(f"{path} is damaged, or not a file of `retrieve export`")
    return data


def _field(number: int, content: bytes) -> bytes:
    """Return a length-delimited field of a protocol buffer, for contents below 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content
