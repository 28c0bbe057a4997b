"""Fit a model to a recording of touches only: it identifies an object from other touches of it.

Frozen towers encode the touches: the gel tower of the package, and a published tower, pretrained on photos. As in
`retrieval.training.cca`, the features of each tower are reduced to their widest directions, with equal weight for every
tower. A linear map then divides them by their spread within the objects (within-class covariance normalisation; Hatch,
Kajarekar and Stolcke, Interspeech 2006):

    code = (W + ridge * v * I)^(-1/2) x

x: a reduced touch; W: covariance of touches about the mean of their object; v: mean variance of x. Two touches are
compared by the cosine of their codes. With a large ridge these are principal components. All directions are kept, so
the map also serves objects that the fit did not see; canonical variates, fewer than the objects, were worse there.

Touches of one session, or without sessions of one sequence, are never compared with each other.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import DataLicence, Grasp, Split, finger_count, linked_objects, object_kinds
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure, pooled
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.references import reference_similarity
from retrieval.model.towers import NO_TOWER
from retrieval.training.calibration.checkpoint import with_sensor_calibrations
from retrieval.training.calibration.references import fit_references
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.cca import (
    MAX_CALIBRATION_TOUCHES,
    MAX_CHOICE_TOUCHES,
    AffineMap,
    CcaProjections,
    CcaSettings,
    Modality,
    unit_rows,
)
from retrieval.training.features import Features, encode_recording
from retrieval.training.initial_weights import build_matcher, training_licences
from retrieval.training.linear import available_config, install_projections
from retrieval.training.selection import (
    COMPARED,
    LOW_PASS,
    MIN_OBJECTS,
    accuracy_row,
    comparison_table,
    draw_folds,
    held_out_folds,
    objects_of_two_sessions,
    ranking_auc,
    validation_rows,
)

Numbers = NDArray[np.int64]
RIDGES = (0.03, 0.1, 0.3, 1.0, 10.0)
DIRECTIONS = 256
"""Directions of each tower's features."""
TURNS = 3
"""Parts of a recording without sessions, each of which is compared with the others."""


# The fit ---------------------------------------------------------------------------------------------------


def fit_maps(
    features: NDArray[np.float32], widths: Sequence[int], owner: Numbers, ridges: Sequence[float] = RIDGES
) -> dict[float, AffineMap]:
    """Return the map to codes for each ridge, given touches (n, F), the widths of towers, and objects (n,)."""
    reduction, settings = Modality(features, widths, DIRECTIONS), CcaSettings(directions=DIRECTIONS)
    items = reduction.items(settings)
    objects, place, counts = np.unique(owner, return_inverse=True, return_counts=True)
    means = np.eye(len(objects))[:, place] @ items / counts[:, None]
    within = items - means[place]
    variances, directions = np.linalg.eigh(within.T @ within / len(items))
    variance = float((items**2).mean())
    bias = np.zeros(items.shape[1])
    # The cosine is the same after a rotation, so the codes stay in the directions of the eigenvectors.
    return {
        ridge: reduction.compose(
            settings, AffineMap(directions / np.sqrt(np.maximum(variances, 0) + ridge * variance), bias)
        )
        for ridge in ridges
    }


def divide(grasps: Sequence[Grasp]) -> tuple[bool, Numbers, Numbers]:
    """Divide the touches of a recording (G) into groups; a touch is compared with those of other turns only.

    Returns:
        Whether the groups are sessions: half of the objects, or 12, have touches of two.
        (G,) session; without several sessions the sequence, or the grasp itself; numbers in order of capture.
        (G,) turn: the session, or the number of the group within its object, modulo `TURNS`.

    Raises:
        BadInput: Fewer than `MIN_OBJECTS` objects have two groups.
    """
    has_sessions = bool(objects_of_two_sessions(grasps, MIN_OBJECTS))
    names = [(grasp.session if has_sessions else grasp.sequence_id or grasp.grasp_id) or "" for grasp in grasps]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    group = np.array([numbers[name] for name in names])
    turn, repeated = group.copy(), 0
    for name in {grasp.object_id for grasp in grasps}:
        mine = [place for place, grasp in enumerate(grasps) if grasp.object_id == name]
        found, number = np.unique(group[mine], return_inverse=True)
        repeated += len(found) > 1
        if not has_sessions:
            turn[mine] = number % TURNS
    if repeated < MIN_OBJECTS:
        raise BadInput(
            f"a fit to touches needs {MIN_OBJECTS} objects with touches of two sequences; {repeated} object(s) have "
            "them: touch the objects again, best in another session"
        )
    return has_sessions, group, turn


