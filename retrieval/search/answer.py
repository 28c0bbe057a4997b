"""The result of a query: a verdict and a ranking of objects with probabilities, with the index and the timing."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from retrieval.errors import BadInput
from retrieval.model.gel_check import NO_CONTACT, NOT_A_GEL
from retrieval.model.verification import ACCEPT, ANOTHER_GRASP, REJECT, DecisionBounds

MATCH, NONE_OF_THESE, UNCALIBRATED = "match", "none of these", "uncalibrated"
CLEAR_PROBABILITY = 0.5
"""A ranking is clear if its first object has a larger probability, given that the catalogue has the object: it is then
more likely than all others together."""
EXIT_CODES = {MATCH: 0, UNCALIBRATED: 0, NONE_OF_THESE: 3, NO_CONTACT: 4, NOT_A_GEL: 5}
"""Exit codes of `retrieve query` by verdict."""
VERIFY_EXIT_CODES = {ACCEPT: 0, REJECT: 3, NO_CONTACT: 4, NOT_A_GEL: 5, ANOTHER_GRASP: 6}
"""Exit codes of `retrieve verify` by decision."""


@dataclass(frozen=True)
class NearestReference:
    """The reference touch of an object with the largest cosine with one of the grasps.

    Attributes:
        touch: Paths of its gel images in the catalogue; those of an enrolled touch are in the folder of the index.
        digests: SHA-256 of these files in the index.
        cosine: Cosine with the nearest grasp.
        adds: Difference that all references of the object, with their openings, make to the logit of its photos,
            perhaps negative; None for an object without photos.
        is_enrolled: Whether it is an enrolled touch.
    """

    touch: tuple[str, ...]
    digests: tuple[str, ...]
    cosine: float
    adds: float | None
    is_enrolled: bool = False


class Enrolment(NamedTuple):
    """The result of an enrolment.

    Attributes:
        object_id: The object, as the index names it.
        touches: Number of its enrolled touches.
        added: Number of those that were enrolled now.

    >>> with retrieval.open("index") as searcher:
    ...     searcher.enrol("ladle", ["a.png", "b.png"]).added
    1
    >>> retrieval.remove_enrolled("index", "ladle")
    ('ladle', 1)
    """

    object_id: str
    touches: int
    added: int


@dataclass(frozen=True)
class Match:
    """One object of a ranking, with its best photo.

    Attributes:
        rank: Rank from 1.
        object_id: The object.
        logit: Match logit, which determines the rank.
        probability: P(object | touches, catalogue), which sums to 1 over all objects and "none of these"; None if the
            model is not calibrated.
        photo: Path of the best photo in the catalogue. An object that was only enrolled has no photo, and this is the
            path of a gel image in the folder of the index (`photo_is_enrolled`).
        photo_digest: SHA-256 of the photo in the index. The file may have changed since.
        metadata: The user's metadata of the photo.
        photo_path: Absolute path of the photo on the disk.
        reference: Nearest reference touch of the object; None, and absent from JSON, if it has none.
        probability_if_present: P(object | touches, the catalogue has the object), which sums to 1 over all objects;
            None if the model is not calibrated.

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
    photo_digest: str
    metadata: dict[str, Any]
    photo_path: Path
    reference: NearestReference | None = None
    probability_if_present: float | None = None

    @property
    def photo_is_enrolled(self) -> bool:
        """Whether `photo` is a gel image of an enrolled touch."""
        return self.reference is not None and self.reference.is_enrolled and self.photo == self.reference.touch[0]

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON, without the absolute path: the document names the catalogue once."""
        document = asdict(self)
        left_out = {"photo_path", *(["reference"] if self.reference is None else [])}
        return {name: value for name, value in document.items() if name not in left_out}


@dataclass(frozen=True)
class QueryResult:
    """A verdict and a ranking.

    Attributes:
        touches: Names of the gel images of each grasp; for files, their paths.
        grasps: Gel check of each grasp: "contact", "no contact" or "not a gel image". Only grasps with contact are
            used.
        index: The searched index and the model.
        timing_ms: Milliseconds of this query by stage; `Searcher.query_many` divides them equally among its objects.
        verdict: "match": the best object is more likely than its absence from the catalogue. "none of these": the
            absence is at least as likely as the best object; the ranking lists the nearest objects. "no contact": no
            grasp shows contact. "not a gel image": nor does any, and an image is unlike the gels of the model. These
            two have no ranking. "uncalibrated": the model has no probabilities.
        none_probability: Probability that the object is out of catalogue.
        posterior: Formula of the probabilities and its numbers (`retrieval.model.posterior`).
        results: The ranking.
        opening_mm: Opening of the jaws in each grasp, None where none was measured; None if there is no opening at all.

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
    opening_mm: list[float | None] | None = None

    @property
    def top(self) -> Match | None:
        """The best object; None without a ranking."""
        return self.results[0] if self.results else None

    @property
    def advice(self) -> str | None:
        """A sentence on how to get a clearer answer, if the verdict is "none of these"; else None."""
        best = self.top
        if self.verdict != NONE_OF_THESE or best is None or best.probability_if_present is None:
            return None
        references = "Reference touches" if best.reference is None else "More reference touches"
        if best.probability_if_present <= CLEAR_PROBABILITY:
            return f"The ranking is not clear. {references} of its first objects would help."
        return f"The ranking is clear. {references} of {best.object_id}, or further grasps, would help."

    @property
    def unlisted_probability(self) -> float | None:
        """Probability of all objects that `results` does not list; None without probabilities."""
        if self.none_probability is None:
            return None
        return max(0.0, 1 - math.fsum((self.none_probability, *(match.probability or 0.0 for match in self.results))))

    @classmethod
    def from_dict(cls, document: dict[str, Any]) -> "QueryResult":
        """Return the result of a document; the inverse of `to_dict`. Raises BadInput for another document."""
        try:
            folders = [Path(document["index"][name]) for name in ("catalogue", "path")]
            matches = [_match(match, *folders) for match in document["results"]]
            query = {name: document["query"][name] for name in ("touches", "grasps")}
            names = ("index", "timing_ms", "verdict", "none_probability", "posterior")
            query["opening_mm"] = document["query"].get("opening_mm")
            return cls(**query, results=matches, **{name: document[name] for name in names})
        except (KeyError, TypeError) as error:
            raise BadInput(f"this is not a document of `retrieve query --json`: {error!r}") from error

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `retrieve query --json`."""
        openings = {} if self.opening_mm is None else {"opening_mm": self.opening_mm}
        return {
            "query": {"touches": self.touches, "grasps": self.grasps, **openings},
            "index": self.index,
            "timing_ms": self.timing_ms,
            "verdict": self.verdict,
            "none_probability": self.none_probability,
            "unlisted_probability": self.unlisted_probability,
            "advice": self.advice,
            "posterior": self.posterior,
            "results": [match.to_dict() for match in self.results],
        }


def _match(document: dict[str, Any], catalogue: Path, index: Path) -> Match:
    own = {name: value for name, value in document.items() if name != "reference"}
    reference = document.get("reference")
    if reference is not None:
        reference = NearestReference(**{**reference, **{name: tuple(reference[name]) for name in ("touch", "digests")}})
    match = Match(**own, photo_path=catalogue / document["photo"], reference=reference)
    return replace(match, photo_path=index / match.photo) if match.photo_is_enrolled else match


def verdict_sentence(result: QueryResult) -> str:
    """Return the verdict as a sentence, with the grasps that were left out."""

    def grasps(shown: str) -> str:
        return ", ".join(str(number) for number, what in enumerate(result.grasps, start=1) if what == shown)

    if result.verdict == NO_CONTACT:
        return "no contact: the gels show no contact; close the jaws on the object, or press harder, and query again"
    if result.verdict == NOT_A_GEL:
        return (
            f"not a gel image: an image of grasp {grasps(NOT_A_GEL)} does not look like the gels of the model (trained "
            f"on: {result.index['trained_on']}); give gel images, or use a model trained on this sensor"
        )
    best, none = result.results[0], result.none_probability
    unused = [f"{shown}: {grasps(shown)}" for shown in (NO_CONTACT, NOT_A_GEL) if shown in result.grasps]
    remark = f"; grasps that were left out ({', '.join(unused)})" if unused else ""
    if result.verdict == MATCH:
        return f"match: {best.object_id}, probability {best.probability:.2f}; none of these: {none:.2f}{remark}"
    if result.verdict == NONE_OF_THESE:
        return (
            f"none of these: the catalogue lacks the object with probability {none:.2f}; if it has the object, this is "
            f"{best.object_id} with probability {best.probability_if_present:.2f}{remark}. {result.advice}"
        )
    return f"uncalibrated: {best.object_id} ranks first; this model has no probabilities{remark}"


@dataclass(frozen=True)
class Verification:
    """The decision whether the object in the hand is the expected one.

    Attributes:
        expected: The expected object.
        decision: "accept", "reject", "another grasp", "no contact" or "not a gel image".
        touches: Names of the gel images of each grasp.
        grasps: Gel check of each grasp, as in `QueryResult`. Only grasps with contact are used.
        log_ratios: Log likelihood ratio of the expected object to an object that the catalogue lacks, after the first
            grasp with contact, the first two, and so on.
        bounds: The bounds of the decision, and their error rates on validation objects.

    >>> retrieval.Verification("mug", "no contact", [["a.png"]], ["no contact"], [], None).sentence
    'no contact: the gels show no contact; close the jaws on the object, or press harder'
    """

    expected: str
    decision: str
    touches: list[list[str]]
    grasps: list[str]
    log_ratios: list[float]
    bounds: DecisionBounds | None

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `retrieve verify --json`."""
        return asdict(self)

    @property
    def sentence(self) -> str:
        """The decision as a sentence."""
        if self.decision == NO_CONTACT:
            return "no contact: the gels show no contact; close the jaws on the object, or press harder"
        if self.decision == NOT_A_GEL or self.bounds is None:
            return "not a gel image: an image does not look like the gels of the model"
        bounds, ratio = self.bounds, self.log_ratios[-1]
        if self.decision == ANOTHER_GRASP:
            bound = f"{bounds.reject:.1f} rejects, {bounds.accept:.1f} accepts"
            return f"another grasp: the log likelihood ratio of {self.expected} is {ratio:.1f} ({bound})"
        if self.decision == ACCEPT:
            rate = bounds.false_accepts
            return (
                f"accept: {self.expected}, log likelihood ratio {max(self.log_ratios):.1f} (accepted from "
                f"{bounds.accept:.1f}); false-accept rate {rate.value:.2g} [{rate.low:.2g}, {rate.high:.2g}]"
            )
        rate = bounds.false_rejects
        return (
            f"reject: not {self.expected}, log likelihood ratio {ratio:.1f}; "
            f"false-reject rate {rate.value:.2g} [{rate.low:.2g}, {rate.high:.2g}]"
        )
