"""Index folders and clusters, opened to be searched with the checkpoint that built them."""

from collections.abc import Callable
from pathlib import Path

from indexes.store.cluster import ClusterManifest, open_shard
from indexes.store.generation import Generation, require_made_by
from indexes.store.manifest import Manifest
from retrieval.model.stored import Stored, fingerprint, read_judge, read_stored
from retrieval.search import defaults
from retrieval.search.query.objects import require_usable
from retrieval.search.query.shard import Described, FolderShard, Shard, Shards
from retrieval.search.sharding.object_store import folder_with


def stored_for(manifest: Manifest | ClusterManifest, model: str | Path | None) -> Stored:
    """What the checkpoint of an index says of itself. model: where it lies now, if it was moved.

    Raises CheckpointError, for a damaged one too; that it is another one is for `require_made_by` to say.
    """
    stored = read_stored(Path(model) if model else defaults.model_of(manifest))
    if stored.digest != manifest.fingerprint.get("checkpoint"):
        from retrieval.model.checkpoint import load_checkpoint

        load_checkpoint(stored.path)  # a damaged one says so
    return stored


def folder_shard(generation: Generation, stored: Stored) -> FolderShard:
    """An opened generation with the layers that judge. Raises MismatchedIndex for another model, and CorruptIndex."""
    generation.require(fingerprint(stored))
    require_usable(generation, stored.config.matcher.half)
    return FolderShard(generation, read_judge(stored.path), stored.config.has_embeddings)


OpenShards = Callable[[str | Path, ClusterManifest, Stored], Shard]
"""Opens the shards of a cluster, which lies in a folder or behind a URL, wherever they are held."""


def open_cluster(cluster: str | Path, manifest: ClusterManifest, stored: Stored, verify: bool = True) -> Shard:
    """All shards of a cluster in this process; fetched first where they lie behind a URL. Raises as `folder_shard`,
    `folder_with` and `indexes.store.cluster.open_shard` do."""
    require_made_by(cluster, manifest.fingerprint, fingerprint(stored))
    shards = [
        folder_shard(
            open_shard(folder_with(cluster, entry), entry, manifest.fingerprint, verify=verify, threads=1), stored
        )
        for entry in manifest.shards
    ]
    return Shards(shards, described_cluster(manifest))


def described_cluster(manifest: ClusterManifest) -> Described:
    """What a cluster's manifest says of all its shards together."""
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
