"""How reports write numbers: one form for numbers, percentages, intervals, probabilities and p-values."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from retrieval.metrics.measure import FEW_OBJECTS

if TYPE_CHECKING:  # imports scipy, which the page of a query does not need
    from retrieval.metrics.intervals import Difference, Summary

MISSING_VALUE = "–"
FEW_OBJECTS_MARK = " †"
FEW_OBJECTS_NOTE = (
    f"† Fewer than {FEW_OBJECTS} objects: the interval is too narrow. In simulated samples it contained the true value "
    "in 50 % of cases for 2 objects, 74 % for 3 and 87 % for 4, instead of 95 %."
)


def format_number(value: float | None) -> str:
    """Return a number with three significant digits; integers and numbers from 100 on without decimals."""
    if value is None:
        return MISSING_VALUE
    if abs(value) >= 99.95 or value == int(value):
        return f"{value:,.0f}"
    return f"{value:#.3g}" if abs(value) >= 1e-4 else f"{value:.1e}"


def percent(fraction: float | None, digits: int = 1) -> str:
    """Return a fraction in percent, without the percent sign."""
    return MISSING_VALUE if fraction is None else f"{100 * fraction:.{digits}f}"


def probability(value: float) -> str:
    """Return a probability in percent, never as certain."""
    return "over 99.9 %" if value > 0.999 else "under 0.1 %" if value < 0.001 else f"{percent(value)} %"


def p_value(value: float) -> str:
    """Return a p-value, never as 0."""
    return "< 0.0001" if value < 0.0001 else f"{value:.2g}" if value < 0.1 else f"{value:.2f}"


def interval(value: float, low: float, high: float, write: Callable[[float], str] = percent) -> str:
    """Return a value and its interval, as in "71.2 [65.0, 77.1]"; `write` formats the three numbers."""
    return f"{write(value)} [{write(low)}, {write(high)}]"


def with_interval(summary: "Summary | None") -> str:
    """Return value and interval of a measure in percent, with a mark if there are too few objects.

    Of a top-n curve, this is the top-1 accuracy.
    """
    if summary is None:
        return MISSING_VALUE
    mark = FEW_OBJECTS_MARK * summary.few_objects
    return interval(summary.value[0], summary.low[0], summary.high[0]) + mark


def difference(found: "Difference") -> str:
    """Return a difference and its interval in percent points, with a mark if there are too few objects."""
    points = interval(found.value, found.low, found.high, lambda fraction: f"{100 * fraction:+.1f}")
    return points + FEW_OBJECTS_MARK * found.few_objects
