"""Memory in commands: freed memory stays in the process."""

import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
"""Options of `mallopt` in <malloc.h> of the GNU C library."""


def keep_freed_memory() -> None:
    """Keep freed memory in this process, for commands that compute with large tensors until they end.

    The GNU C library otherwise returns every large tensor to the system, which maps the next one page by page: up to
    half of the time of a training step. The process then holds the most memory that it ever needed at one time, so a
    service must not call this.
    """
    if sys.platform != "linux":
        return
    import ctypes  # other commands do not need it

    library = ctypes.CDLL(None)
    if hasattr(library, "gnu_get_libc_version"):  # other C libraries have other options, or ignore them
        library.mallopt(_M_MMAP_MAX, 0)
        library.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
