"""Plots of an evaluation: each function returns a matplotlib figure of the results."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.methods import CHANCE
from retrieval.metrics.registry import PHOTO_COUNTS, SET_SIZES, grasps_metric_name, photos_metric_name
from retrieval.report.canvas import MUTED_COLOUR, PART_COLOURS, Axes, Figure, Style, canvas, percent_axis, style_of
from retrieval.report.results import IMPOSTORS, Results, measure_label, method_label, percent, shortened

OVERVIEW = ("pair_accuracy", "topn_k5", "topn_k10", grasps_metric_name(5), "map")
_LABELLED_OBJECTS = 130


def overview(results: Results) -> Figure:
    """Plot value, interval and chance: a row for each method, a panel for each main measure."""
    keys = [key for key in OVERVIEW if any(results.summary(name, key) for name in results.methods)]
    figure = canvas(10.5, 0.9 + 0.32 * len(results.methods))
    panels = figure.subplots(1, len(keys), sharey=True, squeeze=False)[0]
    for panel, key in zip(panels, keys, strict=True):
        for row, name in enumerate(results.methods):
            if summary := results.summary(name, key):
                value, low, high = _first(summary)
                panel.plot([low, high], [row, row], color=style_of(name).colour, lw=2.2, solid_capstyle="butt")
                panel.plot(value, row, style_of(name).marker, color=style_of(name).colour, ms=6.5)
                panel.axvline(100 * summary["chance"][0], color=MUTED_COLOUR, ls="--", lw=1, zorder=0)
        panel.set_title(measure_label(key).replace(", ", "\n", 1), fontsize=9)
        panel.set_xlabel("%")
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="y", visible=False)
    panels[0].set_yticks(range(len(results.methods)), [method_label(name) for name in results.methods])
    panels[0].invert_yaxis()
    return figure


def _first(summary: Any) -> tuple[float, float, float]:
    """Return the first value of a measure and its interval, in percent."""
    value, low, high = (_percents(summary[key])[0] for key in ("value", "low", "high"))
    return float(value), float(low), float(high)


def _percents(fractions: Sequence[float | None]) -> NDArray[np.float64]:
    return 100 * np.array([math.nan if fraction is None else fraction for fraction in fractions])


def topn_curves(results: Results) -> Figure:
    """Plot the top-N accuracy for 5 candidates and, if there are enough objects, for 10."""
    all_keys = ("topn_k5", "topn_k10")
    keys = [key for key in all_keys if any(results.summary(name, key) for name in results.methods)] or all_keys
    figure = canvas(2.5 + 4 * len(keys), 4.6)
    for panel, key in zip(figure.subplots(1, len(keys), squeeze=False)[0], keys, strict=True):
        for name in reversed(results.methods):
            if (summary := results.summary(name, key)) is None:
                continue
            value, low, high = (_percents(summary[part]) for part in ("value", "low", "high"))
            ranks, style = np.arange(1, len(value) + 1), style_of(name)
            panel.plot(ranks, _percents(summary["chance"]), color=MUTED_COLOUR, ls="--", lw=1.2, zorder=1)
            panel.plot(ranks, value, color=style.colour, marker=style.marker, ls=style.line)
            if name != CHANCE:
                panel.fill_between(ranks, low, high, color=style.colour, alpha=0.13, lw=0)
        panel.set_title(f"{key.removeprefix('topn_k')} candidate objects")
        panel.set_xlabel("N")
        panel.xaxis.get_major_locator().set_params(integer=True)
        percent_axis(panel, "object among the first N answers, %")
    _legend(figure, results.methods)
    return figure


def _legend(figure: Figure, names: Sequence[str]) -> None:
    """Add one legend on the right, in the order of the tables."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=style.colour, marker=style.marker, ls=style.line, label=method_label(name))
        for name, style in ((name, style_of(name)) for name in names)
    ]
    handles.append(Line2D([], [], color=MUTED_COLOUR, ls="--", lw=1.2, label="chance, closed form"))
    figure.legend(handles=handles, loc="outside right center", frameon=False)


def grasps_and_photos(results: Results) -> Figure:
    """Plot top-1 accuracy of five against grasps (3 photos of each candidate), and against photos (1 grasp)."""
    figure = canvas(12.5, 4.4)
    left, right = figure.subplots(1, 2)
    _against_counts(left, results, grasps_metric_name, SET_SIZES)
    _against_counts(right, results, photos_metric_name, PHOTO_COUNTS)
    left.set_xlabel("grasps of the same object in one query")
    right.set_xlabel("photos of each candidate")
    _legend(figure, results.methods)
    return figure


