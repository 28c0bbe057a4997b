"""Shards served by Ray Serve: one deployment with replicas for each shard; a query calls all shards and merges.

The name of a deployment contains the digest of its shard. A new generation of a sharded index deploys only the shards
that changed; old deployments are deleted when no client uses them.

If a shard does not answer in time, the query fails: no result lacks a part of the catalogue.
"""

import hashlib
import re
import secrets
import threading
import time
import weakref
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from indexes.errors import IndexesError
from indexes.store.generation import check_fingerprint
from indexes.store.sharded import ShardedManifest, ShardEntry
from retrieval.console.output import say
from retrieval.errors import IncompleteSearch, RetrievalError
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint
from retrieval.search.opening import checkpoint_of, open_shard_of
from retrieval.search.shard import Shards

APPLICATION = re.compile(r"shard-\d+-of-\d+-[0-9a-f]{16}-([0-9a-f]{8})")
RETRY_S, MIN_RESULT_TIMEOUT_S = 0.05, 0.005
"""Pause before a call to a lost replica is repeated, and shortest timeout for a result that may be available."""


@dataclass(frozen=True)
class ReplicaSettings:
    """Settings of the replicas of shards.

    Attributes:
        replicas: Number of replicas of each shard.
        cpus: CPUs that Ray reserves for each replica.
        wait_s: Longest wait for an answer, in seconds.
    """

    replicas: int = 1
    cpus: float = 0.5
    wait_s: float = 5.0


class OwnerActor:
    """An actor whose existence shows that a process uses shards."""


class ShardReplica:
    """One shard in a process of Ray Serve."""

    def __init__(self, index: str, manifest: ShardedManifest, entry: ShardEntry, model: str) -> None:
        self._shard = open_shard_of(Path(index), manifest, entry, checkpoint_of(manifest, model))
        threadpool_limits(1, "blas")  # for the whole process: idle BLAS threads spin on CPUs that others need

    def call(self, method: str, *arguments: Any) -> Any:
        """Return the result or the error of a method of `FolderShard`.

        A raised error would contain the tracebacks of all processes.
        """
        try:
            return getattr(self._shard, method)(*arguments)
        except (RetrievalError, IndexesError) as error:
            return error


class RayShards(Shards):
    """A sharded index that Ray Serve serves; the shards are their entries in the manifest.

    Args:
        manifest: Manifest of the index.
        handles: Folder of each shard to the handle of its deployment.
        settings: Settings of the replicas.
    """

    def __init__(self, manifest: ShardedManifest, handles: dict[str, Any], settings: ReplicaSettings) -> None:
        super().__init__(manifest, manifest.shards)
        self._handles, self._settings = handles, settings

    def call(self, shards: Sequence[ShardEntry], method: str, *arguments: Any) -> list[Any]:
        """As `Shards.call`, with all shards at once. Raises IncompleteSearch if a shard does not answer."""
        until = time.monotonic() + self._settings.wait_s
        waiting = [(entry, self._handles[entry.folder].call.remote(method, *arguments)) for entry in shards]
        results, missing = list[Any](), list[str]()
        for entry, response in waiting:
            result = self._result(entry, response, method, arguments, until)
            if isinstance(result, Exception):
                raise result
            if result is None:
                missing.append(entry.folder)
            results.append(result)
        if missing:
            raise IncompleteSearch(
                f"no answer within {self._settings.wait_s:g} s from {', '.join(missing)}; try again, or raise "
                "--shard-timeout"
            )
        return results

    def _result(self, entry: ShardEntry, response: Any, method: str, arguments: Sequence[Any], until: float) -> Any:
        """Return the result of a shard, with a retry if its replica was lost; None if it does not answer in time."""
        from ray.exceptions import RayError
        from ray.serve.exceptions import RayServeException

        while True:
            try:  # a result that arrived while another shard was awaited is used, even after the deadline
                return response.result(timeout_s=max(MIN_RESULT_TIMEOUT_S, until - time.monotonic()))
            except TimeoutError:
                response.cancel()
                return None
            except (RayError, RayServeException):
                if time.monotonic() + RETRY_S > until:
                    return None
                time.sleep(RETRY_S)
                response = self._handles[entry.folder].call.remote(method, *arguments)


