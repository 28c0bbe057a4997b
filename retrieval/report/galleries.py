"""Figures of photographs: confusions, and the best and worst queries.

All pictures of a figure share one pair of axes, in units of a tile, because the layout of many axes is slow.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

from retrieval.data.dataset import Grasp
from retrieval.report.canvas import Axes, Figure, canvas
from retrieval.report.pages import thumbnail
from retrieval.report.results import format_number, percent, shortened

_TILE_PX = 150
_RIGHT, _WRONG, _LINE = "#0a9d58", "#c8382e", "#c3cad1"
_LETTERS = 21  # per line of a label under a tile

Grasps = Mapping[str, Grasp]
"""Grasps of the recording by grasp_id; missing grasps are left blank."""


def examples(queries: Sequence[Any], grasps: Grasps) -> Figure:
    """Draw a row for each query: gel images, then photos by rank, with green frames for the true object."""
    fingers = max(
        (len(grasps[query["grasp_id"]].touches) for query in queries if query["grasp_id"] in grasps), default=1
    )
    columns = fingers + 0.35 + max(len(query["ranked"]) for query in queries)
    figure, panel = _sheet(columns, 1.4 * len(queries) - 0.1)
    for column in range(fingers):
        panel.text(column + 0.46, -0.12, f"finger {ascii_lowercase[column]}", ha="center", fontsize=8)
    panel.text(fingers + 0.35, -0.12, "catalogue, most likely first", fontsize=8)
    for row, query in enumerate(queries):
        top, own = 1.4 * row, grasps.get(query["grasp_id"])
        for column in range(fingers):
            _tile(panel, column, top, own.touches[column] if own else None)
        _label(
            panel,
            0,
            top,
            f"{shortened(query['object_id'], 2 * _LETTERS + 4)}\nrank {format_number(query['true_rank'])}",
        )
        for place, name in enumerate(query["ranked"]):
            found, left = grasps.get(name), fingers + 0.35 + place
            right = found is not None and found.object_id == query["object_id"]
            _tile(panel, left, top, found.photo if found else None, _RIGHT if right else _LINE, 3 if right else 0.8)
            _label(panel, left, top, f"{place + 1}. {_two_lines(found.object_id if found else name)}")
    return figure


def confusions(pairs: Sequence[Any], photo_of: Mapping[str, Path]) -> Figure:
    """Draw each object next to the object that it was mistaken for, with the fraction of its queries."""
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure, panel = _sheet(3.1 * columns - 0.4, 1.45 * rows - 0.15)
    for place, pair in enumerate(pairs):
        left, top = 3.1 * (place % columns), 1.45 * (place // columns)
        _tile(panel, left, top, photo_of.get(pair["object_id"]))
        _label(panel, left, top, _two_lines(pair["object_id"]))
        panel.text(left + 1.33, top + 0.38, f"{percent(pair['share'], 0)} %", ha="center", va="bottom", fontsize=10)
        panel.annotate(
            "",
            (left + 1.66, top + 0.5),
            (left + 1.02, top + 0.5),
            arrowprops={"arrowstyle": "-|>", "color": _WRONG, "lw": 1.5},
        )
        _tile(panel, left + 1.75, top, photo_of.get(pair["mistaken_for"]), _WRONG, 2)
        _label(panel, left + 1.75, top, _two_lines(pair["mistaken_for"]))
    return figure


# Tiles -----------------------------------------------------------------------------------------------


def _sheet(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of width x height tiles of 1.15 inch; y points downwards."""
    figure = canvas(1.15 * (width + 0.1), 1.15 * (height + 0.3))
    figure.set_layout_engine("none")
    panel = figure.add_axes((0, 0, 1, 1))
    panel.set_axis_off()
    panel.set(xlim=(-0.05, width + 0.05), ylim=(height, -0.3))
    return figure, panel


def _tile(panel: Axes, left: float, top: float, path: Path | None, frame: str = _LINE, width: float = 0.8) -> None:
    """Draw one picture, in its aspect ratio, centred in a tile of 0.92; blank if there is none."""
    from matplotlib.patches import Rectangle

    image = thumbnail(path, _TILE_PX) if path else None
    high, wide = (1, 1) if image is None else image.shape[:2]
    x, y = 0.92 * wide / max(high, wide), 0.92 * high / max(high, wide)
    left, top = left + (0.92 - x) / 2, top + (0.92 - y) / 2
    if image is None:
        panel.text(left + x / 2, top + y / 2, "no picture", ha="center", va="center", fontsize=7, color="#5b6672")
    else:
        panel.imshow(image, extent=(left, left + x, top + y, top), interpolation="antialiased", aspect="auto", zorder=1)
    fill = "none" if image is not None else "#eef1f4"
    panel.add_patch(
        Rectangle((left, top), x, y, facecolor=fill, edgecolor=frame, lw=width, zorder=2 if image is not None else 0)
    )


def _label(panel: Axes, left: float, top: float, text: str) -> None:
    panel.text(left, top + 0.97, text, va="top", fontsize=6.5, linespacing=1.15)


def _two_lines(name: str, reserved: int = 3) -> str:
    """Return the name on at most two lines, broken at a mark, shortened in its middle if it is too long."""
    length = _LETTERS - reserved
    if len(name) <= length:
        return name
    marks = [at + 1 for at, letter in enumerate(name[:length]) if letter in "-_. " and len(name) - at - 1 <= length]
    cut = marks[-1] if marks else length
    return f"{name[:cut]}\n{shortened(name[cut:], length)}"
