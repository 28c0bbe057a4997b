"""Open an index folder or a sharded index, with the checkpoint that built it."""

from collections.abc import Callable
from pathlib import Path

from indexes.store.cluster import ClusterManifest, open_shard
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation, require_made_by
from indexes.store.manifest import Manifest
from retrieval.model.stored import Stored, fingerprint, read_judge, read_stored
from retrieval.search import defaults
from retrieval.search.query.objects import require_usable
from retrieval.search.query.shard import Described, FolderShard, Shard, Shards
from retrieval.search.sharding.object_store import folder_with, is_cluster, read_cluster

OpenShards = Callable[[str | Path, ClusterManifest, Stored], Shard]
"""Opens the shards of a sharded index in a folder or behind a URL, wherever they are held."""


def open_index(
    index: str | Path, model: str | Path | None, verify: bool, shards: OpenShards | None
) -> tuple[Shard, Stored]:
    """Open the current generation of an index folder or of a sharded index.

    Args:
        index: A folder, or the URL of a sharded index.
        model: Path of the checkpoint, if it was moved.
        verify: Compare the checksums of the files.
        shards: Opens the shards; None: in this process.

    Raises:
        IndexesError: The index is missing, damaged, or of another model.
        CheckpointError: The checkpoint is missing or damaged.
    """
    if not is_cluster(index):
        generation = IndexStore(index).open(verify=verify, threads=1)  # one query at a time
        stored = stored_for(generation.manifest, model)
        return folder_shard(generation, stored), stored
    manifest = read_cluster(index)
    stored = stored_for(manifest, model)
    return shards(index, manifest, stored) if shards else open_cluster(index, manifest, stored, verify), stored


def stored_for(manifest: Manifest | ClusterManifest, model: str | Path | None) -> Stored:
    """Return what the checkpoint of an index says of itself. model: its path, if it was moved.

    Raises CheckpointError for a missing or damaged one; `require_made_by` refuses another one.
    """
    stored = read_stored(Path(model) if model else defaults.model_of(manifest))
    if stored.digest != manifest.fingerprint.get("checkpoint"):
        from retrieval.model.checkpoint import load_checkpoint

        load_checkpoint(stored.path)  # a damaged one says so
    return stored


def folder_shard(generation: Generation, stored: Stored) -> FolderShard:
    """Return an opened generation with the scoring layers. Raises MismatchedIndex for another model, CorruptIndex."""
    generation.require(fingerprint(stored))
    require_usable(generation, stored.config.matcher.half)
    return FolderShard(generation, read_judge(stored.path), stored.config.has_embeddings)


def open_cluster(cluster: str | Path, manifest: ClusterManifest, stored: Stored, verify: bool = True) -> Shard:
    """Open all shards of a sharded index in this process; those behind a URL are fetched first. Raises IndexesError."""
    require_made_by(cluster, manifest.fingerprint, fingerprint(stored))
    opened = (
        open_shard(folder_with(cluster, entry), entry, manifest.fingerprint, verify=verify, threads=1)
        for entry in manifest.shards
    )
    return Shards([folder_shard(generation, stored) for generation in opened], described_cluster(manifest))


def described_cluster(manifest: ClusterManifest) -> Described:
    """Return what the manifest says of all shards together."""
    return Described(
        manifest.generation,
        manifest.kind,
        manifest.photos,
        manifest.objects,
        manifest.fingerprint,
        manifest.about,
        manifest.calibration,
        len(manifest.shards),
    )
