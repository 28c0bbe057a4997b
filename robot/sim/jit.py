"""Just-in-time compilation of loops over rays and pixels that numpy cannot express in few passes over memory.

It needs numba, an optional dependency. Without numba, importing this module raises RobotConfigError with the install
command.
"""

from collections.abc import Callable
from typing import Any

from robot.errors import RobotConfigError

try:
    import numba
except ImportError as error:
    raise RobotConfigError(
        "the simulated rig needs numba, which is missing; run pip install 'touch-retrieval[sim]'"
    ) from error


def jit(function: Callable[..., Any], **settings: Any) -> Callable[..., Any]:
    """Compile a function with numba at its first call with arguments of a type; `settings`: more of `numba.njit`.

    The compiled code is cached next to the source, or in the user's cache if that folder is read-only. It is compiled
    again when the function's own file changes, so every function that it calls must be in the same file. Divisions by 0
    follow numpy. It uses no threads, so processes that use it may fork, and it releases the GIL.
    """
    settings = {"error_model": "numpy", "nogil": True, **settings}
    try:
        compiled: Callable[..., Any] = numba.njit(cache=True, **settings)(function)
    except RuntimeError:  # no folder for the cache is writable
        compiled = numba.njit(**settings)(function)
    return compiled


def jit_reassociated(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function whose sums may be reordered, as numpy does; all else is as exact as with `jit`."""
    return jit(function, fastmath={"reassoc", "nsz"})
