"""Every error that `retrieval` raises on purpose.

A message says what must hold, what was got and what to do. The command line prints it on one line and
leaves with `exit_code`; anything that is not one of these errors is a bug.

    RetrievalError             the job ran and failed (exit code 1)
    +-- NumericalError         a NaN or infinite value where a number must be
    +-- TooManyUnreadable             more photos cannot be read than the user allows
    +-- StorageError           a storage behind a URL goes on refusing, or does not hold what it was given
    +-- IncompleteSearch             shards did not answer, and more of the catalogue was asked for
    +-- JobInterrupted            the user stopped the job; what was made is kept
    +-- BadInput               wrong use or bad input (exit code 2)
        +-- ImageError         a file is not a readable image
        +-- DatasetError       a recording or catalogue is not usable
        |   +-- NoReadablePhoto        none of a catalogue's photos can be read
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
    """A NaN or infinite value stands where a number must be."""


class TooManyUnreadable(RetrievalError):
    """More of a catalogue's photos cannot be read than the user allows; the index stays as it was."""


class RemoteStorageError(RetrievalError):
    """A storage behind a URL goes on refusing, or does not hold what it was given; the job can go on later."""


class IncompleteSearch(RetrievalError):
    """Shards of a cluster did not answer, and less of the catalogue was searched than the user asked for."""


class JobInterrupted(RetrievalError):
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

    def __reduce__(self) -> tuple[type["ImageError"], tuple[str, str]]:
        return type(self), (self.path, self.reason)


class DatasetError(BadInput):
    """A recording or a catalogue is not usable."""


class NoReadablePhoto(DatasetError):
    """None of a catalogue's photos can be read. `skipped` says of each why."""

    def __init__(self, message: str, skipped: Sequence[Any] = ()) -> None:
        super().__init__(message)
        self.skipped = list(skipped)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.skipped)


class CheckpointError(BadInput):
    """A checkpoint is missing, damaged, or of another kind than asked for."""


class ConfigError(BadInput):
    """A setting is unknown or out of range."""
