"""Adapt a model to a new sensor and to your objects.

Touches are encoded by the frozen towers of the start model (pretrained on relief in simulation), by the gel tower of
the package (`retrieval.model.towers.weights.gel_tower`) and by a published tower (pretrained on photos); photos by the
tower of the start model and by the published one. The photo tower of a shipped model is left out, since it has seen
simulated photos only. The fit to these features is linear (`retrieval.training.cca_towers`).

Every reported number comes from objects that were left out of the fit. On a similar sensor the start model is better
than a fit to a few objects: it is then kept, with new calibrations.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from retrieval.console.progress import Bar
from retrieval.data.dataset import (
    AnyRecording,
    Grasp,
    Split,
    data_digest,
    finger_count,
    folder_of,
    linked_objects,
    load_grasps,
    object_kinds,
    recording_licence,
    recording_source,
)
from retrieval.data.licences import LICENCES
from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.pairs import fit_calibration
from retrieval.metrics.ranking import k_way_accuracies
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable, store_checkpoint
from retrieval.model.config import Config, load_config
from retrieval.model.encode import default_device, one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import is_shipped, shipped_model
from retrieval.model.towers import TOWER_SEPARATOR
from retrieval.model.towers.tower import Tower
from retrieval.model.towers.weights import GEL
from retrieval.training.batches import FrozenFeatures
from retrieval.training.calibration.calibrate import fit_calibrations, with_gel_check
from retrieval.training.calibration.touches import ScoredTouches, score_touches
from retrieval.training.calibration.verification import fit_verification
from retrieval.training.cca_towers import (
    MAX_CALIBRATION_TOUCHES,
    CcaProjections,
    CcaSelection,
    TowerWidths,
    select_settings,
    touch_rows,
    tower_widths,
)
from retrieval.training.features import Features, encode_recording, features_by_image
from retrieval.training.licences import checkpoint_licences
from retrieval.training.selection import held_out_folds

PRESET = "adapt"
PUBLISHED_TOWER = "mobilenet_v2"
"""Published tower that is combined with the towers of the start model, and backbone of the gel tower."""
NO_TOWER = "none"
"""Value of `init` for no published tower."""
GALLERY = 9
"""Approximate number of objects of a fold, which are the candidates of its touches."""
MIN_OBJECTS = 6
"""Minimum number of objects of an estimate: two folds of three."""


def adapt(
    recording: AnyRecording,
    out: Path,
    start: str | Path | Checkpoint | None = None,
    *,
    init: str = "imagenet",
    split: Split | None = None,
    quiet: bool = False,
) -> "Adaptation":
    """Fit a model to a recording from another sensor with your objects, and write the checkpoint `out`.

    If the pair accuracy of the start model on held-out objects is at least that of the fit, `out` is a copy of the
    start model with newly fitted calibrations and gel check.

    Args:
        recording: A folder, or the object that `robot.read_recording` returns.
        out: The checkpoint (.safetensors).
        start: The start model. Default: the shipped model for one finger, or for two or more.
        init: Weights of the published MobileNetV2 that is combined with the towers of the start model: "imagenet", a
            file, or "none" to use the towers of the start model only.
        split: A split whose test objects are not used at all.
        quiet: No progress on stderr.

    Raises:
        DatasetError: The recording cannot be read.
        BadInput: The recording has fewer than six objects.
        CheckpointError: `start` cannot be read, or `out` cannot be written.

    >>> from pathlib import Path
    >>> made = retrieval.adapt("lab", Path("mine.safetensors"), "model.safetensors", init="none", quiet=True)
    >>> made.checkpoint.path.name, len(made.features)
    ('mine.safetensors', 24)
    """
    require_writable(out)
    recording = folder_of(recording)
    grasps = load_grasps(recording)
    if not isinstance(start, Checkpoint):
        start = load_checkpoint(start or shipped_model(min(finger_count(grasps), 2)))
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    folds = draw_folds(grasps, load_config(PRESET).training.seed)
    data = AdaptationData.of(recording, grasps, start, init, quiet)
    estimate = estimate_accuracy(data, start, folds, quiet)
    calibrated = _calibrated_baseline if estimate.is_baseline_better else _calibrated_fit
    checkpoint = calibrated(start, data, estimate, quiet)
    store_checkpoint(checkpoint, out)
    return Adaptation(load_checkpoint(out), data.features, estimate)


@dataclass(frozen=True, eq=False)
class Adaptation:
    """Result of `adapt`.

    Attributes:
        checkpoint: The written checkpoint.
        features: Features of the fitted grasps.
        estimate: Accuracy on held-out objects.

    >>> from pathlib import Path
    >>> made = retrieval.adapt("lab", Path("own.safetensors"), "model.safetensors", init="none", quiet=True)
    >>> 0 <= made.estimate.to_dict()["held_out_top1"] <= 1
    True
    """

    checkpoint: Checkpoint
    features: Features
    estimate: "Estimate"


# Features of the combined towers ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AdaptationData:
    """The recorded grasps, the combined towers, and the features.

    Attributes:
        grasps: The grasps.
        config: Configuration of the fitted matcher.
        matcher: Matcher with the combined towers.
        features: Tower features of the grasps.
        low_pass: The same with low-pass (8 x 6) touches.
        widths: Feature widths of the combined towers.
        kind_of: The class of each object, as far as the recording has it.
        provenance: Source, licences and digest of the data.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    features: Features
    low_pass: Features
    widths: TowerWidths
    kind_of: dict[str, str]
    provenance: dict[str, object]

    @classmethod
    def of(cls, recording: Path, grasps: list[Grasp], start: Checkpoint, init: str, quiet: bool) -> "AdaptationData":
        """Encode grasps of a recording with the towers of `config_for`."""
        config = config_for(start, finger_count(grasps), init)
        matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
        load_towers(matcher, start, init)
        encode = partial(encode_recording, grasps, matcher, config, None, quiet=quiet)
        features = encode()
        low_pass = encode(touch_variant="low_pass", photo_features_from=features)
        licences = dict.fromkeys([*checkpoint_licences(start), recording_licence(recording)])
        provenance: dict[str, object] = {
            "source": recording_source(recording),
            LICENCES: [dataclasses.asdict(licence) for licence in licences],
            "data_digest": data_digest(grasps),
        }
        widths, kinds = tower_widths(config, features), object_kinds(recording)
        return cls(grasps, config, matcher, features, low_pass, widths, kinds, provenance)