class Touches(NamedTuple):
    """Encoded touches in the order of capture.

    Attributes:
        features: Features of G grasps, with those of the touches in place of those of photos.
        owner: (G,) objects.
        group: (G,) as of `divide`.
        turn: (G,) as of `divide`.
    """

    features: Features
    owner: Numbers
    group: Numbers
    turn: Numbers

    def select(self, rows: NDArray[np.int64]) -> "Touches":
        """Return the touches at `rows`, in that order."""
        return Touches(self.features.select(rows), self.owner[rows], self.group[rows], self.turn[rows])


@dataclass(frozen=True, eq=False)
class TouchFit:
    """A map with the ridge that ranks touches of held-out objects best; among ties, the largest.

    Attributes:
        map: The map, fitted to all touches.
        held_out: For each fold, its touches by a map that was fitted without its objects: the input of the
            calibrations. Of each object at most `MAX_CALIBRATION_TOUCHES`, evenly spaced.
    """

    map: AffineMap
    held_out: list[ScoredTouches]


def fit_touches(
    touches: Touches, widths: Sequence[int], folds_of: Callable[[Features], Sequence[Sequence[str]]]
) -> TouchFit:
    """Fit a map to touches; `folds_of` returns the objects that are held out together to choose the ridge."""
    aucs: dict[float, list[float]] = {ridge: [] for ridge in RIDGES}
    scored: dict[float, list[ScoredTouches]] = {ridge: [] for ridge in RIDGES}
    for fold in (each for each in folds_of(touches.features) if len(each) > 1):
        is_held_out = np.isin(touches.features.object_ids, fold)
        others, part = (touches.select(np.flatnonzero(mask)) for mask in (~is_held_out, is_held_out))
        maps = fit_maps(others.features.touch_rows, widths, others.owner)
        some = validation_rows(part.features, MAX_CHOICE_TOUCHES)
        kept = validation_rows(part.features, MAX_CALIBRATION_TOUCHES * len(fold))
        no_photos, none = np.zeros((len(kept), 0)), np.zeros(0, np.int64)
        for ridge, found in maps.items():
            codes = unit_rows(found(part.features.touch_rows))
            aucs[ridge].append(ranking_auc(codes[some] @ codes[some].T, part.owner[some], part.group[some]))
            of_fold = no_photos, part.owner[kept], none, no_photos > 0, codes[kept]
            scored[ridge].append(ScoredTouches(*of_fold, touch_group=part.group[kept]))
    best = max(aucs, key=lambda ridge: (np.mean(aucs[ridge]), ridge))
    return TouchFit(fit_maps(touches.features.touch_rows, widths, touches.owner, [best])[best], scored[best])


# Accuracy ---------------------------------------------------------------------------------------------------


def recognition(touches: Touches, fit: Callable[[Numbers], TouchFit], gallery: str) -> Measure:
    """Return whether the object of each touch is the most similar one, given the touches of the other turns.

    Args:
        touches: The touches. Objects without touches of another turn are no queries of this turn.
        fit: Returns a fit, given the rows of the references.
        gallery: Description of the objects.
    """
    parts = []
    for turn in np.unique(touches.turn):
        references = np.flatnonzero(touches.turn != turn)
        references = references[np.argsort(touches.owner[references], kind="stable")]
        objects, starts = np.unique(touches.owner[references], return_index=True)
        queries = np.flatnonzero((touches.turn == turn) & np.isin(touches.owner, objects))
        if len(queries):
            codes, owner = unit_rows(fit(references).map(touches.features.touch_rows)), touches.owner[queries]
            near = reference_similarity(codes[queries] @ codes[references].T, starts)
            own = np.take_along_axis(near, np.searchsorted(objects, owner)[:, None], 1)
            values = np.where((near > own).any(1), 0.0, 1 / (near == own).sum(1))
            parts.append(Measure(values[:, None], owner, np.array([1 / len(objects)]), gallery))
    return pooled(parts)


