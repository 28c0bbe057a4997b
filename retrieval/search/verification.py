"""The decision whether the object in the hand is the expected one."""

from dataclasses import asdict, dataclass
from typing import Any

from retrieval.model.gel_check import NO_CONTACT, NOT_A_GEL
from retrieval.model.verification import ACCEPT, ANOTHER_GRASP, REJECT, DecisionBounds

VERIFY_EXIT_CODES = {ACCEPT: 0, REJECT: 3, NO_CONTACT: 4, NOT_A_GEL: 5, ANOTHER_GRASP: 6}
"""Exit codes of `retrieve verify` by decision."""


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

    >>> import retrieval
    >>> retrieval.Verification("mug", "reject", [["a.png"]], ["contact"], [-3.2], None).is_accepted
    False
    """

    expected: str
    decision: str
    touches: list[list[str]]
    grasps: list[str]
    log_ratios: list[float]
    bounds: DecisionBounds | None

    @property
    def is_accepted(self) -> bool:
        """Whether the object is accepted as the expected one."""
        return self.decision == ACCEPT

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
