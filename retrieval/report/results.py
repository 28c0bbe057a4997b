"""Reader of results.json and timings.json, and the report's labels of methods and measures."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _touch_retrieval.files import read_json
from retrieval.errors import BadInput
from retrieval.evaluation import SCHEMA_VERSION
from retrieval.methods import CHANCE
from retrieval.metrics.registry import METRICS
from retrieval.report.numbers import Summary

# Order of every table and figure. Other methods come last, under their own names.
METHOD_LABELS = {
    "late_fusion": "late fusion",
    "retrieve_rerank": "retrieve + rerank",
    "contrastive": "contrastive, InfoNCE",
    "cca_towers": "CCA, tower by tower",
    "cca": "CCA",
    "chance": "random scores",
}
IMPOSTORS = {"random": "random", "similar": "most similar object"}
"""Labels of the impostors of verification."""


@dataclass(frozen=True)
class Results:
    """Results and timings of an evaluation, as in the files."""

    data: Mapping[str, Any]
    timings: Mapping[str, Any]

    @property
    def methods(self) -> list[str]:
        """The evaluated methods, in the order of `METHOD_LABELS`."""
        known = list(METHOD_LABELS)
        return sorted(self.data["methods"], key=lambda name: (known.index(name) if name in known else 99, name))

    @property
    def learned(self) -> list[str]:
        """The methods without chance."""
        return [name for name in self.methods if name != CHANCE]

    def summary(self, method: str, measure: str) -> Summary | None:
        """Return value, interval, chance and basis of a measure; None if the method lacks it."""
        found: Summary | None = self.data["methods"].get(method, {}).get("measures", {}).get(measure)
        return found

    def time(self, method: str, key: str) -> float | None:
        """Return a time of timings.json; None if the method lacks it."""
        found: float | None = self.timings.get("methods", {}).get(method, {}).get(key)
        return found

    @property
    def simulated(self) -> bool:
        """Whether the recording comes from a simulated rig."""
        return "simulat" in self.data["recording"]["source"].lower()


def read_results(out: Path) -> Results:
    """Read `out`/results.json, and `out`/timings.json if it exists.

    Raises:
        BadInput: A file cannot be read.
    """
    timings = out / "timings.json"
    data = read_results_file(out / "results.json", SCHEMA_VERSION, "evaluate")
    return Results(data, read_results_file(timings, None, "evaluate") if timings.exists() else {})


def read_results_file(path: Path, version: int | None, command: str) -> dict[str, Any]:
    """Read a JSON object that a command wrote.

    Args:
        path: The file.
        version: Required schema version; None for any.
        command: Command that writes the file, for messages.

    Returns:
        The object.

    Raises:
        BadInput: The file cannot be read or has another schema version.
    """
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise BadInput(f"{path} must contain results in JSON ({error}). Run `retrieve {command}`.") from error
    if not isinstance(data, dict):
        raise BadInput(f"{path} must contain a JSON object, got {type(data).__name__}. Run `retrieve {command}`.")
    if version is not None and (found := data.get("schema_version")) != version:
        raise BadInput(f"{path} must have schema version {version}, got {found!r}. Run `retrieve {command}`.")
    return data


# Labels ----------------------------------------------------------------------------------------------


def method_label(name: str) -> str:
    """Return the report's label of a method."""
    return METHOD_LABELS.get(name, name.rpartition(":")[2].replace("_", " "))


def measure_label(name: str) -> str:
    """Return the report's label of a measure."""
    return METRICS[name].label if name in METRICS else name.replace("_", " ")


def file_name(name: str) -> str:
    """Return the name with all characters that are unsafe in paths replaced by "-"."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name)


def shortened(name: str, length: int) -> str:
    """Return the name, shortened in its middle to `length` characters, because the ends distinguish objects."""
    if len(name) <= length:
        return name
    head = (length - 1) // 2
    return f"{name[:head]}…{name[len(name) - (length - 1 - head) :]}"
