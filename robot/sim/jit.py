"""Functions in machine code, for loops over rays and pixels that numpy cannot say in few passes over memory.

They need numba, an extra: without it the import of this module raises RobotConfigError, which says what to install.
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
    """The function as numba compiles it when it is first called with arguments of a type.

    What was compiled is kept beside the source (or, where that cannot be written, in the user's cache) and made anew
    when the function's own file has changed: what it calls stands in that file too. Divisions by 0 are numpy's. It uses
    no threads, so that processes that use it may fork, and it lets other threads run.
    """
    settings = {"error_model": "numpy", "nogil": True, **settings}
    try:
        made: Callable[..., Any] = numba.njit(cache=True, **settings)(function)
    except RuntimeError:  # there is no place to keep it
        made = numba.njit(**settings)(function)
    return made


def jit_reassociated(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiled so that a sum may be taken in several parts at once, as numpy takes it; the rest is as exact as else."""
    return jit(function, fastmath={"reassoc", "nsz"})
