"""What is fitted on: own grasps as towers see them that stand still, those of the start beside published ones."""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from retrieval.data.dataset import Grasp, Split, finger_count, load_grasps
from retrieval.errors import BadInput
from retrieval.evaluation.real.protocol import read_facts
from retrieval.methods.cca_towers import Blocks
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config, load_config
from retrieval.model.fusion import Matcher
from retrieval.model.towers import TOGETHER, architectures_of, tower_name
from retrieval.model.towers.base import Tower
from retrieval.model.towers.side_by_side import SideBySide, widths_of
from retrieval.model.towers.weights import initialise_tower
from retrieval.training.features import Features, encode_recording

PRESET = "adapt"
BESIDE = "mobilenet_v2"
"""The tower whose published weights stand beside those of the start."""
NOTHING = "none"
"""In place of first weights: no tower beside those of the start."""


@dataclass(frozen=True, eq=False)
class Material:
    """Own grasps, the towers side by side, and what these make of them; blurred: of an 8 x 6 blur of each touch.

    kind_of: the class of each object, where the recording names it.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    features: Features
    blurred: Features
    kind_of: dict[str, str] | None
    source: str

    @property
    def blocks(self) -> Blocks:
        """How wide the towers' features are that stand side by side, of a touch and of a photo."""
        touch, photo = widths_of(self.matcher.touch_tower), widths_of(self.matcher.photo_tower)
        return touch * self.config.matcher.fingers, photo * self.matcher.views


def encode(
    recording: Path,
    start: Checkpoint,
    *,
    tower: str | type[Tower] = BESIDE,
    init: str,
    split: Split | None,
    cache: Path | None,
    seed: int,
    quiet: bool,
) -> Material:
    """The recording as the towers of the start, and those beside them, see it."""
    grasps = load_grasps(recording)
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    if len({grasp.object_id for grasp in grasps}) < 2:
        raise BadInput("a matcher is fitted to two own objects at least; record more")
    config = config_for(start, finger_count(grasps), None if init == NOTHING else tower, seed=seed)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    take_over(matcher.touch_tower, start.matcher.touch_tower, init)
    take_over(matcher.photo_tower, start.matcher.photo_tower, init)
    shown = partial(encode_recording, grasps, matcher, config, cache, quiet=quiet)
    features = shown()
    blurred = shown(variant="blurred", photos_of=features)
    facts = read_facts(recording)
    return Material(grasps, config, matcher, features, blurred, facts.kind_of, facts.source)


def config_for(start: Checkpoint, fingers: int, tower: str | type[Tower] | None, *, seed: int) -> Config:
    """The preset, for towers of the start and, next to them, a published `tower`."""
    preset, known = load_config(PRESET), start.config.matcher
    beside = [] if tower is None else [tower_name(tower)]
    matcher = dataclasses.replace(
        preset.matcher,
        tower=TOGETHER.join([known.tower, *beside]),
        tower_output=known.tower_output,
        fingers=fingers,
        architectures={**known.architectures, **(architectures_of(beside[0]) if beside else {})},
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="", seed=seed)
    return dataclasses.replace(preset, matcher=matcher, training=training)


def take_over(tower: Tower, known: Tower, init: str) -> None:
    """Give a tower the weights of the start and, to the part beside it, the published ones."""
    if init == NOTHING:
        tower.load_state_dict(known.state_dict())
        return
    assert isinstance(tower, SideBySide)
    *parts, beside = tower.parts
    for part, its in zip(parts, known.parts if isinstance(known, SideBySide) else [known], strict=True):
        part.load_state_dict(its.state_dict())
    initialise_tower(beside, init)  # type: ignore[arg-type]
