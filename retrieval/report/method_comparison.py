"""Sections that set the methods side by side, and say whether the result can be believed."""

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
    "Brackets hold 95 % intervals: a bootstrap that resamples objects, since queries of one object are alike. Every "
    "value is the mean over objects of each object's mean, averaged over seeds where there are several. The interval "
    "covers other objects of this kind; it does not cover another recording, split or rig. "
    "Equal scores count by their expected rank, so a constant scorer gets exactly chance."
)


SECTIONS = {
    TOUCH_TO_PHOTO: "From a touch to all photos of the unseen objects; any photo of the object is right.",
    PHOTO_TO_TOUCH: "The other way: from a photo to all touches.",
    "objectfolder": "ObjectFolder's cross-sensory retrieval: mAP over all instances, those of the query's grasp too.",
    "paired": "Paired, as TVL does it: the whole test set is one batch, and only the photo of the same grasp is right; "
    "mean of both directions.",
}
"""Tables of the full gallery, and what stands above each."""


def method_overview(builder: Builder) -> Iterator[Block | None]:
    """The main measures of all methods."""
    if builder.any(*plots.OVERVIEW):
        shown = [key for key in plots.OVERVIEW if builder.any(key)]
        yield builder.picture(
            "overview.png",
            f"Dots with intervals. {'. '.join(builder.values(key) for key in shown)}.",
            "Value and 95 % interval of each method; dashed: chance in closed form.",
            plots.overview,
            builder.results,
        )
    yield tables.section(builder.results, "main")
    yield Text("Bold: the highest of a column, whether or not the next one is apart from it.")
    yield Text(INTERVALS)


def guess_curves(builder: Builder) -> Iterator[Block | None]:
    """How often the object is found within N guesses."""
    if not builder.any("topn_k5", "topn_k10"):
        return
    methods = builder.results.data["methods"]
    yield builder.picture(
        "guess-curves.png",
        f"Rising curves. {builder.values('topn_k5')}. {builder.values('topn_k10')}.",
        "How often the object is found within N guesses, the true one among K − 1 others. Bands: 95 % intervals. On "
        "the page a click on a point shows grasps that it stands for.",
        plots.guess_curves,
        builder.results,
        spots={
            f"{name} topn_k{k}": [
                (f"{method_label(name)}: found with guess {number} of {k}", shown)
                for number, shown in enumerate(methods[name].get("examples_by_rank", {}).get(str(k), []), start=1)
            ]
            for name in reversed(builder.results.learned)  # the last lies on top
            for k in (5, 10)
        },
    )
    for k in (5, 10):
        if table := tables.guesses(builder.results, f"topn_k{k}"):
            yield Details(f"Numbers for {k} candidates", (table,))


def grasps_and_photos(builder: Builder) -> Iterator[Block | None]:
    """What several grasps of one object add, and several photos of each candidate."""
    keys = [*map(grasps_metric_name, SET_SIZES), *map(photos_metric_name, PHOTO_COUNTS[1:])]
    if builder.any(*keys):
        yield builder.picture(
            "grasps.png",
            "First guess against grasps in a query, and against photos of a candidate. "
            f"{'. '.join(builder.values(k) for k in keys if builder.any(k))}.",
            "Left: a query of several grasps of one object against three photos of each of five objects. Right: a "
            "query of one grasp against several. Dashed: chance.",
            plots.grasps_and_photos,
            builder.results,
        )
        yield tables.section(builder.results, "grasps")
        yield tables.section(builder.results, "photos")


def time(builder: Builder) -> Iterator[Block | None]:
    """Accuracy against run time, and every time."""
    if builder.results.timings.get("methods"):
        if builder.any("topn_k5"):
            yield builder.picture(
                "time.png",
                f"Accuracy against time on a logarithmic scale. {builder.values('topn_k5')}. Times in the table.",
                "Upper left is better. The grey steps join the methods that no other one beats in both; dashed: "
                "chance.",
                plots.accuracy_and_time,
                builder.results,
            )
        yield tables.times(builder.results)


def gallery(builder: Builder) -> Iterator[Block | None]:
    """Ranks in the full gallery, both ways, and the protocols of ObjectFolder and TVL."""
    for name, text in SECTIONS.items():
        if table := tables.section(builder.results, name):
            yield Text(text)
            yield table


def comparisons(builder: Builder) -> Iterator[Block | None]:
    """Paired differences between methods."""
    if builder.results.data.get("comparisons"):
        yield tables.comparisons(builder.results)


# Can it be believed? --------------------------------------------------------------------------------


def controls(builder: Builder) -> Iterator[Block | None]:
    """What is left when the answer is taken out of the input."""
    if builder.results.data.get("controls"):
        yield Text("The same method after what could give the answer was taken away. Chance is what should be left.")
        yield tables.controls(builder.results)


def ceilings(builder: Builder) -> Iterator[Block | None]:
    """How much of the object each side knows by itself."""
    if builder.results.data.get("ceilings"):
        yield Text(
            "CCA fitted and asked within one modality. A match of touch and photo is hardly better than the worse of "
            "both; what lies between that and the result is lost on the way from one to the other."
        )
        yield tables.ceilings(builder.results)


def low_contact(builder: Builder) -> Iterator[Block | None]:
    """Touches that hardly pressed, apart."""
    if found := builder.results.data.get("low_contact"):
        yield Text(
            f"The {found['touches']} test touches that changed the gel least, by at most {found['change']:.1f} grey "
            "levels on average (of the finger that felt more), and all others."
        )
        yield tables.low_contact(builder.results)


def audit(builder: Builder) -> Iterator[Block | None]:
    """What the parts of the split share."""
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
            f"Test frames beside the nearest frames fitted or chosen on; distances: {', '.join(gaps)}.",
            "The nearest frames on both sides of the split. Copies would look the same here; two light touches "
            "look alike without being copies.",
            galleries.nearest_frames,
            found["frames"],
            builder.grasps,
        )
