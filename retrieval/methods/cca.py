"""CCA (`retrieval.training.cca`) of frozen tower features, with a weighted cosine.

Dimensions are weighted by rho^p (Gong et al., IJCV 2014: a plain cosine would give noise dimensions full weight).
"""

from typing import ClassVar

from retrieval.methods.method import Array, Method
from retrieval.training.cca import CanonicalCorrelations, canonical_correlations, decompose, unit_rows
from retrieval.training.features import Features
from retrieval.training.selection import ranking_auc, validation_rows

RIDGES = (1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2)
COMPONENTS = (8, 16, 32, 64, 128, 256)
POWERS = (0, 1, 2, 4)


class Cca(Method):
    """Cosine of canonical variates weighted by rho^p; ranking on validation objects chooses ridge, components and p.

    A subclass may set `max_directions`: then only that many principal components of touch and of photo are used. A few
    dozen objects do not determine which of a thousand features correlate across touch and photo. The ridge damps the
    narrow directions; principal components drop them, which is faster.
    """

    is_seeded = False
    max_directions: ClassVar[int | None] = None

    def _fit(self, train: Features, validation: Features) -> None:
        touch, photo = (decompose(part, self.max_directions) for part in (train.touch, train.photo))
        self._standardise = touch.standardise, photo.standardise
        # The decompositions are made once; a ridge only damps them.
        found = {ridge: canonical_correlations(touch, photo, train.owner, ridge) for ridge in RIDGES}
        chosen = validation.select(validation_rows(validation))
        cells = {(ridge, *cell): auc for ridge, one in found.items() for cell, auc in self._cells(one, chosen).items()}
        ridge, components, power = choice = max(cells, key=cells.__getitem__)
        correlations = found[ridge]
        if self.settings.fit_on_validation:
            known = train.concatenate(validation)
            touch, photo = (decompose(part, self.max_directions) for part in (known.touch, known.photo))
            self._standardise = touch.standardise, photo.standardise
            correlations = canonical_correlations(touch, photo, known.owner, ridge)
        weights = correlations.correlations[:components] ** power
        self._maps = tuple(
            each[:, :components] * weights for each in (correlations.touch_weights, correlations.photo_weights)
        )
        self.best_params = {
            "ridge": ridge,
            "components": components,
            "max_components": len(correlations.correlations),
            "power": power,
            "validation_auc": cells[choice],
            "rank": {"touch": len(touch.singular), "photo": len(photo.singular)},
        }

    def _cells(self, found: CanonicalCorrelations, validation: Features) -> dict[tuple[int, int], float]:
        """Return the AUC on validation objects of each number of components and power."""
        touch = self._standardise[0](validation.touch) @ found.touch_weights
        photo = self._standardise[1](validation.photo) @ found.photo_weights
        limit, aucs = len(found.correlations), {}
        for components in sorted({min(count, limit) for count in COMPONENTS}):
            for power in POWERS:
                weights = found.correlations[:components] ** power
                encodings = unit_rows(touch[:, :components] * weights), unit_rows(photo[:, :components] * weights)
                aucs[components, power] = ranking_auc(encodings[0] @ encodings[1].T, validation.owner)
        return aucs

    def _encode_touch(self, touch: Array) -> Array:
        return unit_rows(self._standardise[0](touch) @ self._maps[0])

    def _encode_photo(self, photo: Array) -> Array:
        return unit_rows(self._standardise[1](photo) @ self._maps[1])