def _against_counts(panel: Axes, results: Results, metric: Callable[[int], str], counts: Sequence[int]) -> None:
    """Plot each method's values of a metric for each count, with its chance; counts without values are left out."""
    counts = [count for count in counts if any(results.summary(name, metric(count)) for name in results.methods)]
    for place, name in enumerate(results.methods):
        shift, style = 0.055 * (place - (len(results.methods) - 1) / 2), style_of(name)
        found = [(at, summary) for at, key in enumerate(map(metric, counts)) if (summary := results.summary(name, key))]
        points = np.array([(at + shift, *_first(summary)) for at, summary in found]).reshape(-1, 4)
        panel.plot(points[:, 0], points[:, 1], color=style.colour, marker=style.marker, ls=style.line, ms=5)
        panel.vlines(points[:, 0], points[:, 2], points[:, 3], color=style.colour, lw=1.4, alpha=0.7)
        for at, summary in found:
            panel.hlines(100 * summary["chance"][0], at - 0.4, at + 0.4, color=MUTED_COLOUR, ls="--", lw=1.2, zorder=1)
    panel.set_xticks(range(len(counts)), list(map(str, counts)))
    percent_axis(panel, "top-1 accuracy among 5 objects, %")


# Objects ---------------------------------------------------------------------------------------------


def objects(results: Results, method: str, which: str) -> Figure:
    """Plot the top-1 accuracy of five for each object, coloured by part; `which` is "test" or "all" (candidates)."""
    accuracies = results.data["methods"][method]["per_object"][f"{which}_candidates"]
    ranked = sorted(accuracies, key=lambda name: (-accuracies[name], name))
    bars = [
        (name, accuracies[name], colour)
        for part, colour in PART_COLOURS.items()
        for name in ranked
        if name in results.data["split"][part]
    ]
    figure = canvas(13, 3.8)
    panel = figure.subplots()
    values, colours = [100 * accuracy for _, accuracy, _ in bars], [colour for *_, colour in bars]
    panel.bar(range(len(bars)), values, 0.78, color=colours)
    if summary := results.summary(method, "topn_k5" if which == "test" else "topn_k5_all_objects"):
        panel.axhline(100 * summary["chance"][0], color="#333333", ls="--", lw=1.2)
        panel.text(len(bars) - 0.4, 100 * summary["chance"][0], " chance", va="center", fontsize=8)
    if len(bars) <= _LABELLED_OBJECTS:
        size = float(np.clip(700 / len(bars), 5.5, 8))
        panel.set_xticks(range(len(bars)), [shortened(name, 24) for name, *_ in bars], rotation=90, fontsize=size)
    else:
        panel.set_xticks([])
        panel.set_xlabel(f"{len(bars)} objects")
    panel.set_xlim(-0.7, len(bars) - 0.3)
    panel.grid(axis="x", visible=False)
    percent_axis(panel, "top-1 accuracy, %")
    return figure


# Decisions -------------------------------------------------------------------------------------------

RELIABILITIES = {
    "pairs": "one touch, one photo, even odds",
    "k5": "5 candidates, one grasp",
    "k10": "10 candidates, one grasp",
    "k5_g5": "5 candidates, 3 photos each, five grasps",
}


def reliability(results: Results, method: str) -> Figure:
    """Plot the fraction of right answers against the stated probability, on test objects, with counts below."""
    diagrams = results.data["methods"][method]["reliability"]
    kinds = [kind for kind in RELIABILITIES if kind in diagrams]
    figure = canvas(0.6 + 2.7 * len(kinds), 4.1)
    grid = figure.subplots(2, len(kinds), sharex=True, sharey="row", squeeze=False, height_ratios=[4, 1])
    colour = style_of(method).colour
    for panel, counts, kind in zip(*grid, kinds, strict=True):
        bins = [found for found in diagrams[kind]["bins"] if found["count"]]
        stated, right = _percents([one["probability"] for one in bins]), _percents([one["frequency"] for one in bins])
        panel.plot([0, 100], [0, 100], color=MUTED_COLOUR, ls="--", lw=1.2)
        panel.vlines(stated, stated, right, color=colour, lw=1, alpha=0.5)
        panel.plot(stated, right, "o-", color=colour, ms=5)
        panel.set_xlim(-2, 102)
        panel.set_title(f"{RELIABILITIES[kind]}\nECE {percent(diagrams[kind]['ece'])} %", fontsize=9)
        counts.bar(stated, [one["count"] for one in bins], width=6, color=colour, alpha=0.6)
        counts.set_yscale("log")
        logarithmic(counts.yaxis, (1,))
        counts.set_xlabel("stated probability, %")
    percent_axis(grid[0][0], "right answers, %")
    grid[1][0].set_ylabel("answers")
    return figure


