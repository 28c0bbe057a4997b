"""Base class of every method; a method implements `_fit`, `_encode_touch`, `_encode_photo`, and possibly `_score`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.training.features import Features

Array = NDArray[np.float32]


@dataclass(frozen=True)
class MethodSettings:
    """Settings of a method.

    Attributes:
        config: Towers, head and training.
        seed: Seed of the fit.
        folder: Folder in which the method may store files, such as a checkpoint; None to store nothing.
        fit_on_validation: A method that can (`cca`, `cca_towers`) also fits on validation objects once its
            settings are chosen. A calibration on their scores is then overconfident.
        kind_of: The kind of each object, if the recording names it. Half of each kind is then held out together to
            choose settings.
        model: A trained model, with which late fusion and retrieve and rerank score as it is.
        start: A model whose head they train further.

    >>> retrieval.MethodSettings(retrieval.load_config("tiny")).seed
    0
    """

    config: Config
    seed: int = 0
    folder: Path | None = None
    _: KW_ONLY
    fit_on_validation: bool = False
    kind_of: Mapping[str, str] | None = None
    model: Checkpoint | None = None
    start: Checkpoint | None = None


class Method(ABC):
    """Scores touches with photos: a higher score is a better match.

    Scores are ranked, ties by expected rank; only calibration gives them a unit. After `fit`, `best_params` contains
    the values chosen on validation objects, in JSON types.

    >>> import numpy as np
    >>> class Brightness(retrieval.Method):
    ...     is_seeded = False
    ...     def _fit(self, train, validation): ...
    ...     def _encode_touch(self, touch):
    ...         return touch.mean((1, 2))[:, None]
    ...     def _encode_photo(self, photo):
    ...         return photo.mean(1)[:, None]
    ...     def _score(self, touch_encodings, photo_encodings):
    ...         return -abs(touch_encodings - photo_encodings.T)
    >>> method = Brightness(retrieval.MethodSettings(retrieval.load_config("tiny")))
    >>> method.best_params
    {}
    """

    is_seeded: ClassVar[bool] = True
    """Whether fits differ by seed; otherwise one fit is enough."""
    uses_cells: ClassVar[bool] = False
    """Whether features end with the cells of the towers, if these have cells (`retrieval.model.late_interaction`)."""

    def __init__(self, settings: MethodSettings) -> None:
        self.settings = settings
        self.best_params: dict[str, Any] = {}

    def fit(self, train: Features, validation: Features) -> None:
        """Fit on the grasps of training objects; choose settings on those of validation objects.

        Raises:
            BadInput: The two have a common object.
        """
        if shared := set(train.object_ids) & set(validation.object_ids):
            raise BadInput(
                f"training and validation objects must differ; {min(shared)!r} is in both; split the grasps by object"
            )
        self._fit(train, validation)

    def encode_touch(self, touch: NDArray[Any]) -> Array:
        """Return encodings (T, ...) of touch features (T, fingers, F), shaped as in the fit."""
        return self._encode_touch(np.asarray(touch, dtype=np.float32))

    def encode_photo(self, photo: NDArray[Any]) -> Array:
        """Return encodings (N, ...) of photo features (N, F), shaped as in the fit."""
        return self._encode_photo(np.asarray(photo, dtype=np.float32))

    def score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        """Return scores (T, N) of every touch with every photo: by default, inner products of the encodings.

        Raises NumericalError for a score that is not finite.
        """
        scores = self._score(touch_encodings, photo_encodings)
        return _checked_scores(scores, (len(touch_encodings), len(photo_encodings)))

    def score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        """Return scores (S, N) of sets (S, G) of touches of one object with every photo.

        By default this is the sum of `score` over the set: log-odds add for grasps that are independent given the
        object.
        """
        scores = self._score_sets(touch_encodings, photo_encodings, sets)
        return _checked_scores(scores, (len(sets), len(photo_encodings)))

    @abstractmethod
    def _fit(self, train: Features, validation: Features) -> None: ...

    @abstractmethod
    def _encode_touch(self, touch: Array) -> Array: ...

    @abstractmethod
    def _encode_photo(self, photo: Array) -> Array: ...

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return touch_encodings @ photo_encodings.T

    def _score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        used, place = np.unique(sets, return_inverse=True)
        return sum_over_sets(self._score(touch_encodings[used], photo_encodings), place.reshape(sets.shape))


def sum_over_sets(scores: Array, sets: NDArray[np.int64]) -> Array:
    """Return sums (S, N) over sets (S, G) of rows of scores (T, N); in float64, near-ties do not depend on order."""
    total = np.zeros((len(sets), scores.shape[1]))
    for rows in sets.T:
        total += scores[rows]
    return total.astype(np.float32)


def _checked_scores(scores: NDArray[Any], shape: tuple[int, int]) -> Array:
    """Return finite scores of this shape as float32. Others are an error: sorting would rank a NaN first."""
    scores = np.asarray(scores, dtype=np.float32)
    if scores.shape != shape:
        raise BadInput(f"scores must be an array of shape {shape}; got {scores.shape}")
    if not np.isfinite(scores).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(scores))[0])
        raise NumericalError(f"scores must be finite; got {scores[place]} at {place}")
    return scores