def config_for(start: Checkpoint, fingers: int, init: str) -> Config:
    """Return the preset with the towers of the fit; with `init` "none" those of the start model only."""
    preset, source = load_config(PRESET), start.config.matcher
    names = {start.matcher.touch_tower: source.tower, start.matcher.photo_tower: source.photo_tower or source.tower}
    touch, photo = (
        TOWER_SEPARATOR.join(PUBLISHED_TOWER if isinstance(part, str) else names[part] for part in parts)
        for parts in _tower_sources(start, init)
    )
    matcher = dataclasses.replace(
        preset.matcher, tower=touch, photo_tower=photo, tower_output=source.tower_output, fingers=fingers
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="")
    return dataclasses.replace(preset, matcher=matcher, training=training)


def load_towers(matcher: Matcher, start: Checkpoint, init: str) -> None:
    """Load the weights of the towers of `config_for`; `init` are those of the published tower, or "none"."""
    for tower, sources in zip((matcher.touch_tower, matcher.photo_tower), _tower_sources(start, init), strict=True):
        parts = [part for one in sources for part in ([one] if isinstance(one, str) else one.backbones)]
        for backbone, source in zip(tower.backbones, parts, strict=True):
            if isinstance(source, str):
                backbone.initialise(source)
            else:
                backbone.load_state_dict(source.state_dict())


def _tower_sources(start: Checkpoint, init: str) -> tuple[list[Tower | str], list[Tower | str]]:
    """Return the parts of the touch tower and of the photo tower: towers of the start model, or initial weights."""
    touch: list[Tower | str] = [start.matcher.touch_tower]
    photo: list[Tower | str] = [start.matcher.photo_tower]
    if init == NO_TOWER:
        return touch, photo
    if start.config.matcher.tower_output == "stages":  # as the features of the gel tower
        touch.append(GEL)
    return [*touch, init], [init] if is_shipped(start.path) else [*photo, init]


