"""What a checkpoint's file says of itself, read without PyTorch: enough for a query whose towers run elsewhere."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from retrieval.config import Config
from retrieval.errors import BadInput, CheckpointError
from retrieval.files import HEADER
from retrieval.judge import Judge

FORMAT = 1
_PARTS = ("config", "split", "calibration", "provenance")
_JUDGE = ("head.second.weight", "head.second.bias", "head.out.weight", "head.out.bias")


@dataclass(frozen=True)
class Stored:
    """A checkpoint's file. digest: its SHA-256. provenance: step, seed, data digest, metrics and so on."""

    path: Path
    digest: str
    config: Config
    provenance: dict[str, Any]


def fingerprint(checkpoint: Stored) -> dict[str, str]:
    """What must be the same for an index to be searched with a checkpoint."""
    return {"checkpoint": checkpoint.digest, "preprocessing": checkpoint.config.preprocessing.digest()}


def read_stored(path: Path) -> Stored:
    """Read what a checkpoint says of itself. Its weights are neither read nor checked: whoever knows the digest that
    the file must have compares it. Raises CheckpointError."""
    header = matcher_header(path, read_header(path))
    return Stored(path, file_digest(path), config_of(path, header), header["provenance"])


def read_judge(path: Path) -> Judge:
    """The layers of a checkpoint's head that judge pairs of halves."""
    with safe_open(path, framework="np") as file:
        second, second_bias, out, out_bias = (file.get_tensor(name).astype(np.float32) for name in _JUDGE)
    return Judge(second, second_bias, out[0], out_bias)


def read_header(path: Path) -> dict[str, Any]:
    """Our JSON header of a `.safetensors` file, "sha256" among it. Raises CheckpointError where there is none."""
    if path.is_dir():
        raise CheckpointError(f"{path} is a folder; give the .safetensors file of a checkpoint")
    if not path.is_file():
        raise CheckpointError(f"there is no checkpoint at {path}; `retrieve train` makes one")
    try:
        with safe_open(path, framework="np") as file:
            text = (file.metadata() or {}).get(HEADER)
    except (SafetensorError, OSError) as error:
        raise unreadable(path, error) from error
    if text is None:
        raise CheckpointError(
            f"{path} holds weights but not our header; only checkpoints of `retrieve train` work here "
            "(give other weights to `retrieve train --init`)"
        )
    return _parsed(path, text)


def unreadable(path: Path, error: Exception) -> CheckpointError:
    """What to raise where the format itself is broken."""
    return CheckpointError(f"{path} is not a readable .safetensors file ({error}); it may be truncated")


def matcher_header(path: Path, header: dict[str, Any]) -> dict[str, Any]:
    """The header, if it is that of a matcher. Raises CheckpointError."""
    if "task" in header:
        raise CheckpointError(
            f"{path} is a {header['task']} classifier, not a matcher; `retrieve collect --gate` takes it, "
            "`retrieve train` makes matchers"
        )
    lacking = [name for name in _PARTS if name not in header]
    if lacking:
        raise CheckpointError(
            f"{path} is not a checkpoint: its header has no {lacking[0]}; a file in .state.safetensors is the state of "
            "an unfinished training, the checkpoint lies beside it"
        )
    return header


def config_of(path: Path, header: dict[str, Any]) -> Config:
    """The settings in a matcher's header. Raises CheckpointError."""
    try:
        return Config.from_dict(header["config"])
    except BadInput as error:
        raise unusable(path, error) from error


def unusable(path: Path, error: Exception) -> CheckpointError:
    """What to raise where a file holds what no matcher of this version is made of."""
    return CheckpointError(f"{path} is not a checkpoint that this version can use: {error}")


def _parsed(path: Path, text: str) -> dict[str, Any]:
    try:
        header = json.loads(text)
        version = header["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"the header of {path} is damaged ({error}); train again or restore the file") from error
    if version != FORMAT:
        raise CheckpointError(
            f"{path} has checkpoint format {version}, this version reads {FORMAT}; install the touch-retrieval "
            f"that wrote it ({header.get('software')}) or train again"
        )
    return dict(header)


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
