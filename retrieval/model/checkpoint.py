"""Checkpoints: one `.safetensors` file with the weights, and everything needed to use them in its header.

Nothing is unpickled. A file is written under a temporary name, flushed to disk, then renamed: it is complete or absent.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from _touch_retrieval.files import write_atomically
from retrieval.data.dataset import Split
from retrieval.data.hub import local_file
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.card import model_card
from retrieval.model.checkpoint_info import (
    FORMAT,
    HEADER,
    PARTS,
    CheckpointInfo,
    checkpoint_info,
    read_header,
    unreadable,
    unusable,
)
from retrieval.model.fusion import GelHead, Matcher
from retrieval.version import __version__

_QUERIES = "queries.touch_partials"


@dataclass(frozen=True)
class Checkpoint(CheckpointInfo):
    """A matcher in evaluation mode, with the contents of its file.

    Attributes:
        matcher: The towers, the fusion head and the projections.
        split: Training, validation and test objects; None if the training run had no split.
        queries: (Q, partial) float16 partial activations of touches of validation objects, with which an index measures
            its own search.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> checkpoint.config.preprocessing.background, len(checkpoint.digest)
    ('none', 64)
    """

    matcher: Matcher = field(kw_only=True)
    split: Split | None = None
    queries: NDArray[np.float16] | None = None

    def without_cells(self) -> Self:
        """Return the model without late interaction; its partial activations are the pooled ones."""
        info = super().without_cells()
        if info is self:
            return self
        matcher = self.matcher.without_cells()
        queries = None if self.queries is None else self.queries[:, : matcher.config.pooled_width]
        return replace(info, matcher=matcher, queries=queries)


def store_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint to a name that ends in .safetensors, and its model card (.md), atomically.

    Raises:
        CheckpointError: The file cannot be written.
    """
    require_writable(path)
    parts = {name: getattr(checkpoint, name) for name in ("split", *PARTS)}
    header = {
        "config": checkpoint.config.to_dict(),
        "provenance": checkpoint.provenance,
        **{name: None if part is None else asdict(part) for name, part in parts.items()},
    }
    state = checkpoint.matcher.state_dict()
    if checkpoint.queries is not None:
        state[_QUERIES] = torch.from_numpy(checkpoint.queries)
    write_tensors(path, state, header)
    write_atomically(
        sibling_file(path, ".md"), model_card(path.name, checkpoint, checkpoint.split).encode(errors="replace")
    )


def require_writable(path: Path) -> None:
    """Raise CheckpointError if no checkpoint can be written to `path`: checked before hours of training."""
    if path.suffix != ".safetensors" or path.is_dir():
        raise CheckpointError(f"a checkpoint must be a file *.safetensors, such as {path.stem}.safetensors; got {path}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise CheckpointError(f"{path} cannot be written ({error.strerror}); choose another place") from error


def sibling_file(path: Path, ending: str) -> Path:
    """Return the file that goes with a checkpoint: `model.safetensors` and ".md" give `model.md`, `v1.2` `v1.2.md`."""
    return path.with_name(path.name.removesuffix(".safetensors") + ending)


def load_checkpoint(path: str | Path, *, digest: str | None = None) -> Checkpoint:
    """Read a checkpoint.

    Args:
        path: The .safetensors file, or `hf://USER/NAME[@REVISION]` on the Hugging Face Hub.
        digest: SHA-256 (hex) of the file, if it was already verified. Digest and checksum are then not computed again.

    Raises:
        CheckpointError: The file is missing, damaged or unusable. The message names the remedy.
        RetrievalError: The Hub cannot be reached, or does not have the file.

    >>> retrieval.load_checkpoint("model.safetensors").config.matcher.fingers
    2
    >>> retrieval.load_checkpoint("none.safetensors")
    Traceback (most recent call last):
    retrieval.errors.CheckpointError: there is no checkpoint at none.safetensors; `retrieve train` makes one
    """
    path = local_file(path)
    state, header = read_tensors(path, check=digest is None)
    info = checkpoint_info(path, header, digest)
    queries = state.pop(_QUERIES, None)
    try:
        split = None if header["split"] is None else Split.from_dict(header["split"])
        matcher = Matcher(info.config.matcher, len(info.config.preprocessing.views))
        if any(name.startswith("gel_head.") for name in state):
            matcher.gel_head = GelHead(matcher.touch_tower.feature_count)
        load_weights(matcher, state)
    except BadInput as error:
        raise unusable(path, error) from error
    stored = None if queries is None else np.asarray(queries.numpy())
    return Checkpoint(**vars(info), matcher=matcher.eval(), split=split, queries=stored)


def load_weights(module: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Load `state` into `module`. Raises CheckpointError unless names and shapes are exactly the module's."""
    try:
        module.load_state_dict(state)
    except RuntimeError as error:  # a line for each weight
        raise CheckpointError(
            f"its weights do not fit its configuration: {str(error).splitlines()[-1].strip()}"
        ) from error


def write_tensors(path: Path, state: dict[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a JSON header as one safetensors file with a checksum over both, atomically.

    The tensors may be on any device and in any memory layout.
    """
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    content = {"format": FORMAT, "software": __version__, **header}
    # The checksum covers both: the safetensors format does not detect a flipped bit.
    text = json.dumps({**content, "sha256": tensors_digest(state, json.dumps(content))}, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(state, {HEADER: text}))


def read_tensors(path: Path, *, check: bool = True) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the header of a file of `write_tensors`.

    Raises:
        CheckpointError: The file is missing or, with `check`, its checksum is wrong or a weight is not finite.
    """
    header = read_header(path)
    try:
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, MemoryError) as error:
        raise unreadable(path, error) from error
    checksum = header.pop("sha256", None)
    if check and checksum != tensors_digest(state, json.dumps(header)):
        raise CheckpointError(f"{path} is damaged: its checksum does not match; restore the file or train again")
    if check and any(not bool(torch.isfinite(tensor).all()) for tensor in state.values()):
        raise CheckpointError(f"{path} contains a NaN or infinite weight; train again with a lower learning rate")
    return state, header


def tensors_digest(state: Mapping[str, Tensor], description: str) -> str:
    """Return the SHA-256 (hex) of `description` and of the tensors with their names, types and shapes."""
    digest = hashlib.sha256(description.encode())
    for name in sorted(state):
        tensor = state[name].cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
