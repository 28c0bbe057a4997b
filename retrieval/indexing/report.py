"""The report of `build-index`, for people and as JSON."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from retrieval.data.catalogue import SkippedPhoto

SHOWN, FEW = 20, 5
"""Number of printed lines for entries with a reason each, and for entries without."""


@dataclass(frozen=True)
class BuildReport:
    """The result of a build; `lines` yields it as text.

    Attributes:
        index: Folder of the index.
        generation: Name of the current generation.
        written: Whether a new generation was written; False if nothing changed.
        photos: Number of photos in the index.
        objects: Number of objects in the index.
        objects_from: Rule that names objects (`retrieval.data.naming`).
        examples: Some objects, each with one of its photos.
        warnings: Sentences about suspicious object names.
        embedded: Number of photos that were encoded now.
        skipped: Images that could not be read.
        ignored: Files that are not images, by their names.
        without_photo: Objects without a readable image.
        notes: Remarks on metadata.
        kind: Kind of index.
        reason: What changed since the previous index, and the number of candidates.
        recall: Measured recall and time of the vector index.
        candidates: Measured number of candidates; None if the checkpoint stores no touches to measure with.
        cells: Whether the index stores the cells of photos, for late interaction; None for a model without cells.
        shards: Shards of a sharded index, as in its manifest (`indexes.store.sharded`); None for an index folder.
        references: Numbers of reference touches (`touches`), their objects (`objects`), objects without photos
            (`touch_only`) and touches that were encoded now (`encoded`); None without references.
        enrolled: Numbers of enrolled touches (`touches`), their objects (`objects`), touches that were encoded now
            (`encoded`) and those that queries use (`usable`); None without enrolled touches.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "new-index")
    >>> report.written, report.objects, report.photos, report.skipped
    (True, 2, 4, [])
    """

    index: str
    generation: str
    written: bool
    photos: int
    objects: int
    objects_from: str
    examples: list[tuple[str, str]]
    warnings: list[str]
    embedded: int
    skipped: list[SkippedPhoto]
    ignored: list[str]
    without_photo: list[str]
    notes: list[str]
    kind: str
    reason: str
    recall: Any
    candidates: dict[str, Any] | None
    cells: bool | None
    shards: list[dict[str, Any]] | None = None
    references: dict[str, Any] | None = None
    enrolled: dict[str, int] | None = None

    def lines(self) -> Iterator[str]:
        """Yield the lines of the printed report."""
        counts = f"{self.embedded} embedded, {self.photos - self.embedded} unchanged"
        yield f"{self.index} ({self.generation}): {self.photos} photos of {self.objects} objects; {counts}"
        if not self.written:
            yield "nothing changed: the index stays as it is"
        yield f"{self.objects} objects by --objects-from {self.objects_from}, such as:"
        yield from (f"  {name} <- {photo}" for name, photo in self.examples)
        yield from (f"warning: {warning}" for warning in self.warnings)
        if references := self.references:
            yield (
                f"{references['touches']} reference touches of {references['objects']} objects, "
                f"{references['touch_only']} of them without a photo; {references['encoded']} embedded"
            )
        if enrolled := self.enrolled:
            left = enrolled["touches"] - enrolled["usable"]
            remark = f"; queries ignore {left} of them, which this model cannot compare" if left else ""
            yield (
                f"{enrolled['touches']} enrolled touches of {enrolled['objects']} objects are kept; "
                f"{enrolled['encoded']} embedded{remark}"
            )
        measured = ""
        if self.recall["queries"]:  # else exact by construction
            recall = self.recall
            measured = (
                f" Recall@{recall['at']} compared with exact search: {recall['value']:.3f}; a search takes "
                f"{recall['ms']:.3g} ms, exact search {recall['exact_ms']:.3g} ms."
            )
        for shard in self.shards or ():
            yield f"  {shard['folder']} ({shard['generation']}): {shard['photos']} photos of {shard['objects']} objects"
        yield f"candidate search: {self.kind}. {self.reason}{measured}"
        if self.cells is False:
            yield "no cells are stored (--cells stores them)"
        yield from _list_lines("remark(s)", self.notes)
        yield from _list_lines("file(s) ignored, not images", self.ignored, FEW)
        reasons: dict[str, list[str]] = {}
        for item in self.skipped:
            reasons.setdefault(item.reason, []).append(item.path)
        for reason, paths in reasons.items():
            yield from _list_lines(f"picture(s) left out: {reason}", paths, FEW)
        if count := len(self.without_photo):
            more = f" and {count - SHOWN} more (--json lists them all)" if count > SHOWN else ""
            yield (
                f"warning: {count} of {self.objects + count} objects are not in the index, because none of their "
                f"images can be read: {', '.join(self.without_photo[:SHOWN])}{more}"
            )


def _list_lines(what: str, items: Sequence[str], shown: int = SHOWN) -> Iterator[str]:
    if items:
        yield f"{len(items)} {what}:"
        yield from (f"  {item}" for item in items[:shown])
    if len(items) > shown:
        yield f"  and {len(items) - shown} more (--json lists them all)"
