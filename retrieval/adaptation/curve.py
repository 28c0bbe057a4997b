"""Learning curve: accuracy on held-out objects of fits to fewer recorded objects and fewer touches."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from _touch_retrieval.files import write_atomically
from retrieval.adaptation.baseline import UnadaptedBaseline
from retrieval.adaptation.data import AdaptationData
from retrieval.adaptation.folds import Fold, draw_folds, fold_accuracy, measure
from retrieval.console.progress import Bar
from retrieval.methods.cca_towers import CcaSettings, TowerWidths, fit_projections
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import one_thread
from retrieval.report.canvas import MUTED_COLOUR, Figure, canvas, draw, percent_axis
from retrieval.training.features import Features
from retrieval.version import __version__

OBJECTS, TOUCHES = (5, 10, 20, 1000), (5, 20, 100)
"""Numbers of recorded objects to fit (at most all outside the fold), and of touches of each object."""
SETTINGS = CcaSettings()
"""Settings of every fit on the curve: few objects leave none for validation."""
ADAPTED = "adapted"
LOW_PASS, UNADAPTED = "adapted, low-pass touches", "the unadapted model"
COLOURS = ("#9ecae1", "#56b4e9", "#0072b2", "#08306b")


Interval = tuple[float, float, float]


@dataclass(frozen=True)
class CurvePoint:
    """One point of the curve: a fit and its accuracy on held-out objects.

    Attributes:
        label: The kind of fit.
        objects: Number of fitted objects.
        touches: Number of touches of each object.
        top1: Top-1 accuracy and the ends of its interval by object.
        pair_accuracy: Pair accuracy and the ends of its interval by object.
        chance: Chance level of the top-1 accuracy.
    """

    label: str
    objects: int
    touches: int
    top1: Interval
    pair_accuracy: Interval
    chance: float

    @classmethod
    def of(cls, label: str, objects: int, touches: int, top1: Measure, pair_accuracy: Measure) -> "CurvePoint":
        """Return the point of these measures on held-out objects."""
        return cls(label, objects, touches, interval_of(top1), interval_of(pair_accuracy), float(top1.chance[0]))


def interval_of(measure: Measure) -> Interval:
    """Return the value of a measure and the ends of its interval."""
    found = summarise([measure])
    return found["value"][0], found["low"][0], found["high"][0]


@one_thread()
def learning_curve(
    data: AdaptationData, start: Checkpoint, *, cache: Path | None = None, seed: int = 0, quiet: bool = False
) -> list[CurvePoint]:
    """Fit to fewer touches of fewer objects and measure the accuracy on held-out objects.

    For comparison the curve includes the unadapted model and, with all objects and touches, the low-pass control.

    Raises:
        BadInput: There are fewer than six objects.
    """
    folds = draw_folds(data.grasps, seed)
    features = data.features
    max_objects = min(len(set(features.object_ids)) - len(fold) for fold in folds)
    max_touches = int(np.bincount(features.owner).min())
    objects, touches = (
        sorted({min(count, end) for count in counts})
        for counts, end in ((OBJECTS, max_objects), (TOUCHES, max_touches))
    )
    fits = [(ADAPTED, features, count, each) for count in objects for each in touches]
    fits.append((LOW_PASS, data.low_pass, objects[-1], touches[-1]))
    baseline = UnadaptedBaseline.of(start, data.grasps, cache, quiet).fold_accuracies(folds)
    points = [CurvePoint.of(UNADAPTED, 0, 0, measure(baseline, "top1"), measure(baseline, "pair_accuracy"))]
    with Bar("learning curve", len(fits), "fits", quiet=quiet) as bar:
        for label, inputs, count, each in fits:
            points.append(_point(label, inputs, data.blocks, folds, count, each, seed))
            bar.advance()
    return points


def _point(
    label: str,
    features: Features,
    blocks: TowerWidths,
    folds: Sequence[Sequence[str]],
    objects: int,
    touches: int,
    seed: int,
) -> CurvePoint:
    """Return a point of the curve: for each fold a fit to random outside objects and touches, scored on the fold."""
    rng = np.random.default_rng([seed, objects, touches])
    everyone = {name for fold in folds for name in fold}
    number_of = {name: number for number, name in enumerate(sorted(set(features.object_ids)))}
    parts = []
    for fold in folds:
        chosen = rng.permutation(sorted(everyone.difference(fold)))[:objects]
        rows = [rng.permutation(np.flatnonzero(features.owner == number_of[name]))[:touches] for name in chosen]
        drawn = features.select(np.sort(np.concatenate(rows)))
        touch = drawn.touch.reshape(len(drawn), -1)
        projections = dict(fit_projections(touch, drawn.photo, drawn.owner, blocks, [SETTINGS]))[SETTINGS]
        parts.append(fold_accuracy(Fold(features.of_objects(fold), projections, SETTINGS)))
    return CurvePoint.of(label, objects, touches, measure(parts, "top1"), measure(parts, "pair_accuracy"))


def write_curve(folder: Path, points: Sequence[CurvePoint]) -> Path:
    """Write curve.json, curve.png and curve.md to `folder`; return the path of curve.md."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {"software": __version__, "points": [asdict(point) for point in points]}
    write_atomically(folder / "curve.json", f"{json.dumps(document, indent=1)}\n".encode())
    draw(folder / "curve.png", _figure, points)
    path = folder / "curve.md"
    write_atomically(path, "\n".join(_text(points)).encode())
    return path


def _text(points: Sequence[CurvePoint]) -> Iterator[str]:
    yield from ("# Accuracy by number of fitted objects and touches", "")
    yield "Top-1 accuracy and pair accuracy of one touch on objects that were left out of the fit. Intervals resample"
    yield f"objects; chance is {points[0].chance:.3f} and 0.500.\n"
    yield "| fit | objects | touches of each | top-1 accuracy | pair accuracy |\n|---|---|---|---|---|"
    for point in points:
        yield (
            f"| {point.label} | {point.objects} | {point.touches} | {{:.3f}} [{{:.3f}}, {{:.3f}}] ".format(*point.top1)
            + "| {:.3f} [{:.3f}, {:.3f}] |".format(*point.pair_accuracy)
        )
    yield "\n![learning curve](curve.png)\n"


def _figure(points: Sequence[CurvePoint]) -> Figure:
    figure = canvas(6.4, 3.8)
    panel = figure.add_subplot()
    fitted = [point for point in points if point.label == ADAPTED]
    for objects, colour in zip(sorted({point.objects for point in fitted}), COLOURS, strict=False):
        line = [point for point in fitted if point.objects == objects]
        across = [point.touches for point in line]
        panel.fill_between(
            across,
            [100 * p.top1[1] for p in line],
            [100 * p.top1[2] for p in line],
            color=colour,
            alpha=0.12,
            lw=0,
        )
        panel.plot(across, [100 * p.top1[0] for p in line], "o-", color=colour, label=f"{objects} objects")
    for label, dashes in ((UNADAPTED, ":"), (LOW_PASS, "--")):
        level = next(100 * point.top1[0] for point in points if point.label == label)
        panel.axhline(level, color=MUTED_COLOUR, ls=dashes, lw=1.2, label=label)
    panel.axhline(100 * points[0].chance, color=MUTED_COLOUR, lw=0.8, label="chance")
    panel.set_xscale("log")
    ticks = sorted({point.touches for point in fitted})
    panel.set_xticks(ticks, [str(tick) for tick in ticks])
    panel.minorticks_off()
    panel.set_xlabel("touches of each fitted object")
    percent_axis(panel, "top-1 accuracy, held-out objects (%)")
    panel.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure
