"""A cluster: several index folders that are one catalogue together, and the one file that says which.

    CLUSTER.json          the shards: folder, generation, SHA-256 of that generation's manifest; the only file replaced
    shard-00-of-04/       an ordinary index folder, with its own CURRENT; empty shards have none
    LOCK                  held by whoever builds

What the file names is the cluster, whatever CURRENT says in the folders: all shards are switched by one rename. The
digest of a generation's manifest stands for every byte of the generation, so that no folder can be mistaken for
another. Opening reads this file alone; it is as long as there are shards, however many photos they hold.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from _touch_retrieval.files import file_digest, named_write_errors, write_atomically
from indexes.errors import AGAIN, CorruptIndex, MismatchedIndex, NoIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.manifest import NAME as GENERATION_MANIFEST
from indexes.store.manifest import encode_document, read_document
from indexes.store.rows import key_of

NAME, FORMAT = "SHARDS.json", 2
SHARD_FOLDER = re.compile(r"shard-(\d{2,})-of-(\d{2,})")
MAX_SHARDS = 4096


@dataclass(frozen=True)
class ShardEntry:
    """One shard: its folder in the cluster's, its generation, the SHA-256 of that one's manifest.json, and what it
    holds.
    """

    folder: Annotated[str, Meta(pattern=rf"^{SHARD_FOLDER.pattern}\Z")]
    generation: Annotated[str, Meta(pattern=r"^gen-\d{6,}\Z")]
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    photos: Annotated[int, Meta(ge=1)]
    objects: Annotated[int, Meta(ge=1)]


@dataclass(frozen=True)
class ShardedManifest:
    """The file. kind, fingerprint: those of all shards; about: catalogue, checkpoint and what else was said of the
    build; calibration: the document of that name, None without one.
    """

    generation: Annotated[str, Meta(pattern=r"^cluster-\d{6,}\Z")]
    created: str
    software: str
    kind: str
    fingerprint: dict[str, str]
    about: dict[str, Any]
    calibration: Any
    of: Annotated[int, Meta(ge=1, le=MAX_SHARDS)]
    shards: Annotated[list[ShardEntry], Meta(min_length=1, max_length=MAX_SHARDS)]

    @property
    def photos(self) -> int:
        """Of all shards."""
        return sum(shard.photos for shard in self.shards)

    @property
    def objects(self) -> int:
        """Of all shards; none lies in two."""
        return sum(shard.objects for shard in self.shards)


def is_sharded(folder: Path) -> bool:
    """Whether a cluster lies there."""
    return (folder / NAME).is_file()


def shard_number(object_id: str, shards: int) -> int:
    """Which of so many shards holds the photos of an object: by a hash of its name, the same everywhere."""
    return int.from_bytes(key_of(object_id)[8:], "little") % shards


def shard_folder(number: int, of: int) -> str:
    """The folder of a shard, counted from 0."""
    return f"shard-{number:02d}-of-{of:02d}"


def sharded_generation_name(number: int) -> str:
    """The name of a cluster's generation, such as cluster-000007."""
    return f"cluster-{number:06d}"


def generation_number(name: str) -> int:
    """The number in a generation's name."""
    return int(name.rpartition("-")[2])


def shard_entry(cluster: Path, folder: str, generation: Generation, objects: int) -> ShardEntry:
    """What the manifest is to say of a shard that was written."""
    digest = file_digest(cluster / folder / generation.name / GENERATION_MANIFEST)
    return ShardEntry(folder, generation.name, digest, generation.count, objects)


def write_sharded_manifest(folder: Path, manifest: ShardedManifest) -> None:
    """Put the file in its place: this cluster answers from now on."""
    with named_write_errors(folder / NAME):
        write_atomically(folder / NAME, sharded_manifest_bytes(manifest))


def sharded_manifest_bytes(manifest: ShardedManifest) -> bytes:
    """The content of the file."""
    return encode_document(manifest, FORMAT)


def read_sharded_manifest(folder: Path) -> ShardedManifest:
    """The manifest of a cluster. Raises NoIndex, CorruptIndex or UnsupportedFormat."""
    path = folder / NAME
    if not path.exists():
        raise NoIndex(f"{folder}: there is no cluster here; run `retrieve build-index --shards` first")
    manifest = read_document(path, FORMAT, ShardedManifest)
    if len({shard.folder for shard in manifest.shards}) < len(manifest.shards):
        raise CorruptIndex(f"{path}: every shard must have a folder of its own, two share one; {AGAIN}")
    return manifest


def open_shard(
    cluster: Path,
    entry: ShardEntry,
    fingerprint: Mapping[str, str],
    *,
    verify: bool = True,
    threads: int | None = None,
) -> Generation:
    """The generation that the cluster names, checked as `IndexStore.open` does. Raises its errors, and CorruptIndex for
    another generation than the cluster was made of.
    """
    store = IndexStore(cluster / entry.folder)
    generation = store.open(name=entry.generation, verify=verify, threads=threads)
    try:
        generation.require(fingerprint)
    except MismatchedIndex as error:
        raise CorruptIndex(f"{generation.folder} is not of this cluster ({error})") from error
    if file_digest(generation.folder / GENERATION_MANIFEST) != entry.sha256 or generation.count != entry.photos:
        raise CorruptIndex(f"{generation.folder} is not the generation that {cluster / NAME} was written for; {AGAIN}")
    return generation
