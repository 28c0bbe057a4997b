"""The accuracy of a model that `retrieve adapt` fitted, on held-out objects."""

from retrieval.console.output import say, show
from retrieval.metrics.intervals import compare, summarise
from retrieval.report.numbers import difference, percent, with_interval
from retrieval.report.terminal import print_columns
from retrieval.training.adapt import Adaptation
from retrieval.training.touches import TouchModel

MEASURES = {"top1": "top-1 accuracy, %", "pair_accuracy": "pair accuracy, %"}
ROWS = {
    "fitted model": "held_out_{}",
    "the same with low-pass touches": "held_out_{}_low_pass",
    "unadapted model": "baseline_{}",
}
"""Label -> name of a measure in `Adaptation.measures`."""
BETTER = "Better than the low-pass control: the fit uses more than light and coarse shape."
NOT_BETTER = "Not better than the low-pass control: no evidence that the fit uses touch. Record more objects."


def print_adaptation(result: Adaptation) -> None:
    """Print a table of the accuracies, two sentences on them, and what was fitted."""
    measures = result.measures
    rows = [
        [label, *(with_interval(summarise([measures[name.format(key)]])) for key in MEASURES)]
        for label, name in ROWS.items()
        if name.format("top1") in measures
    ]
    gains = {key: compare([measures[f"held_out_{key}"]], [measures[f"held_out_{key}_low_pass"]]) for key in MEASURES}
    rows.insert(2, ["fitted minus low-pass, points", *map(difference, gains.values())])
    rows.append(["chance", *(percent(measures[f"held_out_{key}"].chance[0]) for key in MEASURES)])
    gallery = measures["held_out_top1"].gallery
    print_columns(f"On held-out objects, {gallery}", ("one touch", *MEASURES.values()), rows, words=(0,))
    show(f"Each object was held out once; {gallery}.")
    show(BETTER if gains["top1"].low > 0 else NOT_BETTER)
    if result.is_baseline:
        show(
            "The unadapted model is used: its pair accuracy is at least that of the fit. Only its calibrations and its "
            "check of gel images are fitted."
        )
    touched = measures["held_out_top1"].owner
    say(f"{result.checkpoint.path}: fitted to {len(set(touched.tolist()))} objects, {len(touched)} touches")


def print_touch_model(result: TouchModel) -> None:
    """Print a table of the accuracies of a model that is fitted to touches only, and a sentence on it."""
    measures = result.measures
    galleries = {name: measures[name].gallery for name in ("same", "new")}
    rows = [
        [label, *(with_interval(summarise([measures[f"{name}{suffix}"]])) for name in galleries)]
        for label, suffix in (("fitted model", ""), ("the same with low-pass touches", "_low_pass"))
    ]
    rows.append(["chance", *(percent(measures[name].chance[0]) for name in galleries)])
    title = f"One touch, compared with touches of another {'session' if result.has_sessions else 'sequence'}"
    print_columns(title, ("top-1 accuracy, %", *galleries.values()), rows, words=(0,))
    gain = compare([measures["same"]], [measures["same_low_pass"]])
    show(BETTER if gain.low > 0 else NOT_BETTER)
    if not result.has_sessions:
        show(
            "All touches are of one session, so drift of light and gel can help: record another session to exclude it."
        )
    touched = measures["same"].owner
    say(f"{result.checkpoint.path}: fitted to {len(set(touched.tolist()))} objects, {len(touched)} touches")
