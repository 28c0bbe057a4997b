"""Splits that were published row by row, with frames of one video in several parts, as splits of whole sequences.

A row names a grasp. Its object, and the sequence of the object, can be in several parts. Such a split measures
memorisation, because neighbouring frames are nearly the same. It is not stored; a note states the affected fraction of
its test rows. It is replaced by `<name>-whole`: sequences with test rows only are the test part, all others the
training part.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

Split = Mapping[str, Sequence[str]]


class RowSplit:
    """A published split, read row by row. Memory grows with the number of objects, not of rows."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._parts: dict[str, Counter[str]] = defaultdict(Counter)  # part -> object -> rows
        self._sequence: dict[str, str] = {}

    def add(self, part: str, object_id: str, sequence_id: str) -> None:
        """Add one row.

        Args:
            part: train, validation or test.
            object_id: Its object.
            sequence_id: Sequence of the object.
        """
        self._parts[part][object_id] += 1
        self._sequence[object_id] = sequence_id

    def object_splits(self) -> tuple[dict[str, Split], list[str]]:
        """Return the resulting splits of whole sequences by name, and notes for the user."""
        if len(self._parts) < 2:
            return {}, []
        parts_of: dict[str, set[str]] = defaultdict(set)
        for part, objects in self._parts.items():
            for object_id in objects:
                parts_of[self._sequence[object_id]].add(part)
        if all(len(parts) == 1 for parts in parts_of.values()):
            return {self.name: {part: sorted(objects) for part, objects in self._parts.items()}}, []
        test = self._parts["test"]
        leaked = sum(rows for object_id, rows in test.items() if len(parts_of[self._sequence[object_id]]) > 1)
        whole: Split = {
            "train": sorted(name for name, sequence in self._sequence.items() if parts_of[sequence] != {"test"}),
            "test": sorted(name for name, sequence in self._sequence.items() if parts_of[sequence] == {"test"}),
        }
        replacement: dict[str, Split] = {f"{self.name}-whole": whole} if whole["test"] and whole["train"] else {}
        remark = f"; {self.name}-whole tests sequences that are not in its training part" if replacement else ""
        return replacement, [
            f"LEAK: the published split {self.name!r} has {sum(len(parts) > 1 for parts in parts_of.values())} of "
            f"{len(parts_of)} sequences in two parts, and {leaked / max(test.total(), 1):.0%} of its test rows are "
            f"frames of training sequences: a score on them measures memorisation; it is not stored{remark}"
        ]