def logarithmic(axis: Any, steps: tuple[int, ...]) -> None:
    """Label a logarithmic axis with plain numbers, at `steps` times powers of ten; matplotlib's labels are formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=steps, numticks=16))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())


def reject(results: Results) -> Figure:
    """Plot the ROC curve of "the catalogue contains the object", and the top-1 risk against coverage."""
    figure = canvas(10.5, 4.4)
    accepts, risk = figure.subplots(1, 2)
    names = [name for name in results.methods if results.data["methods"][name].get("reject")]
    for name in reversed(names):
        found = results.data["methods"][name]["reject"]
        _decisions(accepts, name, found["roc"])
        _decisions(risk, name, found["risk_coverage"])
    accepts.plot([0, 100], [0, 100], color=MUTED_COLOUR, ls="--", lw=1.2)
    accepts.axhline(95, color=MUTED_COLOUR, lw=0.8)
    accepts.set(xlabel="accepted, object absent (false accepts), %", ylabel="accepted, object present, %")
    risk.axhline(50, color=MUTED_COLOUR, lw=0.8)
    risk.set(xlabel="answered queries, most confident first, %", ylabel="wrong top-1 answers among these, %")
    for panel in (accepts, risk):
        panel.set(xlim=(-1, 101), ylim=(-1, 101))
        panel.set_aspect("equal", adjustable="box")
    _legend(figure, names)
    return figure


def _decisions(panel: Axes, name: str, corners: Sequence[Sequence[float]]) -> None:
    """Plot a curve of many corners with a few markers."""
    points, style = 100 * np.array(corners), style_of(name)
    panel.plot(points[:, 0], points[:, 1], color=style.colour, ls=style.line)
    step = max(1, len(points) // 6)
    panel.plot(points[step:-1:step, 0], points[step:-1:step, 1], style.marker, color=style.colour, ms=5)


DET_TICKS = (0.001, 0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.95, 0.99)
_GRASP_STYLES = {
    "1": Style("#d55e00", "o"), "2": Style("#e69f00", "s"), "3": Style("#009e73", "D"), "5": Style("#0072b2", "^")
}  # fmt: skip


def verification(results: Results) -> Figure:
    """Plot the false-reject rate against the false-accept rate on probit axes: a panel for each kind of impostor."""
    from matplotlib.lines import Line2D
    from scipy.stats import norm

    found = results.data["verification"]
    figure = canvas(10.5, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    for panel, kind in zip(panels, found, strict=True):
        for grasps, style in _GRASP_STYLES.items():
            if grasps not in found[kind]:
                continue
            far, frr, supported = np.array(found[kind][grasps]["det"]).T
            x, y = norm.ppf(far), np.where((frr > 0) & (frr < 1), norm.ppf(frr), math.nan)
            panel.plot(x, y, ":", color=style.colour, lw=1.2)
            panel.plot(x, np.where(supported > 0, y, math.nan), color=style.colour)
            panel.plot(x[::8], y[::8], style.marker, color=style.colour, ms=5)
        panel.plot(norm.ppf([0.001, 0.5]), norm.ppf([0.001, 0.5]), color=MUTED_COLOUR, ls="--", lw=1.2)
        ticks = [tick for tick in DET_TICKS if tick < 0.5]
        panel.set_xticks(norm.ppf([*ticks, 0.5]), [f"{100 * tick:g}" for tick in [*ticks, 0.5]])
        panel.set(xlim=norm.ppf([0.0008, 0.52]), xlabel="false-accept rate (FAR), %")
        panel.set_title(f"impostors: {IMPOSTORS[kind]}")
    panels[0].set_yticks(norm.ppf(DET_TICKS), [f"{100 * tick:g}" for tick in DET_TICKS])
    panels[0].set_ylabel("false-reject rate (FRR), %")
    handles = [
        Line2D([], [], color=style.colour, marker=style.marker, label=f"grasps: {grasps}")
        for grasps, style in _GRASP_STYLES.items()
    ]
    figure.legend(handles=handles, loc="outside right center", frameon=False)
    return figure


# Time ------------------------------------------------------------------------------------------------


def accuracy_and_time(results: Results) -> Figure:
    """Plot top-1 accuracy of five against the time of a query, and against the time of fitting."""
    figure = canvas(10.5, 4.4)
    panels = figure.subplots(1, 2, sharey=True)
    titles = {"query_ms": "one query against the whole gallery, ms", "fit_s": "fitting, s"}
    for panel, (key, title) in zip(panels, titles.items(), strict=True):
        front: list[tuple[float, float]] = []
        for name in results.methods:
            time, summary = results.time(name, key), results.summary(name, "topn_k5")
            if not (time and summary):
                continue
            value, low, high = _first(summary)
            front.append((time, value))
            panel.errorbar(
                time, value, [[value - low], [high - value]], fmt=style_of(name).marker, color=style_of(name).colour
            )
            panel.axhline(100 * summary["chance"][0], color=MUTED_COLOUR, ls="--", lw=1.2, zorder=0)
        # The Pareto front of time and accuracy.
        front = [
            (time, value)
            for time, value in sorted(front)
            if not any(other != (time, value) and other[0] <= time and other[1] >= value for other in front)
        ]
        if front:
            panel.step(*zip(*front, strict=True), where="post", color="#222222", lw=1, alpha=0.45, zorder=0)
        panel.set_xscale("log")
        low, high = panel.get_xlim()
        logarithmic(panel.xaxis, (1, 2, 5) if high < 1000 * low else (1,))
        panel.set_xlabel(title)
    percent_axis(panels[0], "top-1 accuracy among 5 objects, %")
    _legend(figure, results.methods)
    return figure
