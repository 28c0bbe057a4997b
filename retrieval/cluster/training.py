"""Training on a Ray cluster: Ray Train starts the ranks, and each rank trains as under `torchrun`.

If a rank is lost, Ray restarts all of them. They resume from the state file next to the checkpoint. The state file and
the recording must have the same path on every machine.
"""

import tempfile
from pathlib import Path

from retrieval.cluster.session import ray_session
from retrieval.console.output import say
from retrieval.data.dataset import Split
from retrieval.errors import JobInterrupted, RetrievalError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable
from retrieval.model.config import Config
from retrieval.training.trainer import train_matcher

MAX_RESTARTS = 3
"""Largest number of restarts after a rank was lost."""


def train_on_ray(
    recording: Path, out: Path, config: Config, *, split: Split | None = None, workers: int = 2
) -> Checkpoint:
    """Train on several ranks, each with a GPU if the cluster has enough; as `retrieval.training.trainer.train_matcher`.

    Args:
        recording: As for `train_matcher`.
        out: As for `train_matcher`.
        config: As for `train_matcher`.
        split: As for `train_matcher`.
        workers: Number of ranks.

    Raises:
        BadInput: Ray is not installed.
        RetrievalError: Training fails, or ranks are lost repeatedly.
        JobInterrupted: The user stopped the training.
    """
    require_writable(out)
    settings = {"recording": recording.resolve(), "out": out.resolve(), "config": config, "split": split}
    with ray_session() as ray, tempfile.TemporaryDirectory() as notes:
        from ray.train import FailureConfig, RunConfig, ScalingConfig, TrainingFailedError
        from ray.train.torch import TorchTrainer

        has_gpus = ray.cluster_resources().get("GPU", 0) >= workers
        say(f"training on {workers} ranks of Ray; their logs show the progress")
        trainer = TorchTrainer(
            lambda options: train_matcher(**options),  # in a process of Ray Train, which has joined the ranks
            train_loop_config=settings,
            scaling_config=ScalingConfig(num_workers=workers, use_gpu=has_gpus, resources_per_worker={"CPU": 1}),
            run_config=RunConfig(storage_path=notes, failure_config=FailureConfig(max_failures=MAX_RESTARTS)),
        )
        try:
            trainer.fit()
        except KeyboardInterrupt as error:
            raise JobInterrupted("Stopped; run the same command to continue from the last state.") from error
        except TrainingFailedError as error:
            lost = RetrievalError(
                f"ranks were lost {MAX_RESTARTS + 1} times; run the same command to continue: {error}"
            )
            raise _error_of_rank(error) or lost from error
    return load_checkpoint(out)


def _error_of_rank(error: BaseException) -> RetrievalError | None:
    """Return the error that a rank raised on purpose; None for other failures."""
    for failure in getattr(error, "worker_failures", {}).values():
        cause = failure
        while cause is not None:
            if isinstance(cause, RetrievalError):
                return cause
            cause = getattr(cause, "cause", None) or cause.__cause__
    return None
