"""Importers: each turns one public data set into a recording, and is loaded when it is asked for."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from robot.errors import UnknownName
from robot.recording.folder import Recording

Progress = Callable[[int, int], None]
"""Called with (done, total) after each grasp."""


class Importer(Protocol):
    """Reads the data set's own files below `src`, writes or continues the recording `out`."""

    def __call__(self, src: Path, out: Path, progress: Progress | None = None) -> Recording:
        """Raises ImporterError where `src` is not this data set, RecordingError, StorageError."""


IMPORTERS = {"billets": "robot.importers.billets:import_billets"}


def load_importer(name: str) -> Importer:
    """Return the importer called `name`. Raises UnknownName, which lists the known ones.

    >>> robot.load_importer("billets").__name__
    'import_billets'
    """
    if name not in IMPORTERS:
        raise UnknownName(f"no importer is called {name!r}; known: {', '.join(sorted(IMPORTERS))}")
    module, function = IMPORTERS[name].split(":")
    return cast(Importer, getattr(import_module(module), function))
