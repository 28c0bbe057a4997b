"""Splits that were published row by row, frames of one video on both sides: what they say of whole objects.

A row names a grasp; its object, and the sequence that the object was recorded in, may stand on several sides. Then the
split judges what is remembered: neighbouring frames are nearly alike. Such a split is not kept; a sentence says how
much of its test part it touches, and what is left of it goes by the name `<name>-whole`: the sequences that only test
rows name are tested, all the others are trained on.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

Split = Mapping[str, Sequence[str]]


class RowSplit:
    """A published split, row after row; memory grows with its objects, not with its rows."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._parts: dict[str, Counter[str]] = defaultdict(Counter)  # part -> object -> rows
        self._sequence: dict[str, str] = {}

    def add(self, part: str, object_id: str, sequence_id: str) -> None:
        """One row: its part (train, validation, test), its object and that object's sequence."""
        self._parts[part][object_id] += 1
        self._sequence[object_id] = sequence_id

    def object_splits(self) -> tuple[dict[str, Split], list[str]]:
        """The splits of whole sequences that come of it, by name, and what is to be said of it."""
        if len(self._parts) < 2:
            return {}, []
        sides: dict[str, set[str]] = defaultdict(set)
        for part, objects in self._parts.items():
            for object_id in objects:
                sides[self._sequence[object_id]].add(part)
        if all(len(parts) == 1 for parts in sides.values()):
            return {self.name: {part: sorted(objects) for part, objects in self._parts.items()}}, []
        test = self._parts["test"]
        leaked = sum(rows for object_id, rows in test.items() if len(sides[self._sequence[object_id]]) > 1)
        whole: Split = {
            "train": sorted(name for name, at in self._sequence.items() if sides[at] != {"test"}),
            "test": sorted(name for name, at in self._sequence.items() if sides[at] == {"test"}),
        }
        kept: dict[str, Split] = {f"{self.name}-whole": whole} if whole["test"] and whole["train"] else {}
        rest = f"; {self.name}-whole tests the sequences that it does not train on" if kept else ""
        return kept, [
            f"LEAK: the published split {self.name!r} has {sum(len(parts) > 1 for parts in sides.values())} of "
            f"{len(sides)} sequences on two sides, and {leaked / max(test.total(), 1):.0%} of its test rows are frames "
            f"of sequences that it trains on: a score on them shows what is remembered; it is not kept{rest}"
        ]
