"""A sharded index in an object store, at any URL that `fsspec` can write to.

    SHARDS.json                                as in a folder (`indexes.store.sharded`); uploaded last, by one request
    shard-00-of-04/gen-000007-<SHA-256>/       a generation, named by the digest of its manifest
        rows.jsonl, ...
        manifest.json                          uploaded last

The name of a generation determines every byte of it: it is immutable, and two builds cannot mix their files. A
generation is complete if its manifest exists; files with another size than in the manifest are uploaded again. Each
file is checked by its digest when it is fetched.

Generations are built in one local folder and fetched into another for searching. Both are in the user's cache and may
be deleted at any time. The caches of fsspec (`filecache`, `simplecache`) are not suitable: they store files under
hashed names and do not compare digests.
"""

import errno
import hashlib
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from _touch_retrieval.files import file_digest, remove_folder, write_atomically
from indexes.errors import AGAIN, CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.store import sharded
from indexes.store.folder import IndexStore
from indexes.store.locking import exclusive_lock
from indexes.store.manifest import NAME as MANIFEST
from indexes.store.manifest import read_manifest
from indexes.store.sharded import SHARD_FOLDER, ShardedManifest, ShardEntry, sharded_manifest_bytes
from retrieval.console.files import cache_folder, make_cache_folder
from retrieval.data.storage import PERMANENT_ERRORS, file_system, is_url, retry
from retrieval.errors import BadInput, RemoteStorageError

T = TypeVar("T")
GENERATION = re.compile(r"(gen-\d{6,})-([0-9a-f]{64})")
MAX_MANIFEST_BYTES = 16 * 2**20
"""Largest manifest."""
MAX_FETCHED_GENERATIONS = 2
"""Fetched generations of a shard that stay in the cache: one can be searched while the next is fetched."""


def is_sharded(where: str | Path) -> bool:
    """Whether this is a sharded index; an index behind a URL always is."""
    return is_url(where) or sharded.is_sharded(Path(where))


def read_sharded_manifest(where: str | Path) -> ShardedManifest:
    """Return the manifest in a folder or behind a URL. Raises IndexesError and StorageError."""
    if not is_url(where):
        return sharded.read_sharded_manifest(Path(where))
    stored = RemoteShardedIndex(str(where))
    return stored.parse_manifest(stored.manifest())


def local_folder(where: str | Path, entry: ShardEntry) -> Path:
    """Return the local folder that contains a shard, which is fetched first from a URL.

    Args:
        where: Folder or URL of the sharded index.
        entry: Manifest entry of the shard.
    """
    return RemoteShardedIndex(str(where)).fetch(entry) if is_url(where) else Path(where)


