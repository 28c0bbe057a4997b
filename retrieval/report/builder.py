"""What every section of an evaluation's report is built with."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

from retrieval.report.canvas import draw
from retrieval.report.document import Block, Card, Details, Picture, Spot
from retrieval.report.galleries import Grasps
from retrieval.report.results import Results, capitalized, measure_label, method_label, percent


class Builder:
    """Results, the recording's grasps (none: no galleries) and the folder; figures are written on the way."""

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
        """A figure. spots: by the `gid` of what the figure shows, for each of its places a label and the grasps that
        results.json names there.
        """
        path = self.out / "figures" / name
        places = draw(path, make, *arguments)
        self.figures.append(path)
        clicked = [
            Spot(box, label, tuple(map(self._card, grasps)))
            for gid, asked in (spots or {}).items()
            for box, (label, grasps) in zip(places.get(gid, ()), asked, strict=False)
            if grasps and self.grasps
        ]
        return Picture(f"figures/{name}", alt, caption, tuple(clicked))

    def _card(self, shown: Any) -> Card:
        """A grasp of results.json: its gel images, its object, and the photo that was found."""
        own, found = self.grasps.get(shown["grasp_id"]), self.grasps.get(shown["found"])
        taken = found.object_id if found else shown["found"]
        touches = own.touches if own else ()
        gels = [(f"finger {ascii_lowercase[place]}", path) for place, path in enumerate(touches)]
        # Of a confusion they are those that speak most for it: of this seed the object itself may have come first.
        right = "found" if taken == shown["object_id"] else "found, wrong"
        photos = [
            (f"the object: {shown['object_id']}", own.photo if own else None),
            (f"{right}: {taken}", found.photo if found else None),
        ]
        return Card(f"Grasp {shown['grasp_id']}", (*gels, *photos))

    def any(self, *measures: str) -> bool:
        return any(self.results.summary(name, key) for name in self.results.methods for key in measures)

    def values(self, measure: str) -> str:
        """Values of all methods in words, for the text that stands for a figure."""
        found = [(method_label(name), self.results.summary(name, measure)) for name in self.results.methods]
        values = [f"{label} {percent(summary['value'][0])} %" for label, summary in found if summary]
        chance = next((summary["chance"][0] for _, summary in found if summary), None)
        return f"{measure_label(measure)}: {', '.join(values)}; chance {percent(chance)} %"

    def each(self, what: str, show: Callable[["Builder", str], Iterator[Block]]) -> Iterator[Block]:
        """Blocks of the main method, then folded those of the other ones that have `what`."""
        for name in self.results.learned:
            if self.results.data["methods"][name].get(what):
                blocks = tuple(show(self, name))
                folded = (Details(capitalized(method_label(name)), blocks),) if blocks else ()
                yield from blocks if name == self.main else folded
