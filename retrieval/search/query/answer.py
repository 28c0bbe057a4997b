"""What a query answers: a verdict, a ranking of objects with their probabilities, of what index, in how long."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.model.fusion_scorer import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.information import Information, information, unlisted_probability
from retrieval.model.posterior import Posterior

MATCH, NONE_OF_THESE, UNCALIBRATED = "match", "none of these", "uncalibrated"
CLEAR_PROBABILITY = 0.5
"""A ranking is clear where its first object, given that the catalogue has the object, has a larger probability: it is
likelier than all others together."""
EXIT_CODES = {MATCH: 0, UNCALIBRATED: 0, NONE_OF_THESE: 3, NO_CONTACT: 4, NOT_A_GEL: 5}
"""Of `retrieve query`, by verdict."""


@dataclass(frozen=True)
class NearestReference:
    """The reference touch of an object that is nearest to one of the grasps.

    touch: its gel images, paths in the catalogue. cosine: how near it is. adds: what all references of the object add
    to the logit that its photos alone give it, perhaps less than nothing; None for an object without photos, which its
    references alone have found.
    """

    touch: tuple[str, ...]
    cosine: float
    adds: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON."""
        return {**asdict(self), "touch": list(self.touch)}


_MATCH_FIELDS = ("rank", "object_id", "logit", "probability", "probability_if_present", "photo", "metadata")


@dataclass(frozen=True)
class Match:
    """One object of a ranking, shown by its best photo.

    * `logit`: what ranks. `probability`: P(object | touches, catalogue); over all objects and "none of these" it adds
      up to 1; None where the model was never calibrated.
    * `probability_if_present`: P(object | touches, the catalogue has the object); over all objects it adds up to 1;
      None where the model was never calibrated.
    * `photo`: path of the photo in the catalogue. `photo_path`: its absolute path on the disk. `metadata`: the user's
      own.
    * `reference`: the nearest reference touch of the object; None, and in no document, where it has none.

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
    reference: NearestReference | None = None
    probability_if_present: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON, without the absolute path: the document names the catalogue once."""
        said = {name: getattr(self, name) for name in _MATCH_FIELDS}
        return said if self.reference is None else {**said, "reference": self.reference.to_dict()}


