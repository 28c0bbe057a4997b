"""Every error that `indexes` raises on purpose.

A message says what must hold, what was got and what to do. Each class carries the exit code that a command
line leaves with; anything that is not one of these errors is a bug.

    IndexesError                  wrong use or bad input (exit code 2)
    +-- VectorError               a vector is NaN, infinite, zero, not of unit norm, or of another size
    +-- RowError                  the rows, arrays or documents of an index are not usable
    +-- ParameterError            an unknown kind, or a setting that is unknown or out of range
    +-- NoIndex                   there is no index at the path
    +-- CorruptIndex              a file of the index is missing, cut short or damaged
    +-- MismatchedIndex           the index was made by another model or preprocessing than asked for
    +-- UnsupportedFormat         the index has a newer or older format than this software reads
    +-- LockedIndex               another writer works on the index
    +-- JobFailed                 the job ran and failed (exit code 1)
        +-- SelfRetrievalFailed   rows of a new index do not find themselves
        +-- WriteFailed           the disk refused a write
        +-- EngineError           the vector library failed
"""

from collections.abc import Sequence

AGAIN = "run `retrieve build-index` again"


class IndexesError(Exception):
    """Wrong use or bad input.

    >>> try:
    ...     indexes.IndexStore("nowhere").open()
    ... except indexes.IndexesError as error:
    ...     print(error.exit_code, error)
    2 nowhere: there is no index here; run `retrieve build-index` first
    """

    exit_code = 2


class VectorError(IndexesError):
    """A vector is not a finite unit vector of the right size. `row` names it where one row is to blame."""

    def __init__(self, message: str, row: str | None = None) -> None:
        super().__init__(message)
        self.row = row


class RowError(IndexesError):
    """The rows, arrays or documents of an index are not usable. `row` is the id where one row is to blame."""

    def __init__(self, message: str, row: str | None = None) -> None:
        super().__init__(message)
        self.row = row


class ParameterError(IndexesError):
    """An unknown kind of index, or a setting that is unknown or out of range."""


class NoIndex(IndexesError):
    """There is no index at the path."""


class CorruptIndex(IndexesError):
    """A file of the index is missing, cut short or damaged."""


class MismatchedIndex(IndexesError):
    """The index was made by another model or preprocessing than the one asked for."""


class UnsupportedFormat(IndexesError):
    """The index has a newer or an older format than this software reads."""


class LockedIndex(IndexesError):
    """Another writer works on the index. `holder` is its process id where known."""

    def __init__(self, message: str, holder: int | None = None) -> None:
        super().__init__(message)
        self.holder = holder


class JobFailed(IndexesError):
    """The job ran and failed."""

    exit_code = 1


class SelfRetrievalFailed(JobFailed):
    """Rows of an index do not find themselves. `ids` lists them."""

    def __init__(self, message: str, ids: Sequence[str]) -> None:
        super().__init__(message)
        self.ids = list(ids)


class WriteFailed(JobFailed):
    """The disk refused a write; the index is as it was, or as written, but whole."""


class EngineError(JobFailed):
    """The vector library failed on input that passed every check."""
