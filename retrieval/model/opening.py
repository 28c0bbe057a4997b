"""The opening of the jaws as evidence, next to gel images: how far a gripper is open on an object.

Gel images show relief, and little of an object's size. A catalogue object has an opening if one was measured with its
reference touches. For one grasp with the log opening x, and the log openings r of the object's references:

    N(x; m, s)      density of a normal distribution with mean m and standard deviation s
    p0(x)           = (1 - floor) N(x; mean, spread) + floor * uniform density over `RANGE_MM`    any object
    log ratio       = log mean over r of [(1 - floor) N(x; r, width) / p0(x) + floor]

The sum over grasps is a log likelihood ratio of this object to an object that the catalogue lacks. It is divided by
1 + dependence * (grasps - 1), as match logits are (`retrieval.model.posterior`), and added to the object's log ratio.
It is 0 for a grasp or an object without an opening. mean and spread are those of validation objects; width and floor
maximise the likelihood of their further grasps. `floor` is the part of grasps whose opening says nothing, such as a
grasp of another side of the object: no opening excludes an object.
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
_LOG_RANGE = math.log(RANGE_MM[1] / RANGE_MM[0])


@dataclass(frozen=True)
class OpeningCalibration:
    """Parameters of the formula above.

    Attributes:
        mean: Mean log opening, in log millimetres.
        spread: Standard deviation of log openings of different objects.
        width: Standard deviation of the log opening among grasps of an object.
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

    def log_ratios(self, openings_mm: ArrayLike, references_mm: ArrayLike, starts: Numbers) -> Floats:
        """Return the log likelihood ratios (G, O) of grasps to objects; 0 where either has no opening.

        Args:
            openings_mm: (G,) openings of the grasps, NaN where none was measured.
            references_mm: (R,) openings of the references, NaN where none was measured.
            starts: (O,) place of each object's first reference.
        """
        logs, known = (np.log(np.asarray(values, dtype=np.float64)) for values in (openings_mm, references_mm))
        outside = math.log(self.floor) - math.log(_LOG_RANGE)
        any_object = np.logaddexp(math.log1p(-self.floor) + _log_normal(logs, self.mean, self.spread), outside)
        same = math.log1p(-self.floor) + _log_normal(logs[:, None], known, self.width) - any_object[:, None]
        measured = np.isfinite(known)
        terms = np.where(measured, np.logaddexp(same, math.log(self.floor)), -np.inf)
        counts = np.add.reduceat(measured, starts, dtype=np.int64)
        ratios = np.logaddexp.reduceat(terms, starts, axis=1) - np.log(np.maximum(counts, 1))
        return np.where((counts > 0) & np.isfinite(logs)[:, None], ratios, 0.0)


def _log_normal(x: Floats, mean: float | Floats, spread: float) -> Floats:
    return np.asarray(-0.5 * ((x - mean) / spread) ** 2 - math.log(spread) - 0.5 * math.log(2 * math.pi))
