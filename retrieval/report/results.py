"""results.json and timings.json as the report reads them, and how numbers, measures and methods are called in it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _touch_retrieval.files import read_json
from retrieval.errors import BadInput
from retrieval.evaluation import SCHEMA_VERSION
from retrieval.methods import TRIVIAL_BASELINES
from retrieval.metrics.intervals import FEW_OBJECTS
from retrieval.metrics.registry import METRICS

MISSING_VALUE = "–"

# Order of every table and figure. A method that is not here comes last, under its own name.
METHOD_LABELS = {
    "late_fusion": "late fusion",
    "set_fusion": "set fusion",
    "retrieve_rerank": "prune + rerank",
    "contrastive": "contrastive, InfoNCE",
    "contrastive_sigmoid": "contrastive, sigmoid",
    "cca_towers": "CCA, tower by tower",
    "cca_pca": "CCA, principal components",
    "cca": "CCA",
    "plsca": "PLS-CA",
    "chance": "random scores",
    "constant": "constant score",
}
Summary = Mapping[str, Any]


@dataclass(frozen=True)
class Results:
    """An evaluation's results and timings, as they stand in the files."""

    data: Mapping[str, Any]
    timings: Mapping[str, Any]

    @property
    def methods(self) -> list[str]:
        """The methods that were judged, in the order of METHODS."""
        known = list(METHOD_LABELS)
        return sorted(self.data["methods"], key=lambda name: (known.index(name) if name in known else 99, name))

    @property
    def learned(self) -> list[str]:
        """The methods that look at their input."""
        return [name for name in self.methods if name not in TRIVIAL_BASELINES]

    def summary(self, method: str, measure: str) -> Summary | None:
        """Value, interval, chance and basis of a measure; None where it was not taken."""
        found: Summary | None = self.data["methods"].get(method, {}).get("measures", {}).get(measure)
        return found

    def time(self, method: str, what: str) -> float | None:
        """A time of timings.json; None where it was not taken."""
        found: float | None = self.timings.get("methods", {}).get(method, {}).get(what)
        return found

    @property
    def simulated(self) -> bool:
        """Whether the recording comes from a simulated rig."""
        return "simulat" in self.data["recording"]["source"].lower()


def read_results(out: Path) -> Results:
    """Read `out`/results.json, and `out`/timings.json where it is. Raises BadInput."""
    timings = out / "timings.json"
    data = read_results_file(out / "results.json", SCHEMA_VERSION, "evaluate")
    return Results(data, read_results_file(timings, None, "evaluate") if timings.exists() else {})


def read_results_file(path: Path, version: int | None, command: str) -> dict[str, Any]:
    """Read a JSON object of `retrieve COMMAND`, of this schema version unless it is None. Raises BadInput."""
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise BadInput(f"{path} must hold results in JSON ({error}); run `retrieve {command}`") from error
    if not isinstance(data, dict):
        raise BadInput(f"{path} must hold a JSON object, got a {type(data).__name__}; run `retrieve {command}`")
    if version is not None and (found := data.get("schema_version")) != version:
        raise BadInput(f"{path} must have schema version {version}, got {found!r}; run `retrieve {command}`")
    return data


# Words -----------------------------------------------------------------------------------------------


def method_label(name: str) -> str:
    """What a method is called in the report."""
    return METHOD_LABELS.get(name, name.rpartition(":")[2].replace("_", " "))


def capitalized(label: str) -> str:
    """The label as a sentence begins with it: CCA stays CCA."""
    return label[:1].upper() + label[1:]


def measure_label(name: str) -> str:
    """What a measure is called in the report."""
    return METRICS[name].label if name in METRICS else name.replace("_", " ")


def percent(share: float | None, digits: int = 1) -> str:
    """A share in percent, without the sign."""
    return MISSING_VALUE if share is None else f"{100 * share:.{digits}f}"


FEW_OBJECTS_MARK = " †"
FEW_OBJECTS_NOTE = (
    f"† Fewer than {FEW_OBJECTS} objects: the interval is too narrow. In simulated samples it held the truth in "
    "50 % of cases for 2 objects, 74 % for 3 and 87 % for 4, instead of 95 %."
)


def with_interval(summary: Summary | None, place: int = 0) -> str:
    """Value and interval in percent, as in "71.2 [65.0, 77.1]"; marked where objects are too few for it."""
    if summary is None or summary["value"][place] is None:
        return MISSING_VALUE
    low, high = percent(summary["low"][place]), percent(summary["high"][place])
    return f"{percent(summary['value'][place])} [{low}, {high}]{few_objects_mark(summary)}"


def few_objects_mark(summary: Mapping[str, Any]) -> str:
    """The mark of an interval from too few objects, else nothing."""
    return FEW_OBJECTS_MARK if summary.get("few_objects") else ""


def format_number(value: float | None) -> str:
    """Three significant digits; whole numbers and all from 100 on without a point."""
    if value is None:
        return MISSING_VALUE
    return f"{value:,.0f}" if abs(value) >= 99.95 or value == int(value) else f"{value:#.3g}"


def file_name(name: str) -> str:
    """The name with nothing in it that a path could trip over."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name)


def shortened(name: str, length: int) -> str:
    """The name, its middle left out where it is longer than `length`: the ends tell objects apart."""
    if len(name) <= length:
        return name
    head = (length - 1) // 2
    return f"{name[:head]}…{name[len(name) - (length - 1 - head) :]}"