class RemoteShardedIndex:
    """The sharded index behind a URL.

    Args:
        url: Its URL.

    Attributes:
        work: Local folder in which its shards are built.

    Raises:
        BadInput: The URL cannot be opened, or is a local folder.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if self.url.startswith(("file:", "local:")):
            raise BadInput(f"{url} is a local folder; give its path")
        self._system, root = file_system(self.url)
        self._root = root.rstrip("/")
        cache = cache_folder()
        if cache is None:
            raise BadInput(f"{url}: there is no cache folder to work in; set XDG_CACHE_HOME")
        make_cache_folder(cache)
        key = hashlib.sha256(self.url.encode()).hexdigest()[:32]
        self.work, self._fetched = cache / "building" / key, cache / "shards" / key

    # Reading ---------------------------------------------------------------------------------------------------

    def manifest(self) -> bytes | None:
        """Return the content of the manifest; None without one. Raises StorageError."""
        return self._try(sharded.NAME, self._content)

    def parse_manifest(self, manifest: bytes | None) -> ShardedManifest:
        """Parse the content of a manifest. Raises NoIndex for None, CorruptIndex and UnsupportedFormat."""
        if manifest is None:
            raise NoIndex(
                f"{self.url}: there is no sharded index here; run `retrieve build-index --out {self.url}` first"
            )
        own = self._fetched / sharded.NAME
        own.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(own, manifest)
        try:
            return sharded.read_sharded_manifest(own.parent)
        except (CorruptIndex, UnsupportedFormat) as error:
            raise type(error)(f"{self.url}: {error}") from error

    def fetch(self, entry: ShardEntry) -> Path:
        """Fetch a shard unless it is in the cache, and return the local folder that contains it.

        Args:
            entry: Manifest entry of the shard.

        Raises:
            CorruptIndex: The shard has another content.
            StorageError: The storage fails.
        """
        own = self._fetched / entry.sha256[:32]
        place = own / entry.folder / entry.generation
        if not place.is_dir():
            with exclusive_lock(own.with_name(f"{own.name}.lock")):
                if not place.is_dir():
                    self._fetch(f"{entry.folder}/{_generation_name(entry)}", entry.sha256, place)
            with suppress(OSError):  # another process may delete the same folders
                old = sorted(self._fetched.glob(f"*/{entry.folder}"), key=lambda path: path.stat().st_mtime)
                for path in old[:-MAX_FETCHED_GENERATIONS]:
                    remove_folder(path.parent)
        return own

    def restore(self, folder: str) -> None:
        """Fetch the newest complete generation of a shard and make it current in the local folder.

        A build then reuses the codes of other machines. A damaged generation is ignored.

        Args:
            folder: Folder of the shard.
        """
        name = max((name for name, is_whole in self.generations(folder).items() if is_whole), default=None)
        if name is None:
            return
        store = IndexStore(self.work / folder)
        generation, sha256 = GENERATION.fullmatch(name).groups()  # type: ignore[union-attr]
        place = store.path / generation
        if place.is_dir():
            if file_digest(place / MANIFEST) == sha256:
                return
            remove_folder(place)  # a local generation of that name with other content is obsolete
        with suppress(IndexesError):
            self._fetch(f"{folder}/{name}", sha256, place)
            store.make_current(generation)

    def generations(self, folder: str = "") -> dict[str, bool]:
        """Return {generation: whether its manifest exists} of one shard; or of all, as `<shard>/<generation>`."""
        files = self._sizes(folder)
        generation_names = {file.rpartition("/")[0] for file in files}
        found = {
            name: f"{name}/{MANIFEST}" in files
            for name in generation_names
            if GENERATION.fullmatch(name.rpartition("/")[2])
        }
        return {
            name: whole for name, whole in found.items() if folder or SHARD_FOLDER.fullmatch(name.rpartition("/")[0])
        }

    # Writing ---------------------------------------------------------------------------------------------------

    def put(self, entry: ShardEntry, verify: bool = False) -> None:
        """Upload the files of a shard from the local folder, except those that the store already has.

        Args:
            entry: Manifest entry of the shard.
            verify: Compare digests, not only sizes.

        Raises:
            StorageError: The storage fails.
        """
        place, own = f"{entry.folder}/{_generation_name(entry)}", self.work / entry.folder / entry.generation
        uploaded = self._sizes(place)
        must = {name: file.sha256 for name, file in read_manifest(own).files.items()} | {MANIFEST: entry.sha256}
        for name, sha256 in must.items():
            size = (own / name).stat().st_size
            if uploaded.get(name) != size or (verify and self._try(f"{place}/{name}", self._digest) != sha256):
                self._put(own / name, f"{place}/{name}")

    def switch(self, before: bytes | None, manifest: ShardedManifest) -> None:
        """Make this manifest the current one.

        Args:
            before: Content of the manifest when the build began.
            manifest: The new manifest.

        Raises:
            StorageError: The storage fails, or another build switched in the meantime. Stores with conditional writes
                detect a switch up to the write itself.
        """
        content = sharded_manifest_bytes(manifest)

        def put(path: str) -> bool:
            # Take the condition (ETag) first. Taken after the content, a switch in between would go unnoticed.
            condition = self._unchanged(path)
            current = self._content(path)
            if current == content:  # written by a request whose response was lost
                return True
            torn = current is not None and content.startswith(current)
            if current != before and not torn:
                return False
            try:
                self._system.pipe_file(path, content, **condition)
            except OSError as error:
                if error.errno != errno.ENOSYS:
                    raise
                self._system.pipe_file(path, content)
            if self._content(path) != content:
                raise OSError("the upload was incomplete")
            return True

        if not self._try(sharded.NAME, put):
            raise RemoteStorageError(
                f"{self.url}: another build switched this index in the meantime; run the same command again, which "
                "reuses all embeddings"
            )

    def discard(self, generation_names: Iterable[str]) -> None:
        """Delete generations, named as `generations` names them, each manifest first."""

        def delete(path: str) -> None:
            with suppress(FileNotFoundError):  # deleted by a request whose response was lost
                self._system.rm_file(path)

        for name in generation_names:
            for file in sorted(self._sizes(name), key=lambda file: file != MANIFEST):
                self._try(f"{name}/{file}", delete)

    # The store -------------------------------------------------------------------------------------------------

    def _try(self, name: str, function: Callable[[str], T]) -> T:
        """Call `function` with the whole path of `name`, and retry if the store fails. Raises StorageError."""
        what = f"{self.url}/{name}".rstrip("/")
        try:
            return retry(what, lambda: function(f"{self._root}/{name}".rstrip("/")))
        except PERMANENT_ERRORS as error:
            raise RemoteStorageError(
                f"{what}: the storage refused the request ({type(error).__name__}: {error})"
            ) from error

    def _sizes(self, name: str) -> dict[str, int]:
        """Return {file below `name`: its number of bytes}."""

        def sizes(path: str) -> dict[str, int]:
            self._system.invalidate_cache()
            try:
                found = self._system.find(path, detail=True)
            except FileNotFoundError:
                return {}
            below = f"{path}/"
            pairs = {one["name"]: one["size"] for one in found.values()}
            return {name.removeprefix(below): size for name, size in pairs.items() if name.startswith(below)}

        return self._try(name, sizes)

    def _info(self, path: str) -> dict[str, Any] | None:
        """Return the store's current information about a file; None without one."""
        self._system.invalidate_cache()
        try:
            found: dict[str, Any] = self._system.info(path)
        except FileNotFoundError:
            return None
        return found

    def _content(self, path: str) -> bytes | None:
        """Return the content of a manifest; None without one."""
        try:
            data: bytes = self._system.cat_file(path, start=0, end=MAX_MANIFEST_BYTES + 1)
        except FileNotFoundError:
            return None
        if len(data) > MAX_MANIFEST_BYTES:
            raise ValueError(f"a manifest must have at most {MAX_MANIFEST_BYTES} bytes")
        return data

    def _unchanged(self, path: str) -> dict[str, Any]:
        """Return arguments with which `pipe_file` replaces only the current file.

        These are fsspec's if there is no file, S3's for an existing file, and none for other stores.
        """
        found = self._info(path)
        if found is None:
            return {"mode": "create"}
        return {"IfMatch": found["ETag"]} if "s3" in self._system.protocol and found.get("ETag") else {}

    def _digest(self, path: str) -> str:
        with self._system.open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _put(self, file: Path, name: str) -> None:
        def put(path: str) -> None:
            self._system.put_file(str(file), path)
            if (self._info(path) or {}).get("size") != file.stat().st_size:
                raise OSError("the upload was incomplete")

        self._try(name, put)

    def _fetch(self, name: str, sha256: str, place: Path) -> None:
        """Fetch a generation into `place`, which is created when it is complete; files of earlier tries are reused."""
        part = place.with_name(f"{place.name}.part")
        part.mkdir(parents=True, exist_ok=True)
        self._fetch_file(f"{name}/{MANIFEST}", part / MANIFEST, None, sha256)
        for file, must in read_manifest(part).files.items():
            self._fetch_file(f"{name}/{file}", part / file, must.bytes, must.sha256)
        part.rename(place)

    def _fetch_file(self, name: str, file: Path, must: int | None, sha256: str) -> None:
        """Fetch one file; `must` is its number of bytes, None for a manifest."""
        if file.is_file() and file_digest(file) == sha256:
            return
        size = (self._try(name, self._info) or {}).get("size")
        if size is None or (size > MAX_MANIFEST_BYTES if must is None else size != must):
            expected = f"at most {MAX_MANIFEST_BYTES}" if must is None else must
            what = "is missing" if size is None else f"has {size} bytes instead of {expected}"
            raise CorruptIndex(f"{self.url}/{name} {what}; {AGAIN}")

        def fetch(path: str) -> None:
            self._system.get_file(path, str(file))
            if file.stat().st_size != size:
                raise OSError("the download was incomplete")

        self._try(name, fetch)
        if file_digest(file) != sha256:
            file.unlink()
            raise CorruptIndex(f"{self.url}/{name} was altered; `retrieve build-index --verify` repairs it")


def generation_names(entries: Iterable[ShardEntry]) -> set[str]:
    """Return the names of generations in the form of `RemoteShardedIndex.generations`."""
    return {f"{entry.folder}/{_generation_name(entry)}" for entry in entries}


def _generation_name(entry: ShardEntry) -> str:
    return f"{entry.generation}-{entry.sha256}"
