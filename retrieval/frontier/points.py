"""Results of a measurement: points of error and time, the Pareto front, and the recommended point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retrieval.metrics.intervals import binomial_interval
from retrieval.report.numbers import format_number


@dataclass(frozen=True)
class Tradeoff:
    """One setting with its run time and its error against the reference.

    Attributes:
        series: Points that differ in one number only; they have the same colour.
        setting: The number, in words.
        error: Error in the panel's unit.
        interval: 95 % interval of the error if it is a fraction of queries, else None.
        is_default: Whether the code uses this setting by default.
        seconds: Run time; NaN until `retrieval.frontier.clock` has measured it.
    """

    series: str
    setting: str
    error: float
    interval: tuple[float, float] | None = None
    is_default: bool = False
    seconds: float = math.nan

    @property
    def name(self) -> str:
        """Series and setting, with a comma between."""
        return ", ".join(part for part in (self.series, self.setting) if part)


def miss_rate_point(
    series: str, setting: str, wrong: Sequence[bool] | NDArray[np.bool_], is_default: bool = False
) -> Tradeoff:
    """Return a point whose error is the percentage of wrong queries, with its exact 95 % interval."""
    count, bad = len(wrong), int(np.count_nonzero(wrong))
    low, high = binomial_interval(bad, count)
    return Tradeoff(series, setting, 100 * bad / count, (100 * low, 100 * high), is_default)


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
    """

    title: str
    time: str
    unit: str
    reference: str
    tolerance: float
    points: tuple[Tradeoff, ...]

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
        best, within = self.recommended, f"within {self.tolerance:g}"
        found = f"cheapest {within}" if best.error <= self.tolerance else f"none {within}, smallest error"
        default = self.describe_default()
        return f"{self.title} (against {self.reference}); {found}: {self.describe(best)}; default: {default}"

    def describe_default(self) -> str:
        """Return the default point as text; "the same" if it is the recommended one."""
        if self.default is None:
            return "none"
        return "the same" if self.default == self.recommended else self.describe(self.default)

    def describe(self, point: Tradeoff) -> str:
        """Return name, error and time of a point as text."""
        return f"{point.name}: {format_number(point.error)} {self.unit}, {format_duration(point.seconds)}"


@dataclass(frozen=True)
class ApproximationResult:
    """The measurement of one approximation.

    Attributes:
        title: Title of the approximation.
        text: What it is and how it was measured, or why it was left out.
        panels: The measurements; none if it was left out.
    """

    title: str
    text: str
    panels: tuple[Panel, ...] = ()

    def lines(self) -> list[str]:
        """Return one line of text for each panel."""
        return [panel.line() for panel in self.panels] or [f"{self.title}: {self.text}"]


def format_duration(seconds: float) -> str:
    """Format a duration in s, ms or us with three digits."""
    scale, unit = (1, "s") if seconds >= 1 else (1e3, "ms") if seconds >= 1e-3 else (1e6, "us")
    return f"{format_number(seconds * scale)} {unit}"
