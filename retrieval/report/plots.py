"""Plots of an evaluation: each function returns a matplotlib figure of one protocol."""

from collections.abc import Iterable, Sequence

import numpy as np

from retrieval.methods import CHANCE
from retrieval.metrics.intervals import Summary
from retrieval.metrics.registry import SET_SIZES, grasps_metric_name
from retrieval.report.canvas import (
    MUTED_COLOUR,
    PART_COLOURS,
    Figure,
    canvas,
    percent_axis,
    style_of,
)
from retrieval.report.numbers import percent
from retrieval.report.results import ProtocolView

_LABELLED_OBJECTS = 130


def overview(view: ProtocolView, keys: Sequence[str]) -> Figure:
    """Plot value, interval and chance: a line for each row, a panel for each measure."""
    figure = canvas(10.5, 0.9 + 0.32 * len(view.result.rows))
    panels = figure.subplots(1, len(keys), sharey=True, squeeze=False)[0]
    for panel, key in zip(panels, keys, strict=True):
        for place, name in enumerate(view.result.rows):
            if summary := view.summary(name, key):
                value, low, high = _first(summary)
                panel.plot([low, high], [place, place], color=style_of(name).colour, lw=2.2, solid_capstyle="butt")
                panel.plot(value, place, style_of(name).marker, color=style_of(name).colour, ms=6.5)
                panel.axvline(100 * summary.chance[0], color=MUTED_COLOUR, ls="--", lw=1, zorder=0)
        panel.set_title(view.measure_label(key).replace(", ", "\n", 1), fontsize=9)
        panel.set_xlabel("%")
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="y", visible=False)
    panels[0].set_yticks(range(len(view.result.rows)), list(map(view.label, view.result.rows)))
    panels[0].invert_yaxis()
    return figure


def _first(summary: Summary) -> tuple[float, float, float]:
    return 100 * summary.value[0], 100 * summary.low[0], 100 * summary.high[0]


def topn_curves(view: ProtocolView, keys: Sequence[str]) -> Figure:
    """Plot the top-N accuracy: a panel for each number of candidates."""
    figure = canvas(2.5 + 4 * len(keys), 4.6)
    for panel, key in zip(figure.subplots(1, len(keys), squeeze=False)[0], keys, strict=True):
        for name, summary in reversed(view.summaries(key).items()):
            value, low, high, chance = (
                100 * np.array(part) for part in (summary.value, summary.low, summary.high, summary.chance)
            )
            ranks, style = np.arange(1, len(value) + 1), style_of(name)
            panel.plot(ranks, chance, color=MUTED_COLOUR, ls="--", lw=1.2, zorder=1)
            panel.plot(ranks, value, color=style.colour, marker=style.marker, ls=style.line)
            if name != CHANCE:
                panel.fill_between(ranks, low, high, color=style.colour, alpha=0.13, lw=0)
        panel.set(title=f"{key.removeprefix('topn_k')} candidate objects", xlabel="N")
        panel.xaxis.get_major_locator().set_params(integer=True)
        percent_axis(panel, "object among the first N answers, %")
    _legend(figure, view, view.result.rows)
    return figure


def _legend(figure: Figure, view: ProtocolView, names: Iterable[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=style.colour, marker=style.marker, ls=style.line, label=view.label(name))
        for name, style in ((name, style_of(name)) for name in names)
    ]
    handles.append(Line2D([], [], color=MUTED_COLOUR, ls="--", lw=1.2, label="chance, closed form"))
    figure.legend(handles=handles, loc="outside right center", frameon=False)


def grasps(view: ProtocolView) -> Figure:
    """Plot top-1 accuracy of five against the number of grasps, with 3 photos of each candidate."""
    figure = canvas(8, 4.4)
    panel = figure.subplots()
    keys = {key: count for count in SET_SIZES if view.summaries(key := grasps_metric_name(count))}
    for place, name in enumerate(view.result.rows):
        shift, style = 0.055 * (place - (len(view.result.rows) - 1) / 2), style_of(name)
        found = [(at, summary) for at, key in enumerate(keys) if (summary := view.summary(name, key))]
        points = np.array([(at + shift, *_first(summary)) for at, summary in found]).reshape(-1, 4)
        panel.plot(points[:, 0], points[:, 1], color=style.colour, marker=style.marker, ls=style.line, ms=5)
        panel.vlines(points[:, 0], points[:, 2], points[:, 3], color=style.colour, lw=1.4, alpha=0.7)
        for at, summary in found:
            panel.hlines(100 * summary.chance[0], at - 0.4, at + 0.4, color=MUTED_COLOUR, ls="--", lw=1.2, zorder=1)
    panel.set_xticks(range(len(keys)), list(map(str, keys.values())))
    panel.set_xlabel("grasps of the same object in one query")
    percent_axis(panel, "top-1 accuracy among 5 objects, %")
    _legend(figure, view, view.result.rows)
    return figure


