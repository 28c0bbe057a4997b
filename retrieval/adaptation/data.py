"""Inputs of a fit: the recorded grasps, encoded by frozen towers.

Touches are encoded by the tower of the start model, by the gel tower of the package
(`retrieval.model.towers.weights.gel_tower`) and by a published tower; photos by the tower of the start model and by the
published one. The photo tower of a shipped model is left out, since it has seen simulated photos only.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from retrieval.data.dataset import Grasp, Split, finger_count, load_grasps, recording_licence
from retrieval.data.licences import DataLicence
from retrieval.errors import BadInput
from retrieval.evaluation.real.protocol import read_recording_facts
from retrieval.methods.cca_towers import TowerWidths
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config, load_config
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import is_shipped
from retrieval.model.towers import TOWER_SEPARATOR
from retrieval.model.towers.tower import Tower
from retrieval.model.towers.weights import GEL
from retrieval.training.features import Features, encode_recording
from retrieval.training.licences import checkpoint_licences

PRESET = "adapt"
PUBLISHED_TOWER = "mobilenet_v2"
"""Published tower that is combined with the towers of the start model, and backbone of the gel tower."""
NO_TOWER = "none"
"""Value of `init` for no published tower."""


@dataclass(frozen=True, eq=False)
class AdaptationData:
    """The recorded grasps, the combined towers, and the features.

    Attributes:
        grasps: The grasps.
        config: Configuration of the fitted matcher.
        matcher: Matcher with the combined towers.
        features: Tower features of the grasps.
        low_pass: The same with low-pass (8 x 6) touches.
        kind_of: The class of each object, if the recording has it.
        source: Source of the recording.
        licences: Licences of the recording and of the start model's data.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    features: Features
    low_pass: Features
    kind_of: dict[str, str] | None
    source: str
    licences: list[DataLicence]

    @property
    def blocks(self) -> TowerWidths:
        """Feature widths of the combined towers, for a touch and for a photo."""
        towers = self.matcher.touch_tower, self.matcher.photo_tower
        touch, photo = ([part.feature_count for part in tower.backbones] for tower in towers)
        return TowerWidths(touch * self.config.matcher.fingers, photo * self.matcher.views, len(touch))


def load_adaptation_data(
    recording: Path,
    start: Checkpoint,
    *,
    init: str,
    split: Split | None,
    cache: Path | None,
    seed: int,
    quiet: bool,
) -> AdaptationData:
    """Read a recording, without the test objects of `split`, and encode it with the towers of `config_for`.

    `init` are the weights of the published tower, or "none" for no such tower.

    Raises:
        BadInput: Fewer than two objects are left.
    """
    grasps = load_grasps(recording)
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    if len({grasp.object_id for grasp in grasps}) < 2:
        raise BadInput("A fit needs a recording of at least 2 objects. Record more.")
    config = config_for(start, finger_count(grasps), init, seed=seed)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    load_towers(matcher, start, init)
    encode = partial(encode_recording, grasps, matcher, config, cache, quiet=quiet)
    features = encode()
    low_pass = encode(touch_variant="low_pass", photo_features_from=features)
    facts = read_recording_facts(recording)
    licences = list(dict.fromkeys([*checkpoint_licences(start), recording_licence(recording)]))
    return AdaptationData(grasps, config, matcher, features, low_pass, facts.kind_of, facts.source, licences)


def config_for(start: Checkpoint, fingers: int, init: str, *, seed: int) -> Config:
    """Return the preset with the towers of the fit; with `init` "none" those of the start model only."""
    preset, source = load_config(PRESET), start.config.matcher
    touch, photo = [source.tower], [source.photo_tower or source.tower]
    if init != NO_TOWER:
        touch += [PUBLISHED_TOWER] * (1 + _has_gel_tower(start))
        photo = [PUBLISHED_TOWER] if is_shipped(start.path) else [*photo, PUBLISHED_TOWER]
    matcher = dataclasses.replace(
        preset.matcher,
        tower=TOWER_SEPARATOR.join(touch),
        photo_tower=TOWER_SEPARATOR.join(photo),
        tower_output=source.tower_output,
        fingers=fingers,
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="", seed=seed)
    return dataclasses.replace(preset, matcher=matcher, training=training)


def load_towers(matcher: Matcher, start: Checkpoint, init: str) -> None:
    """Load the weights of the towers of `config_for`; `init` are those of the published tower, or "none"."""
    own, published = start.matcher, [] if init == NO_TOWER else [init]
    gel = [GEL] if published and _has_gel_tower(start) else []
    _load_parts(matcher.touch_tower, own.touch_tower.backbones, [*gel, *published])
    only_published = published and is_shipped(start.path)
    _load_parts(matcher.photo_tower, [] if only_published else own.photo_tower.backbones, published)


def _load_parts(tower: Tower, start: Sequence[Tower], inits: Sequence[str]) -> None:
    """Load the weights of the start model into the first parts of a tower, and those of `inits` into the others."""
    parts = tower.backbones
    for part, source in zip(parts, start, strict=False):
        part.load_state_dict(source.state_dict())
    for part, init in zip(parts[len(start) :], inits, strict=True):
        part.initialise(init)


def _has_gel_tower(start: Checkpoint) -> bool:
    """Return whether the gel tower is used with the towers of this model: its features are statistics of stages."""
    return start.config.matcher.tower_output == "stages"
