"""What is fitted on: own grasps as towers see them that stand still, those of the start beside published ones."""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from retrieval.data.dataset import Grasp, Split, finger_count, load_grasps
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

PRESET = "adapt"
PUBLISHED_TOWER = "mobilenet_v2"
"""The tower whose published weights stand beside those of the start."""
NO_TOWER = "none"
"""In place of first weights: no tower beside those of the start."""


@dataclass(frozen=True, eq=False)
class AdaptationData:
    """Own grasps, the towers side by side, and what these make of them; blurred: of an 8 x 6 blur of each touch.

    kind_of: the class of each object, where the recording names it.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    features: Features
    low_pass: Features
    kind_of: dict[str, str] | None
    source: str

    @property
    def blocks(self) -> TowerWidths:
        """How wide the towers' features are that stand side by side, of a touch and of a photo."""
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
    """The recording as the towers of the start, and those beside them, see it."""
    grasps = load_grasps(recording)
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    if len({grasp.object_id for grasp in grasps}) < 2:
        raise BadInput("a matcher is fitted to two own objects at least; record more")
    config = config_for(start, finger_count(grasps), None if init == NO_TOWER else tower, seed=seed)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    load_start_weights(matcher.touch_tower, start.matcher.touch_tower, init)
    load_start_weights(matcher.photo_tower, start.matcher.photo_tower, init)
    shown = partial(encode_recording, grasps, matcher, config, cache, quiet=quiet)
    features = shown()
    low_pass = shown(touch_variant="low_pass", photo_features_from=features)
    facts = read_recording_facts(recording)
    return AdaptationData(grasps, config, matcher, features, low_pass, facts.kind_of, facts.source)


def config_for(start: Checkpoint, fingers: int, tower: str | type[Tower] | None, *, seed: int) -> Config:
    """The preset, for towers of the start and, next to them, a published `tower`."""
    preset, known = load_config(PRESET), start.config.matcher
    beside = [] if tower is None else [tower_name(tower)]
    matcher = dataclasses.replace(
        preset.matcher,
        tower=TOWER_SEPARATOR.join([known.tower, *beside]),
        tower_output=known.tower_output,
        fingers=fingers,
        architectures={**known.architectures, **(architectures_of(beside[0]) if beside else {})},
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="", seed=seed)
    return dataclasses.replace(preset, matcher=matcher, training=training)


def load_start_weights(tower: Tower, known: Tower, init: str) -> None:
    """Give a tower the weights of the start and, to the part beside it, the published ones."""
    if init == NO_TOWER:
        tower.load_state_dict(known.state_dict())
        return
    assert isinstance(tower, ConcatenatedTowers)
    *parts, beside = tower.parts
    for part, its in zip(parts, known.parts if isinstance(known, ConcatenatedTowers) else [known], strict=True):
        part.load_state_dict(its.state_dict())
    initialise_tower(beside, init)  # type: ignore[arg-type]
