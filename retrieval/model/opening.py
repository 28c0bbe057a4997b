"""The opening of the jaws as evidence, next to gel images: how far a gripper is open on an object.

Gel images show relief, and little of an object's size. A catalogue object has an opening if one was measured with its
reference touches. For one grasp with the log opening x, and the log openings r of the object's references:

    p0(x)      = (1 - floor) normal(x; mean, spread) + floor * uniform(x; RANGE_MM)    density for any object
    log ratio  = log mean over r of [(1 - floor) Cauchy(x; r, width) / p0(x) + floor]

The sum over grasps is a log likelihood ratio of this object to an object that the catalogue lacks. It is divided by
1 + dependence * (grasps - 1), as match logits are (`retrieval.model.posterior`), and added to the object's log ratio.
It is 0 for a grasp or an object without an opening.

mean and spread are those of recorded objects. width and floor maximise the likelihood of their further grasps. Half of
the grasps of an object differ by less than 4 %, others touch another side. Therefore the tails are heavy (with normal
ones fewer unseen simulated objects were found), and in the part `floor` of the grasps the opening says nothing: no
opening excludes an object.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from _touch_retrieval.documents import Positive, check_fields
from retrieval.data.opening import RANGE_MM
from retrieval.errors import BadInput

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class OpeningCalibration:
    """Parameters of the formula above.

    Attributes:
        mean: Mean log opening, in log millimetres.
        spread: Standard deviation of log openings of different objects.
        width: Half width at half maximum of the log opening among grasps of an object.
        floor: Part of the grasps whose opening says nothing.
        objects: Number of objects of the fit.
        touches: Number of their query touches.
    """

    mean: float
    spread: Positive
    width: Positive
    floor: Annotated[float, Meta(gt=0, lt=1)]
    objects: Annotated[int, Meta(ge=0)]
    touches: Annotated[int, Meta(ge=0)]

    def __post_init__(self) -> None:
        check_fields(self, "opening", BadInput)

    @np.errstate(invalid="ignore")  # NaN, of what was not measured
    def log_ratios(self, openings_mm: ArrayLike, references_mm: ArrayLike, starts: Numbers) -> Floats:
        """Return the log likelihood ratios (G, O) of grasps to objects; 0 where either has no opening.

        Args:
            openings_mm: (G,) openings of the grasps, NaN where none was measured.
            references_mm: (R,) openings of the references, NaN where none was measured.
            starts: (O,) place of each object's first reference.
        """
        logs, known = (np.log(np.asarray(values, dtype=np.float64)) for values in (openings_mm, references_mm))
        measured, of_grasp = np.isfinite(known), self.log_density(logs[:, None], known)
        terms = np.where(measured, of_grasp - self.log_density(logs)[:, None], -np.inf)
        counts = np.add.reduceat(measured, starts, dtype=np.int64)
        ratios = np.logaddexp.reduceat(terms, starts, axis=1) - np.log(np.maximum(counts, 1))
        return np.where((counts > 0) & np.isfinite(logs)[:, None], ratios, 0.0)

    @np.errstate(invalid="ignore")
    def log_density(self, logs: Floats, references: Floats | None = None) -> Floats:
        """Return the log density of log openings: of any object, or of the object with this reference."""
        normal = -0.5 * ((logs - self.mean) / self.spread) ** 2 - math.log(self.spread * math.sqrt(2 * math.pi))
        uniform = math.log(self.floor / math.log(RANGE_MM[1] / RANGE_MM[0]))
        any_object = np.asarray(np.logaddexp(math.log1p(-self.floor) + normal, uniform))
        if references is None:
            return any_object
        cauchy = -np.log1p(((logs - references) / self.width) ** 2) - math.log(math.pi * self.width)
        return np.asarray(np.logaddexp(math.log1p(-self.floor) + cauchy, math.log(self.floor) + any_object))