# Accuracy on held-out objects ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Estimate:
    """Accuracy on held-out objects, of the fit, of the low-pass control and of the unadapted start model.

    Attributes:
        choice: The fit to all objects; its settings were selected by holding out half of each kind.
        folds: Objects that are left out together. The fit to the others selects its settings among them.
        baseline: Features of the grasps by the unadapted start model; None if it has another number of fingers.
        measures: "top1" and "pair_accuracy" of each, such as "held_out_top1", "held_out_top1_low_pass" and
            "baseline_top1".
    """

    choice: CcaSelection
    folds: list[tuple[str, ...]]
    baseline: Features | None
    measures: dict[str, Measure]

    @property
    def is_baseline_better(self) -> bool:
        """Whether the unadapted model has at least the pair accuracy of the fit."""
        means = self.to_dict()
        return means.get("baseline_pair_accuracy", 0.0) >= means["held_out_pair_accuracy"]

    def to_dict(self) -> dict[str, float]:
        """Return the metrics that the checkpoint stores: means over objects."""
        means = {name: float(measure.by_object()[1].mean()) for name, measure in self.measures.items()}
        return means | {"held_out_top1_chance": float(self.measures["held_out_top1"].chance[0])}


@one_thread()
def estimate_accuracy(data: AdaptationData, start: Checkpoint, folds: list[tuple[str, ...]], quiet: bool) -> Estimate:
    """Return the accuracy on the objects of each fold, of fits to the other objects."""
    measures: dict[str, Measure] = {}
    for suffix, features in (("", data.features), ("_low_pass", data.low_pass)):
        fits = fit_folds(features, folds, data, f"estimate{suffix}".replace("_", " "), quiet)
        left_out = [features.of_objects(fold) for fold in folds]
        scores = [
            fit.projections.cosines(touch_rows(part), part.photo) for fit, part in zip(fits, left_out, strict=True)
        ]
        found = accuracies(scores, left_out)
        measures |= {f"held_out_{name}{suffix}": measure for name, measure in found.items()}
    baseline = None
    if start.config.matcher.fingers == finger_count(data.grasps):
        baseline = encode_recording(data.grasps, start.matcher, start.config, None, quiet=quiet)
        scores = [part.logits for part in _baseline_touches(start, baseline, folds)]
        found = accuracies(scores, [baseline.of_objects(fold) for fold in folds])
        measures |= {f"baseline_{name}": measure for name, measure in found.items()}
    return Estimate(_choose_settings(data.features, data), folds, baseline, measures)


