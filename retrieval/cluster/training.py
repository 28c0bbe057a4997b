"""Training on the processes of a Ray cluster: Ray Train starts the ranks, and each trains as it does under `torchrun`.

A rank that is lost ends the others, and Ray starts all of them again; they go on from the state beside the checkpoint,
which every machine must see under the same path, as it must see the recording.
"""

import tempfile
from pathlib import Path
from typing import Any

from retrieval.cluster.session import ray_session
from retrieval.console.output import say
from retrieval.data.dataset import Split
from retrieval.errors import BadInput, JobInterrupted, RetrievalError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable
from retrieval.model.config import Config
from retrieval.training.state import require_no_unfinished_state, state_path
from retrieval.training.train import train

MAX_RESTARTS = 3
"""How often a training without a step of progress is begun again."""


def train_on_ray(
    recording: Path,
    out: Path,
    config: Config,
    *,
    split: Split | None = None,
    resume: bool = False,
    cache: Path | None = None,
    workers: int = 2,
    cpus: int | None = None,
) -> Checkpoint:
    """As `retrieval.training.train.train`, on so many ranks, each with a graphics card where the cluster has as many.

    cpus: of a Ray that is started here, None: all. Raises its errors, BadInput without Ray or for a number of workers
    that is none, and RetrievalError where ranks are lost again and again.
    """
    if workers < 1:
        raise BadInput(f"workers must be 1 or more; got {workers}")
    require_writable(out)
    if not resume:
        require_no_unfinished_state(out)
    asked = {
        "recording": recording.resolve(),
        "out": out.resolve(),
        "config": config,
        "split": split,
        "resume": resume,
        "cache": cache and cache.resolve(),
    }
    with ray_session(cpus) as ray, tempfile.TemporaryDirectory() as notes:
        from ray.train import RunConfig, ScalingConfig, TrainingFailedError
        from ray.train.torch import TorchTrainer

        has_cards = ray.cluster_resources().get("GPU", 0) >= workers
        scaling = ScalingConfig(num_workers=workers, use_gpu=has_cards, resources_per_worker={"CPU": 1})
        failures, known = 0, None
        say(f"training on {workers} ranks of Ray; their logs show how far they are")
        while True:
            trainer = TorchTrainer(
                _rank, train_loop_config=asked, scaling_config=scaling, run_config=RunConfig(storage_path=notes)
            )
            try:
                trainer.fit()
                return load_checkpoint(out)
            except KeyboardInterrupt as error:
                raise JobInterrupted(f"stopped; --resume goes on from {state_path(out)}, where it is") from error
            except TrainingFailedError as error:
                if (ours := _error_of_rank(error)) is not None:
                    raise ours from error
                state = _state_mtime(out)
                failures = failures + 1 if state == known else 1
                known = state
                if failures > MAX_RESTARTS:
                    raise RetrievalError(f"ranks were lost {failures} times without progress: {error}") from error
                say("a rank was lost; all begin again" + (" from the last state" if state else ""))


def _rank(asked: dict[str, Any]) -> None:
    """Train in a process of Ray Train, which has joined the ranks."""
    resume = asked["resume"] or state_path(asked["out"]).exists()
    train(asked["recording"], asked["out"], asked["config"], split=asked["split"], resume=resume, cache=asked["cache"])


def _error_of_rank(error: BaseException) -> RetrievalError | None:
    """What a rank says is wrong with what it was given; another try would say it again."""
    for failure in getattr(error, "worker_failures", {}).values():
        cause = failure
        while cause is not None:
            if isinstance(cause, RetrievalError):
                return cause
            cause = getattr(cause, "cause", None) or cause.__cause__
    return None


def _state_mtime(out: Path) -> float | None:
    """When the state was written last; None without one."""
    try:
        return state_path(out).stat().st_mtime
    except FileNotFoundError:
        return None
