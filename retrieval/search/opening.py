"""Find the checkpoint that built an index, and the default one; open an index folder or a sharded index."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from _touch_retrieval.files import file_digest
from indexes.errors import IndexesError
from indexes.store.folder import IndexStore
from indexes.store.generation import check_fingerprint
from indexes.store.manifest import Manifest, read_manifest
from indexes.store.sharded import (
    ShardedManifest,
    ShardEntry,
    is_sharded,
    open_shard,
    read_sharded_manifest,
    shard_folder,
)
from retrieval.data.hub import local_file
from retrieval.errors import CheckpointError
from retrieval.indexing.enrolled import EnrolledTable
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint, read_checkpoint_info
from retrieval.model.fusion_scorer import CELLS
from retrieval.model.shipped import SHIPPED_NAMES, shipped_model
from retrieval.search.shard import FolderShard, Shards

INDEX = Path("index")
"""Default index folder of `build-index` and `query`."""


def find_model(choice: str | None, index: str | Path = INDEX) -> tuple[Path, str]:
    """Return the checkpoint to use, and the reason.

    Args:
        choice: A path, an address on the Hub or one of `SHIPPED_NAMES`; None for the checkpoint of `index`, else the
            shipped one.
        index: Index folder or sharded index.

    Raises:
        CheckpointError: There is no checkpoint, or the one of `index` is missing.
    """
    if choice in SHIPPED_NAMES:
        return shipped_model(SHIPPED_NAMES[choice]), "shipped; trained on the simulated rig"
    if choice is not None:
        return local_file(choice), "given"
    manifest = None
    with suppress(IndexesError):  # an unusable index is ignored
        manifest = manifest_of(index)
    if manifest is not None:
        return model_of(manifest), f"the one that {index} was built with"
    if shipped_model().is_file():
        return shipped_model(), "shipped; trained on the simulated rig: train your own for real sensors"
    raise CheckpointError("there is no trained model; make one with `retrieve train`, or name it with --model")


def manifest_of(index: str | Path) -> Manifest | ShardedManifest:
    """Return the manifest of the current generation of an index folder or of a sharded index.

    Raises:
        IndexesError: The index is missing or damaged.
    """
    folder = Path(index)
    return read_sharded_manifest(folder) if is_sharded(folder) else read_manifest(folder / IndexStore(folder).current())


def model_of(manifest: Manifest | ShardedManifest) -> Path:
    """Return the checkpoint that built an index: at its old path, else an equal shipped one.

    Raises:
        CheckpointError: Neither exists.
    """
    path = Path(str(manifest.about.get("checkpoint")))
    if path.is_file():
        return path
    for shipped in map(shipped_model, SHIPPED_NAMES.values()):
        if shipped.is_file() and file_digest(shipped) == manifest.fingerprint.get("checkpoint"):
            return shipped
    raise CheckpointError(
        f"the model of this index is no longer at {path}; name it with --model, or build the index again with another"
    )


OpenShards = Callable[[str | Path, ShardedManifest, CheckpointInfo], Shards]
"""Opens the shards of a sharded index, in this process or elsewhere."""


def open_index(
    index: Path, model: str | Path | None, shards: OpenShards | None
) -> tuple[FolderShard | Shards, CheckpointInfo]:
    """Open the current generation of an index folder or of a sharded index.

    Args:
        index: Its folder.
        model: Path of the checkpoint, if it was moved.
        shards: Opens the shards; None to open them in this process.

    Returns:
        The index, and the checkpoint's header, as the index uses it.

    Raises:
        IndexesError: The index is missing, damaged, or of another model.
        CheckpointError: The checkpoint is missing or damaged.
    """
    if not is_sharded(index):
        generation = IndexStore(index).open()
        stored = checkpoint_of(generation.manifest, model)
        return FolderShard(generation, stored), stored
    manifest = read_sharded_manifest(index)
    stored = checkpoint_of(manifest, model)
    if shards is not None:
        return shards(index, manifest, stored), stored
    check_fingerprint(index, manifest.fingerprint, fingerprint(stored))
    return Shards(manifest, [open_shard_of(index, manifest, entry, stored) for entry in manifest.shards]), stored


def open_shard_of(index: Path, manifest: ShardedManifest, entry: ShardEntry, stored: CheckpointInfo) -> FolderShard:
    """Open a shard of a sharded index, with the enrolled touches of its objects."""
    enrolled = EnrolledTable(index, lambda name: shard_folder(name, manifest) == entry.folder)
    return FolderShard(open_shard(index, entry), stored, enrolled)


def checkpoint_of(manifest: Manifest | ShardedManifest, model: str | Path | None) -> CheckpointInfo:
    """Return the header of the checkpoint that built an index, as the index uses it: perhaps without cells.

    A readable checkpoint is not compared with the index; `check_fingerprint` refuses another model.

    Args:
        manifest: Manifest of the index.
        model: Path of the checkpoint, if it was moved.

    Raises:
        CheckpointError: The checkpoint is missing or damaged.
    """
    stored = read_checkpoint_info(model or model_of(manifest))
    if stored.digest != manifest.fingerprint.get("checkpoint"):
        from retrieval.model.checkpoint import load_checkpoint

        load_checkpoint(stored.path)  # raises an error for a damaged checkpoint
    return stored.without_cells() if manifest.about.get(CELLS) is False else stored
