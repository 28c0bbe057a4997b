"""Results of a measurement: points of error and time, the Pareto front, and the recommended point."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.metrics.k_way import binomial_interval


@dataclass(frozen=True)
class Tradeoff:
    """One setting with its run time and its error against the reference.

    Attributes:
        series: Points that differ in one number only; they have the same colour.
        setting: The number, in words.
        error: Error in the panel's unit.
        low: Lower end of the 95 % interval if the error is a fraction of queries, else None.
        high: Upper end of that interval.
        is_default: Whether the code uses this setting by default.
        seconds: Run time; NaN until `retrieval.frontier.clock` has measured it.
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
    """The points of one plot: one kind of error against one reference, one kind of time.

    Attributes:
        title: The kind of error.
        time: The timed work.
        unit: Unit of the error.
        reference: The reference of the error.
        tolerance: Accepted error; the recommended point is the fastest within it.
        points: The points.
        resolution: Smallest measurable error above 0.
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
        """The fastest point within the tolerance; if there is none, the point of the smallest error."""
        within = [point for point in self.points if point.error <= self.tolerance]
        if within:
            return min(within, key=lambda point: point.seconds)
        return min(self.points, key=lambda point: (point.error, point.seconds))

    @property
    def default(self) -> Tradeoff | None:
        """The default point; None if the setting has no default."""
        return next((point for point in self.points if point.is_default), None)

    def pareto(self) -> list[Tradeoff]:
        """Return the Pareto front, fastest first: for its points, no other point is better in both time and error."""
        front: list[Tradeoff] = []
        for point in sorted(self.points, key=lambda point: (point.seconds, point.error)):
            if not front or point.error < front[-1].error:
                front.append(point)
        return front

    def line(self) -> str:
        """Return the panel as one line of text."""
        best, used = self.recommended, self.default
        within = f"cheapest within {self.tolerance:g}"
        label = within if best.error <= self.tolerance else f"none within {self.tolerance:g}, smallest error"
        parts = [f"{self.title} (against {self.reference})", f"{label}: {self.describe(best)}"]
        if used is None:
            parts.append("no default")
        elif used == best:
            parts.append("this is the default")
        else:
            parts.append(f"default {self.describe(used)}")
        return "; ".join(parts)

    def describe(self, point: Tradeoff) -> str:
        """Return name, error and time of a point as text."""
        return f"{point.name}: {format_number(point.error)} {self.unit}, {format_duration(point.seconds)}"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON types: the fields, with marks of recommended points and of the Pareto front."""
        front = self.pareto()
        points = [
            asdict(point) | {"recommended": point == self.recommended, "pareto": point in front}
            for point in self.points
        ]
        return asdict(self) | {"points": points}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Panel":
        """Return the panel of `to_dict`."""
        derived = {"recommended", "pareto"}
        points = tuple(
            Tradeoff(**{key: value for key, value in point.items() if key not in derived}) for point in data["points"]
        )
        return cls(**{**data, "points": points})


@dataclass(frozen=True)
class ApproximationResult:
    """The measurement of one approximation.

    Attributes:
        title: Title of the approximation.
        text: What it is and how it was measured.
        panels: The measurements.
        skipped: Why it was not measured, else None.
    """

    title: str
    text: str
    panels: tuple[Panel, ...] = ()
    skipped: str | None = None

    def lines(self) -> list[str]:
        """Return one line of text for each panel."""
        return [panel.line() for panel in self.panels] or [f"{self.title}: left out, {self.skipped}"]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON types."""
        return asdict(self) | {"panels": [panel.to_dict() for panel in self.panels], "lines": self.lines()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "ApproximationResult":
        """Return the result of `to_dict`."""
        panels = tuple(Panel.from_dict(panel) for panel in data["panels"])
        return cls(data["title"], data["text"], panels, data["skipped"])


def miss_rate_point(
    series: str, setting: str, wrong: Sequence[bool] | NDArray[np.bool_], is_default: bool = False
) -> Tradeoff:
    """Return a point whose error is the percentage of wrong queries.

    Args:
        series: As in `Tradeoff`.
        setting: As in `Tradeoff`.
        wrong: Whether each query is wrong; the 95 % interval is exact for independent queries.
        is_default: As in `Tradeoff`.
    """
    count, bad = len(wrong), int(np.count_nonzero(wrong))
    low, high = binomial_interval(bad, count)
    return Tradeoff(series, setting, 100 * bad / count, 100 * low, 100 * high, is_default)


def smallest_error(points: Iterable[Tradeoff]) -> float:
    """Return the smallest error above 0, the resolution of errors that are no fractions; 1 if all are 0."""
    return min((point.error for point in points if point.error > 0), default=1.0)


def format_number(value: float) -> str:
    """Format a number with two or three digits, without an exponent if it stays short."""
    if value == 0:
        return "0"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.1e}"


def format_duration(seconds: float) -> str:
    """Format a duration in s, ms or us with three digits."""
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if seconds * scale >= 1:
            return f"{seconds * scale:.3g} {unit}"
    return f"{1e6 * seconds:.3g} us" if math.isfinite(seconds) else "-"
