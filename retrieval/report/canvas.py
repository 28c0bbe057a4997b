"""Style and files of the report's figures: colours that colour-blind readers can distinguish, light background."""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from _touch_retrieval.files import write_atomically
from retrieval.errors import RetrievalError

Figure = Any
Axes = Any

MUTED_COLOUR = "#8a949e"
PART_COLOURS = {"test": "#c8382e", "validation": "#9aa3ab", "train": "#2f6fb3"}
FIGURE_DPI = 144
# No $...$ formulas, because object names may contain dollar signs.
_RC: Any = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#5b6672",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e9ec",
    "lines.linewidth": 1.8,
    "lines.markersize": 6,
    "text.parse_math": False,
}


@dataclass(frozen=True)
class Style:
    """Colour, marker and line of a method, the same in every figure."""

    colour: str
    marker: str
    line: str = "-"


# The palette of Okabe and Ito for the main methods, and a marker for each method, for readers without colours.
_STYLES = {
    "late_fusion": Style("#0072b2", "o"),
    "retrieve_rerank": Style("#009e73", "D"),
    "contrastive": Style("#d55e00", "^"),
    "cca": Style("#aa3377", "P"),
    "cca_towers": Style("#44aa99", "h"),
    "chance": Style("#6b7580", ".", ":"),
}


def style_of(method: str) -> Style:
    """Return the style of a method; unknown methods are black."""
    return _STYLES.get(method, Style("#222222", "*"))


def canvas(width_in: float, height_in: float) -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure as MatplotlibFigure

    return MatplotlibFigure((width_in, height_in), FIGURE_DPI, layout="constrained", facecolor="white")


def percent_axis(panel: Axes, label: str) -> None:
    """Set a vertical axis from 0 to 100 %."""
    panel.set(ylim=(0, 102), yticks=range(0, 101, 20), ylabel=label)


def logarithmic(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers, because matplotlib's labels are formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,), numticks=16))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())


def draw(path: Path, make: Callable[[], Figure]) -> None:
    """Write the figure that `make()` returns as a PNG file.

    Raises:
        RetrievalError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ImportError as error:
        raise RetrievalError(
            f"Figures need matplotlib, but {error.name} is missing. Run: pip install 'touch-retrieval[evaluation]'"
        ) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context(_RC), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        agg: Any = FigureCanvasAgg(make())
        agg.draw()
    image, data = Image.fromarray(np.ascontiguousarray(np.asarray(agg.buffer_rgba())[..., :3])), io.BytesIO()
    # A palette of 256 colours makes the file three times smaller.
    image.quantize(256, dither=Image.Dither.NONE).save(data, "PNG", optimize=True)
    write_atomically(path, data.getvalue())
