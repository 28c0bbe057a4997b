"""Importers: each converts one data set or format to a recording, and is loaded on first use."""

import inspect
import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import msgspec

from _touch_retrieval.registry import Registry
from robot.errors import ImporterError, UnknownName
from robot.importers.importing import DataSet, Progress
from robot.recording.folder import Recording


class Importer(Protocol):
    """A function that reads the files of a data set below `src` and writes or continues the recording `out`.

    Its keyword-only parameters, each with a default, are its options. The docstring of its module begins with a line on
    the data set. The module contains `DATA_SET`, the facts of the data set. Raises ImporterError if `src` is not this
    data set or an option is wrong.
    """

    def __call__(self, src: Path, out: Path, progress: Progress | None = None, **options: Any) -> Recording:
        """Import the data set; call `progress` with (done, total) after each grasp."""


IMPORTERS: "Registry[Importer]" = Registry(
    "importer",
    "importers",
    {
        "billets": "robot.importers.billets:import_billets",
        "estimate-modulus": "robot.importers.estimate_modulus:import_estimate_modulus",
        "feeling-of-success": "robot.importers.feeling_of_success:import_feeling_of_success",
        "folder": "robot.importers.folder:import_folder",
        "lerobot": "robot.importers.lerobot:import_lerobot",
        "objectfolder": "robot.importers.objectfolder:import_objectfolder",
        "physiclear": "robot.importers.physiclear:import_physiclear",
        "rosbag": "robot.importers.rosbag:import_rosbag",
        "vt60": "robot.importers.vt60:import_vt60",
    },
    error=UnknownName,
)


def load_importer(name: str) -> Importer:
    """Return the importer with this name of `IMPORTERS`, or "module:function".

    Raises:
        UnknownName: There is no such importer; the message lists the known ones.

    >>> robot.load_importer("billets").__name__
    'import_billets'
    """
    return IMPORTERS.load(name)


def title_of(name: str) -> str:
    """Return the line that describes the data set of an importer."""
    module = sys.modules[load_importer(name).__module__]
    return (module.__doc__ or "").strip().split("\n")[0].rstrip(".")


def data_set_of(name: str) -> DataSet:
    """Return the facts of the data set of an importer, `DATA_SET` of its module."""
    facts: DataSet = sys.modules[load_importer(name).__module__].DATA_SET
    return facts


def options_of(importer: Importer) -> dict[str, tuple[type, Any]]:
    """Return the options of an importer: name -> (type, default). The type is str, int, float or bool."""
    hints = typing.get_type_hints(importer)
    return {
        name: (hints[name], parameter.default)
        for name, parameter in inspect.signature(importer).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }


def read_options(importer: Importer, words: Sequence[str]) -> dict[str, Any]:
    """Return the values of options "name=value" of an importer.

    Raises:
        ImporterError: An option is unknown, or its value has another type.
    """
    known = options_of(importer)
    values: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if name not in known or not equals:
            names = ", ".join(f"{option}=..." for option in known)
            raise ImporterError(
                f"options must have the form name=value, got {word!r}; this importer takes {names or 'no options'}"
            )
        kind = known[name][0]
        try:
            values[name] = msgspec.convert(value, kind, strict=False)
        except msgspec.ValidationError as error:
            raise ImporterError(f"option {name} must be of type {kind.__name__}, got {value!r}") from error
    return values
