"""Report sections that compare the methods and check whether the result is valid."""

from collections.abc import Iterator

from retrieval.metrics.registry import (
    PHOTO_COUNTS,
    PHOTO_TO_TOUCH,
    SET_SIZES,
    TOUCH_TO_PHOTO,
    grasps_metric_name,
    photos_metric_name,
)
from retrieval.report import galleries, plots, tables
from retrieval.report.builder import Builder
from retrieval.report.document import Block, Details, Listing, Text
from retrieval.report.results import method_label

INTERVALS = (
    "Brackets contain 95 % intervals of a bootstrap that resamples objects, because queries of one object are "
    "correlated. Every value is the mean over objects of each object's mean, averaged over seeds. The interval covers "
    "other objects of this kind; it does not cover another recording, split or rig. Ties get their expected rank, "
    "so a constant scorer gets exactly chance."
)


SECTIONS = {
    TOUCH_TO_PHOTO: "From a touch to all photos of the unseen objects; any photo of the object is right.",
    PHOTO_TO_TOUCH: "From a photo to all touches of the unseen objects.",
    "objectfolder": "ObjectFolder's cross-sensory retrieval: mAP over all instances, including the query's grasp.",
    "paired": "Paired, as in TVL: the whole test set is one batch, and only the photo of the same grasp is right; "
    "mean of both directions.",
}
"""Sections of the full gallery, with the text above each table."""


def method_overview(builder: Builder) -> Iterator[Block | None]:
    """Yield the main measures of all methods."""
    if builder.any(*plots.OVERVIEW):
        keys = [key for key in plots.OVERVIEW if builder.any(key)]
        yield builder.picture(
            "overview.png",
            f"Dots with intervals. {'. '.join(builder.values(key) for key in keys)}.",
            "Value and 95 % interval of each method; dashed: chance in closed form.",
            plots.overview,
            builder.results,
        )
    yield tables.section(builder.results, "main")
    yield Text("Bold: the highest value of a column, even if it does not differ significantly from the next one.")
    yield Text(INTERVALS)


def topn_curves(builder: Builder) -> Iterator[Block | None]:
    """Yield the top-N accuracy: how often the object is among the first N answers."""
    if not builder.any("topn_k5", "topn_k10"):
        return
    methods = builder.results.data["methods"]
    yield builder.picture(
        "guess-curves.png",
        f"Rising curves. {builder.values('topn_k5')}. {builder.values('topn_k10')}.",
        "How often the object is among the first N answers, with K − 1 other objects as candidates. Bands: 95 % "
        "intervals. On the page, click a point to see grasps with this rank.",
        plots.topn_curves,
        builder.results,
        spots={
            f"{name} topn_k{k}": [
                (f"{method_label(name)}: rank {number} of {k}", grasps)
                for number, grasps in enumerate(methods[name].get("examples_by_rank", {}).get(str(k), []), start=1)
            ]
            for name in reversed(builder.results.learned)  # the last lies on top
            for k in (5, 10)
        },
    )
    for k in (5, 10):
        if table := tables.ranks(builder.results, f"topn_k{k}"):
            yield Details(f"Numbers for {k} candidates", (table,))


def grasps_and_photos(builder: Builder) -> Iterator[Block | None]:
    """Yield the effect of several grasps of one object, and of several photos of each candidate."""
    keys = [*map(grasps_metric_name, SET_SIZES), *map(photos_metric_name, PHOTO_COUNTS[1:])]
    if builder.any(*keys):
        yield builder.picture(
            "grasps.png",
            "Top-1 accuracy against grasps in a query, and against photos of a candidate. "
            f"{'. '.join(builder.values(k) for k in keys if builder.any(k))}.",
            "Left: a query of several grasps of one object against three photos of each of five objects. Right: a "
            "query of one grasp against several photos of each. Dashed: chance.",
            plots.grasps_and_photos,
            builder.results,
        )
        yield tables.section(builder.results, "grasps")
        yield tables.section(builder.results, "photos")


def time(builder: Builder) -> Iterator[Block | None]:
    """Yield accuracy against run time, and all run times."""
    if builder.results.timings.get("methods"):
        if builder.any("topn_k5"):
            yield builder.picture(
                "time.png",
                f"Accuracy against time on a logarithmic scale. {builder.values('topn_k5')}. Times in the table.",
                "Upper left is better. The grey steps join the methods on the Pareto front; dashed: chance.",
                plots.accuracy_and_time,
                builder.results,
            )
        yield tables.times(builder.results)


def gallery(builder: Builder) -> Iterator[Block | None]:
    """Yield ranks in the full gallery, in both directions, and the protocols of ObjectFolder and TVL."""
    for name, text in SECTIONS.items():
        if table := tables.section(builder.results, name):
            yield Text(text)
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


def low_contact(builder: Builder) -> Iterator[Block | None]:
    """Yield the accuracy on low-contact touches, and on all others."""
    if found := builder.results.data.get("low_contact"):
        yield Text(
            f"Low-contact: the {found['touches']} test touches that changed the gel image least, by at most "
            f"{found['change']:.1f} grey levels on average (of the finger with the larger change). Others: all other "
            "test touches."
        )
        yield tables.low_contact(builder.results)


def audit(builder: Builder) -> Iterator[Block | None]:
    """Yield the audit of leakage between the parts of the split."""
    if not (found := builder.results.data.get("audit")):
        return
    yield Text(found["verdict"], warn=not found["clean"])
    if examples := found["identical"]["examples"]:
        yield Listing("\n".join("  =  ".join(places) for places in examples))
    yield tables.audit(found)
    if builder.grasps and any(frames["nearest"] for frames in found["frames"].values()):
        gaps = [
            f"{kind} {one['nearest'][0]['distance']:.2f}" for kind, one in found["frames"].items() if one["nearest"]
        ]
        yield builder.picture(
            "nearest.jpg",
            f"Test frames next to the nearest training or validation frames; distances: {', '.join(gaps)}.",
            "The nearest frames on both sides of the split. Copies would look the same; two low-contact touches look "
            "similar without being copies.",
            galleries.nearest_frames,
            found["frames"],
            builder.grasps,
        )
