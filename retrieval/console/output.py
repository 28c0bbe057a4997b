"""Where the command line speaks: results to stdout, all else to stderr.

Names of objects and files are of strangers. What a terminal would obey or hide (control characters, marks that turn
the direction of writing, line breaks inside a line) is shown as an escape; JSON stays exact.
"""

import contextlib
import json
import logging
import os
import sys
import unicodedata
from collections.abc import Iterator, Sequence
from typing import Any

from retrieval.errors import RetrievalError


def print_json(document: Any) -> None:
    """One JSON document on stdout, in ASCII."""
    with checked_stdout():
        print(json.dumps(document, allow_nan=False))


def show(text: str) -> None:
    """A line of results for a person, on stdout."""
    with checked_stdout():
        print(printable(text), flush=True)


@contextlib.contextmanager
def checked_stdout() -> Iterator[None]:
    """Raises RetrievalError where stdout takes nothing more, as on a full disk. A reader that left is no error."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        discard_stdout()
        raise RetrievalError(f"standard output cannot be written: {error.strerror or error}") from error


def discard_stdout() -> None:
    """Throw away what is still to be printed, so that the end of Python does not fail on it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def say(text: str) -> None:
    """A line for a person, on stderr; one that cannot be said, as on a full disk, fails nothing."""
    with contextlib.suppress(OSError):
        print(printable(text), file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """`text` on one line, with escapes for everything that would not be seen as it is."""
    return "".join(
        character
        if character.isprintable() or unicodedata.category(character) == "Zs"  # spaces of any width
        else character.encode("unicode_escape").decode()
        for character in text
    )


def abbreviate_list(names: Sequence[str], shown: int = 5) -> str:
    """The first of many names, and how many there are beside them."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


class PrintableFormatter(logging.Formatter):
    """What the packages log, with names escaped like everywhere."""

    def format(self, record: logging.LogRecord) -> str:
        """The record's message on one line."""
        return printable(super().format(record))


def prepare_streams() -> None:
    """Letters that the terminal's coding lacks are escaped rather than refused; logging speaks as `say` does."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableFormatter("%(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
