"""What a fit is worth: first guesses on own objects that were left out of it, beside the same of blurred touches."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from retrieval.adaptation.folds import Fold, choose_settings, draw_folds, first_guesses, fit_folds, measure
from retrieval.adaptation.material import Material
from retrieval.adaptation.start import AsItIs
from retrieval.console.output import say
from retrieval.errors import BadInput
from retrieval.methods.cca_towers import Choice
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

    choice: Choice
    folds: list[Fold]
    known: AsItIs
    first: Measure
    below: Measure
    blurred_first: Measure
    blurred_below: Measure
    known_first: Measure
    known_below: Measure

    @property
    def keeps_the_model(self) -> bool:
        """Whether the model as it is tells these objects apart better than the fit does. One for another number of
        fingers cannot be kept."""
        fingers = self.known.start.config.matcher.fingers == self.folds[0].left_out.touch.shape[1]
        return fingers and mean(self.known_below) >= mean(self.below)

    def lines(self) -> list[str]:
        """The estimate as lines for people."""
        found = [("first guess", self.first, self.blurred_first), ("pair accuracy", self.below, self.blurred_below)]
        lines = [f"objects left out once each, one touch, {self.first.gallery}:"]
        for name, touched, control in found:
            mine, other, gain = summarise([touched]), summarise([control]), compare([touched], [control])
            lines.append(
                f"  {name} {interval(mine)}; blurred touch {interval(other)}; chance {mine['chance'][0]:.3f}; "
                f"difference {gain['difference']:+.3f} [{gain['low']:+.3f}, {gain['high']:+.3f}]"
            )
        lines.append("  " + self.verdict)
        known = [interval(summarise([each])) for each in (self.known_first, self.known_below)]
        lines.append(f"the model as it is: first guess {known[0]}, pair accuracy {known[1]}")
        if self.keeps_the_model:
            lines.append("  it is kept: a fit to these objects knows less; its probabilities are fitted to them")
        return lines

    @property
    def verdict(self) -> str:
        """Whether the touch itself was felt, in words."""
        gain = compare([self.first], [self.blurred_first])
        if gain["low"] > 0:
            return "the touch tells more than its blur does: what was learnt is more than light and coarse shape"
        return "the touch tells no more than its blur does: this is not shown to be touch; record more objects"

    def to_dict(self) -> dict[str, float]:
        """The numbers that a checkpoint keeps as its metrics."""
        return {
            "left_out_first_guess": mean(self.first),
            "left_out_first_guess_blurred": mean(self.blurred_first),
            "left_out_first_guess_chance": float(self.first.chance[0]),
            "left_out_pair_accuracy": mean(self.below),
            "left_out_pair_accuracy_blurred": mean(self.blurred_below),
            "as_it_is_first_guess": mean(self.known_first),
            "as_it_is_pair_accuracy": mean(self.known_below),
        }


def mean(measure: Measure) -> float:
    """The mean of a measure over objects, which count alike."""
    return float(measure.by_object()[1].mean())


def interval(summary: dict[str, Any]) -> str:
    """A value with its interval."""
    return f"{summary['value'][0]:.3f} [{summary['low'][0]:.3f}, {summary['high'][0]:.3f}]"


@one_thread()
def judge(material: Material, start: Checkpoint, *, cache: Path | None, seed: int, quiet: bool) -> Estimate | None:
    """The estimate from objects left out; None where there are too few of them."""
    try:
        drawn = draw_folds(material.grasps, seed)
    except BadInput as error:
        if not quiet:
            say(f"nothing is known of how good this is: {error}")
        return None
    folds, blurred = (
        list(fit_folds(features, drawn, material, seed=seed, what=what, quiet=quiet))
        for features, what in ((material.features, "touches"), (material.blurred, "blurred touches"))
    )
    choice = choose_settings(material.features, material, seed)
    told, control = list(map(first_guesses, folds)), list(map(first_guesses, blurred))
    known = AsItIs.of(start, material.grasps, cache, quiet)
    rows = (told, control, known.told(drawn))
    measures = (measure(parts, column) for parts in rows for column in ("first", "below"))
    return Estimate(choice, folds, known, *measures)
