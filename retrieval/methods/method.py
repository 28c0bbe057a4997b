"""Base class of every method; a method only implements `_fit`, `_encode_touch`, `_encode_photo` and `_score`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.model.config import Config

if TYPE_CHECKING:
    from retrieval.training.features import Features

Array = NDArray[np.float32]


@dataclass(frozen=True)
class MethodSettings:
    """Settings of a method.

    Attributes:
        config: Towers, head and training.
        seed: Seed of the fit.
        folder: Folder in which the method may store files, such as a checkpoint; None to store nothing.
        quiet: Show no progress on stderr.
        fit_on_validation: A method that can (`cca`, `cca_towers`) also fits on validation objects once its
            settings are chosen. A calibration on their scores is then overconfident.
        kind_of: The kind of each object, if the recording names it. Half of each kind is then held out together to
            choose settings.

    >>> retrieval.MethodSettings(retrieval.load_config("tiny")).seed
    0
    """

    config: Config
    seed: int = 0
    folder: Path | None = None
    quiet: bool = True
    fit_on_validation: bool = False
    kind_of: Mapping[str, str] | None = None


class Method(ABC):
    """Scores touches with photos: a higher score is a better match.

    Scores are ranked, ties by expected rank; only calibration gives them a unit. After `fit`, `best_params` contains
    the values chosen on validation objects, in JSON types. A method that is already fitted (from a checkpoint) sets
    `fitted`.

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
    >>> method.fitted
    False
    """

    is_seeded: ClassVar[bool] = True
    """Whether fits differ by seed; otherwise one fit is enough."""
    uses_cells: ClassVar[bool] = False
    """Whether features end with the cells of the towers, if these have cells (`retrieval.model.late_interaction`)."""

    def __init__(self, settings: MethodSettings) -> None:
        self.settings = settings
        self.best_params: dict[str, Any] = {}
        self.fitted = False
        self._shapes: tuple[tuple[int, ...], tuple[int, ...]] | None = None

    def fit(self, train: "Features", validation: "Features") -> None:
        """Fit on the grasps of training objects; choose settings on those of validation objects.

        Raises:
            BadInput: One of the two has fewer than two objects, or they have a common object.
            NumericalError: A feature is not finite.
        """
        _require_fit(train, validation)
        self._fit(train, validation)
        self._shapes = train.touch.shape[1:], train.photo.shape[1:]
        self.fitted = True

    def encode_touch(self, touch: NDArray[Any]) -> Array:
        """Return encodings (T, ...) of touch features (T, fingers, F). Raises BadInput unless shaped as in the fit."""
        self._require_fitted()
        touch = _checked("touch features", touch, 3, self._shapes and self._shapes[0])
        return _checked_encodings(self._encode_touch(touch), len(touch))

    def encode_photo(self, photo: NDArray[Any]) -> Array:
        """Return encodings (N, ...) of photo features (N, F). Raises BadInput unless shaped as in the fit."""
        self._require_fitted()
        photo = _checked("photo features", photo, 2, self._shapes and self._shapes[1])
        return _checked_encodings(self._encode_photo(photo), len(photo))

    def score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        """Return scores (T, N) of every touch with every photo. Raises NumericalError for one that is not finite."""
        self._require_fitted()
        return _checked_scores(
            self._score(touch_encodings, photo_encodings), len(touch_encodings), len(photo_encodings)
        )

    def score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        """Return scores (S, N) of sets of grasps of one object with every photo.

        By default this is the sum of `score` over the set: log-odds add for grasps that are independent given the
        object.

        Args:
            touch_encodings: (T, ...) encodings.
            photo_encodings: (N, ...) encodings.
            sets: (S, G) rows of `touch_encodings`.
        """
        self._require_fitted()
        return _checked_scores(
            self._score_sets(touch_encodings, photo_encodings, sets), len(sets), len(photo_encodings)
        )

    @abstractmethod
    def _fit(self, train: "Features", validation: "Features") -> None: ...

    @abstractmethod
    def _encode_touch(self, touch: Array) -> Array: ...

    @abstractmethod
    def _encode_photo(self, photo: Array) -> Array: ...

    @abstractmethod
    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array: ...

    def _score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        used, place = np.unique(sets, return_inverse=True)
        return sum_over_sets(self._score(touch_encodings[used], photo_encodings), place.reshape(sets.shape))

    def _require_fitted(self) -> None:
        if not self.fitted:
            raise BadInput(f"a method must be fitted before use; call fit on this {type(self).__name__} first")


def sum_over_sets(scores: Array, sets: NDArray[np.int64]) -> Array:
    """Return sums (S, N) over sets (S, G) of rows of scores (T, N); in float64, near-ties do not depend on order."""
    total = np.zeros((len(sets), scores.shape[1]))
    for rows in sets.T:
        total += scores[rows]
    return total.astype(np.float32)


def _require_fit(train: "Features", validation: "Features") -> None:
    for name, part in (("training", train), ("validation", validation)):
        count = len(set(part.object_ids))
        if count < 2:
            raise BadInput(f"a method is fitted on at least 2 {name} objects; got {count}; record more objects")
        _checked(f"touch features of {name} objects", part.touch, 3, train.touch.shape[1:])
        _checked(f"photo features of {name} objects", part.photo, 2, train.photo.shape[1:])
    if shared := set(train.object_ids) & set(validation.object_ids):
        raise BadInput(
            f"training and validation objects must differ; {min(shared)!r} is in both; split the grasps by object"
        )


def _checked(name: str, array: NDArray[Any], ndim: int, shape: tuple[int, ...] | None) -> Array:
    array = np.asarray(array, dtype=np.float32)
    if array.ndim != ndim or (shape is not None and array.shape[1:] != shape):
        expected = f"of shape (B, {', '.join(map(str, shape))})" if shape is not None else f"with {ndim} axes"
        raise BadInput(f"{name} must be an array {expected}, as in the fit; got {array.shape}")
    _require_finite(name, array)
    return array


def _checked_encodings(encodings: Array, count: int) -> Array:
    encodings = np.asarray(encodings, dtype=np.float32)
    if len(encodings) != count:
        raise BadInput(f"a method must return one encoding per item; got {len(encodings)} for {count}")
    _require_finite("encodings", encodings)
    return encodings


def _checked_scores(scores: Array, touches: int, photos: int) -> Array:
    scores = np.asarray(scores, dtype=np.float32)
    if scores.shape != (touches, photos):
        raise BadInput(f"scores must be of shape {(touches, photos)}, touches by photos; got {scores.shape}")
    _require_finite("scores", scores)
    return scores


def _require_finite(name: str, array: Array) -> None:
    """Raise NumericalError for a NaN or infinite value: sorting would rank a NaN first."""
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise NumericalError(f"{name} must be finite; got {array[place]} at {place}")
