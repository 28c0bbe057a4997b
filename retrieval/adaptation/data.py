"""Inputs of a fit: the recorded grasps, encoded by the frozen towers of the start model and a published tower."""

import dataclasses
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
from retrieval.model.towers import TOWER_SEPARATOR, architectures_of, tower_name
from retrieval.model.towers.concatenated import ConcatenatedTowers, feature_counts_of
from retrieval.model.towers.tower import Tower
from retrieval.model.towers.weights import initialise_tower
from retrieval.training.features import Features, encode_recording
from retrieval.training.licences import checkpoint_licences

PRESET = "adapt"
PUBLISHED_TOWER = "mobilenet_v2"
"""Published tower that is combined with the towers of the start model by default."""
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
        touch, photo = feature_counts_of(self.matcher.touch_tower), feature_counts_of(self.matcher.photo_tower)
        return touch * self.config.matcher.fingers, photo * self.matcher.views


def load_adaptation_data(
    recording: Path,
    start: Checkpoint,
    *,
    tower: str | type[Tower] = PUBLISHED_TOWER,
    init: str,
    split: Split | None,
    cache: Path | None,
    seed: int,
    quiet: bool,
) -> AdaptationData:
    """Read a recording and encode it with the towers of the start model and a published tower.

    Args:
        recording: Folder of the recording.
        start: The start model.
        tower: The published tower.
        init: Weights of that tower, or "none" for no such tower.
        split: Its test objects are left out.
        cache: Folder of encoded features.
        seed: Seed of the configuration.
        quiet: No progress on stderr.

    Raises:
        BadInput: Fewer than two objects are left.
    """
    grasps = load_grasps(recording)
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    if len({grasp.object_id for grasp in grasps}) < 2:
        raise BadInput("A fit needs a recording of at least 2 objects. Record more.")
    config = config_for(start, finger_count(grasps), None if init == NO_TOWER else tower, seed=seed)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    load_start_weights(matcher.touch_tower, start.matcher.touch_tower, init)
    load_start_weights(matcher.photo_tower, start.matcher.photo_tower, init)
    encode = partial(encode_recording, grasps, matcher, config, cache, quiet=quiet)
    features = encode()
    low_pass = encode(touch_variant="low_pass", photo_features_from=features)
    facts = read_recording_facts(recording)
    licences = list(dict.fromkeys([*checkpoint_licences(start), recording_licence(recording)]))
    return AdaptationData(grasps, config, matcher, features, low_pass, facts.kind_of, facts.source, licences)


def config_for(start: Checkpoint, fingers: int, tower: str | type[Tower] | None, *, seed: int) -> Config:
    """Return the preset for the towers of the start model and, if not None, a published tower.

    Args:
        start: The start model.
        fingers: Fingers of a touch.
        tower: The published tower.
        seed: Seed of the configuration.
    """
    preset, source = load_config(PRESET), start.config.matcher
    published = [] if tower is None else [tower_name(tower)]
    matcher = dataclasses.replace(
        preset.matcher,
        tower=TOWER_SEPARATOR.join([source.tower, *published]),
        tower_output=source.tower_output,
        fingers=fingers,
        architectures={**source.architectures, **(architectures_of(published[0]) if published else {})},
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="", seed=seed)
    return dataclasses.replace(preset, matcher=matcher, training=training)


def load_start_weights(tower: Tower, start: Tower, init: str) -> None:
    """Load the weights of the start model and, into the last part of a combined tower, the published ones."""
    if init == NO_TOWER:
        tower.load_state_dict(start.state_dict())
        return
    assert isinstance(tower, ConcatenatedTowers)
    *parts, published = tower.parts
    for part, source in zip(parts, start.parts if isinstance(start, ConcatenatedTowers) else [start], strict=True):
        part.load_state_dict(source.state_dict())
    initialise_tower(published, init)  # type: ignore[arg-type]
