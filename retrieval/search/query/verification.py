"""Verify that the object in the hand is the expected one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from retrieval.errors import BadInput
from retrieval.model.fusion_scorer import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.touch_reader import Stopwatch
from retrieval.model.touches import AnyImage, AnyTouches, parse_grasps
from retrieval.model.verification import (
    ACCEPT,
    ANOTHER_GRASP,
    MAX_GRASPS,
    REJECT,
    DecisionBounds,
    VerificationCalibration,
)
from retrieval.search.query.answer import gel_classes

if TYPE_CHECKING:
    from retrieval.model.posterior import Posterior
    from retrieval.search.query.searcher import Searcher

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


def calibration_of(searcher: Searcher) -> VerificationCalibration | None:
    """Return the calibration of verifications; None if the model has none, or the index lacks the model's cells."""
    has_cells = searcher.scorer.cell_dim == searcher.checkpoint.config.matcher.cell_dim
    return searcher.checkpoint.verification if has_cells and searcher.posterior else None


def expected_object(searcher: Searcher, expect: str, far: float) -> tuple[int, DecisionBounds, Posterior]:
    """Return the number of the expected object, the bounds of the decision and the posterior.

    Raises:
        BadInput: The catalogue lacks the object, the rate is too small for the model's validation objects, or the model
            has no error rates.
    """
    calibration, posterior = calibration_of(searcher), searcher.posterior
    if calibration is None or posterior is None:
        raise BadInput(
            f"{searcher.checkpoint.path} has no error rates for verification with this index: fit a model with at "
            "least 20 objects of 5 grasps (`retrieve train`: validation objects), and build its index with its cells"
        )
    bounds = calibration.bounds(far)
    number = int(searcher.folder_shard.objects.numbers_of([expect])[0])
    if number < 0:
        raise BadInput(f"the catalogue of {searcher.index} has no object {expect!r}; give the name of its folder")
    return number, bounds, posterior


def verify(
    searcher: Searcher,
    touches: AnyTouches,
    expect: str,
    *,
    far: float = 0.01,
    background: Sequence[AnyImage] | None = None,
) -> Verification:
    """Decide whether the object in the hand is the expected one; see `Searcher.verify`."""
    number, bounds, posterior = expected_object(searcher, expect, far)
    reader = searcher.reader
    grasps = parse_grasps(touches, reader.fingers)
    names = [[image.name for image in grasp] for grasp in grasps]
    codes = reader.encode(grasps, reader.no_contact_frames(background), Stopwatch())
    checked = gel_classes(searcher.gel_check, codes)
    partials, classes = codes.partials[checked == CONTACT][:MAX_GRASPS], checked.tolist()
    if NOT_A_GEL in classes or not len(partials):
        decision = NOT_A_GEL if NOT_A_GEL in classes else NO_CONTACT
        return Verification(expect, decision, names, classes, [], None)
    ratios = [
        float(posterior.log_ratio(searcher.folder_shard.object_logit(number, partials[:count], posterior), count))
        for count in range(1, len(partials) + 1)
    ]
    return Verification(expect, bounds.decide(np.array(ratios)), names, classes, ratios, bounds)
