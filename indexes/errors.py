"""Every error that `indexes` raises on purpose; any other exception is a bug.

A message contains the requirement, the value and the remedy. Each class has the exit code of the command line.
"""

AGAIN = "run `retrieve build-index` again"


class IndexesError(Exception):
    """Wrong use or bad input.

    >>> try:
    ...     indexes.IndexStore("nowhere").open()
    ... except indexes.IndexesError as error:
    ...     print(error.exit_code, error)
    2 nowhere: there is no index here; run `retrieve build-index` first (CURRENT: No such file or directory)
    """

    exit_code = 2


class VectorError(IndexesError):
    """A vector is not a finite unit vector of the right size."""


class RowError(IndexesError):
    """The rows, arrays or documents of an index are invalid."""


class ParameterError(IndexesError):
    """An unknown kind of index, or a setting that is unknown or out of range."""


class NoIndex(IndexesError):
    """There is no index at the path."""


class CorruptIndex(IndexesError):
    """A file of the index is missing, truncated or damaged."""


class MismatchedIndex(IndexesError):
    """The index was made with another model or preprocessing than the required one."""


class UnsupportedFormat(IndexesError):
    """The index has a newer or an older format than this software supports."""


class LockedIndex(IndexesError):
    """Another writer is writing the index."""


class WriteFailed(IndexesError):
    """A file could not be written. The index is complete: either the old one or the new one."""

    exit_code = 1
