"""Every error that `retrieval` raises on purpose.

A message states the problem, the value and the remedy. The command line prints it on one line and exits with
`exit_code`; any other error is a bug.

    RetrievalError             the job ran and failed (exit code 1)
    +-- NumericalError         a value is NaN or infinite
    +-- IncompleteSearch       a shard did not answer, so not all of the catalogue was searched
    +-- JobInterrupted         the user stopped the job; results so far are stored
    +-- BadInput               wrong use or bad input (exit code 2)
        +-- ImageError         a file is not a readable image
        +-- DatasetError       a recording or catalogue is not usable
        |   +-- NoReadablePhoto    no photo of a catalogue is readable
        +-- CheckpointError    a checkpoint is missing, damaged or of another kind
        +-- ConfigError        a setting is unknown or out of range
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any


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
    """A value is NaN or infinite."""


class IncompleteSearch(RetrievalError):
    """A shard did not answer, so not all of the catalogue was searched."""


class JobInterrupted(RetrievalError):
    """The user stopped the job; results so far are stored."""


class BadInput(RetrievalError):
    """Wrong use or bad input.

    >>> retrieval.open("index").query(["a.png", "missing.png"])
    Traceback (most recent call last):
    retrieval.errors.ImageError: missing.png: no such file
    """

    exit_code = 2


class ImageError(BadInput):
    """A file is not a readable image.

    Attributes:
        path: The file.
        reason: The cause, for a person.
    """

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = str(path)
        self.reason = reason

    def __reduce__(self) -> tuple[type["ImageError"], tuple[str, str]]:
        return type(self), (self.path, self.reason)


class DatasetError(BadInput):
    """A recording or a catalogue is not usable."""


class NoReadablePhoto(DatasetError):
    """No photo of a catalogue is readable.

    Attributes:
        skipped: The reason for each photo.
    """

    def __init__(self, message: str, skipped: Sequence[Any] = ()) -> None:
        super().__init__(message)
        self.skipped = list(skipped)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.skipped)


class CheckpointError(BadInput):
    """A checkpoint is missing, damaged or of another kind."""


class ConfigError(BadInput):
    """A setting is unknown or out of range."""
