"""Builder of the sections of an evaluation's report."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

from retrieval.report.canvas import draw
from retrieval.report.document import Block, Card, Details, Picture, Spot
from retrieval.report.galleries import Grasps
from retrieval.report.results import Results, capitalized, measure_label, method_label, percent


class Builder:
    """Results, grasps and folder of one report; it writes the figures while the sections are built.

    Args:
        results: Results of the evaluation.
        grasps: Grasps of the recording by id; empty for a report without pictures.
        out: Folder of the report.

    Attributes:
        main: The method that the report shows in detail.
        figures: The figures written so far.
    """

    def __init__(self, results: Results, grasps: Grasps, out: Path) -> None:
        self.results, self.grasps, self.out = results, grasps, out
        self.main = (results.learned or results.methods)[0]
        self.figures: list[Path] = []

    def picture(
        self,
        name: str,
        alt: str,
        caption: str,
        make: Callable[..., Any],
        *arguments: Any,
        spots: Mapping[str, Sequence[tuple[str, Sequence[Any]]]] | None = None,
    ) -> Picture:
        """Write a figure and return its block.

        Args:
            name: File name.
            alt: Text alternative.
            caption: Caption.
            make: Function that draws the figure.
            *arguments: Arguments of `make`.
            spots: `gid` of an artist of the figure -> label and grasps (of results.json) for each of its points.

        Returns:
            The block of the figure, with its clickable spots.
        """
        path = self.out / "figures" / name
        places = draw(path, make, *arguments)
        self.figures.append(path)
        clickable = [
            Spot(box, label, tuple(map(self._card, grasps)))
            for gid, labelled_grasps in (spots or {}).items()
            for box, (label, grasps) in zip(places.get(gid, ()), labelled_grasps, strict=False)
            if grasps and self.grasps
        ]
        return Picture(f"figures/{name}", alt, caption, tuple(clickable))

    def _card(self, example: Any) -> Card:
        """Return the card of a grasp in results.json: gel images, its object's photo, and the found photo."""
        own, found = self.grasps.get(example["grasp_id"]), self.grasps.get(example["found"])
        found_object = found.object_id if found else example["found"]
        touches = own.touches if own else ()
        gels = [(f"finger {ascii_lowercase[place]}", path) for place, path in enumerate(touches)]
        # The grasps of a confusion come from all seeds: in this seed the object itself may be the first result.
        status = "found" if found_object == example["object_id"] else "found, wrong"
        photos = [
            (f"the object: {example['object_id']}", own.photo if own else None),
            (f"{status}: {found_object}", found.photo if found else None),
        ]
        return Card(f"Grasp {example['grasp_id']}", (*gels, *photos))

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