class Deployments:
    """The shards that Ray Serve serves for this process, by the digest of their content.

    Their names contain an id of this object, so other processes on the same Ray are not affected when it closes. An
    actor with this id marks them as used; Ray ends it with this process. Deployments whose process was killed are
    deleted by the next process.

    Args:
        ray: The Ray module of a session (`retrieval.cluster.session`).
        settings: Settings of the replicas.
    """

    def __init__(self, ray: Any, settings: ReplicaSettings) -> None:
        self._ray, self._settings = ray, settings
        self._owner_id = secrets.token_hex(4)
        actor = ray.remote(num_cpus=0)(OwnerActor)
        self._owner = actor.options(name=self._owner_id, namespace="touch-retrieval").remote()
        self._users: Counter[str] = Counter()
        self._handles: dict[str, Any] = {}
        self._lock = threading.RLock()  # garbage collection calls `_release` on any thread, also during `open`
        ray.serve.start(proxy_location="Disabled")
        self._delete_orphans()

    def open(self, index: str | Path, manifest: ShardedManifest, stored: CheckpointInfo) -> RayShards:
        """Open a sharded index on Ray Serve, and return when all its shards are ready.

        Args:
            index: Its folder.
            manifest: Its manifest.
            stored: Header of the checkpoint.

        Raises:
            MismatchedIndex: The index is of another model.
            RetrievalError: Ray cannot start the shards.
        """
        check_fingerprint(index, manifest.fingerprint, fingerprint(stored))
        # Which enrolled objects are in a shard depends on the shards that there are.
        folders = [entry.folder for entry in manifest.shards]
        names = {
            entry.folder: f"{entry.folder}-{hashlib.sha256(f'{entry.sha256}{folders}'.encode()).hexdigest()[:16]}-"
            f"{self._owner_id}"
            for entry in manifest.shards
        }
        self._close_handles()
        with self._lock:
            self._deploy(names, str(Path(index).resolve()), manifest, str(stored.path.resolve()))
            self._users.update(names.values())
            for name in set(names.values()) - set(self._handles):
                # Create its router now: concurrent first calls would create several, and only one could be shut down.
                self._handles[name] = self._ray.serve.get_app_handle(name).options()
            handles = {folder: self._handles[name] for folder, name in names.items()}
        opened = RayShards(manifest, handles, self._settings)
        weakref.finalize(opened, self._release, list(names.values()))
        return opened

    def close(self) -> None:
        """Release all opened shards. Call this before the Ray session ends."""
        self._release(list(self._users.elements()))
        self._close_handles()

    def _close_handles(self) -> None:
        """Shut down the handles of unused shards.

        A handle that stays open reports its queue to Ray without end, even after that Ray has ended. The shutdown waits
        for the reporting thread, so garbage collection must not do it: it may run on this thread.
        """
        with self._lock:
            unused = [self._handles.pop(name) for name in list(self._handles) if self._users[name] <= 0]
        for handle in unused:
            handle.shutdown()

    def _delete_orphans(self) -> None:
        owners = {actor["name"] for actor in self._ray.util.list_named_actors(all_namespaces=True)}
        for name in self._ray.serve.status().applications:
            match = APPLICATION.fullmatch(name)
            if match and match[1] not in owners:
                self._ray.serve.delete(name, _blocking=False)

    def _deploy(self, names: dict[str, str], index: str, manifest: ShardedManifest, model: str) -> None:
        serve, settings = self._ray.serve, self._settings
        deployed = serve.status().applications
        deployment = serve.deployment(
            ShardReplica,
            name="shard",
            num_replicas=settings.replicas,
            max_ongoing_requests=4,
            ray_actor_options={"num_cpus": settings.cpus},
            health_check_period_s=2,
            health_check_timeout_s=10,
            graceful_shutdown_timeout_s=10,
        )
        targets = [
            serve.RunTarget(deployment.bind(index, manifest, entry, model), name=names[entry.folder], route_prefix=None)
            for entry in manifest.shards
            if names[entry.folder] not in deployed
        ]
        if not targets:
            return
        needed = settings.cpus * settings.replicas * len(targets)
        if needed > (free := self._ray.available_resources().get("CPU", 0.0)):
            say(f"{len(targets)} shards need {needed:g} CPUs, but only {free:g} are free in Ray: they wait for more")
        try:
            serve.run_many(targets)
        except RuntimeError as error:
            raise RetrievalError(f"{index}: Ray could not start the shards ({error})") from error

    def _release(self, names: Sequence[str]) -> None:
        with self._lock:
            self._users.subtract(names)
            unused = [name for name in set(names) if self._users[name] <= 0]
        if self._ray.is_initialized():
            for name in unused:
                self._ray.serve.delete(name, _blocking=False)
