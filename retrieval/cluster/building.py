"""Shards built by Ray Data: a pool of processes, each of which embeds and writes one shard after the other.

What is sent are names; a photo is read, embedded and written by one process on one machine. A process that is lost is
replaced, and its shard is taken up where it was left: by the codes that are in its folder, which all machines must see.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from indexes.errors import IndexesError
from retrieval.cluster.session import connected
from retrieval.errors import RetrievalError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.search.build_cluster import Run, ShardBuilt, ShardJob, build_shard


class ShardBuilder:
    """A process of the pool, with the model."""

    def __init__(self, model: Path) -> None:
        self._checkpoint = load_checkpoint(model)

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Build the shards of these jobs. What is wrong with one is its answer, for another try would say it again."""
        answers: list[ShardBuilt | RetrievalError | IndexesError] = []
        for job in batch["job"]:
            try:
                answers.append(build_shard(job, self._checkpoint))
            except (RetrievalError, IndexesError) as error:
                answers.append(error)
        return {"built": np.array(answers, dtype=object)}


def by_ray(cpus: int | None = None, workers: int | None = None) -> Run:
    """Builds shards on a Ray cluster (`retrieval.cluster.session`). workers: processes at once, at most; None: as many
    as there are processors for, each with one."""

    def run(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterator[ShardBuilt]:
        with connected(cpus) as ray:
            context = ray.data.DataContext.get_current()
            context.enable_progress_bars = False
            most = min(len(jobs), workers or max(1, int(ray.cluster_resources().get("CPU", 1))))
            items = [{"job": job} for job in jobs]
            built = ray.data.from_items(items, override_num_blocks=len(items)).map_batches(
                ShardBuilder,
                batch_size=1,
                compute=ray.data.ActorPoolStrategy(min_size=1, max_size=most),
                num_cpus=1,
                fn_constructor_args=(checkpoint.path.resolve(),),
            )
            for row in built.iter_rows():
                answer = row["built"]
                if isinstance(answer, Exception):
                    raise answer
                yield answer

    return run
