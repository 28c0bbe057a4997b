"""Storage behind a URL, opened by `fsspec`; failed requests are retried."""

import tarfile
import time
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from retrieval.errors import BadInput, RemoteStorageError

T = TypeVar("T")
RETRY_WAITS_S = (0.1, 0.4, 1.6, 3.2, 6.4)
"""Pauses between attempts."""
PERMANENT_ERRORS = (FileNotFoundError, IsADirectoryError, PermissionError, ValueError, tarfile.TarError)
"""Errors that a retry would only repeat."""


def is_url(where: str | Path) -> bool:
    """Return whether `where` is a URL, not a path on this machine."""
    return isinstance(where, str) and "://" in where


def url_or_path(where: str | Path) -> str | Path:
    """Return a URL unchanged, and anything else as a Path."""
    return where if is_url(where) else Path(where)


def is_inside(path: object) -> bool:
    """Return whether `path` is a relative path that stays below its folder or archive.

    Paths in indexes, archives and tables are untrusted: a path with ".." could lead to other files of the user.
    """
    if not isinstance(path, str) or "\0" in path:
        return False
    parts = PurePosixPath(path).parts
    return bool(parts) and not path.startswith("/") and ".." not in parts


def file_system(url: str) -> tuple[Any, str]:
    """Return the `fsspec` file system of a URL, and the path in it.

    Raises:
        BadInput: `fsspec` is missing, or no file system opens the URL.
    """
    try:
        import fsspec
    except ImportError as error:
        raise BadInput(f"{url}: fsspec is missing; run: pip install 'touch-retrieval[cluster]'") from error
    try:
        system_and_path: tuple[Any, str] = fsspec.core.url_to_fs(url)
        return system_and_path
    except (ValueError, ImportError) as error:
        raise BadInput(f"{url} cannot be opened ({error}); for S3: pip install 'touch-retrieval[cluster]'") from error


def retry(what: str, function: Callable[[], T]) -> T:
    """Return the result of `function`, and retry it if the storage fails.

    Args:
        what: Name of the request in messages.
        function: The request.

    Raises:
        RemoteStorageError: All attempts failed.
    """
    for wait in (*RETRY_WAITS_S, None):
        try:
            return function()
        except PERMANENT_ERRORS:
            raise
        except Exception as error:  # each storage has its own errors
            if wait is None:
                raise RemoteStorageError(
                    f"{what}: the storage failed {len(RETRY_WAITS_S) + 1} times ({type(error).__name__}: {error}); run "
                    "the same command again to continue"
                ) from error
            time.sleep(wait)
    raise AssertionError
