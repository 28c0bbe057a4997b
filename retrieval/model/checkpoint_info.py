"""The header of a checkpoint's file, read without PyTorch: enough for a query whose towers run elsewhere."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from safetensors import SafetensorError, safe_open

from _touch_retrieval.documents import typed
from _touch_retrieval.files import file_digest, open_regular, parse_json
from retrieval.data.hub import local_file
from retrieval.errors import BadInput, CheckpointError
from retrieval.model.config import Config
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.gel_check import GelCheck
from retrieval.model.opening import OpeningCalibration
from retrieval.model.posterior import Posterior
from retrieval.model.references import ReferenceCalibration
from retrieval.model.verification import VerificationCalibration

FORMAT = 2
HEADER = "touch_retrieval"
"""Key of our entry in the metadata of a `.safetensors` file."""
_SCORER_TENSORS = ("head.second.weight", "head.second.bias", "head.out.weight", "head.out.bias")


@dataclass(frozen=True)
class CheckpointInfo:
    """The header of a checkpoint's file.

    Attributes:
        path: The file.
        digest: SHA-256 of the file, in hexadecimal; empty for a model that is not written yet.
        config: Settings of towers, head and preprocessing.
        provenance: Source, step, seed, data digest, licences of the data and metrics of the training.
        posterior: Calibration of the match logits; None for an uncalibrated model.
        gel_check: Thresholds that separate touches, no-contact gels and other images; None without a gel head.
        verification: Error rates of `Searcher.verify`; None if there were too few validation objects.
        references: Calibration of reference touches; None if there were too few data.
        opening: Calibration of the opening of the jaws; None if it was not measured.
        pooled_posterior: As `posterior`, of the logits without late interaction; None for a model without cells.
        pooled_references: As `references`, of the same logits.
    """

    path: Path
    digest: str
    config: Config
    provenance: dict[str, Any]
    posterior: Posterior | None = None
    gel_check: GelCheck | None = None
    verification: VerificationCalibration | None = None
    references: ReferenceCalibration | None = None
    opening: OpeningCalibration | None = None
    pooled_posterior: Posterior | None = None
    pooled_references: ReferenceCalibration | None = None

    def without_cells(self) -> Self:
        """Return the model without late interaction, with the calibration of its logits, for an index without cells.

        It has the same digest. A model without cells is returned as it is.
        """
        if not self.config.matcher.cell_dim:
            return self
        return replace(
            self,
            config=replace(self.config, matcher=replace(self.config.matcher, cell_dim=0)),
            posterior=self.pooled_posterior,
            references=self.pooled_references,
            verification=None,
            pooled_posterior=None,
            pooled_references=None,
        )


PARTS: dict[str, type[Any]] = {
    "posterior": Posterior,
    "gel_check": GelCheck,
    "verification": VerificationCalibration,
    "references": ReferenceCalibration,
    "opening": OpeningCalibration,
    "pooled_posterior": Posterior,
    "pooled_references": ReferenceCalibration,
}
"""Types of the optional entries of a header that a query may need."""


def fingerprint(checkpoint: CheckpointInfo) -> dict[str, str]:
    """Return the digests that an index and the checkpoint that searches it must share."""
    return {"checkpoint": checkpoint.digest, "preprocessing": checkpoint.config.preprocessing.digest()}


def read_checkpoint_info(path: str | Path) -> CheckpointInfo:
    """Read the header of a checkpoint, perhaps of one on the Hub; its weights are neither read nor checked.

    Raises:
        CheckpointError: The file is missing, or not a checkpoint of this version.
    """
    path = local_file(path)
    return checkpoint_info(path, read_header(path))


def checkpoint_info(path: Path, header: dict[str, Any], digest: str | None = None) -> CheckpointInfo:
    """Parse the header of a matcher's file with this SHA-256. Raises CheckpointError for the header of another file."""
    if "task" in header:
        raise CheckpointError(
            f"{path} is a {header['task']} classifier, not a matcher; use it with `retrieve collect --gate`, "
            "or train a matcher with `retrieve train`"
        )
    if lacking := [name for name in ("config", "split", "provenance") if name not in header]:
        raise CheckpointError(
            f"{path} is not a checkpoint: its header has no {lacking[0]}; a .state.safetensors file is the state of "
            "an unfinished training; `retrieve train` continues it and writes the checkpoint"
        )
    try:
        config = Config.from_dict(header["config"])
        provenance = typed(header["provenance"], dict[str, Any], "provenance", error=BadInput)
        parts = {
            name: typed(header[name], kind, name, complete=True, error=BadInput)
            for name, kind in PARTS.items()
            if header.get(name) is not None
        }
    except BadInput as error:
        raise unusable(path, error) from error
    return CheckpointInfo(path, digest or file_digest(path), config, provenance, **parts)


def read_scorer(info: CheckpointInfo) -> FusionScorer:
    """Read the layers of a checkpoint's head that score pairs of partial activations. Raises CheckpointError."""
    path, matcher = info.path, info.config.matcher
    try:
        with safe_open(path, framework="np") as file:
            parts = [file.get_tensor(name) for name in _SCORER_TENSORS]
    except (SafetensorError, OSError, TypeError) as error:  # TypeError: data types that numpy does not have
        raise unreadable(path, error) from error
    second, second_bias, out, out_bias = (part.astype(np.float32) for part in parts)
    cosine_dim = matcher.pooled_width - matcher.hidden
    return FusionScorer(second, second_bias, out[0], out_bias, cosine_dim=cosine_dim, cell_dim=matcher.cell_dim)


def read_header(path: Path) -> dict[str, Any]:
    """Read our JSON header of a `.safetensors` file, with its "sha256". Raises CheckpointError if there is none."""
    try:
        open_regular(path).close()
        with safe_open(path, framework="np") as file:
            text = (file.metadata() or {}).get(HEADER)
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no checkpoint at {path}; `retrieve train` makes one") from error
    except (SafetensorError, OSError) as error:
        raise unreadable(path, error) from error
    if text is None:
        raise CheckpointError(
            f"{path} contains weights but no header of ours; only checkpoints of `retrieve train` work here "
            "(use other weights with `retrieve train --init`)"
        )
    try:
        header = parse_json(text, own=True)
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
    """Return the error for a file that is not valid safetensors."""
    return CheckpointError(f"{path} is not a readable .safetensors file ({error}); it may be truncated")


def unusable(path: Path, error: object) -> CheckpointError:
    """Return the error for a file that this version cannot build a matcher from."""
    return CheckpointError(f"{path} is not a checkpoint that this version can use: {error}")
