"""Building of shards with Ray Data: each process of a pool embeds and writes one shard after another.

Jobs contain the paths and metadata of photos, not their bytes. The process that reads a photo also embeds it and writes
its row. A lost process is replaced. Its shard continues from the embeddings and partial activations in its folder,
which must be visible to all machines.

If Ray has GPUs, each process has a GPU of its own, and the towers run there.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from indexes.errors import IndexesError, LockedIndex
from retrieval.cluster.session import ray_session
from retrieval.console.output import say
from retrieval.errors import NoReadablePhoto, RetrievalError
from retrieval.indexing.sharded import ShardBuild, ShardJob, build_shard
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import default_device


class ShardBuildWorker:
    """A process of the pool with the model, on a GPU if Ray assigned one."""

    def __init__(self, model: Path, has_gpu: bool) -> None:
        self._checkpoint = load_checkpoint(model)
        if has_gpu:
            torch.backends.cudnn.allow_tf32 = False  # an index may mix codes of CPU and GPU: compute both in float32
            self._checkpoint.matcher.to(default_device())

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Build the shards of these jobs. Errors are returned as results, because a retry would fail the same way."""
        return {"built": np.array([self._build(job) for job in batch["job"]], dtype=object)}

    def _build(self, job: ShardJob) -> ShardBuild | RetrievalError | IndexesError:
        until = time.monotonic() + 60.0  # by then a lost process has released the lock of its shard
        while True:
            try:
                return build_shard(job, self._checkpoint)
            except LockedIndex as error:
                if time.monotonic() > until:
                    return error
                time.sleep(0.2)
            except (RetrievalError, IndexesError) as error:
                return error


def build_on_ray(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterator[ShardBuild]:
    """Build shards on a Ray cluster (`retrieval.cluster.session`): a `ShardRunner`."""
    with ray_session() as ray:
        ray.data.DataContext.get_current().enable_progress_bars = False
        processes, pool = ray_worker_pool(ray)
        try:
            built = ray.data.from_items([{"job": job} for job in jobs], override_num_blocks=len(jobs)).map_batches(
                ShardBuildWorker,
                batch_size=1,
                compute=ray.data.ActorPoolStrategy(min_size=1, max_size=min(len(jobs), processes)),
                fn_constructor_args=(checkpoint.path.resolve(), bool(pool["num_gpus"])),
                **pool,
            )
            for row in built.iter_rows():
                if isinstance(row["built"], Exception) and not isinstance(row["built"], NoReadablePhoto):
                    raise row["built"]
                yield row["built"]
        except (RetrievalError, IndexesError):
            raise
        except Exception as error:  # the exceptions of Ray have no common base
            raise RetrievalError(
                f"Ray lost the build ({type(error).__name__}: {error}); run the same command again to continue"
            ) from error


def ray_worker_pool(ray: Any) -> tuple[int, dict[str, int]]:
    """Return the number of processes for a Ray cluster, and the CPUs and GPUs that each requests.

    There is a process for each GPU. Each requests the same number of CPUs, which read and decode: the smallest number
    of CPUs per GPU of any machine that has GPUs. Without a GPU that PyTorch can use, there is a process for each CPU.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    gpu_nodes = [node for node in nodes if node.get("GPU", 0) >= 1]
    if gpu_nodes and ray.get(ray.remote(num_cpus=0, num_gpus=1)(_has_gpu).remote()):
        cpus = min(int(node.get("CPU", 1) / node["GPU"]) for node in gpu_nodes)
        return sum(int(node["GPU"]) for node in gpu_nodes), {"num_cpus": max(1, cpus), "num_gpus": 1}
    if gpu_nodes:
        say("Ray has GPUs, but PyTorch cannot use them there; CPUs embed the photos")
    return max(1, int(sum(node.get("CPU", 0) for node in nodes))), {"num_cpus": 1, "num_gpus": 0}


def _has_gpu() -> bool:
    return default_device().type == "cuda"
