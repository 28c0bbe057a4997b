"""A hard case, and the result text of an error."""

from collections.abc import Callable
from dataclasses import dataclass

from indexes.errors import IndexesError
from retrieval.errors import RetrievalError
from robot.errors import RobotError


@dataclass(frozen=True)
class HardCase:
    """An input of a numerical kernel, its requirement, and the results.

    Attributes:
        kernel: Name of the kernel.
        case: The input.
        must_hold: Requirement for the result.
        naive: Result of the naive formula.
        ours: Result of the kernel.
        holds: Whether `ours` meets the requirement.
        naive_holds: Whether `naive` meets it.
    """

    kernel: str
    case: str
    must_hold: str
    naive: str
    ours: str
    holds: bool
    naive_holds: bool


def error_of(work: Callable[[], object], *words: str) -> tuple[str, bool]:
    """Return the error of a call, and whether it contains all words; the result and False without an error."""
    try:
        result = work()
    except (RetrievalError, IndexesError, RobotError) as error:
        return f"refused: {error}", all(word in str(error) for word in words)
    return f"accepted: {result}", False
