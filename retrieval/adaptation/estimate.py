"""What a fit is worth: first guesses on own objects that were left out of it, beside the same of blurred touches."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from retrieval.adaptation.baseline import UnadaptedBaseline
from retrieval.adaptation.data import AdaptationData
from retrieval.adaptation.folds import Fold, choose_settings, draw_folds, fit_folds, fold_accuracy, measure
from retrieval.console.output import say
from retrieval.errors import BadInput
from retrieval.methods.cca_towers import CcaSelection
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import one_thread


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the fit is worth on objects left out; the same of blurred touches is the control.

    choice: the fit to all objects, whose settings were chosen by holding out half of each kind. folds: the fits behind
    the estimate, each with settings chosen in the same way among the objects that taught it. first, below: first
    guesses among a fold's objects, and pairs.
    known: the model that one starts from, with nothing fitted; known_first, known_below: what it is worth.
    """

    choice: CcaSelection
    folds: list[Fold]
    baseline: UnadaptedBaseline
    top1: Measure
    pair_accuracy: Measure
    low_pass_top1: Measure
    low_pass_pair_accuracy: Measure
    baseline_top1: Measure
    baseline_pair_accuracy: Measure

    @property
    def is_baseline_better(self) -> bool:
        """Whether the model as it is tells these objects apart better than the fit does. One for another number of
        fingers cannot be kept.
        """
        fingers = self.baseline.start.config.matcher.fingers == self.folds[0].left_out.touch.shape[1]
        return fingers and mean(self.baseline_pair_accuracy) >= mean(self.pair_accuracy)

    def lines(self) -> list[str]:
        """The estimate as lines for people."""
        found = [
            ("first guess", self.top1, self.low_pass_top1),
            ("pair accuracy", self.pair_accuracy, self.low_pass_pair_accuracy),
        ]
        lines = [f"objects left out once each, one touch, {self.top1.gallery}:"]
        for name, touched, control in found:
            mine, other, gain = summarise([touched]), summarise([control]), compare([touched], [control])
            lines.append(
                f"  {name} {interval(mine)}; blurred touch {interval(other)}; chance {mine['chance'][0]:.3f}; "
                f"difference {gain['difference']:+.3f} [{gain['low']:+.3f}, {gain['high']:+.3f}]"
            )
        lines.append("  " + self.verdict)
        baseline = [interval(summarise([each])) for each in (self.baseline_top1, self.baseline_pair_accuracy)]
        lines.append(f"the model as it is: first guess {baseline[0]}, pair accuracy {baseline[1]}")
        if self.is_baseline_better:
            lines.append("  it is kept: a fit to these objects knows less; its probabilities are fitted to them")
        return lines

    @property
    def verdict(self) -> str:
        """Whether the touch itself was felt, in words."""
        gain = compare([self.top1], [self.low_pass_top1])
        if gain["low"] > 0:
            return "the touch tells more than its blur does: what was learnt is more than light and coarse shape"
        return "the touch tells no more than its blur does: this is not shown to be touch; record more objects"

    def to_dict(self) -> dict[str, float]:
        """The numbers that a checkpoint keeps as its metrics."""
        return {
            "held_out_top1": mean(self.top1),
            "held_out_top1_low_pass": mean(self.low_pass_top1),
            "held_out_top1_chance": float(self.top1.chance[0]),
            "held_out_pair_accuracy": mean(self.pair_accuracy),
            "held_out_pair_accuracy_low_pass": mean(self.low_pass_pair_accuracy),
            "baseline_top1": mean(self.baseline_top1),
            "baseline_pair_accuracy": mean(self.baseline_pair_accuracy),
        }


def mean(measure: Measure) -> float:
    """The mean of a measure over objects, which count alike."""
    return float(measure.by_object()[1].mean())


def interval(summary: dict[str, Any]) -> str:
    """A value with its interval."""
    return f"{summary['value'][0]:.3f} [{summary['low'][0]:.3f}, {summary['high'][0]:.3f}]"


@one_thread()
def estimate_accuracy(
    data: AdaptationData, start: Checkpoint, *, cache: Path | None, seed: int, quiet: bool
) -> Estimate | None:
    """The estimate from objects left out; None where there are too few of them."""
    try:
        drawn = draw_folds(data.grasps, seed)
    except BadInput as error:
        if not quiet:
            say(f"nothing is known of how good this is: {error}")
        return None
    folds, low_pass = (
        list(fit_folds(features, drawn, data, seed=seed, label=label, quiet=quiet))
        for features, label in ((data.features, "touches"), (data.low_pass, "blurred touches"))
    )
    choice = choose_settings(data.features, data, seed)
    fold_accuracies, control = list(map(fold_accuracy, folds)), list(map(fold_accuracy, low_pass))
    baseline = UnadaptedBaseline.of(start, data.grasps, cache, quiet)
    rows = (fold_accuracies, control, baseline.fold_accuracies(drawn))
    measures = (measure(parts, column) for parts in rows for column in ("top1", "pair_accuracy"))
    return Estimate(choice, folds, baseline, *measures)
