"""A sharded index: several index folders that together form one catalogue, and the file that lists them.

    SHARDS.json           the shards: folder, generation, SHA-256 of its manifest; the only replaced file
    shard-00-of-04/       an ordinary index folder with its own CURRENT; empty shards have no folder
    LOCK                  locked by the build

The generations in this file are current, and the CURRENT file of each folder is ignored: one rename switches all. The
digest of a generation's manifest covers every byte of the generation, so no folder can be mistaken for another.
Opening a sharded index reads only this file. Its length depends on the number of shards, not on the number of photos.
"""

import re
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from _touch_retrieval.files import file_digest, write_atomically
from indexes.errors import AGAIN, CorruptIndex, NoIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.manifest import NAME as GENERATION_MANIFEST
from indexes.store.manifest import encode_document, read_document

NAME, FORMAT = "SHARDS.json", 3
SHARD_FOLDER = re.compile(r"shard-(\d{2,})-of-(\d{2,})")
MAX_SHARDS = 4096


@dataclass(frozen=True)
class ShardEntry:
    """One shard: its folder, generation, SHA-256 of its manifest.json, and numbers of photos and objects."""

    folder: Annotated[str, Meta(pattern=rf"^{SHARD_FOLDER.pattern}\Z")]
    generation: Annotated[str, Meta(pattern=r"^gen-\d{6,}\Z")]
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    photos: Annotated[int, Meta(ge=1)]
    objects: Annotated[int, Meta(ge=1)]


@dataclass(frozen=True)
class ShardedManifest:
    """Content of the file.

    Attributes:
        generation: Name of this generation, such as sharded-000007.
        created: Time of the build.
        software: Version of the software.
        kind: Kinds of index of the shards.
        fingerprint: Fingerprint of all shards.
        about: Catalogue, checkpoint and further facts of the build.
        of: Number of shards, including empty ones.
        shards: The shards that have photos.
    """

    generation: Annotated[str, Meta(pattern=r"^sharded-\d{6,}\Z")]
    created: str
    software: str
    kind: str
    fingerprint: dict[str, str]
    about: dict[str, Any]
    of: Annotated[int, Meta(ge=1, le=MAX_SHARDS)]
    shards: Annotated[list[ShardEntry], Meta(min_length=1, max_length=MAX_SHARDS)]

    @property
    def photos(self) -> int:
        """Number of photos in all shards."""
        return sum(shard.photos for shard in self.shards)

    @property
    def objects(self) -> int:
        """Number of objects in all shards; the photos of an object are in one shard."""
        return sum(shard.objects for shard in self.shards)


def is_sharded(folder: Path) -> bool:
    """Whether the folder is a sharded index."""
    return (folder / NAME).is_file()


def shard_number(object_id: str, shards: int) -> int:
    """Return the shard of an object, one of `shards`, from a hash of its name that is equal on every machine."""
    digest = blake2b(object_id.encode("utf-8", "surrogatepass"), digest_size=16).digest()
    return int.from_bytes(digest[8:], "little") % shards


def shard_folder(object_id: str, manifest: ShardedManifest) -> str:
    """Return the folder of the shard that an object is in, or would be: another one stands in for an empty shard."""
    folders, number = [shard.folder for shard in manifest.shards], shard_number(object_id, manifest.of)
    full = [folder for folder in folders if folder.startswith(f"shard-{number:02d}-")]
    return full[0] if full else folders[number % len(folders)]


def write_sharded_manifest(folder: Path, manifest: ShardedManifest) -> None:
    """Write the manifest, which switches the sharded index to this generation; delete files of killed writers."""
    for path in folder.glob(f".{NAME}.*.tmp"):
        path.unlink()
    write_atomically(folder / NAME, encode_document(manifest, FORMAT))


def read_sharded_manifest(folder: Path) -> ShardedManifest:
    """Read the manifest of a sharded index. Raises NoIndex, CorruptIndex or UnsupportedFormat."""
    path = folder / NAME
    if not path.exists():
        raise NoIndex(f"{folder}: there is no sharded index here; run `retrieve build-index --shards` first")
    return read_document(path, FORMAT, ShardedManifest)


def open_shard(index: Path, entry: ShardEntry) -> Generation:
    """Open and check the shard of a manifest entry.

    Raises:
        IndexesError: The shard is missing, damaged, or not the generation in the manifest.
    """
    generation = IndexStore(index / entry.folder).open(name=entry.generation)
    if file_digest(generation.folder / GENERATION_MANIFEST) != entry.sha256:
        raise CorruptIndex(f"{generation.folder} is not the generation that {index / NAME} lists; {AGAIN}")
    return generation
