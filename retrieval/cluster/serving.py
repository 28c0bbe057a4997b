"""Shards held by Ray Serve: a deployment for each, with replicas; whoever asks, asks all of them at once and merges.

A deployment is named by the digest of its shard's content. A new generation of a cluster deploys the shards that
changed and leaves the others as they are; the shards of the old one end when nobody asks them any more.

A shard that does not answer in time is left out. The answer then says which share of the catalogue was searched, and
its objects keep the probability that they had, on average; where more of the catalogue was asked for, there is none.
"""

import re
import secrets
import threading
import time
import weakref
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from indexes.errors import IndexesError
from indexes.store.generation import check_fingerprint
from indexes.store.sharded import ShardedManifest, ShardEntry, open_shard
from retrieval.console.output import say
from retrieval.data.storage import is_url
from retrieval.errors import BadInput, IncompleteSearch, RetrievalError
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint, read_checkpoint_info
from retrieval.model.posterior import Posterior
from retrieval.search.query.opening import folder_shard, sharded_index_info
from retrieval.search.query.shard import (
    IndexInfo,
    Page,
    ShardQuery,
    ShardResult,
    merge_pages,
    merge_results,
    merge_rows,
)
from retrieval.search.sharding.object_store import local_folder

OWNERS = "touch-retrieval"
APPLICATION = re.compile(r"shard-\d+-of-\d+-[0-9a-f]{16}-([0-9a-f]{8})")
RETRY_S, MIN_RESULT_TIMEOUT_S = 0.05, 0.005
"""Before a shard whose replica was lost is asked again; to take an answer that is there."""


MAX_WAIT_S = 86_400


@dataclass(frozen=True)
class ReplicaSettings:
    """How shards are held.

    replicas: of each, at least; max_replicas: to which number they may grow as requests wait. cpus: that Ray counts
    for each. ongoing: requests that a replica works on at once. wait_s: for an answer. least_share: of the catalogue,
    that must be searched.
    """

    replicas: int = 1
    max_replicas: int | None = None
    cpus: float = 0.5
    max_ongoing_requests: int = 4
    wait_s: float = 5.0
    min_share: float = 1.0

    def __post_init__(self) -> None:
        """Raises BadInput."""
        if not 1 <= self.replicas <= (self.max_replicas or self.replicas):
            raise BadInput(f"replicas must be 1 or more, and no more than the most; got {self.replicas}")
        if not 0 < self.min_share <= 1:
            raise BadInput(f"the least share must lie above 0 and be 1 at most; got {self.min_share}")
        if not 0 < self.wait_s <= MAX_WAIT_S:
            raise BadInput(f"the wait for a shard must be above 0 and at most {MAX_WAIT_S} seconds; got {self.wait_s}")


class OwnerActor:
    """Says by being there that a process holds shards."""


class ShardReplica:
    """One shard in a process of Ray Serve."""

    def __init__(self, cluster: str, entry: ShardEntry, made_by: dict[str, str], model: str, verify: bool) -> None:
        stored = read_checkpoint_info(Path(model))
        generation = open_shard(local_folder(cluster, entry), entry, made_by, verify=verify, threads=1)
        self._shard = folder_shard(generation, stored)
        threadpool_limits(1, "blas")  # as long as this process lives: idle ones spin, and take others' processors

    def call(self, method: str, *arguments: Any) -> Any:
        """Return what this method of `Shard` returns, or its error: raised, it would carry the tracebacks of all
        processes.
        """
        try:
            return getattr(self._shard, method)(*arguments)
        except (RetrievalError, IndexesError) as error:
            return error


