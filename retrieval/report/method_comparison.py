"""Report sections that compare the methods and check whether the result is valid."""

from collections.abc import Iterator

from retrieval.metrics.registry import SET_SIZES, grasps_metric_name
from retrieval.report import plots, tables
from retrieval.report.builder import Builder
from retrieval.report.document import Block, Picture, Text

INTERVALS = (
    "Brackets contain 95 % intervals of a bootstrap that resamples objects, because queries of one object are "
    "correlated. Every value is the mean over objects of each object's mean, averaged over seeds. The interval covers "
    "other objects of this kind; it does not cover another recording, split or rig. Ties get their expected rank, "
    "so a constant scorer gets exactly chance."
)


def method_overview(builder: Builder) -> Iterator[Block | None]:
    """Yield the main measures of all methods."""
    if builder.any(*plots.OVERVIEW):
        keys = [key for key in plots.OVERVIEW if builder.any(key)]
        yield Picture(
            "overview",
            f"Dots with intervals. {'. '.join(builder.values(key) for key in keys)}.",
            "Value and 95 % interval of each method; dashed: chance in closed form.",
            lambda: plots.overview(builder.results),
        )
    yield tables.section(builder.results, "main")
    yield Text(INTERVALS)


def topn_curves(builder: Builder) -> Iterator[Block | None]:
    """Yield the top-N accuracy: how often the object is among the first N answers."""
    if not builder.any("topn_k5", "topn_k10"):
        return
    yield Picture(
        "guess-curves",
        f"Rising curves. {builder.values('topn_k5')}. {builder.values('topn_k10')}.",
        "How often the object is among the first N answers, with K − 1 other objects as candidates. Bands: 95 % "
        "intervals.",
        lambda: plots.topn_curves(builder.results),
    )


def grasps(builder: Builder) -> Iterator[Block | None]:
    """Yield the effect of several grasps of one object."""
    keys = [key for key in map(grasps_metric_name, SET_SIZES) if builder.any(key)]
    if keys:
        yield Picture(
            "grasps",
            f"Top-1 accuracy against grasps in a query. {'. '.join(map(builder.values, keys))}.",
            "A query of several grasps of one object against three photos of each of five objects. Dashed: chance.",
            lambda: plots.grasps(builder.results),
        )
        yield tables.section(builder.results, "grasps")


def time(builder: Builder) -> Iterator[Block | None]:
    """Yield accuracy against run time, and all run times."""
    if builder.results.timings.get("methods"):
        if builder.any("topn_k5"):
            yield Picture(
                "time",
                f"Accuracy against time on a logarithmic scale. {builder.values('topn_k5')}. Times in the table.",
                "Upper left is better. The grey steps join the methods on the Pareto front; dashed: chance.",
                lambda: plots.accuracy_and_time(builder.results),
            )
        yield tables.times(builder.results)


def gallery(builder: Builder) -> Iterator[Block | None]:
    """Yield ranks in the full gallery."""
    if table := tables.section(builder.results, "gallery"):
        yield Text("From a touch to all photos of the unseen objects; any photo of the object is right.")
        yield table


def comparisons(builder: Builder) -> Iterator[Block | None]:
    """Yield paired differences between methods."""
    if builder.results.data.get("comparisons"):
        yield tables.comparisons(builder.results)


# Validity ------------------------------------------------------------------------------------------


def controls(builder: Builder) -> Iterator[Block | None]:
    """Yield the controls: the same method on inputs without the information of interest."""
    if builder.results.data.get("controls"):
        yield Text(
            "The same method on inputs without the information of interest. Permuted touches and no-contact frames "
            "should be at chance. Low-pass touches contain light and coarse shape, so they may be above chance."
        )
        yield tables.controls(builder.results)


def ceilings(builder: Builder) -> Iterator[Block | None]:
    """Yield the accuracy within each modality, which bounds the accuracy between them."""
    if builder.results.data.get("ceilings"):
        yield Text(
            "CCA trained and tested within one modality. Matching between touch and photo can hardly be better than "
            "the worse of the two. The difference between that ceiling and the result is due to the change of modality."
        )
        yield tables.ceilings(builder.results)
