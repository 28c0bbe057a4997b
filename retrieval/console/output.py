"""Output of the command line: results to stdout, everything else to stderr.

Names of objects and files are untrusted. Characters that a terminal would obey or hide (control characters, direction
marks, line breaks within a line) are shown as escapes. JSON stays exact.
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
    """Print one JSON document to stdout, in ASCII."""
    show(json.dumps(document, allow_nan=False))


def show(text: str) -> None:
    """Print a line of results to stdout."""
    with checked_stdout():
        print(printable(text), flush=True)


@contextlib.contextmanager
def checked_stdout() -> Iterator[None]:
    """Raise RetrievalError if stdout cannot be written, such as on a full disk; BrokenPipeError passes unchanged."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        discard_stdout()
        raise RetrievalError(f"Standard output cannot be written: {error.strerror or error}") from error


def discard_stdout() -> None:
    """Discard buffered output, so that Python does not fail on it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def say(text: str) -> None:
    """Print a line to stderr; write errors, such as a full disk, are ignored."""
    with contextlib.suppress(OSError):
        print(printable(text), file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Return `text` on one line, with escapes for unprintable characters."""
    return "".join(
        character
        if character.isprintable() or unicodedata.category(character) == "Zs"  # spaces of any width
        else character.encode("unicode_escape").decode()
        for character in text
    )


def abbreviate_list(names: Sequence[str], shown: int = 5) -> str:
    """Return the first `shown` names, and the number of further names."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


class _PrintableFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def prepare_streams() -> None:
    """Escape characters that the terminal's encoding lacks, and send log messages to stderr, as `say` does."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PrintableFormatter("%(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
