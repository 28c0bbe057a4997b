"""CCA of concatenated towers (`retrieval.training.cca`), as `retrieve train` fits it."""

from retrieval.methods.method import Array, Method
from retrieval.training.cca import fit_projections, select_settings, tower_widths, unit_rows
from retrieval.training.features import Features
from retrieval.training.selection import held_out_folds


class CcaTowers(Method):
    """CCA on the features of concatenated towers: a pair's score is the cosine of its two encodings.

    Settings are chosen by ranking on validation objects; with `fit_on_validation`, by cross-validation within all
    objects.
    """

    is_seeded = False

    def _fit(self, train: Features, validation: Features) -> None:
        blocks = tower_widths(self.settings.config, train)
        known, folds = train.concatenate(validation), [tuple(sorted(set(validation.object_ids)))]
        if self.settings.fit_on_validation:
            folds = held_out_folds(known, self.settings.kind_of, seed=self.settings.seed)
        choice = select_settings(known, blocks, folds)
        self.best_params = {**choice.settings._asdict(), "validation_auc": choice.auc}
        self._projections = choice.projections
        if not self.settings.fit_on_validation:
            self._projections = fit_projections(train, blocks, [choice.settings])[choice.settings]

    def _encode_touch(self, touch: Array) -> Array:
        return unit_rows(self._projections.touch(touch.reshape(len(touch), -1)))

    def _encode_photo(self, photo: Array) -> Array:
        return unit_rows(self._projections.photo(photo))
