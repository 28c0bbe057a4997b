"""Builder of the sections of an evaluation's report."""

from collections.abc import Callable, Iterator

from retrieval.report.document import Block, Details, capitalized
from retrieval.report.numbers import percent
from retrieval.report.results import Results, measure_label, method_label


class Builder:
    """Results of one report.

    Args:
        results: Results of the evaluation.

    Attributes:
        main: The method that the report shows in detail.
    """

    def __init__(self, results: Results) -> None:
        self.results = results
        self.main = (results.learned or results.methods)[0]

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
