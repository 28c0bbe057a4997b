"""One hard case, and how an error of ours is shown."""

from collections.abc import Callable
from dataclasses import dataclass

from indexes.errors import IndexesError
from retrieval.errors import RetrievalError
from robot.errors import RobotError


@dataclass(frozen=True)
class HardCase:
    """An input of a numerical kernel, what must be true of it, and what came out.

    `holds` says whether `must_hold` is true of `ours`, `naive_holds` whether it is of the obvious formula.
    """

    kernel: str
    case: str
    must_hold: str
    naive: str
    ours: str
    holds: bool
    naive_holds: bool


def error_of(work: Callable[[], object], *words: str) -> tuple[str, bool]:
    """What an error of ours says, and whether it holds all the words; what came out where nothing was refused."""
    try:
        result = work()
    except (RetrievalError, IndexesError, RobotError) as error:
        return f"refused: {error}", all(word in str(error) for word in words)
    return f"accepted: {result}", False
