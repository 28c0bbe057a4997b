"""A training that is wanted once: what is finished is taken, what is unfinished gone on with, else it is begun."""

from pathlib import Path

from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import Checkpoint, beside, load_checkpoint
from retrieval.training.train import Trainer, state_path


def unfinished(done: Path) -> Path:
    """Where the checkpoint lies until its training is finished: in another folder, so that `done` always is."""
    return done.parent / "unfinished" / done.name


def finish(trainer: Trainer, done: Path, quiet: bool) -> Checkpoint:
    """The checkpoint of a training whose `out` is `unfinished(done)`; afterwards it lies at `done`.

    A checkpoint of the very same training is taken as it lies there, one of another is replaced. Raises Interrupted
    after Ctrl-C; the next call goes on.
    """
    if not _is_of(trainer, done):
        _resume(trainer)
        trainer.run(quiet)
        for ending in (".md", ".safetensors"):
            beside(trainer.out, ending).replace(beside(done, ending))
    return load_checkpoint(done)


def _is_of(trainer: Trainer, path: Path) -> bool:
    if not path.is_file():
        return False
    kept = load_checkpoint(path)
    mine = (trainer.config, trainer.split, trainer.data_digest)
    return (kept.config, kept.split, kept.provenance.get("data_digest")) == mine


def _resume(trainer: Trainer) -> None:
    if not state_path(trainer.out).is_file():
        return
    try:
        trainer.resume()
    except CheckpointError:  # of another training, which nobody wants any more
        state_path(trainer.out).unlink()
