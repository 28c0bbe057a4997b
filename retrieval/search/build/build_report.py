"""What `build-index` did and understood, for people and for JSON."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePosixPath
from typing import Any

from retrieval.data.folder_walk import SkippedPhoto

SHOWN, FEW = 20, 5
"""Lines to show on a terminal of what has a reason each, and of what has not."""


@dataclass(frozen=True)
class BuildReport:
    """What a build did and what it understood; `lines` says it to people.

    * `written`: False where nothing had changed, so that the generation stayed as it was.
    * `objects_from`: the rule that names objects (`retrieval.data.naming`). `per_object`: least, median and largest
      number of their photos. `examples`: some objects, each with a photo of it. `warnings`: sentences on what looks wrong
      about the objects.
    * `photos`, `objects`: how many the index holds. Of the photos `embedded` were encoded now and `reused` were not. Of
      these `renamed` had another name in the index before, `re_embedded` have a new embedding made of their old half, and
      `resumed` had been embedded by a build that was cut off.
    * `removed`: photos that the index held before and the catalogue no longer does.
    * `unread`: photos whose files were not read, for they look as they did when an earlier build read them
      (`retrieval.search.build.stat_cache`).
    * `skipped`: pictures that could not be read. `ignored`: files that are no pictures by name. `left_out`: how many of
      both for each reason. `without_photo`: objects all of whose pictures were skipped. `notes`: remarks on metadata.
    * `kind`, `reason`, `recall`, `candidates`: how the index is searched and why (`retrieval.search.build.operating`);
      `candidates` is None where the checkpoint has nothing to measure them with.
    * `partial_error`: largest rounding of a stored half. `seconds`: time of decoding and encoding alone.
    * `shards`: those of a cluster, as its manifest names them (`indexes.store.sharded`); None for an index folder.
    * `references`: how many reference touches of how many objects, how many of these have no photo (`alone`), how many
      touches were encoded now, and who says what they are worth (`by`); None where there are none.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "new-index", quiet=True)
    >>> report.written, report.objects, report.photos, report.skipped
    (True, 2, 4, [])
    """

    index: str
    generation: str
    written: bool
    model: str
    photos: int
    objects: int
    objects_from: str
    per_object: dict[str, float]
    examples: list[tuple[str, str]]
    warnings: list[str]
    embedded: int
    reused: int
    renamed: int
    resumed: int
    re_embedded: int
    removed: int
    unread: int
    skipped: list[SkippedPhoto]
    ignored: list[str]
    without_photo: list[str]
    notes: list[str]
    kind: str
    reason: str
    recall: Any
    candidates: dict[str, Any] | None
    partial_error: float
    seconds: float
    shards: list[dict[str, Any]] | None = None
    references: dict[str, Any] | None = None

    @property
    def left_out(self) -> dict[str, int]:
        """How many files were left out for each reason, the most frequent first."""
        endings = (PurePosixPath(name).suffix.lower() or "without an ending" for name in self.ignored)
        reasons = [f"no picture by name ({ending})" for ending in endings]
        reasons += [item.reason.split(":")[0] for item in self.skipped]
        return dict(Counter(reasons).most_common())

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        said = asdict(self) | {"left_out": self.left_out}
        if self.references is None:
            del said["references"]
        return said

    def lines(self) -> Iterator[str]:
        """The report for people."""
        rate = f", {self.embedded / self.seconds:.1f} photos per second" if self.embedded else ""
        renamed = f" ({self.renamed} under another name)" if self.renamed else ""
        resumed = f", {self.resumed} from a build that was cut off" if self.resumed else ""
        re_embedded = f", {self.re_embedded} with new embeddings of their old halves" if self.re_embedded else ""
        unchanged = self.reused - self.resumed - self.re_embedded
        yield (
            f"{self.index} ({self.generation}): {self.photos} photos of {self.objects} objects; "
            f"{self.embedded} embedded{resumed}{re_embedded}, {unchanged} unchanged{renamed}, {self.removed} removed{rate}"
        )
        if not self.written:
            yield "nothing changed: the index stays as it is"
        if self.unread:
            yield (
                f"{self.unread} photos are taken to be what they were, by size, times and inode of their files; the "
                f"other {self.photos - self.unread} were read (--verify reads all)"
            )
        each = " / ".join(f"{self.per_object[name]:g}" for name in ("min", "median", "max"))
        yield f"{self.objects} objects by --objects-from {self.objects_from}; photos of each: {each} (min, median, max)"
        yield from (f"  {name} <- {photo}" for name, photo in self.examples)
        yield from (f"warning: {doubt}" for doubt in self.warnings)
        if told := self.references:
            yield (
                f"{told['touches']} reference touches of {told['objects']} objects, {told['alone']} of which have no "
                f"photo; {told['encoded']} embedded; what they are worth is told by {told['by']}"
            )
        measured = ""
        if self.recall["queries"]:  # else exact by construction
            at, recall = self.recall["at"], self.recall["value"]
            measured = f" Recall@{at} against exact search: {recall:.3f}, measured on this index."
        for shard in self.shards or ():
            yield f"  {shard['folder']} ({shard['generation']}): {shard['photos']} photos of {shard['objects']} objects"
        yield f"candidate search: {self.kind}. {self.reason}{measured}"
        yield f"halves are stored as float16, each within {self.partial_error:.2g} of the float32 one"
        yield from _some("remark(s)", self.notes)
        if self.left_out:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
            yield f"{sum(self.left_out.values())} file(s) left out: {reasons}"
        yield from _some("ignored, no picture(s) by name", self.ignored, FEW)
        yield from _some("photo(s) skipped", [f"{item.path}: {item.reason}" for item in self.skipped])
        if self.without_photo:
            yield f"warning: {self.missing()}"

    def missing(self) -> str:
        """A sentence that counts and names the objects without a photo."""
        count = len(self.without_photo)
        more = f" and {count - SHOWN} more (--json lists them all)" if count > SHOWN else ""
        return (
            f"{count} of {self.objects + count} objects are not in the index, for none of their pictures can be read: "
            f"{', '.join(self.without_photo[:SHOWN])}{more}"
        )


def _some(what: str, items: Sequence[str], shown: int = SHOWN) -> Iterator[str]:
    if items:
        yield f"{len(items)} {what}:"
        yield from (f"  {item}" for item in items[:shown])
    if len(items) > shown:
        yield f"  and {len(items) - shown} more (--json lists them all)"
