"""Shards built by Ray Data: a pool of processes, each of which embeds and writes one shard after the other.

What is sent are names; a photo is read, embedded and written by one process on one machine. A process that is lost is
replaced, and its shard is taken up where it was left: by the codes that are in its folder, which all machines must see.

Where Ray has graphics cards, each process has one of them to itself, and the towers run there.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from indexes.errors import IndexesError, LockedIndex
from retrieval.cluster.session import ray_session
from retrieval.console.output import say
from retrieval.errors import RetrievalError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import default_device
from retrieval.search.sharding.build_sharded import ShardBuild, ShardJob, ShardRunner, build_shard

RELEASE_TIMEOUT_S, MAX_FAILURES = 60.0, 3
"""Within which a process that was given up lets go of its shard; how often all may fail without a shard between."""


class BuildWorkerPool(NamedTuple):
    """So many processes at once, and what each asks Ray for: processors, and a graphics card or none."""

    processes: int
    cpus: int
    gpus: int


class ShardBuildWorker:
    """A process of the pool, with the model; on a graphics card where Ray has given it one."""

    def __init__(self, model: Path, has_gpu: bool) -> None:
        self._checkpoint = load_checkpoint(model)
        if has_gpu:
            torch.backends.cudnn.allow_tf32 = False  # an index may have codes of both: they are to be the same
            self._checkpoint.matcher.to(default_device())

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Build the shards of these jobs. What is wrong with one is its answer, for another try would say it again."""
        return {"built": np.array([self._answer(job) for job in batch["job"]], dtype=object)}

    def _answer(self, job: ShardJob) -> ShardBuild | RetrievalError | IndexesError:
        until = time.monotonic() + RELEASE_TIMEOUT_S
        while True:
            try:
                return build_shard(job, self._checkpoint)
            except LockedIndex as error:
                if time.monotonic() > until:
                    return error
                time.sleep(0.2)
            except (RetrievalError, IndexesError) as error:
                return error


def ray_runner(cpus: int | None = None, workers: int | None = None) -> ShardRunner:
    """Builds shards on a Ray cluster (`retrieval.cluster.session`). workers: processes at once, at most; None: one for
    each graphics card of the cluster, or for each processor where it has none.
    """

    def run(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterator[ShardBuild]:
        left, failures = {job.folder: job for job in jobs}, 0
        with ray_session(cpus) as ray:
            ray.data.DataContext.get_current().enable_progress_bars = False
            while left:
                try:
                    for answer in _answers(ray, list(left.values()), checkpoint, workers):
                        if isinstance(answer, Exception):
                            raise answer
                        del left[answer.folder]
                        failures = 0
                        yield answer
                except (RetrievalError, IndexesError):
                    raise
                except Exception as error:  # Ray Data's own: processes lost at the wrong moment make it fail as a whole
                    failures += 1
                    if failures > MAX_FAILURES:
                        raise RetrievalError(
                            f"Ray failed {failures} times without a shard ({type(error).__name__}: {error}); the same "
                            "command goes on where it stopped"
                        ) from error

    return run


def _answers(
    ray: Any, jobs: Sequence[ShardJob], checkpoint: Checkpoint, workers: int | None
) -> Iterator[ShardBuild | RetrievalError | IndexesError]:
    items, pool = [{"job": job} for job in jobs], ray_worker_pool(ray)
    built = ray.data.from_items(items, override_num_blocks=len(items)).map_batches(
        ShardBuildWorker,
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(min_size=1, max_size=min(len(items), workers or pool.processes)),
        num_cpus=pool.cpus,
        num_gpus=pool.gpus,
        fn_constructor_args=(checkpoint.path.resolve(), bool(pool.gpus)),
    )
    for row in built.iter_rows():
        yield row["built"]


def ray_worker_pool(ray: Any) -> BuildWorkerPool:
    """A process for each graphics card of a Ray cluster, with its share of its machine's processors, which read and
    decode; for each processor where there is no card, or none that PyTorch can use there.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    having = [node for node in nodes if node.get("GPU", 0) >= 1]
    if having and ray.get(ray.remote(num_cpus=0, num_gpus=1)(_has_gpu).remote()):
        share = min(int(node.get("CPU", 1) / node["GPU"]) for node in having)
        return BuildWorkerPool(sum(int(node["GPU"]) for node in having), max(1, share), 1)
    if having:
        say("Ray has graphics cards, but PyTorch cannot use them there: processors embed")
    return BuildWorkerPool(max(1, int(sum(node.get("CPU", 0) for node in nodes))), 1, 0)


def _has_gpu() -> bool:
    return default_device().type == "cuda"
