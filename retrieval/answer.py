"""What a query answers: a ranking of objects, of what index, in how long."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Match:
    """One object of a ranking, by its best photo.

    probability: None where the model was never calibrated. photo: its path in the catalogue; photo_path: on the disk,
    absolute. metadata: the user's own.

    >>> with retrieval.open("index") as searcher:
    ...     best = searcher.query(["a.png", "b.png"]).top
    >>> best.rank, best.photo_path.is_absolute(), best.photo_path.name == best.photo.split("/")[-1]
    (1, True, True)
    """

    rank: int
    object_id: str
    logit: float
    probability: float | None
    photo: str
    metadata: dict[str, Any]
    photo_path: Path

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON, without the absolute path: the document names the catalogue once."""
        return {name: value for name, value in asdict(self).items() if name != "photo_path"}


@dataclass(frozen=True)
class QueryResult:
    """A ranking. verdict: "match", "no match" (the best is below the reject threshold) or "uncalibrated".

    touches: the gel images of each grasp by name, files by their paths. index: what was searched with what.
    timing_ms: by stage, of this query; of several at once (`Searcher.query_many`) an equal share for each.

    >>> with retrieval.open("index") as searcher:
    ...     answer = searcher.query(["a.png", "b.png"])
    >>> answer.top == answer.results[0]
    True
    >>> answer.to_dict()["query"]
    {'touches': [['a.png', 'b.png']]}
    """

    touches: list[list[str]]
    index: dict[str, Any]
    timing_ms: dict[str, float]
    verdict: str
    results: list[Match]

    @property
    def top(self) -> Match:
        """The best object."""
        return self.results[0]

    def to_dict(self) -> dict[str, Any]:
        """The document of `retrieve query --json`."""
        return {
            "query": {"touches": self.touches},
            "index": self.index,
            "timing_ms": self.timing_ms,
            "verdict": self.verdict,
            "results": [match.to_dict() for match in self.results],
        }
