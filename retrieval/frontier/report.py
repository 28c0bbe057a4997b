"""Report of `retrieve frontier`: a plot for each approximation and one HTML page."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, format_duration
from retrieval.report.canvas import MUTED_COLOUR, Axes, Figure, canvas, logarithmic
from retrieval.report.document import (
    Block,
    Document,
    Picture,
    Section,
    Table,
    Text,
    capitalized,
    write_document,
)
from retrieval.report.numbers import format_number, interval

# Palette of Okabe and Ito; the markers distinguish series without colour.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6f4e37", "#222222", "#aa3377")
_MARKERS = "o^sDvPX<>"
_LABEL: Any = {"textcoords": "offset points", "fontsize": 7.5, "color": "#3a434c"}
_SIDES = (7, 5), (7, -10)
"""Offsets of labels in points: above and below in turn, because neighbours may be near each other."""
_FLOOR = 0.5
"""An error of 0 is drawn at this fraction of the smallest error above 0, or at the tolerance if that is lower."""

LEGEND = (
    "Lower left is better. The line is the Pareto front: for its points, no other point is better in both time and "
    "error. The star marks the recommended point, the fastest within the tolerance (dashed); the ring marks the "
    "default. An open marker at the lower edge is a measured error of 0. Whiskers are 95 % intervals."
)


def write_frontier(
    out: Path, rows: Mapping[str, ApproximationResult], machine: Mapping[str, Any], quick: bool
) -> list[Path]:
    """Write frontier.md, frontier.html and figures/ of results by name; return the files.

    Raises:
        RetrievalError: matplotlib is missing.
    """
    sections = (Section(row.title, tuple(_section(name, row))) for name, row in rows.items())
    page = Document("Error against run time", (*_lead(rows, machine, quick), *sections))
    return write_document(page, out, "frontier")


def _lead(rows: Mapping[str, ApproximationResult], machine: Mapping[str, Any], quick: bool) -> Iterator[Block]:
    yield Text(
        "The error of each approximation against its reference and its run time were measured in one run on this "
        f"machine: {machine['processor']}, {machine['cores']} core(s), {machine['system']}. Times are medians."
    )
    yield Text(LEGEND)
    if quick:
        yield Text("A quick run: too few queries and repetitions for conclusions.", warn=True)
    yield Table(
        ("approximation", "error", "reference", "tolerance", "recommended", "default"),
        tuple(
            (
                *(row.title, panel.title, panel.reference, f"{panel.tolerance:g} {panel.unit}"),
                *(panel.describe(panel.recommended), panel.describe_default()),
            )
            for row in rows.values()
            for panel in row.panels
        ),
        words=frozenset({1, 2, 3, 4, 5}),
    )


def _section(name: str, row: ApproximationResult) -> Iterator[Block]:
    yield Text(row.text, warn=not row.panels)
    if row.panels:
        lines = row.lines()
        caption = " ".join(f"{capitalized(line)}." for line in lines)
        yield Picture(name, ". ".join(lines), caption, lambda: figure(row.panels))
        yield Section("Every point", tuple(_points(panel) for panel in row.panels))


def _points(panel: Panel) -> Table:
    best, front, rows = panel.recommended, panel.pareto(), []
    for point in panel.points:
        error = format_number(point.error)
        if point.interval:
            error = interval(point.error, *point.interval, format_number)
        marks = {"recommended": point == best, "default": point.is_default, "Pareto": point in front}
        rows.append(
            (point.name, format_duration(point.seconds), error, ", ".join(mark for mark in marks if marks[mark]))
        )
    header = (panel.title, panel.time, f"error, {panel.unit}", "")
    return Table(header, tuple(rows), (f"Against: {panel.reference}.",), frozenset({3}))


# Figures -----------------------------------------------------------------------------------------------


def figure(panels: Sequence[Panel]) -> Figure:
    """Draw the panels of one approximation, one below the other."""
    made = canvas(9.5, 4.1 * len(panels))
    for axes, panel in zip(made.subplots(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        _draw(axes, panel)
    return made


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set(xscale="log", yscale="log", xlabel=f"{panel.time}, ms", ylabel=panel.unit)
    axes.margins(x=0.12, y=0.1)
    limits = (panel.tolerance, *(_FLOOR * point.error for point in panel.points))
    floor = min((limit for limit in limits if limit > 0), default=1.0)
    for number, name in enumerate(dict.fromkeys(point.series for point in panel.points)):
        _series(axes, [point for point in panel.points if point.series == name], number, floor)
    _front(axes, panel, floor)
    axes.axhline(max(panel.tolerance, floor), color="#333333", ls="--", lw=1, zorder=0, label="tolerance")
    axes.set_title(f"{capitalized(panel.title)}, against {panel.reference}", fontsize=9.5, loc="left")
    logarithmic(axes.xaxis)
    logarithmic(axes.yaxis)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)


def _series(axes: Axes, points: Sequence[Tradeoff], number: int, floor: float) -> None:
    colour, marker = _COLOURS[number % len(_COLOURS)], _MARKERS[number % len(_MARKERS)]
    axes.plot([], [], marker, color=colour, label=points[0].series or None, ls="")
    for point in points:
        at, error = _place(point, floor)
        fill = colour if point.error else "white"
        axes.plot(at, error, marker, mfc=fill, mec=colour, ms=5, clip_on=point.error > 0)
        if point.error and point.interval:
            axes.vlines(at, *np.maximum(point.interval, floor), color=colour, lw=1, alpha=0.35, zorder=1)


def _front(axes: Axes, panel: Panel, floor: float) -> None:
    front, best, used = panel.pareto(), panel.recommended, panel.default
    axes.plot(*zip(*(_place(point, floor) for point in front), strict=True), color=MUTED_COLOUR, lw=1.2, zorder=0)
    if used:
        axes.plot(*_place(used, floor), "o", ms=14, mfc="none", mec="#222222", mew=1.3, clip_on=False, label="default")
    mark = {"mec": "white", "mew": 0.6, "clip_on": False, "label": "recommended"}
    axes.plot(*_place(best, floor), "*", ms=11, color="#c8382e", **mark)
    step = 1 if len(front) < 8 else 2  # a long front has a label at every second point
    for number, point in enumerate({id(one): one for one in (*front[::step], best)}.values()):
        text = point.setting or point.series
        axes.annotate(text, _place(point, floor), xytext=_SIDES[number % 2], **_LABEL).set_in_layout(False)


def _place(point: Tradeoff, floor: float) -> tuple[float, float]:
    return 1e3 * point.seconds, max(point.error, floor)
