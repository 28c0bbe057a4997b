"""Report of `retrieve frontier`: a plot for each approximation and one HTML page."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.console.files import text_bytes, write_output
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, format_duration, format_number
from retrieval.report.canvas import MUTED_COLOUR, Axes, Figure, canvas, draw, logarithmic
from retrieval.report.document import Block, Details, Document, Picture, Section, Table, Text, to_html
from retrieval.report.results import capitalized

# Palette of Okabe and Ito; the markers distinguish series without colour.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6f4e37", "#222222", "#aa3377")
_MARKERS = "o^sDvPX<>"
_LABEL: Any = {"textcoords": "offset points", "fontsize": 7.5, "color": "#3a434c"}
_ABOVE, _BELOW, _NEAR_PX = (7, 5), (7, -10), 20
"""Label offsets above and below a point, in points; a label within `_NEAR_PX` of the previous one goes below."""
_FLOOR = 0.5
"""An error of 0 is drawn at this fraction of the smallest measurable error."""

LEGEND = (
    "Lower left is better. The line is the Pareto front: for its points, no other point is better in both time and "
    "error. The star marks "
    "the recommended point, the fastest within the tolerance (dashed); the ring marks the default. An open marker at "
    "the lower edge is a measured error of 0. Whiskers are 95 % intervals."
)


def write_frontier(out: Path, document: Mapping[str, Any]) -> list[Path]:
    """Write `out`/frontier.html and `out`/figures/NAME.png.

    Args:
        out: Folder of the report.
        document: The content of frontier.json.

    Returns:
        The files.

    Raises:
        RetrievalError: matplotlib is missing.
    """
    rows = {name: ApproximationResult.from_dict(row) for name, row in document["rows"].items()}
    figures = {out / "figures" / f"{name}.png": row.panels for name, row in rows.items() if row.panels}
    for path, panels in figures.items():
        draw(path, figure, panels)
    page = out / "frontier.html"
    sections = tuple(Section(row.title, tuple(_section(name, row))) for name, row in rows.items())
    html = to_html(Document("Error against run time", tuple(_lead(document, rows)), sections), out)
    write_output(page, text_bytes(html))
    return [page, *figures]


def _lead(document: Mapping[str, Any], rows: Mapping[str, ApproximationResult]) -> Iterator[Block]:
    machine, scale = document["machine"], document["scale"]
    yield Text(
        "The error of each approximation against its reference and its run time were measured in one run on this "
        f"machine: {machine['processor']}, {machine['cores']} core(s), "
        f"{machine['system']}. Times are medians."
    )
    yield Text(LEGEND)
    if scale["quick"]:
        yield Text("A quick run: too few queries and repetitions for conclusions.", warn=True)
    found = [(row.title, panel) for row in rows.values() for panel in row.panels]
    yield Table(
        ("approximation", "error", "reference", "tolerance", "recommended", "default"),
        tuple(_summary(title, panel) for title, panel in found),
        words=frozenset({1, 2, 3, 4, 5}),
    )


def _summary(title: str, panel: Panel) -> tuple[str, ...]:
    best, used = panel.recommended, panel.default
    default = "none" if used is None else "the same" if used == best else panel.describe(used)
    return (title, panel.title, panel.reference, f"{panel.tolerance:g} {panel.unit}", panel.describe(best), default)


def _section(name: str, row: ApproximationResult) -> Iterator[Block]:
    if row.text:
        yield Text(row.text)
    if row.skipped:
        yield Text(f"Left out: {row.skipped}.", warn=True)
    if row.panels:
        lines = [panel.line() for panel in row.panels]
        yield Picture(
            f"figures/{name}.png", ". ".join(lines), " ".join(f"{line[0].upper()}{line[1:]}." for line in lines)
        )
        yield Details("Every point", tuple(_points(panel) for panel in row.panels))


def _points(panel: Panel) -> Table:
    front = panel.pareto()
    rows = tuple(
        (
            point.name,
            format_duration(point.seconds),
            format_number(point.error),
            "" if point.low is None or point.high is None else f"{point.low:.3g} to {point.high:.3g}",
            ", ".join(word for word, holds in _marks(panel, point, front) if holds),
        )
        for point in panel.points
    )
    header = (panel.title, panel.time, f"error, {panel.unit}", "95 % interval", "")
    return Table(header, rows, (f"Against: {panel.reference}.",), frozenset({4}))


def _marks(panel: Panel, point: Tradeoff, front: Sequence[Tradeoff]) -> tuple[tuple[str, bool], ...]:
    return (
        ("recommended", point == panel.recommended),
        ("default", point.is_default),
        ("Pareto", point in front),
    )


# Figures -----------------------------------------------------------------------------------------------


def figure(panels: Sequence[Panel]) -> Figure:
    """Draw the panels of one approximation, one below the other."""
    made = canvas(9.5, 4.1 * len(panels))
    for axes, panel in zip(made.subplots(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        _draw(axes, panel)
    return made


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.12, y=0.1)
    floor = _FLOOR * min([panel.resolution, *(point.error for point in panel.points if point.error > 0)])
    series = list(dict.fromkeys(point.series for point in panel.points))
    for place, name in enumerate(series):
        _series(axes, [point for point in panel.points if point.series == name], place, floor, name)
    _front(axes, panel, floor)
    axes.axhline(max(panel.tolerance, floor), color="#333333", ls="--", lw=1, zorder=0, label="tolerance")
    axes.set_title(f"{capitalized(panel.title)}, against {panel.reference}", fontsize=9.5, loc="left")
    axes.set_xlabel(f"{panel.time}, ms")
    axes.set_ylabel(panel.unit)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        logarithmic(axis, (1, 2, 5) if high < 300 * low else (1,))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)


def _series(axes: Axes, points: Sequence[Tradeoff], place: int, floor: float, name: str) -> None:
    colour, marker = _COLOURS[place % len(_COLOURS)], _MARKERS[place % len(_MARKERS)]
    positive = [point for point in points if point.error > 0]
    axes.plot([], [], marker, color=colour, label=name or None, ls="")
    for point in positive:
        if point.low is not None and point.high is not None:
            at = 1e3 * point.seconds
            axes.plot([at, at], [max(point.low, floor), point.high], color=colour, lw=1, alpha=0.35, zorder=1)
    axes.plot(
        [1e3 * point.seconds for point in positive], [point.error for point in positive], marker, color=colour, ms=5
    )
    none = [1e3 * point.seconds for point in points if point.error == 0]
    if none:  # an empty unclipped line would extend the figure to its corner
        axes.plot(none, np.full(len(none), floor), marker, mfc="white", mec=colour, ms=5, clip_on=False)


def _front(axes: Axes, panel: Panel, floor: float) -> None:
    front = [_place(point, floor) for point in panel.pareto()]
    axes.plot(*zip(*front, strict=True), color=MUTED_COLOUR, lw=1.2, zorder=0)
    if (used := panel.default) is not None:
        axes.plot(*_place(used, floor), "o", ms=14, mfc="none", mec="#222222", mew=1.3, clip_on=False, label="default")
    best = panel.recommended
    axes.plot(
        *_place(best, floor), "*", ms=11, color="#c8382e", mec="white", mew=0.6, clip_on=False, label="recommended"
    )
    step = 1 if len(front) < 8 else 2  # a long front has a label at every second point
    axes.get_xlim(), axes.get_ylim()  # fixes the limits, so that pixel positions are final
    previous = np.full(2, np.inf)
    for point in {id(one): one for one in (*panel.pareto()[::step], best)}.values():
        at = axes.transData.transform(_place(point, floor))
        side = _BELOW if np.abs(at - previous).max() < _NEAR_PX else _ABOVE
        label = axes.annotate(point.setting or point.series, _place(point, floor), xytext=side, **_LABEL)
        label.set_in_layout(False)
        previous = at


def _place(point: Tradeoff, floor: float) -> tuple[float, float]:
    return 1e3 * point.seconds, max(point.error, floor)
