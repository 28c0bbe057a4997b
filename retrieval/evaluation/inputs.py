"""Inputs of methods: features of touches and photos by frozen towers, and the inputs of controls and ceilings.

A control runs a method on inputs that lack information that the method should use. A ceiling measures how well one
modality alone identifies the object, and so which modality limits the result.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.data.camera import PhotoCamera
from retrieval.data.dataset import Grasp, finger_count
from retrieval.errors import DatasetError
from retrieval.methods import METHODS
from retrieval.methods.cca import Cca
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.features import Features, encode_recording

INPUTS = {
    "touch": "the touches and photos",
    "permuted": "touches are randomly assigned to other objects before fitting, so there is nothing to learn",
    "no_contact": "no-contact frames replace the touches, in fitting and in scoring",
    "low_pass": "each gel image is reduced to 8 x 6 pixels, in fitting and in scoring",
    "order": "the input is the position of the touch in the order of capture (of its session), not its image: an upper "
    "bound on the information in sensor drift",
    "background": "only the margin of each photo is used, an eighth of each side, in fitting and in scoring",
    "touch_to_touch": "the touch of another grasp replaces the photo: how repeatable touches are",
    "photo_to_photo": "the photo of another grasp replaces the touch: how repeatable photos are",
}
"""Kind of inputs -> description. "touch" is the result, the last two are ceilings, the others are controls."""
_BUMPS = (4, 16, 64)
FURTHER: dict[str, Any] = {
    "freeze_towers": True,
    "iterations": 20,
    "touches_per_batch": 32,
    "learning_rate": 1e-4,
    "schedule": "cosine",
    "validate_every": 10,
    "validation_fraction": 0.2,
    "test_fraction": 0.3,
}
"""Settings with which the head of a checkpoint is trained further, and fractions of the objects for its evaluation."""


class ControlCca(Cca):
    """Method of the controls of real data: it takes features of any width, and principal components make it fast."""

    max_directions = 96


CONTROL_CCA = METHODS.name_of(ControlCca)


@dataclass(frozen=True, eq=False)
class TowerEncoder:
    """Towers that encode the grasps of a recording; each kind of inputs is encoded once.

    Heads are fitted with `config`, from the head of `checkpoint` if there is one. `camera` is that of the photos,
    `cache` the folder of the cache of features.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    checkpoint: Checkpoint | None
    camera: PhotoCamera
    cache: Path
    _encoded: dict[tuple[str, bool, int | None], Features] = field(default_factory=dict)

    @classmethod
    def of(cls, grasps: list[Grasp], source: Config | Checkpoint, camera: PhotoCamera, seed: int, cache: Path) -> Self:
        """Return the frozen towers of a configuration, or the towers of a checkpoint, whose seed is replaced.

        If a checkpoint has two fingers and the recording one, both fingers get the same touch.

        Raises:
            DatasetError: The recording has more fingers than the checkpoint.
        """
        recorded = finger_count(grasps)
        if isinstance(source, Config):
            config = replace(source, matcher=replace(source.matcher, fingers=recorded))
            return cls(grasps, config, frozen_matcher(config), None, camera, cache)
        if recorded not in (1, fingers := source.config.matcher.fingers):
            raise DatasetError(
                f"{source.path} needs {fingers} finger(s), but the recording has {recorded}. Evaluate a model for "
                f"{recorded} finger(s)."
            )
        config = replace(source.config, training=source.config.training.with_given_weights(**FURTHER, seed=seed))
        return cls(with_fingers(grasps, fingers), config, source.matcher, source, camera, cache)

    def inputs(self, kind: str, with_cells: bool = True, max_grasps: int | None = None) -> Features:
        """Return the features of one of `INPUTS`, with or without the cells of the towers, of thinned grasps."""
        key = kind, with_cells, max_grasps
        if key not in self._encoded:
            self._encoded[key] = self._inputs(*key)
        return self._encoded[key]

    def touches(self, grasps: Sequence[Grasp], touch_variant: str) -> NDArray[np.float32]:
        """Return the features (G, fingers * F) of other touches, without cells; their photos are not read."""
        encoded = self._encode(with_fingers(grasps, self.config.matcher.fingers), touch_variant, "none")
        return encoded.pooled(self.matcher).touch_rows

    def missing_reason(self, kind: str) -> str | None:
        """Return why the recording cannot give this kind of inputs; None if it can."""
        if kind == "no_contact":
            return missing_no_contact_reason(self.grasps)
        if kind == "photo_to_photo":
            features = self.inputs("touch")
            photos = {
                (owner, row.tobytes()) for owner, row in zip(features.owner.tolist(), features.photo, strict=True)
            }
            return None if len(photos) > len(set(features.object_ids)) else "no object has two different photos"
        return None

    def _inputs(self, kind: str, with_cells: bool, max_grasps: int | None) -> Features:
        if kind in ("permuted", "order", "touch_to_touch", "photo_to_photo"):
            touches = self.inputs("touch", with_cells, max_grasps)
            if kind == "permuted":  # the experiment permutes the touches of each part
                return touches
            if kind == "order":
                return replace(touches, touch=_clock_of_sessions(thin_grasps(self.grasps, max_grasps))[:, None])
            if kind == "touch_to_touch":
                return replace(touches, photo=touches.touch.reshape(len(touches), -1))
            return replace(touches, touch=touches.photo[:, None])
        if not with_cells:
            return self.inputs(kind, max_grasps=max_grasps).pooled(self.matcher)
        grasps = thin_grasps(self.grasps, max_grasps)
        if kind == "background":
            return self._encode(grasps, "touch", "margin")
        return self._encode(grasps, kind)

    def _encode(self, grasps: Sequence[Grasp], touch: str, photo: str = "photo") -> Features:
        return encode_recording(
            grasps, self.matcher, self.config, self.cache, touch_variant=touch, photo_variant=photo, camera=self.camera
        )


