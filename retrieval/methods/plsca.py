"""Partial least squares in its canonical form (Wold 1975), ObjectFolder's second linear baseline."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from retrieval.methods.cca import Matrix, component_counts, cosine, decompose, unit_rows
from retrieval.methods.method import Array, Method
from retrieval.methods.selection import Validator, next_rows_of_object

if TYPE_CHECKING:
    from retrieval.training.features import Features

MAX_PRINCIPAL_COMPONENTS = 256
"""Principal components of each modality. Every step of the power iteration passes over all features of all rows.
For 2,560 + 1,280 features, 100 components would take minutes. The omitted directions vary least."""
COMPONENTS = (4, 8, 16, 32, 64, 100)
"""The last number is ObjectFolder's."""


class Plsca(Method):
    """Cosine of canonical PLS scores; the number of components is chosen by ranking on validation objects.

    scikit-learn requires rows in pairs. A row of the fit is a touch with the photo of the object's next grasp: with its
    own photo the fit would use the common pose of the grasp.
    """

    is_seeded = False

    def _fit(self, train: "Features", validation: "Features") -> None:
        self._touch = _PrincipalComponents(train.touch)
        self._photo = _PrincipalComponents(train.photo)
        maps = _rotations(self._touch(train.touch), self._photo(train.photo)[next_rows_of_object(train.owner, 2)[:, 1]])
        validator = Validator.of(validation)
        touch, photo = self._touch(validator.features.touch) @ maps[0], self._photo(validator.features.photo) @ maps[1]
        # Components are found one after another, so a smaller number of them is a prefix of a larger one.
        aucs = {
            count: validator.touch_auc(cosine(unit_rows(touch[:, :count]), unit_rows(photo[:, :count])))
            for count in component_counts(COMPONENTS, maps[0].shape[1])
        }
        count = max(aucs, key=aucs.__getitem__)
        self._maps = maps[0][:, :count], maps[1][:, :count]
        self.best_params = {
            "components": count,
            "max_components": maps[0].shape[1],
            "principal_components": {"touch": self._touch.count, "photo": self._photo.count},
            "validation_auc": aucs[count],
        }

    def _encode_touch(self, touch: Array) -> Array:
        return unit_rows(self._touch(touch) @ self._maps[0])

    def _encode_photo(self, photo: Array) -> Array:
        return unit_rows(self._photo(photo) @ self._maps[1])

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return cosine(touch_encodings, photo_encodings)


class _PrincipalComponents:
    """Standardised features in their principal directions, at most `MAX_PRINCIPAL_COMPONENTS`."""

    def __init__(self, x: Array) -> None:
        view = decompose(x)
        self._standardise, self._directions = view.standardise, view.right[:MAX_PRINCIPAL_COMPONENTS].T
        self.count = self._directions.shape[1]

    def __call__(self, x: Array) -> Matrix:
        return np.asarray(self._standardise(x) @ self._directions)


def _rotations(touch: Matrix, photo: Matrix) -> tuple[Matrix, Matrix]:
    """Return maps (r, k) of either view to its k components.

    They come from power iteration. scikit-learn's other algorithm decomposes the deflated cross matrix in full, and
    LAPACK's gesdd did not converge on such a matrix of ImageNet features after 20 components.
    """
    from sklearn.cross_decomposition import PLSCanonical  # slow to import
    from sklearn.exceptions import ConvergenceWarning

    # Centring removes one dimension of the rows; the smaller view's directions also limit the components.
    limit = min(COMPONENTS[-1], touch.shape[1], photo.shape[1], len(touch) - 1)
    with warnings.catch_warnings():
        # Nearly equal covariances converge slowly: any direction is valid; validation chooses how many are used.
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = PLSCanonical(limit, scale=False).fit(touch, photo)
    return model.x_rotations_, model.y_rotations_
