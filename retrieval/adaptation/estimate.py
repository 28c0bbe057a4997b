"""Accuracy estimate of a fit: top-1 and pair accuracy on held-out objects, compared with low-pass touches."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from retrieval.adaptation.baseline import UnadaptedBaseline
from retrieval.adaptation.data import AdaptationData
from retrieval.adaptation.folds import Fold, choose_settings, draw_folds, fit_folds, measure
from retrieval.console.output import say
from retrieval.errors import BadInput
from retrieval.methods.cca_towers import CcaSelection
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import one_thread


@dataclass(frozen=True, eq=False)
class Estimate:
    """Accuracy on held-out objects, of the fit, of the low-pass control and of the unadapted baseline.

    Attributes:
        choice: The fit to all objects; its settings were selected by holding out half of each kind.
        folds: The fits of the estimate; each selects its settings in the same way among its own fitted objects.
        baseline: The unadapted start model.
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
        """Whether the unadapted model has at least the pair accuracy of the fit.

        A model for another number of fingers cannot be used and is never better.
        """
        same_fingers = self.baseline.start.config.matcher.fingers == self.folds[0].left_out.touch.shape[1]
        return same_fingers and mean(self.baseline_pair_accuracy) >= mean(self.pair_accuracy)

    def lines(self) -> list[str]:
        """Return the estimate as lines of text."""
        found = [
            ("top-1 accuracy", self.top1, self.low_pass_top1),
            ("pair accuracy", self.pair_accuracy, self.low_pass_pair_accuracy),
        ]
        lines = [f"each object held out once, one touch, {self.top1.gallery}:"]
        for name, touched, control in found:
            mine, other, gain = summarise([touched]), summarise([control]), compare([touched], [control])
            lines.append(
                f"  {name} {interval(mine)}; low-pass touch {interval(other)}; chance {mine['chance'][0]:.3f}; "
                f"difference {gain['difference']:+.3f} [{gain['low']:+.3f}, {gain['high']:+.3f}]"
            )
        lines.append("  " + self.verdict)
        baseline = [interval(summarise([each])) for each in (self.baseline_top1, self.baseline_pair_accuracy)]
        lines.append(f"unadapted model: top-1 accuracy {baseline[0]}, pair accuracy {baseline[1]}")
        if self.is_baseline_better:
            lines.append(
                "  The unadapted model is used: its pair accuracy is at least that of the fit. "
                "Only its calibrations and its check of gel images are fitted."
            )
        return lines

    @property
    def verdict(self) -> str:
        """A sentence on whether the fit is better than its low-pass control."""
        gain = compare([self.top1], [self.low_pass_top1])
        if gain["low"] > 0:
            return "Better than the low-pass control: the fit uses more than light and coarse shape."
        return (
            "Not better than the low-pass control: there is no evidence that the fit uses touch. Record more objects."
        )

    def to_dict(self) -> dict[str, float]:
        """Return the metrics that the checkpoint stores."""
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
    """Return the mean of a measure over objects, with equal weights."""
    return float(measure.by_object()[1].mean())


def interval(summary: dict[str, Any]) -> str:
    """Format a value with its interval."""
    return f"{summary['value'][0]:.3f} [{summary['low'][0]:.3f}, {summary['high'][0]:.3f}]"


@one_thread()
def estimate_accuracy(
    data: AdaptationData, start: Checkpoint, *, cache: Path | None, seed: int, quiet: bool
) -> Estimate | None:
    """Return the accuracy on held-out objects; None if there are too few objects."""
    try:
        drawn = draw_folds(data.grasps, seed)
    except BadInput as error:
        if not quiet:
            say(f"no accuracy estimate: {error}")
        return None
    folds, low_pass = (
        list(fit_folds(features, drawn, data, seed=seed, label=label, quiet=quiet))
        for features, label in ((data.features, "touches"), (data.low_pass, "low-pass touches"))
    )
    choice = choose_settings(data.features, data, seed)
    fold_accuracies, control = ([fold.accuracy() for fold in each] for each in (folds, low_pass))
    baseline = UnadaptedBaseline.of(start, data.grasps, cache, quiet)
    rows = (fold_accuracies, control, baseline.fold_accuracies(drawn))
    measures = (measure(parts, column) for parts in rows for column in ("top1", "pair_accuracy"))
    return Estimate(choice, folds, baseline, *measures)
