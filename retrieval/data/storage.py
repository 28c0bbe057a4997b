"""Storage behind a URL: whatever `fsspec` opens. What it refuses is asked for again, until an error says so."""

import tarfile
import time
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from retrieval.errors import BadInput, RemoteStorageError

T = TypeVar("T")
RETRY_WAITS_S = (0.1, 0.4, 1.6, 3.2, 6.4)
"""Between one try and the next."""
PERMANENT_ERRORS = (FileNotFoundError, IsADirectoryError, PermissionError, ValueError, tarfile.TarError)
"""What another try would say again."""


def is_url(where: str | Path) -> bool:
    """Whether this names a place by URL, not a path of this machine."""
    return isinstance(where, str) and "://" in where


def url_or_path(where: str | Path) -> str | Path:
    """A URL as it is, anything else as a path."""
    return where if is_url(where) else Path(where)


def is_inside(path: object) -> bool:
    """Whether `path` is text that names a file below the folder or archive that it is relative to, wherever that lies:
    paths in indexes, archives and tables come from anyone, and one with ".." would lead to other files of the user.
    """
    if not isinstance(path, str) or "\0" in path:
        return False
    parts = PurePosixPath(path).parts
    return bool(parts) and not path.startswith("/") and ".." not in parts


def file_system(url: str) -> tuple[Any, str]:
    """The `fsspec` file system of a URL, and the path in it. Raises BadInput for one that nothing opens."""
    try:
        import fsspec
    except ImportError as error:
        raise BadInput(f"{url}: fsspec is missing; run: pip install 'touch-retrieval[cluster]'") from error
    try:
        found: tuple[Any, str] = fsspec.core.url_to_fs(url)
        return found
    except (ValueError, ImportError) as error:
        raise BadInput(f"{url} cannot be opened ({error}); for S3: pip install 'touch-retrieval[cluster]'") from error


def retry(what: str, function: Callable[[], T]) -> T:
    """What `function` gives, asked again where a storage refuses. Raises StorageError where it goes on refusing."""
    for wait in (*RETRY_WAITS_S, None):
        try:
            return function()
        except PERMANENT_ERRORS:
            raise
        except Exception as error:  # each storage has its own errors
            if wait is None:
                raise RemoteStorageError(
                    f"{what}: the storage refused {len(RETRY_WAITS_S) + 1} times ({type(error).__name__}: {error}); the same "
                    "command goes on where it stopped"
                ) from error
            time.sleep(wait)
    raise AssertionError
