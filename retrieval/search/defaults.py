"""The default model and index of a command: those of the working folder, else the shipped model."""

from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from _touch_retrieval.files import file_digest
from retrieval.errors import BadInput, CheckpointError

if TYPE_CHECKING:
    from indexes.store.manifest import Manifest
    from indexes.store.sharded import ShardedManifest

SHIPPED = {2: "simulated-mobilenet.safetensors", 1: "simulated-mobilenet-one-finger.safetensors"}
"""Shipped checkpoints by the number of gel images of a touch."""
SHIPPED_NAMES = {"shipped": 2, "shipped-one-finger": 1}
"""Names of the shipped checkpoints in options that take a checkpoint."""
INDEX = Path("index")
"""Default index folder of `build-index` and `query`."""


def shipped_model(fingers: int = 2) -> Path:
    """Return the path of a shipped checkpoint, trained on the simulated rig, to try out the program.

    Args:
        fingers: Number of gel images of a touch.

    Raises:
        BadInput: No shipped checkpoint takes this number.

    >>> retrieval.shipped_model().name
    'simulated-mobilenet.safetensors'
    """
    if fingers not in SHIPPED:
        raise BadInput(f"the shipped models take touches of 1 or 2 gel images; got {fingers}")
    return Path(str(resources.files("retrieval") / "shipped" / SHIPPED[fingers]))


def is_shipped(path: Path) -> bool:
    """Whether this is a shipped checkpoint, after following links."""
    return path.resolve() in [shipped_model(fingers).resolve() for fingers in SHIPPED]


def find_model(choice: str | None, index: str | Path = INDEX) -> tuple[Path, str]:
    """Return the checkpoint to use, and the reason.

    Args:
        choice: A path or one of `SHIPPED_NAMES`; None for the checkpoint of `index`, else the shipped one.
        index: Index folder or sharded index.

    Raises:
        CheckpointError: There is no checkpoint, or the one of `index` is missing.
    """
    if choice in SHIPPED_NAMES:
        return shipped_model(SHIPPED_NAMES[choice]), "shipped; trained on the simulated rig"
    if choice is not None:
        return Path(choice), "given"
    from indexes.errors import IndexesError

    manifest: Manifest | ShardedManifest | None = None
    with suppress(IndexesError):  # an unusable index is ignored
        manifest = manifest_of(index)
    if manifest is not None:
        return model_of(manifest), f"the one that {index} was built with"
    if shipped_model().is_file():
        return shipped_model(), "shipped; trained on the simulated rig: train your own for real sensors"
    raise CheckpointError("there is no trained model; make one with `retrieve train`, or name it with --model")


def manifest_of(index: str | Path) -> "Manifest | ShardedManifest":
    """Return the manifest of the current generation of an index.

    Args:
        index: An index folder, or the folder of a sharded index.

    Raises:
        IndexesError: The index is missing or damaged.
    """
    from indexes.store.folder import IndexStore
    from indexes.store.manifest import read_manifest
    from indexes.store.sharded import is_sharded, read_sharded_manifest

    folder = Path(index)
    return read_sharded_manifest(folder) if is_sharded(folder) else read_manifest(folder / IndexStore(folder).current())


def model_of(manifest: "Manifest | ShardedManifest") -> Path:
    """Return the checkpoint that built an index: at its old path, else an equal shipped one.

    Args:
        manifest: Manifest of the index.

    Raises:
        CheckpointError: Neither exists.
    """
    path = Path(str(manifest.about.get("checkpoint")))
    if path.is_file():
        return path
    shipped = shipped_model()
    if shipped.is_file() and file_digest(shipped) == manifest.fingerprint.get("checkpoint"):
        return shipped
    raise CheckpointError(
        f"the model of this index is no longer at {path}; name it with --model, or build the index again with another"
    )


def find_index(choice: str | None) -> tuple[Path, str]:
    """Return the index folder to use, and the reason.

    Args:
        choice: A folder; None for ./index.

    Raises:
        BadInput: There is no index.
    """
    if choice is not None:
        if Path(choice).is_file():
            raise BadInput(f"{choice} is a file; an index is a folder, which `retrieve build-index` writes")
        return Path(choice), "given"
    if _is_index(INDEX):
        return INDEX, "in this folder"
    raise BadInput(
        "there is no index in this folder; run `retrieve build-index CATALOGUE` first, or name one with --index"
    )


def _is_index(folder: Path) -> bool:
    """Whether the folder is an index or a sharded index."""
    return any((folder / name).is_file() for name in ("CURRENT", "SHARDS.json"))
