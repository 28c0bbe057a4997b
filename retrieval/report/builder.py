"""Builder of the sections of an evaluation's report."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from retrieval.report.canvas import draw
from retrieval.report.document import Block, Details, Picture
from retrieval.report.results import Results, capitalized, measure_label, method_label, percent


class Builder:
    """Results and folder of one report; it writes the figures while the sections are built.

    Args:
        results: Results of the evaluation.
        out: Folder of the report.

    Attributes:
        main: The method that the report shows in detail.
        figures: The figures written so far.
    """

    def __init__(self, results: Results, out: Path) -> None:
        self.results, self.out = results, out
        self.main = (results.learned or results.methods)[0]
        self.figures: list[Path] = []

    def picture(self, name: str, alt: str, caption: str, make: Callable[..., Any], *arguments: Any) -> Picture:
        """Write a figure and return its block.

        Args:
            name: File name.
            alt: Text alternative.
            caption: Caption.
            make: Function that draws the figure.
            *arguments: Arguments of `make`.
        """
        path = self.out / "figures" / name
        draw(path, make, *arguments)
        self.figures.append(path)
        return Picture(f"figures/{name}", alt, caption)

    def any(self, *measures: str) -> bool:
        """Return whether any method has one of these measures."""
        return any(self.results.summary(name, key) for name in self.results.methods for key in measures)

    def values(self, measure: str) -> str:
        """Return the values of all methods as text, for the text alternative of a figure."""
        found = [(method_label(name), self.results.summary(name, measure)) for name in self.results.methods]
        values = [f"{label} {percent(summary['value'][0])} %" for label, summary in found if summary]
        chance = next((summary["chance"][0] for _, summary in found if summary), None)
        return f"{measure_label(measure)}: {', '.join(values)}; chance {percent(chance)} %"

    def each(self, entry: str, show: Callable[["Builder", str], Iterator[Block]]) -> Iterator[Block]:
        """Yield the blocks of the main method, then, folded, of the other methods that have this entry."""
        for name in self.results.learned:
            if self.results.data["methods"][name].get(entry):
                blocks = tuple(show(self, name))
                folded = (Details(capitalized(method_label(name)), blocks),) if blocks else ()
                yield from blocks if name == self.main else folded
