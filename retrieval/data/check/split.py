"""Checks of a split: objects or sequences in two of its parts."""

from collections import defaultdict
from collections.abc import Iterable, Sequence

from retrieval.console.output import abbreviate_list
from retrieval.data.check.pictures import Finding
from retrieval.data.dataset import Grasp, Split
from retrieval.errors import DatasetError


def check_split(grasps: Sequence[Grasp], split: Split) -> Iterable[Finding]:
    """Yield findings about objects and sequences in two parts of a split, and objects in none."""
    parts = {"train": split.train, "validation": split.validation, "test": split.test}
    part_of: dict[str, set[str]] = defaultdict(set)
    for part, objects in parts.items():
        for name in objects:
            part_of[name].add(part)
    sides: dict[str, set[str]] = defaultdict(set)
    for grasp in grasps:
        if grasp.sequence_id is not None:
            sides[grasp.sequence_id] |= part_of.get(grasp.object_id, set())
    recorded = {grasp.object_id for grasp in grasps}
    shared, cut = ({name for name, in_parts in table.items() if len(in_parts) > 1} for table in (part_of, sides))
    for severity, kind, text, names in (
        ("error", "split-objects", "shares {} object(s)", shared),
        ("error", "split-sequences", "cuts {} sequence(s) in two, so that neighbouring frames are on both sides", cut),
        ("warning", "split-unknown", "names {} object(s) not recorded", part_of.keys() - recorded),
        ("warning", "split-absent", "leaves out {} object(s)", recorded - part_of.keys()),
    ):
        if names:
            yield Finding(severity, kind, f"the split {text.format(len(names))}: {abbreviate_list(sorted(names))}")


def require_fit(split: Split, grasps: Sequence[Grasp]) -> None:
    """Check that a split fits a recording.

    Raises:
        DatasetError: Parts of the split share an object or a sequence, or a part has fewer than two objects in the
            recording.
    """
    for finding in check_split(grasps, split):
        if finding.severity == "error":
            raise DatasetError(f"{finding.message}; every object and sequence must be in one part of the split")
    for part in ("train", "validation"):
        count = len({grasp.object_id for grasp in split.select(grasps, part)})
        if count < 2 and (part == "train" or split.validation):
            raise DatasetError(
                f"pairs need at least 2 objects in the {part} part of the split; the recording has {count} of them"
            )
