"""Shards built by Ray Data: a pool of processes, each of which embeds and writes one shard after the other.

What is sent are names; a photo is read, embedded and written by one process on one machine. A process that is lost is
replaced, and its shard is taken up where it was left: by the codes that are in its folder, which all machines must see.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from indexes.errors import IndexesError, LockedIndex
from retrieval.cluster.session import connected
from retrieval.errors import RetrievalError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.search.build_cluster import Run, ShardBuilt, ShardJob, build_shard

ENDING_S, FAILURES = 60.0, 3
"""Within which a process that was given up lets go of its shard; how often all may fail without a shard between."""


class ShardBuilder:
    """A process of the pool, with the model."""

    def __init__(self, model: Path) -> None:
        self._checkpoint = load_checkpoint(model)

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Build the shards of these jobs. What is wrong with one is its answer, for another try would say it again."""
        return {"built": np.array([self._answer(job) for job in batch["job"]], dtype=object)}

    def _answer(self, job: ShardJob) -> ShardBuilt | RetrievalError | IndexesError:
        until = time.monotonic() + ENDING_S
        while True:
            try:
                return build_shard(job, self._checkpoint)
            except LockedIndex as error:
                if time.monotonic() > until:
                    return error
                time.sleep(0.2)
            except (RetrievalError, IndexesError) as error:
                return error


def by_ray(cpus: int | None = None, workers: int | None = None) -> Run:
    """Builds shards on a Ray cluster (`retrieval.cluster.session`). workers: processes at once, at most; None: as many
    as there are processors for, each with one."""

    def run(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterator[ShardBuilt]:
        left, failures = {job.folder: job for job in jobs}, 0
        with connected(cpus) as ray:
            ray.data.DataContext.get_current().enable_progress_bars = False
            most = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
            while left:
                try:
                    for answer in _answers(ray, list(left.values()), checkpoint, min(len(left), most)):
                        if isinstance(answer, Exception):
                            raise answer
                        del left[answer.folder]
                        failures = 0
                        yield answer
                except (RetrievalError, IndexesError):
                    raise
                except Exception as error:  # Ray Data's own: processes lost at the wrong moment make it fail as a whole
                    failures += 1
                    if failures > FAILURES:
                        raise RetrievalError(
                            f"Ray failed {failures} times without a shard ({type(error).__name__}: {error}); the same "
                            "command goes on where it stopped"
                        ) from error

    return run


def _answers(
    ray: Any, jobs: Sequence[ShardJob], checkpoint: Checkpoint, processes: int
) -> Iterator[ShardBuilt | RetrievalError | IndexesError]:
    items = [{"job": job} for job in jobs]
    built = ray.data.from_items(items, override_num_blocks=len(items)).map_batches(
        ShardBuilder,
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(min_size=1, max_size=processes),
        num_cpus=1,
        fn_constructor_args=(checkpoint.path.resolve(),),
    )
    for row in built.iter_rows():
        yield row["built"]
