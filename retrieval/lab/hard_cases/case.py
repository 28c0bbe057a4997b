"""One hard case, and how an error of ours is shown."""

from collections.abc import Callable
from dataclasses import dataclass

from retrieval.errors import RetrievalError


@dataclass(frozen=True)
class HardCase:
    """`holds` says whether `must_hold` is true of `ours`, `naive_holds` whether it is of the obvious formula."""

    kernel: str
    case: str
    must_hold: str
    naive: str
    ours: str
    holds: bool
    naive_holds: bool


def refused(work: Callable[[], object], *words: str) -> tuple[str, bool]:
    """What an error of ours says, and whether it holds all the words; what came out where nothing was refused."""
    try:
        result = work()
    except RetrievalError as error:
        return f"refused: {error}", all(word in str(error) for word in words)
    return f"accepted: {result}", False
