"""Adapt a model to a new sensor and to your objects.

Touches are encoded by the frozen towers of the start model (pretrained on relief in simulation), by the gel tower of
the package (`retrieval.model.towers.weights.gel_tower`) and by a published tower (pretrained on photos); photos by the
tower of the start model and by the published one. The photo tower of a shipped model is left out, since it has seen
simulated photos only. The fit to these features is linear (`retrieval.training.cca`).

Every reported number comes from objects that were left out of the fit. On a similar sensor the start model is better
than a fit to a few objects: it is then kept, with new calibrations.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from retrieval.console.progress import Bar
from retrieval.data.dataset import (
    LICENCES,
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
from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.pairs import fit_calibration
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable, store_checkpoint
from retrieval.model.config import Config, load_config
from retrieval.model.encode import one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import is_shipped, shipped_model
from retrieval.model.towers import TOWER_SEPARATOR
from retrieval.model.towers.tower import Tower
from retrieval.model.towers.weights import GEL
from retrieval.training.calibration import ScoredTouches, score_touches, with_calibrations, with_sensor_calibrations
from retrieval.training.cca import (
    MAX_CALIBRATION_TOUCHES,
    CcaSelection,
    select_settings,
    tower_widths,
)
from retrieval.training.features import Features, encode_recording
from retrieval.training.initial_weights import checkpoint_licences
from retrieval.training.selection import held_out_folds

PUBLISHED_TOWER = "mobilenet_v2"
"""Published tower that is combined with the towers of the start model, and backbone of the gel tower."""
GALLERY = 9
"""Approximate number of objects of a fold, which are the candidates of its touches."""
MIN_OBJECTS = 6
"""Minimum number of objects of an estimate: two folds of three."""


@dataclass(frozen=True, eq=False)
class Adaptation:
    """Result of `adapt`.

    Attributes:
        checkpoint: The written checkpoint.
        measures: Accuracy on held-out objects: "held_out_top1" and "held_out_pair_accuracy" of the fit, the same with
            "_low_pass" touches (8 x 6, the control), and "baseline_top1" and "baseline_pair_accuracy" of the unadapted
            start model, which are absent if it has another number of fingers.
        is_baseline: Whether the checkpoint is the start model, since its pair accuracy is at least that of the fit.

    >>> from pathlib import Path
    >>> made = retrieval.adapt("lab", Path("own.safetensors"), "model.safetensors", init="none", quiet=True)
    >>> 0 <= made.checkpoint.provenance["metrics"]["held_out_top1"] <= 1
    True
    """

    checkpoint: Checkpoint
    measures: dict[str, Measure]
    is_baseline: bool


def adapt(
    recording: AnyRecording,
    out: Path,
    start: str | Path | Checkpoint | None = None,
    *,
    init: str = "imagenet",
    split: Split | None = None,
    quiet: bool = False,
) -> Adaptation:
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
    >>> made.checkpoint.path.name, made.is_baseline in (True, False)
    ('mine.safetensors', True)
    """
    require_writable(out)
    recording = folder_of(recording)
    grasps = load_grasps(recording)
    fingers = finger_count(grasps)
    if not isinstance(start, Checkpoint):
        start = load_checkpoint(start or shipped_model(min(fingers, 2)))
    if split is not None:
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    config, matcher = combined_matcher(start, fingers, init)
    seed = config.training.seed
    folds = draw_folds(grasps, seed)
    encode = partial(encode_recording, grasps, cache=None, quiet=quiet)
    features = encode(matcher, config)
    low_pass = encode(matcher, config, touch_variant="low_pass", photo_features_from=features)
    baseline = encode(start.matcher, start.config) if start.config.matcher.fingers == fingers else None
    widths, kinds, linked = tower_widths(config, features), object_kinds(recording), linked_objects(grasps)

    def fit(some: Features) -> CcaSelection:
        return select_settings(some, widths, held_out_folds(some, kinds, linked, seed))

    with one_thread():
        measures = dict[str, Measure]()
        for suffix, each in (("", features), ("_low_pass", low_pass)):
            fits = fit_folds(each, folds, fit, f"measuring accuracy{suffix}".replace("_", " "), quiet)
            parts = [each.of_objects(fold) for fold in folds]
            cosines = [
                one.projections.cosines(part.touch_rows, part.photo) for one, part in zip(fits, parts, strict=True)
            ]
            measures |= {f"held_out_{name}{suffix}": found for name, found in accuracies(cosines, parts).items()}
        if baseline is not None:
            logits = [part.logits for part in _baseline_touches(start, baseline, folds)]
            of_start = accuracies(logits, [baseline.of_objects(fold) for fold in folds])
            measures |= {f"baseline_{name}": found for name, found in of_start.items()}
    metrics = {name: float(measure.by_object()[1].mean()) for name, measure in measures.items()}
    kept = baseline if metrics.get("baseline_pair_accuracy", 0.0) >= metrics["held_out_pair_accuracy"] else None
    licences = dict.fromkeys([*checkpoint_licences(start), recording_licence(recording)])
    about: dict[str, object] = {"source": recording_source(recording), "data_digest": data_digest(grasps)}
    provenance = {
        LICENCES: [dataclasses.asdict(licence) for licence in licences],
        "metrics": metrics | {"held_out_top1_chance": float(measures["held_out_top1"].chance[0])},
    }
    if kept is not None:
        made = dataclasses.replace(start, provenance=start.provenance | {"adapted_to": about} | provenance)
        touches = partial(_baseline_touches, start, kept, max_touches=MAX_CALIBRATION_TOUCHES)
        # Nothing was fitted to the objects, so a verification compares all of them with each other.
        pooled_touches = touches(folds, pooled=True) if start.config.matcher.cell_dim else []
        made = with_calibrations(made, touches(folds), pooled_touches, touches([kept.object_ids]))
    else:
        with one_thread():
            choice = fit(features)
        made = Checkpoint(
            path=start.path,
            digest="",
            config=config,
            provenance={"step": 0, **about, **provenance},
            matcher=matcher,
            split=Split(seed, tuple(sorted(set(features.object_ids))), (), ()),
        )
        # The projections are overfitted to the fitted objects: calibrate on those that were held out.
        made = with_calibrations(made, install_projections(matcher, choice))
    made = with_sensor_calibrations(made, grasps, features if kept is None else kept, quiet=quiet)
    store_checkpoint(made, out)
    return Adaptation(load_checkpoint(out), measures, kept is not None)


