"""Calibration of reference touches: touches of catalogue objects with which a query's touch is compared.

    c(g, o) = 1 / SHARPNESS * log mean exp(SHARPNESS * cosine)   grasp g with object o, over the references of o
    C(o)    = sum of c(g, o) over the grasps

The cosine is that of the contrastive embeddings of two touches. The references of an object are equally likely, so a
copy of a reference changes nothing. C is calibrated like match logits (`retrieval.model.posterior`), on objects some of
whose touches are references and the others queries:

    an object with touches only       log likelihood ratio = w_a C + offset_a
    an object with photos, too        log likelihood ratio = w_b (l_b + weight C) + offset_b

w_a, offset_a and w_b, offset_b are those of two posteriors, and l_b is the object's logit over its photos by the second
one. The second is fitted on the sums, because photo and reference are compared with the same touch and are not
independent evidence. Each ratio is converted to the logit of an object with photos only and the same ratio. One formula
then ranks all objects of a catalogue and gives their probabilities, with photos, references or both.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import check_fields
from retrieval.errors import BadInput
from retrieval.model.posterior import Posterior

Floats = NDArray[np.float32]
Numbers = NDArray[np.int64]
REFERENCE_ROWS, REFERENCE_PARTIALS = "references", "touches"
"""Names in an index: of the document that lists its reference touches (and, in the manifest, of their number), and of
their partial activations."""
SHARPNESS = 16.0
"""Weight of the nearest of an object's references relative to the others. With 8, with 16 and with only the nearest,
unseen simulated objects were found equally often."""


@dataclass(frozen=True)
class ReferenceCalibration:
    """Parameters of the formulas above.

    Attributes:
        touch_only: Posterior of objects without photos.
        weight: Weight of C for objects with photos; None if no object had both.
        with_photos: Posterior of objects with photos; None if no object had both.
        objects: Number of objects of the fit.
        touches: Number of their query touches.
    """

    touch_only: Posterior
    weight: Annotated[float, Meta(ge=0, le=1e9)] | None
    with_photos: Posterior | None
    objects: Annotated[int, Meta(ge=0)]
    touches: Annotated[int, Meta(ge=0)]

    def __post_init__(self) -> None:
        check_fields(self, "references", BadInput)
        if (self.weight is None) != (self.with_photos is None):
            raise BadInput("weight and with_photos must both be present or both be absent; one of them is missing")


def unit_embeddings(partials: NDArray[np.floating[Any]], columns: slice) -> Floats:
    """Return the unit contrastive embeddings (B, d) of touches or photos.

    Args:
        partials: (B, partial) partial activations.
        columns: Their d columns with the scaled embeddings (`FusionScorer.cosine_columns`). d is 0 for a model whose
            logit has no cosine.
    """
    embeddings = np.asarray(partials[:, columns], dtype=np.float32)
    return np.asarray(embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), np.float32(1e-6)))


def reference_similarity(cosines: NDArray[np.floating[Any]], starts: Numbers) -> NDArray[np.float64]:
    """Return C (G, O) of cosines (G, R) of grasps with references; an object's columns begin at `starts` (O,)."""
    scaled = SHARPNESS * cosines.astype(np.float64)
    counts = np.diff(np.append(starts, scaled.shape[1]))
    top = np.maximum.reduceat(scaled, starts, axis=1)
    sums = np.add.reduceat(np.exp(scaled - np.repeat(top, counts, axis=1)), starts, axis=1)
    return np.asarray((top + np.log(sums / counts)) / SHARPNESS)