class RayShardGroup:
    """A cluster whose shards Ray Serve holds. handles: name of a shard -> its deployment."""

    def __init__(
        self, info: IndexInfo, entries: Sequence[ShardEntry], handles: dict[str, Any], settings: ReplicaSettings
    ) -> None:
        self.info, self.entries, self._handles, self._settings = info, list(entries), handles, settings

    def search(self, query: ShardQuery, top: int, candidates: int | None, posterior: Posterior | None) -> ShardResult:
        """As `Shard.search`. Raises IncompleteSearch where less of the catalogue was searched than is wanted."""
        answers, silent = self._call_shards("search", query, top, candidates, posterior)
        searched = sum(entry.photos for entry in self.entries if entry not in silent)
        if not answers or searched < self._settings.min_share * self.info.photos:
            raise self._unanswered_error(silent, searched)
        found = merge_results(answers, top)
        if found.mass is not None:
            found = replace(found, mass=found.mass.extrapolated(sum(entry.objects for entry in silent)))
        return found

    def rows(self, ids: Sequence[str]) -> list[dict[str, Any] | None]:
        """As `Shard.rows`. Raises IncompleteSearch where a photo may be in a shard that did not answer."""
        answers, silent = self._call_shards("rows", list(ids))
        found: list[dict[str, Any] | None] = merge_rows(answers) if answers else [None for _ in ids]
        if silent and None in found:
            raise self._unanswered_error(silent, sum(entry.photos for entry in self.entries if entry not in silent))
        return found

    def page(self, words: Sequence[str], object_id: str | None, offset: int, limit: int) -> Page:
        """As `Shard.page`. Raises IncompleteSearch where a shard does not answer."""

        def of_shard(entry: ShardEntry, offset: int, limit: int) -> Page:
            answers, silent = self._call_shards("page", list(words), object_id, offset, limit, entries=[entry])
            if silent:
                raise self._unanswered_error(silent, self.info.photos - entry.photos)
            found: Page = answers[0]
            return found

        return merge_pages([partial(of_shard, entry) for entry in self.entries], offset, limit)

    def _call_shards(
        self, method: str, *asked: Any, entries: Sequence[ShardEntry] | None = None
    ) -> tuple[list[Any], list[ShardEntry]]:
        """What shards answer, all of them unless `entries` says which, and those that do not in time."""
        until = time.monotonic() + self._settings.wait_s
        wanted = self.entries if entries is None else entries
        waiting = [(entry, self._send(entry, method, asked)) for entry in wanted]
        answers, silent = [], []
        for entry, response in waiting:
            answer = self._answer(entry, response, method, asked, until)
            if answer is None:
                silent.append(entry)
            elif isinstance(answer, Exception):
                raise answer
            else:
                answers.append(answer)
        return answers, silent

    def _send(self, entry: ShardEntry, method: str, asked: Sequence[Any]) -> Any:
        return self._handles[entry.folder].call.remote(method, *asked)

    def _answer(self, entry: ShardEntry, response: Any, method: str, asked: Sequence[Any], until: float) -> Any:
        """The answer of a shard, asked again where its replica was lost; None where it has none in time."""
        from ray.exceptions import RayError
        from ray.serve.exceptions import RayServeException

        while True:
            try:  # what came while another shard was waited for is taken, however late it is looked at
                return response.result(timeout_s=max(MIN_RESULT_TIMEOUT_S, until - time.monotonic()))
            except TimeoutError:
                response.cancel()
                return None
            except (RayError, RayServeException):
                if time.monotonic() + RETRY_S > until:
                    return None
                time.sleep(RETRY_S)
                response = self._send(entry, method, asked)

    def _unanswered_error(self, silent: Sequence[ShardEntry], photos: int) -> IncompleteSearch:
        share = photos / self.info.photos
        names = ", ".join(entry.folder for entry in silent)
        return IncompleteSearch(
            f"no answer within {self._settings.wait_s:g} s from {names}: {share:.3f} of the catalogue could be searched, "
            f"and {self._settings.min_share:g} was asked for; ask again, or admit less (--min-share)"
        )