def draw_folds(grasps: Sequence[Grasp], seed: int) -> list[tuple[str, ...]]:
    """Draw folds of about `GALLERY` objects, each left out once; objects that share a sequence stay together.

    Raises:
        BadInput: There are fewer than `MIN_OBJECTS` objects.
    """
    groups = linked_objects(grasps)
    total = sum(map(len, groups))
    if total < MIN_OBJECTS:
        raise BadInput(f"A fit needs a recording of at least {MIN_OBJECTS} objects, got {total}. Record more.")
    folds: list[list[str]] = [[] for _ in range(min(max(round(total / GALLERY), 2), total // 3))]
    for place in np.random.default_rng([seed, 7]).permutation(len(groups)):
        min(folds, key=len).extend(groups[place])
    return [tuple(sorted(fold)) for fold in folds]


def fit_folds(
    features: Features, folds: Sequence[Sequence[str]], data: AdaptationData, title: str, quiet: bool
) -> Iterator[CcaSelection]:
    """Yield the fit to the objects outside each fold. The settings are selected on the same objects."""
    everyone = {name for fold in folds for name in fold}
    with Bar(title, len(folds), "folds", quiet=quiet) as bar:
        for fold in folds:
            yield _choose_settings(features.of_objects(everyone.difference(fold)), data)
            bar.advance()


def _choose_settings(features: Features, data: AdaptationData) -> CcaSelection:
    """Return settings, selected by holding out half of each kind of objects, and projections fitted to all objects."""
    parts = held_out_folds(features, data.kind_of, linked_objects(data.grasps), data.config.training.seed)
    return select_settings(features, data.widths, parts)


def accuracies(scores: Sequence[NDArray[np.float32]], folds: Sequence[Features]) -> dict[str, Measure]:
    """Return the accuracy of each touch of each fold with one random photo of each object of the fold.

    Args:
        scores: For each fold, (n, n) of every touch with every photo.
        folds: The grasps of each fold.

    Returns:
        "top1": whether the photo of the touched object ranks first; 1/m if m photos tie. "pair_accuracy": the fraction
        of the other objects' photos with a lower score; ties count 1/2.
    """
    names = sorted({name for fold in folds for name in fold.object_ids})
    parts: dict[str, list[Measure]] = {"top1": [], "pair_accuracy": []}
    for table, fold in zip(scores, folds, strict=True):
        rng, owner = np.random.default_rng([0, 8]), fold.owner
        rows = [np.flatnonzero(owner == name) for name in range(owner.max() + 1)]
        higher, equal = np.empty((2, len(fold)), np.int64)
        for touch, name in enumerate(owner):
            drawn = np.array([rng.choice(mine[mine != touch] if len(mine) > 1 else mine) for mine in rows])
            own, others = table[touch, drawn[name]], np.delete(table[touch, drawn], name)
            higher[touch], equal[touch] = (others > own).sum(), (others == own).sum()
        rivals, number = len(rows) - 1, np.array([names.index(each) for each in fold.object_ids])
        top1 = k_way_accuracies(higher, equal, rivals, len(rows))
        pairs = (1 - (higher + equal / 2) / rivals)[:, None]
        for name, values, chance in (("top1", top1[:, :1], 1 / len(rows)), ("pair_accuracy", pairs, 0.5)):
            parts[name].append(Measure(values, number, np.array([chance]), ""))
    sizes = sorted({len(set(fold.object_ids)) for fold in folds})
    gallery = " or ".join(map(str, sizes)) + " held-out objects, one photo of each"
    return {name: dataclasses.replace(pooled(each), gallery=gallery) for name, each in parts.items()}


@one_thread()
def _baseline_touches(
    start: Checkpoint,
    features: Features,
    folds: Sequence[Sequence[str]],
    max_touches: int | None = None,
    *,
    pooled: bool = False,
) -> list[ScoredTouches]:
    """Return the touches of each fold, at most `max_touches` of an object; `pooled`: without late interaction."""
    parts = []
    for part in map(features.of_objects, folds):
        if max_touches is not None:
            rows = [np.flatnonzero(part.owner == name)[:max_touches] for name in np.unique(part.owner)]
            part = part.select(np.concatenate(rows))
        tensors = torch.from_numpy(part.touch).flatten(1), torch.from_numpy(part.photo)
        own = np.eye(len(part), dtype=np.bool_)
        parts.append(score_touches(start.matcher, tensors, (part.owner, part.owner), own, pooled=pooled))
    return parts


# The checkpoint --------------------------------------------------------------------------------------------


def _log_odds(parts: Iterable[ScoredTouches]) -> tuple[float, float]:
    """Return scale and offset from cosine to log-odds of a match, with equally many true and false pairs."""
    cosines, labels = [], []
    for part in parts:
        same = part.touch_owner[:, None] == part.photo_owner
        rng = np.random.default_rng(0)
        pairs = [rng.permutation(np.flatnonzero(mask.ravel())) for mask in (same & ~part.own, ~same)]
        count = min(len(pairs[0]), len(pairs[1]), 20_000)
        cosines += [part.logits.ravel()[drawn[:count]] for drawn in pairs]
        labels += [np.ones(count), np.zeros(count)]
    return fit_calibration(np.concatenate(cosines), np.concatenate(labels))


@torch.no_grad()
def install_projections(matcher: Matcher, projections: CcaProjections, scale: float, offset: float) -> None:
    """Make the match logit `scale * cosine + offset` of the projected features; the layers of the head contribute 0."""
    for layer, found in ((matcher.touch_projection, projections.touch), (matcher.photo_projection, projections.photo)):
        assert isinstance(layer, nn.Linear)  # the configuration of `adapt` has no hidden layer
        used = found.weight.shape[1]  # shorter encodings leave zeros, which do not change the cosine
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:used] = torch.from_numpy(found.weight.T.astype(np.float32))
        layer.bias[:used] = torch.from_numpy(found.bias.astype(np.float32))
    for parameter in matcher.head.parameters():
        parameter.zero_()
    matcher.head.out.bias.fill_(offset)
    assert matcher.cosine_scale is not None
    matcher.cosine_scale.fill_(scale)


def _calibrated_fit(start: Checkpoint, data: AdaptationData, estimate: Estimate, quiet: bool) -> Checkpoint:
    """Return a checkpoint with projections fitted to all objects, calibrations and a gel check.

    The calibrations are fitted on the touches of held-out objects (half of each kind at a time), because the
    projections are overfitted to the fitted objects.
    """
    held_out, matcher = estimate.choice.held_out_touches, data.matcher
    with one_thread():
        scale, offset = _log_odds(held_out)
        install_projections(matcher, estimate.choice.projections, scale, offset)
    assert matcher.cosine_scale is not None
    scale, offset = matcher.cosine_scale.item(), matcher.head.out.bias.item()  # float32
    left_out = [dataclasses.replace(part, logits=scale * part.logits + offset) for part in held_out]
    posterior, references = fit_calibrations(left_out)
    made = Checkpoint(
        path=start.path,
        digest="",
        config=data.config,
        provenance={"step": 0, **data.provenance, "metrics": estimate.to_dict()},
        verification=fit_verification(left_out, posterior),
        matcher=matcher,
        split=Split(data.config.training.seed, tuple(sorted(set(data.features.object_ids))), (), ()),
        posterior=posterior,
        references=references,
    )
    return _with_gel_check(made, data.grasps, data.features, quiet)


def _calibrated_baseline(start: Checkpoint, data: AdaptationData, estimate: Estimate, quiet: bool) -> Checkpoint:
    """Return the start model with a gel check and calibrations fitted to the recorded objects."""
    assert estimate.baseline is not None
    checkpoint = _with_gel_check(start, data.grasps, estimate.baseline, quiet)
    about = {name: data.provenance[name] for name in ("source", "data_digest")}
    provenance = start.provenance | {
        "adapted_to": about,
        LICENCES: data.provenance[LICENCES],
        "metrics": estimate.to_dict(),
    }
    touches = partial(_baseline_touches, start, estimate.baseline, max_touches=MAX_CALIBRATION_TOUCHES)
    posterior, references = fit_calibrations(touches(estimate.folds))
    # Nothing was fitted to the objects, so a verification compares all of them with each other.
    verification = fit_verification(touches([data.features.object_ids]), posterior)
    made = dataclasses.replace(
        checkpoint, provenance=provenance, posterior=posterior, references=references, verification=verification
    )
    if start.config.matcher.cell_dim:
        posterior, references = fit_calibrations(touches(estimate.folds, pooled=True))
        made = dataclasses.replace(made, pooled_posterior=posterior, pooled_references=references)
    return made


def _with_gel_check(checkpoint: Checkpoint, grasps: list[Grasp], features: Features, quiet: bool) -> Checkpoint:
    """Return the checkpoint with a gel check: fitted on half of the objects, with thresholds from the others."""
    device = default_device()
    names = sorted({grasp.object_id for grasp in grasps})
    groups = [[grasp for grasp in grasps if grasp.object_id in names[side::2]] for side in (0, 1)]
    checkpoint.matcher.to(device)
    source = FrozenFeatures(checkpoint.config, features_by_image(grasps, features, device))
    return with_gel_check(checkpoint, source, *groups, quiet=quiet)
