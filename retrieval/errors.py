"""Every error that `retrieval` raises on purpose.

A message says what must hold, what was got and what to do. The command line prints it on one line and
leaves with `exit_code`; anything that is not one of these errors is a bug.

    RetrievalError             the job ran and failed (exit code 1)
    +-- NumericalError         a NaN or infinite value where a number must be
    +-- Interrupted            the user stopped the job; what was made is kept
    +-- BadInput               wrong use or bad input (exit code 2)
        +-- ImageError         a file is not a readable image
        +-- DatasetError       a recording or catalogue is not usable
        +-- CheckpointError    a checkpoint is missing, damaged or of another kind
        +-- ConfigError        a setting is unknown or out of range
"""

from pathlib import Path


class RetrievalError(Exception):
    """The job ran and failed.

    >>> try:
    ...     retrieval.open("index").query(["a.png"])
    ... except retrieval.RetrievalError as error:
    ...     print(error.exit_code, error)
    2 this model takes 2 gel image(s) for one touch; got 1: a.png (one grasp is ...)
    """

    exit_code = 1


class NumericalError(RetrievalError):
    """A NaN or infinite value stands where a number must be."""


class Interrupted(RetrievalError):
    """The user stopped the job; what was made so far is kept."""


class BadInput(RetrievalError):
    """Wrong use or bad input.

    >>> retrieval.open("index").query(["a.png", "missing.png"])
    Traceback (most recent call last):
    retrieval.errors.ImageError: missing.png: no such file
    """

    exit_code = 2


class ImageError(BadInput):
    """A file is not a readable image. `path` names the file, `reason` says why."""

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = str(path)
        self.reason = reason


class DatasetError(BadInput):
    """A recording or a catalogue is not usable."""


class CheckpointError(BadInput):
    """A checkpoint is missing, damaged, or of another kind than asked for."""


class ConfigError(BadInput):
    """A setting is unknown or out of range."""