def _accuracies(
    touches: Touches, folds: Sequence[Sequence[str]], fit: Callable[[Touches], TouchFit]
) -> Iterator[tuple[str, Measure]]:
    """Yield the accuracy of "same" objects, which the fit knows from other turns, and of "new" ones."""
    gallery = f"the same {len(np.unique(touches.owner))} objects"
    yield "same", recognition(touches, lambda rows: fit(touches.select(np.sort(rows))), gallery)
    parts = []
    for fold in folds:
        is_new = np.isin(touches.features.object_ids, fold)
        fitted = fit(touches.select(np.flatnonzero(~is_new)))
        part = touches.select(np.flatnonzero(is_new))
        parts.append(recognition(part, lambda _: fitted, f"about {len(fold)} new objects"))  # noqa: B023
    yield "new", pooled(parts)


# The checkpoint ---------------------------------------------------------------------------------------------


def fit_to_touches(recording: Path, grasps: Sequence[Grasp], init: str) -> tuple[Checkpoint, list[DataLicence]]:
    """Fit a model to the touches of grasps of a recording; return it, and the licences of its data.

    Raises:
        BadInput: There are fewer than six objects, or no object was touched again.
        CheckpointError: The weights cannot be read.
    """
    published, linked = available_config(finger_count(grasps), init), linked_objects(grasps)
    config = Config(
        dataclasses.replace(published.matcher, photo_tower=NO_TOWER),
        dataclasses.replace(published.training, init_photo="random"),
        Preprocessing(touch_px=published.preprocessing.touch_px, photo_px=32, background="none"),
    )
    seed, folds = config.training.seed, draw_folds(linked)
    licences = training_licences(recording, config.training)
    matcher = build_matcher(config).eval()
    widths = [part.feature_count for part in matcher.touch_tower.backbones] * config.matcher.fingers
    folds_of = partial(held_out_folds, kind_of=object_kinds(recording), linked=linked, seed=seed)
    fit = partial(fit_touches, widths=widths, folds_of=folds_of)
    has_sessions, group, turn = divide(grasps)
    measures, encoded = dict[str, Measure](), dict[str, Touches]()
    for variant, suffix in (("touch", ""), ("low_pass", "_low_pass")):
        features = encode_recording(grasps, matcher, config, None, touch_variant=variant, photo_variant="none")
        features = dataclasses.replace(features, photo=features.touch_rows)
        encoded[variant] = touches = Touches(features, features.owner, group, turn)
        with one_thread():
            measures |= {f"{name}{suffix}": measure for name, measure in _accuracies(touches, folds, fit)}
    with one_thread():
        choice = fit(encoded["touch"])
    references = fit_references(*choice.held_out, seed=seed)
    if references is None:
        raise BadInput("too few objects have touches of two sequences to calibrate the model; touch more objects again")
    config, matcher = _with_map(config, matcher, choice.map)
    made = Checkpoint(
        path=Path("touches"),
        digest="",
        config=config,
        provenance={
            "step": 0,
            COMPARED: _table(measures, has_sessions),
            "metrics": {f"{name}_top1": float(measure.by_object()[1].mean()) for name, measure in measures.items()},
        },
        matcher=matcher,
        split=Split(seed, tuple(sorted({grasp.object_id for grasp in grasps})), (), ()),
        posterior=references.touch_only,
        references=references,
    )
    return with_sensor_calibrations(made, grasps, encoded["touch"].features), licences


def _table(measures: Mapping[str, Measure], has_sessions: bool) -> dict[str, Any]:
    """Return the accuracies for `retrieval.training.selection.COMPARED`."""
    rows = {
        f"{measures[name].gallery}{suffix}": accuracy_row(measures[f"{name}{variant}"])
        for name in ("same", "new")
        for suffix, variant in (("", ""), (f", {LOW_PASS}", "_low_pass"))
    }
    same, low_pass = (measures[name] for name in ("same", "same_low_pass"))
    title = f"one touch, compared with touches of another {'session' if has_sessions else 'sequence'}"
    return comparison_table(title, rows, same, low_pass, across_sessions=has_sessions)


def _with_map(config: Config, matcher: Matcher, found: AffineMap) -> tuple[Config, Matcher]:
    """Return the matcher whose embedding of a touch is its code, with the same towers, and its configuration."""
    settings = dataclasses.replace(config.matcher, embedding_dim=len(found.bias))
    made = Matcher(settings).eval()
    made.touch_tower = matcher.touch_tower
    no_photo = AffineMap(np.zeros((made.pooled_counts[1], len(found.bias))), np.eye(len(found.bias))[0])
    install_projections(made, CcaProjections(found, no_photo), 1.0, 0.0)  # an index requires unit embeddings
    return dataclasses.replace(config, matcher=settings, training=config.training.with_given_weights()), made
