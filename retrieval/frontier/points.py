"""What a measurement says: points of error and time, which of them nothing beats, and which one to use."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.metrics.k_way import binomial_interval


@dataclass(frozen=True)
class Tradeoff:
    """One setting: what it costs in seconds and how far it is from the reference, in the panel's unit.

    series: points that differ in one number only, joined by colour. low, high: 95 % interval of the error where it is
    a share of queries, else None. is_default: what the code uses unless told otherwise. seconds: NaN until
    `retrieval.frontier.clock` has timed it.
    """

    series: str
    setting: str
    error: float
    low: float | None = None
    high: float | None = None
    is_default: bool = False
    seconds: float = math.nan

    @property
    def name(self) -> str:
        """Series and setting, with a comma between."""
        return ", ".join(part for part in (self.series, self.setting) if part)


@dataclass(frozen=True)
class Panel:
    """Points that one plot can hold: one kind of error against one reference, one kind of time.

    time: what the seconds are of. tolerance: the error that is accepted; the recommended point is the cheapest
    within it. resolution: the smallest error other than 0 that could have been seen.
    """

    title: str
    time: str
    unit: str
    reference: str
    tolerance: float
    points: tuple[Tradeoff, ...]
    resolution: float

    @property
    def recommended(self) -> Tradeoff:
        """The cheapest point within the tolerance; where there is none, the one of the least error."""
        within = [point for point in self.points if point.error <= self.tolerance]
        if within:
            return min(within, key=lambda point: point.seconds)
        return min(self.points, key=lambda point: (point.error, point.seconds))

    @property
    def default(self) -> Tradeoff | None:
        """The point in use, None where the caller always says."""
        return next((point for point in self.points if point.is_default), None)

    def pareto(self) -> list[Tradeoff]:
        """Points that no other one beats in both time and error, fastest first."""
        front: list[Tradeoff] = []
        for point in sorted(self.points, key=lambda point: (point.seconds, point.error)):
            if not front or point.error < front[-1].error:
                front.append(point)
        return front

    def line(self) -> str:
        """The panel in one line of text."""
        best, used = self.recommended, self.default
        within = f"cheapest within {self.tolerance:g}"
        met = within if best.error <= self.tolerance else f"none within {self.tolerance:g}, nearest"
        said = [f"{self.title} (against {self.reference})", f"{met}: {self.said(best)}"]
        if used is None:
            said.append("no default: the caller says")
        elif used == best:
            said.append("which is the default")
        else:
            said.append(f"default {self.said(used)}")
        return "; ".join(said)

    def said(self, point: Tradeoff) -> str:
        """A point in words: its name, its error and its time."""
        return f"{point.name}: {format_number(point.error)} {self.unit}, {format_duration(point.seconds)}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the fields, and which points are recommended, default and on the front."""
        front = self.pareto()
        points = [
            asdict(point) | {"recommended": point == self.recommended, "pareto": point in front}
            for point in self.points
        ]
        return asdict(self) | {"points": points}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Panel":
        """Inverse of `to_dict`."""
        derived = {"recommended", "pareto"}
        points = tuple(
            Tradeoff(**{key: value for key, value in point.items() if key not in derived}) for point in data["points"]
        )
        return cls(**{**data, "points": points})


@dataclass(frozen=True)
class ApproximationResult:
    """One approximation, measured: its panels; text: what it is and how it was measured; skipped: why it was not."""

    title: str
    text: str
    panels: tuple[Panel, ...] = ()
    skipped: str | None = None

    def lines(self) -> list[str]:
        """One line of text for each panel."""
        return [panel.line() for panel in self.panels] or [f"{self.title}: left out, {self.skipped}"]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"panels": [panel.to_dict() for panel in self.panels], "lines": self.lines()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "ApproximationResult":
        """Inverse of `to_dict`."""
        panels = tuple(Panel.from_dict(panel) for panel in data["panels"])
        return cls(data["title"], data["text"], panels, data["skipped"])


def miss_rate_point(
    series: str, setting: str, wrong: Sequence[bool] | NDArray[np.bool_], is_default: bool = False
) -> Tradeoff:
    """A point whose error is the share of queries that went wrong, in percent, with its exact 95 % interval for
    queries that are independent.
    """
    count, bad = len(wrong), int(np.count_nonzero(wrong))
    low, high = binomial_interval(bad, count)
    return Tradeoff(series, setting, 100 * bad / count, 100 * low, 100 * high, is_default)


def smallest_error(points: Iterable[Tradeoff]) -> float:
    """The smallest error above 0, for a panel whose errors are no shares; 1 where all are 0."""
    return min((point.error for point in points if point.error > 0), default=1.0)


def format_number(value: float) -> str:
    """Two or three digits, without an exponent where it is short."""
    if value == 0:
        return "0"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.1e}"


def format_duration(seconds: float) -> str:
    """Seconds, milliseconds or microseconds with three digits."""
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if seconds * scale >= 1:
            return f"{seconds * scale:.3g} {unit}"
    return f"{1e6 * seconds:.3g} us" if math.isfinite(seconds) else "-"
