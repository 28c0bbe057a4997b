"""What a checkpoint's file says of itself, read without PyTorch: enough for a query whose towers run elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from _touch_retrieval.files import file_digest, open_regular, parse_json
from retrieval.console.files import HEADER
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.config import Config
from retrieval.model.fusion_scorer import FusionScorer, GelCheck

FORMAT = 2
_SCORER_TENSORS = ("head.second.weight", "head.second.bias", "head.out.weight", "head.out.bias")


@dataclass(frozen=True)
class CheckpointInfo:
    """A checkpoint's file. digest: its SHA-256. provenance: step, seed, data digest, metrics and so on. gel_check:
    thresholds for what its gel head reads; None without one.
    """

    path: Path
    digest: str
    config: Config
    provenance: dict[str, Any]
    gel_check: GelCheck | None


def fingerprint(checkpoint: CheckpointInfo) -> dict[str, str]:
    """What must be the same for an index to be searched with a checkpoint."""
    return {"checkpoint": checkpoint.digest, "preprocessing": checkpoint.config.preprocessing.digest()}


PARTIALS_FROM = "partials_from"
"""In the provenance: digests of checkpoints with the same towers, head and preprocessing, whose halves these are."""


def can_reuse_partials(checkpoint: CheckpointInfo, made_by: Mapping[str, str]) -> bool:
    """Whether the halves of an index with that fingerprint are those that this checkpoint would make again, and its
    embeddings alone are others, which a candidate_encoder makes of these.
    """
    before = checkpoint.provenance.get(PARTIALS_FROM)
    same = isinstance(before, list) and made_by.get("checkpoint") in before
    return (
        same
        and checkpoint.config.matcher.candidate_width > 0
        and made_by.get("preprocessing") == fingerprint(checkpoint)["preprocessing"]
    )


def read_checkpoint_info(path: Path) -> CheckpointInfo:
    """Read what a checkpoint says of itself. Its weights are neither read nor checked: whoever knows the digest that
    the file must have compares it. Raises CheckpointError.
    """
    return checkpoint_info(path, read_header(path))


def checkpoint_info(path: Path, header: dict[str, Any]) -> CheckpointInfo:
    """What the header of a matcher's file says. Raises CheckpointError for that of another file."""
    if "task" in header:
        raise CheckpointError(
            f"{path} is a {header['task']} classifier, not a matcher; `retrieve collect --gate` takes it, "
            "`retrieve train` makes matchers"
        )
    if not isinstance(header.get("provenance", {}), dict):
        raise unusable(path, "its provenance must be an object")
    if lacking := [name for name in ("config", "split", "provenance") if name not in header]:
        raise CheckpointError(
            f"{path} is not a checkpoint: its header has no {lacking[0]}; a file in .state.safetensors is the state of "
            "an unfinished training, the checkpoint lies beside it"
        )
    try:
        config = Config.from_dict(header["config"])
        check = None if header.get("gel_check") is None else GelCheck.from_dict(header["gel_check"])
    except BadInput as error:
        raise unusable(path, error) from error
    return CheckpointInfo(path, file_digest(path), config, header["provenance"], check)


def read_scorer(path: Path) -> FusionScorer:
    """The layers of a checkpoint's head that judge pairs of halves. Raises CheckpointError."""
    try:
        with safe_open(path, framework="np") as file:
            parts = [file.get_tensor(name) for name in _SCORER_TENSORS]
    except (SafetensorError, OSError, TypeError) as error:  # TypeError: numbers that numpy does not know
        raise unreadable(path, error) from error
    hidden = parts[1].size
    wanted = [(hidden, hidden), (hidden,), (1, hidden), (1,)]
    for name, part, shape in zip(_SCORER_TENSORS, parts, wanted, strict=True):
        if part.shape != shape or part.dtype.kind != "f":
            raise unusable(path, f"{name} is {part.dtype} {part.shape}, must be of floats {shape}")
    second, second_bias, out, out_bias = (part.astype(np.float32) for part in parts)
    return FusionScorer(second, second_bias, out[0], out_bias)


def read_header(path: Path) -> dict[str, Any]:
    """Our JSON header of a `.safetensors` file, "sha256" among it. Raises CheckpointError where there is none."""
    try:
        open_regular(path).close()
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no checkpoint at {path}; `retrieve train` makes one") from error
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be read ({error.strerror}); give the .safetensors file of a checkpoint"
        ) from error
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
    try:
        header = parse_json(text)
        version = header["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"the header of {path} is damaged ({error}); train again or restore the file") from error
    if version != FORMAT:
        raise CheckpointError(
            f"{path} has checkpoint format {version}, this version reads {FORMAT}; install the touch-retrieval "
            f"that wrote it ({header.get('software')}) or train again"
        )
    return dict(header)


def unreadable(path: Path, error: Exception) -> CheckpointError:
    """What to raise where the format itself is broken."""
    return CheckpointError(f"{path} is not a readable .safetensors file ({error}); it may be truncated")


def unusable(path: Path, error: object) -> CheckpointError:
    """What to raise where a file holds what no matcher of this version is made of."""
    return CheckpointError(f"{path} is not a checkpoint that this version can use: {error}")