class Deployments:
    """The shards that Ray Serve holds for this process, by the digest of what they hold.

    Their names are this object's own: whoever else holds the same shards on the same Ray keeps its own when this ends.
    An actor of this process, which Ray ends with it however it ends, says that they are held: those of a process that
    was killed are deleted by the next.
    """

    def __init__(self, ray: Any, settings: ReplicaSettings, verify: bool = True) -> None:
        self._ray, self._settings, self._verify = ray, settings, verify
        self._owner_id = secrets.token_hex(4)
        self._owner = ray.remote(num_cpus=0)(OwnerActor).options(name=self._owner_id, namespace=OWNERS).remote()
        self._users: Counter[str] = Counter()
        self._handles: dict[str, Any] = {}
        self._lock = threading.RLock()  # the collector of garbage lets shards go wherever it runs, in `open` too
        ray.serve.start(proxy_location="Disabled")
        self._delete_orphans()

    def open(self, cluster: str | Path, manifest: ShardedManifest, stored: CheckpointInfo) -> RayShardGroup:
        """As `retrieval.search.query.opening.open_sharded_index`, of shards that Ray Serve holds: returns when all answer."""
        check_fingerprint(cluster, manifest.fingerprint, fingerprint(stored))
        names = {entry.folder: f"{entry.folder}-{entry.sha256[:16]}-{self._owner_id}" for entry in manifest.shards}
        self._close_handles()
        with self._lock:
            where = cluster if is_url(cluster) else Path(cluster).resolve()
            self._deploy(names, str(where), manifest, stored)
            self._users.update(names.values())
            for name in set(names.values()) - set(self._handles):
                # With its router at once: threads that ask first would make one each, and one alone could be ended.
                self._handles[name] = self._ray.serve.get_app_handle(name).options()
            handles = {folder: self._handles[name] for folder, name in names.items()}
        opened = RayShardGroup(sharded_index_info(manifest), manifest.shards, handles, self._settings)
        weakref.finalize(opened, self._release, list(names.values()))
        return opened

    def close(self) -> None:
        """End all that was opened; to be called before Ray is left."""
        self._release(list(self._users.elements()))
        self._close_handles()

    def _close_handles(self) -> None:
        """Of shards that nobody asks any more. One that is left tells Ray of its queue for ever, also when that Ray has
        ended. Waits for the thread that does so: nothing for the collector of garbage, which may run on it.
        """
        with self._lock:
            over = [self._handles.pop(name) for name in list(self._handles) if self._users[name] <= 0]
        for handle in over:
            handle.shutdown()

    def _delete_orphans(self) -> None:
        settings = {one["name"] for one in self._ray.util.list_named_actors(all_namespaces=True)}
        for name in self._ray.serve.status().applications:
            made = APPLICATION.fullmatch(name)
            if made and made[1] not in settings:
                self._ray.serve.delete(name, _blocking=False)

    def _deploy(self, names: dict[str, str], cluster: str, manifest: ShardedManifest, stored: CheckpointInfo) -> None:
        serve, settings = self._ray.serve, self._settings
        there = serve.status().applications
        wanted = [entry for entry in manifest.shards if names[entry.folder] not in there]
        made_by, model = dict(manifest.fingerprint), str(stored.path.resolve())
        scale: dict[str, Any] = {"num_replicas": settings.replicas}
        if settings.max_replicas is not None and settings.max_replicas > settings.replicas:
            scale = {
                "autoscaling_config": {
                    "min_replicas": settings.replicas,
                    "max_replicas": settings.max_replicas,
                    "target_ongoing_requests": max(1, settings.max_ongoing_requests // 2),
                }
            }
        deployment = serve.deployment(
            ShardReplica,
            name="shard",
            max_ongoing_requests=settings.max_ongoing_requests,
            ray_actor_options={"num_cpus": settings.cpus},
            health_check_period_s=2,
            health_check_timeout_s=10,
            graceful_shutdown_timeout_s=10,
            **scale,
        )
        targets = [
            serve.RunTarget(
                deployment.bind(cluster, entry, made_by, model, self._verify),
                name=names[entry.folder],
                route_prefix=None,
            )
            for entry in wanted
        ]
        if targets:
            needed, free = (
                settings.cpus * settings.replicas * len(targets),
                self._ray.available_resources().get("CPU", 0.0),
            )
            if needed > free:
                say(f"{len(targets)} shards take {needed:g} processors, and Ray has {free:g} free: they wait for more")
            try:
                serve.run_many(targets)
            except RuntimeError as error:
                raise RetrievalError(f"{cluster}: shards could not be started on Ray ({error})") from error

    def _release(self, names: Sequence[str]) -> None:
        with self._lock:
            self._users.subtract(names)
            over = [name for name in set(names) if self._users[name] <= 0]
        if self._ray.is_initialized():
            for name in over:
                self._ray.serve.delete(name, _blocking=False)