def objects(view: ProtocolView, row: str, candidates: str, measure: str) -> Figure:
    """Plot the top-1 accuracy of five for each object, coloured by part, and the chance of `measure`."""
    accuracies, split = view.details[row].per_object[candidates], view.result.folds[0][0]
    ranked = sorted(accuracies, key=lambda name: (-accuracies[name], name))
    bars = [(name, colour) for part, colour in PART_COLOURS.items() for name in ranked if name in split[part]]
    figure = canvas(13, 3.8)
    panel = figure.subplots()
    heights, colours = [100 * accuracies[name] for name, _ in bars], [colour for _, colour in bars]
    panel.bar(range(len(bars)), heights, 0.78, color=colours)
    if summary := view.summary(row, measure):
        panel.axhline(100 * summary.chance[0], color="#333333", ls="--", lw=1.2)
        panel.text(len(bars) - 0.4, 100 * summary.chance[0], " chance", va="center", fontsize=8)
    if len(bars) <= _LABELLED_OBJECTS:
        size = float(np.clip(700 / len(bars), 5.5, 8))
        # A long name is cut in its middle, because the ends distinguish objects.
        names = [name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}" for name, _ in bars]
        panel.set_xticks(range(len(bars)), names, rotation=90, fontsize=size)
    else:
        panel.set(xticks=[], xlabel=f"{len(bars)} objects")
    panel.set_xlim(-0.7, len(bars) - 0.3)
    panel.grid(axis="x", visible=False)
    percent_axis(panel, "top-1 accuracy, %")
    return figure


# Decisions -------------------------------------------------------------------------------------------

RELIABILITIES = {
    "k5": "5 candidates, one grasp",
    "k10": "10 candidates, one grasp",
}


def reliability(view: ProtocolView, row: str) -> Figure:
    """Plot the fraction of right answers against the stated probability, on test objects."""
    diagrams = view.details[row].reliability
    kinds = [kind for kind in RELIABILITIES if kind in diagrams]
    figure = canvas(0.6 + 2.7 * len(kinds), 3.5)
    panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
    for panel, kind in zip(panels, kinds, strict=True):
        bins = [found for found in diagrams[kind]["bins"] if found["count"]]
        stated, right = (100 * np.array([one[key] for one in bins]) for key in ("probability", "frequency"))
        panel.plot([0, 100], [0, 100], color=MUTED_COLOUR, ls="--", lw=1.2)
        panel.plot(stated, right, "o-", color=style_of(row).colour, ms=5)
        panel.set_title(f"{RELIABILITIES[kind]}\nECE {percent(diagrams[kind]['ece'])} %", fontsize=9)
        panel.set(xlim=(-2, 102), xlabel="stated probability, %")
    percent_axis(panels[0], "right answers, %")
    return figure


def reject(view: ProtocolView) -> Figure:
    """Plot the ROC curve of "the catalogue contains the object"."""
    figure = canvas(6.5, 4.4)
    panel = figure.subplots()
    rejections = {name: details.reject for name, details in view.details.items() if details.reject}
    for name, rejection in reversed(rejections.items()):
        points, style = 100 * np.array(rejection.roc), style_of(name)
        panel.plot(*points.T, color=style.colour, ls=style.line)
        step = max(1, len(points) // 6)  # a curve of many corners, with a few markers
        panel.plot(*points[step:-1:step].T, style.marker, color=style.colour, ms=5)
    panel.plot([0, 100], [0, 100], color=MUTED_COLOUR, ls="--", lw=1.2)
    panel.axhline(95, color=MUTED_COLOUR, lw=0.8)
    panel.set(xlabel="accepted, object absent (false accepts), %", ylabel="accepted, object present, %")
    panel.set(xlim=(-1, 101), ylim=(-1, 101))
    panel.set_aspect("equal", adjustable="box")
    _legend(figure, view, rejections)
    return figure