@dataclass(frozen=True, eq=False)
class Row:
    """A row of the result table: its name, a method, the towers under it, and whether their checkpoint scores as is."""

    name: str
    method: str
    towers: TowerEncoder
    is_unfitted: bool = False


def with_fingers(grasps: Sequence[Grasp], fingers: int) -> list[Grasp]:
    """Return the grasps for a model of this many fingers: each finger gets the touch of a grasp that has only one."""
    copies = fingers if len(grasps[0].touches) == 1 else 1
    return [replace(grasp, touches=grasp.touches * copies, backgrounds=grasp.backgrounds * copies) for grasp in grasps]


def missing_no_contact_reason(grasps: Sequence[Grasp]) -> str | None:
    """Return why no-contact frames cannot replace touches; None if they can."""
    if not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
        return "the recording lacks no-contact frames"
    if len({grasp.backgrounds for grasp in grasps}) == 1:
        return "all touches share one no-contact frame, so it contains no information about the object"
    return None


def thin_grasps(grasps: Sequence[Grasp], max_grasps: int | None) -> list[Grasp]:
    """Return at most `max_grasps` grasps of each object, evenly spaced in the order of its grasps; None for all."""
    if max_grasps is None:
        return list(grasps)
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, grasp in enumerate(grasps):
        rows_of[grasp.object_id].append(row)
    selected = [
        rows[place]
        for rows in rows_of.values()
        for place in np.linspace(0, len(rows) - 1, min(max_grasps, len(rows))).astype(int)
    ]
    return [grasps[row] for row in sorted(selected)]


def _clock_of_sessions(grasps: Sequence[Grasp]) -> NDArray[np.float32]:
    """Return `clock_features` (G, F) of the place of each grasp in the order of its session."""
    sessions = np.array([grasp.session or "" for grasp in grasps])
    rows = [np.flatnonzero(sessions == session) for session in np.unique(sessions)]
    return np.concatenate([clock_features(len(part)) for part in rows])[np.argsort(np.concatenate(rows))]


def clock_features(count: int) -> NDArray[np.float32]:
    """Encode the places 0..count-1 of an order as Gaussian bumps of three widths.

    Near places have similar features, and a linear method can distinguish distant ones.

    Returns:
        (count, F) float32.
    """
    place = np.linspace(0, 1, count)[:, None]
    bumps = [np.exp(-0.5 * ((place - np.linspace(0, 1, number)) * number) ** 2) for number in _BUMPS]
    return np.concatenate(bumps, axis=1).astype(np.float32)