# The combined towers ---------------------------------------------------------------------------------------


def combined_matcher(start: Checkpoint, fingers: int, init: str) -> tuple[Config, Matcher]:
    """Return the configuration and a matcher with the towers of the fit; `init` as for `adapt`."""
    preset, source = load_config("adapt"), start.config.matcher
    touch_parts: list[Tower | str] = [start.matcher.touch_tower]
    photo_parts: list[Tower | str] = [start.matcher.photo_tower]
    if init != "none":
        gel = [GEL] if source.tower_output == "stages" else []  # as the features of the gel tower
        touch_parts += [*gel, init]
        photo_parts = [init] if is_shipped(start.path) else [*photo_parts, init]
    names = {start.matcher.touch_tower: source.tower, start.matcher.photo_tower: source.photo_tower or source.tower}
    touch, photo = (
        TOWER_SEPARATOR.join(PUBLISHED_TOWER if isinstance(part, str) else names[part] for part in parts)
        for parts in (touch_parts, photo_parts)
    )
    settings = dataclasses.replace(
        preset.matcher, tower=touch, photo_tower=photo, tower_output=source.tower_output, fingers=fingers
    )
    training = dataclasses.replace(preset.training, init="random", init_touch="", init_photo="")
    config = dataclasses.replace(preset, matcher=settings, training=training)
    matcher = Matcher(config.matcher, len(config.preprocessing.views)).eval()
    for tower, parts in ((matcher.touch_tower, touch_parts), (matcher.photo_tower, photo_parts)):
        weights = [each for part in parts for each in ([part] if isinstance(part, str) else part.backbones)]
        for backbone, initial in zip(tower.backbones, weights, strict=True):
            if isinstance(initial, str):
                backbone.initialise(initial)
            else:
                backbone.load_state_dict(initial.state_dict())
    return config, matcher


# Accuracy on held-out objects ------------------------------------------------------------------------------


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
    features: Features, folds: Sequence[Sequence[str]], fit: Callable[[Features], CcaSelection], title: str, quiet: bool
) -> Iterator[CcaSelection]:
    """Yield the fit to the objects outside each fold. The settings are selected on the same objects."""
    everyone = {name for fold in folds for name in fold}
    with Bar(title, len(folds), "folds", quiet=quiet) as bar:
        for fold in folds:
            yield fit(features.of_objects(everyone.difference(fold)))
            bar.advance()


def accuracies(scores: Sequence[NDArray[np.float32]], folds: Sequence[Features]) -> dict[str, Measure]:
    """Return the accuracy of each touch of each fold with one random photo of each object of the fold.

    "top1" is whether the photo of the touched object ranks first; 1/m if m photos tie. "pair_accuracy" is the fraction
    of the other objects' photos with a lower score; ties count 1/2. `scores` of a fold (n, n) are of every touch with
    every photo.
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
        number = np.array([names.index(each) for each in fold.object_ids])
        top1, pairs = np.where(higher == 0, 1 / (1 + equal), 0.0), 1 - (higher + equal / 2) / (len(rows) - 1)
        for name, values, chance in (("top1", top1, 1 / len(rows)), ("pair_accuracy", pairs, 0.5)):
            parts[name].append(Measure(values[:, None], number, np.array([chance]), ""))
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
        rows = [np.flatnonzero(part.owner == name)[:max_touches] for name in np.unique(part.owner)]
        part = part.select(np.sort(np.concatenate(rows)))
        tensors = torch.from_numpy(part.touch_rows), torch.from_numpy(part.photo)
        own = np.eye(len(part), dtype=np.bool_)
        parts.append(score_touches(start.matcher, tensors, (part.owner, part.owner), own, pooled=pooled))
    return parts


# The fit ---------------------------------------------------------------------------------------------------


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


@one_thread()
@torch.no_grad()
def install_projections(matcher: Matcher, choice: CcaSelection) -> list[ScoredTouches]:
    """Make the match logit `scale * cosine + offset` of the projected features, and return the held-out touches.

    The layers of the head contribute 0. The touches have these logits, by projections that were fitted without them.
    """
    projections, (scale, offset) = choice.projections, _log_odds(choice.held_out_touches)
    for layer, found in ((matcher.touch_projection, projections.touch), (matcher.photo_projection, projections.photo)):
        assert isinstance(layer, nn.Linear)  # the configuration of `adapt` has no hidden layer
        used = found.weight.shape[1]  # shorter encodings leave zeros, which do not change the cosine
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:used] = torch.from_numpy(found.weight.T.astype(np.float32))
        layer.bias[:used] = torch.from_numpy(found.bias.astype(np.float32))
    for parameter in matcher.head.parameters():
        parameter.zero_()
    assert matcher.cosine_scale is not None
    matcher.cosine_scale.fill_(scale)
    matcher.head.out.bias.fill_(offset)
    scale, offset = matcher.cosine_scale.item(), matcher.head.out.bias.item()  # float32
    return [dataclasses.replace(part, logits=scale * part.logits + offset) for part in choice.held_out_touches]