@dataclass(frozen=True)
class QueryResult:
    """A verdict and a ranking.

    * `verdict`: "match": the best object is likelier than that the catalogue lacks it. "none of these": it is not; the
      ranking names the nearest. "no contact": no grasp felt anything. "not a gel image": one of the images is none, as
      far as the model knows gels. These two come without a ranking. "uncalibrated": a ranking of a model without
      probabilities.
    * `touches`: the gel images of each grasp by name, files by their paths. `grasps`: what each shows, "contact", "no
      contact" or "not a gel image"; only grasps with contact were judged.
    * `none_probability`: probability that the object is none of the catalogue's. `posterior`: the formula of the
      probabilities and its numbers (`retrieval.model.posterior`).
    * `more_grasps`: where the verdict is "none of these" and the ranking is clear (its first object is likelier than
      all others together, given that the catalogue has the object): further grasps like those so far after which the
      verdict is expected to be "match" (`Posterior.more_grasps`); None where too many are needed, and else.
    * `index`: what was searched, and with which model. `timing_ms`: milliseconds of this query by stage; of several
      objects at once (`Searcher.query_many`) each has an equal share.
    * `embeddings`: those of the grasps, (G, embedding_dim), where they were encoded in this process; no document holds
      them.

    >>> with retrieval.open("index") as searcher:
    ...     answer = searcher.query(["a.png", "b.png"])
    >>> answer.top == answer.results[0]
    True
    >>> answer.to_dict()["query"]
    {'touches': [['a.png', 'b.png']], 'grasps': ['contact']}
    """

    touches: list[list[str]]
    grasps: list[str]
    index: dict[str, Any]
    timing_ms: dict[str, float]
    verdict: str
    none_probability: float | None
    posterior: dict[str, Any] | None
    results: list[Match]
    more_grasps: int | None = None
    embeddings: NDArray[np.float32] | None = field(default=None, repr=False, compare=False)

    @property
    def top(self) -> Match | None:
        """The best object; None where nothing was ranked."""
        return self.results[0] if self.results else None

    @property
    def advice(self) -> str | None:
        """A sentence for people on how to get a clearer answer, where the verdict is "none of these"; else None."""
        best = self.top
        if self.verdict != NONE_OF_THESE or best is None or best.probability_if_present is None:
            return None
        references = "Reference touches" if best.reference is None else "More reference touches"
        if not is_clear(best.probability_if_present):
            return f"The ranking is not clear. {references} of its first objects would help."
        if self.more_grasps is None:
            return (
                "The ranking is clear, but more grasps would hardly change the verdict. "
                f"{references} of {best.object_id} would help."
            )
        like = "this one" if self.grasps.count(CONTACT) == 1 else "these"
        return f'Another grasp would help: {self.more_grasps} more like {like} would make the verdict "match".'

    @property
    def unlisted_probability(self) -> float | None:
        """Probability of all objects of the catalogue that `results` does not list; None without probabilities."""
        none = self.none_probability
        return (
            None if none is None else unlisted_probability(none, [match.probability or 0.0 for match in self.results])
        )

    @property
    def information(self) -> Information | None:
        """What the grasps told, what is left, and what a further grasp is expected to tell; None without
        probabilities.
        """
        said, none = self.posterior, self.none_probability
        if said is None or none is None:
            return None
        return information(
            Posterior(said["slope"], said["offset"], said["dependence"]),
            said["grasps"],
            none,
            [match.probability or 0.0 for match in self.results],
            objects=said["objects"],
            none_prior=said["none_prior"],
        )

    @classmethod
    def from_dict(cls, document: dict[str, Any]) -> "QueryResult":
        """Inverse of `to_dict`. Raises BadInput for another document."""
        try:
            matches = [_match(match, Path(document["index"]["catalogue"])) for match in document["results"]]
            asked = {name: document["query"][name] for name in ("touches", "grasps")}
            names = ("index", "timing_ms", "verdict", "none_probability", "posterior")
            others = {name: document[name] for name in names}
            others["more_grasps"] = document.get("more_grasps")  # a service's history holds documents without it
            return cls(**asked, results=matches, **others)
        except (KeyError, TypeError) as error:
            raise BadInput(f"this is not the document of `retrieve query --json`: {error!r}") from error

    def to_dict(self) -> dict[str, Any]:
        """The document of `retrieve query --json`."""
        told = self.information
        return {
            "query": {"touches": self.touches, "grasps": self.grasps},
            "index": self.index,
            "timing_ms": self.timing_ms,
            "verdict": self.verdict,
            "none_probability": self.none_probability,
            "unlisted_probability": self.unlisted_probability,
            "more_grasps": self.more_grasps,
            "advice": self.advice,
            "information": None if told is None else asdict(told),
            "posterior": self.posterior,
            "results": [match.to_dict() for match in self.results],
        }


def _match(said: dict[str, Any], catalogue: Path) -> Match:
    own = {name: value for name, value in said.items() if name != "reference"}
    reference = said.get("reference")
    if reference is not None:
        reference = NearestReference(**{**reference, "touch": tuple(reference["touch"])})
    return Match(**own, photo_path=catalogue / said["photo"], reference=reference)


def is_clear(probability_if_present: float) -> bool:
    """Whether a ranking whose first object has this probability is clear."""
    return probability_if_present > CLEAR_PROBABILITY


def verdict_sentence(result: QueryResult) -> str:
    """The verdict as a sentence for people, and which grasps were left out."""

    def grasps(shown: str) -> str:
        return ", ".join(str(number) for number, what in enumerate(result.grasps, start=1) if what == shown)

    if result.verdict == NO_CONTACT:
        return "no contact: the gels look untouched; close the jaws on the object, or press harder, and query again"
    if result.verdict == NOT_A_GEL:
        return (
            f"not a gel image: what was given for grasp {grasps(NOT_A_GEL)} does not look like a gel that the model "
            f"knows (trained on: {result.index['trained_on']}); give gel images, or a model trained on this sensor"
        )
    best, none = result.results[0], result.none_probability
    remark = f"; grasps without contact were left out: {grasps(NO_CONTACT)}" if NO_CONTACT in result.grasps else ""
    if result.verdict == MATCH:
        return f"match: {best.object_id}, probability {best.probability:.2f}; none of these: {none:.2f}{remark}"
    if result.verdict == NONE_OF_THESE:
        return (
            f"none of these: the catalogue lacks the object with probability {none:.2f}; if it has the object, this is "
            f"{best.object_id} with probability {best.probability_if_present:.2f}{remark}. {result.advice}"
        )
    return f"uncalibrated: {best.object_id} comes first; this model has no probabilities{remark}"
