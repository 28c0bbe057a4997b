"""Sections on single objects, queries and decisions: where a method is right, where wrong, and how sure it is."""

from collections.abc import Iterator

from retrieval.report import galleries, plots, tables
from retrieval.report.builder import Builder
from retrieval.report.document import Block, Details, Listing, Text
from retrieval.report.results import capitalized, file_name, method_label, percent

TOO_FEW = (
    "Not asked: which object it is, or none, is fitted on three validation objects at least and judged on three test "
    "objects at least."
)


def objects(builder: Builder) -> Iterator[Block | None]:
    """First guess for every object, among test objects and among all."""
    yield from builder.each("per_object", _per_object_blocks)
    if len(plots.test_object_accuracy(builder.results)) > 1:
        yield builder.picture(
            "objects-methods.png",
            "Share of right first guesses for every test object and method; the numbers are in results.json.",
            f"Each test object under each method, sorted by {method_label(builder.main)}.",
            plots.objects_by_method,
            builder.results,
        )


def _per_object_blocks(builder: Builder, name: str) -> Iterator[Block]:
    label, shares = method_label(name), builder.results.data["methods"][name]["per_object"]
    for key, make, what in (
        ("test", plots.objects_among_test, "(a) candidates: test objects only"),
        ("all", plots.objects_among_all, "(b) candidates: all objects"),
    ):
        if not (own := shares.get(f"{key}_candidates")):
            continue
        best, worst = max(own, key=own.__getitem__), min(own, key=own.__getitem__)
        yield builder.picture(
            f"objects-{key}-{file_name(name)}.png",
            f"Bars, {label}, {what}: {percent(own[best])} % ({best}) to {percent(own[worst])} % ({worst}).",
            f"First guess of five for each object, {label}; {what}.",
            make,
            builder.results,
            name,
        )


def confusions(builder: Builder) -> Iterator[Block | None]:
    """Pictures of what objects were mistaken for."""
    if not builder.grasps:
        yield Text("The pictures need the recording, which was not given.")
        return
    yield from builder.each("confusions", _confusion_blocks)


def _confusion_blocks(builder: Builder, name: str) -> Iterator[Block]:
    pairs = builder.results.data["methods"][name]["confusions"]
    descriptions = [f"{one['object_id']} for {one['mistaken_for']} ({percent(one['share'], 0)} %)" for one in pairs]
    yield builder.picture(
        f"confusions-{file_name(name)}.jpg",
        f"Objects beside what they were mistaken for, {method_label(name)}: {'; '.join(descriptions)}.",
        f"Left the object, right (red) what {method_label(name)} took it for, with the share of the object's "
        "touches for which that came first in the full gallery of unseen objects. On the page a click on a pair shows "
        "such touches.",
        galleries.confusions,
        pairs,
        {grasp.object_id: grasp.photo for grasp in reversed(list(builder.grasps.values()))},
        spots={
            str(place): [(f"{one['object_id']} taken for {one['mistaken_for']}", one.get("grasps", ()))]
            for place, one in enumerate(pairs)
        },
    )


def examples(builder: Builder) -> Iterator[Block | None]:
    """Galleries of best and worst queries."""
    if builder.grasps:
        yield from builder.each("examples", _example_blocks)


def _example_blocks(builder: Builder, name: str) -> Iterator[Block]:
    for which, queries in builder.results.data["methods"][name]["examples"].items():
        if queries:
            descriptions = [f"{one['object_id']} (rank {one['true_rank']:g})" for one in queries]
            yield builder.picture(
                f"{file_name(which)}-{file_name(name)}.jpg",
                f"Queries and the photos found, {which}, {method_label(name)}: {'; '.join(descriptions)}.",
                f"{capitalized(which)} queries of {method_label(name)}: gel images, then photos in the order found; "
                "green: the object that was touched. Rank: that of its first photo in the full gallery.",
                galleries.examples,
                queries,
                builder.grasps,
            )


# Decisions -----------------------------------------------------------------------------------------


def calibration(builder: Builder) -> Iterator[Block | None]:
    """Whether probabilities mean what they say."""
    yield from builder.each("reliability", _reliability)
    found = {name: builder.results.data["methods"][name] for name in builder.results.methods}
    if any(one.get("reliability") for one in found.values()):
        yield tables.calibrations(builder.results, plots.RELIABILITIES)
    if fitted := {name: one["calibration"] for name, one in found.items() if one.get("calibration")}:
        yield Details("Calibration fitted on validation objects", (Listing.of_json(fitted),))


def _reliability(builder: Builder, name: str) -> Iterator[Block]:
    diagrams = builder.results.data["methods"][name]["reliability"]
    descriptions = [
        f"{text}: ECE {percent(diagrams[key]['ece'])} %" for key, text in plots.RELIABILITIES.items() if key in diagrams
    ]
    yield builder.picture(
        f"reliability-{file_name(name)}.png",
        f"Reliability diagrams, {method_label(name)}. {'; '.join(descriptions)}.",
        f"Share of right answers against the probability that {method_label(name)} gave; on the diagonal the "
        "probability means what it says. Below: how many answers (logarithmic).",
        plots.reliability,
        builder.results,
        name,
    )


def reject(builder: Builder) -> Iterator[Block | None]:
    """The decision that an object is in the catalogue."""
    found = {name: one["reject"] for name, one in builder.results.data["methods"].items() if one.get("reject")}
    if found:
        descriptions = [
            f"{method_label(name)} {percent(one['auroc']['value'][0])} % "
            f"({percent(one['risk_coverage'][-1][1])} % wrong where all are answered)"
            for name, one in found.items()
        ]
        yield builder.picture(
            "reject.png",
            f"ROC curves, and risk against coverage; areas under the former: {', '.join(descriptions)}.",
            "Each query with its object in the gallery and with it taken out. Left: the decision that it is one of "
            "these; the grey line accepts 95 %. Right: first guesses that are wrong; half of the queries have no right "
            "one, so that nothing that answers them all ends below the grey line.",
            plots.reject,
            builder.results,
        )
        yield tables.rejects(builder.results)
        yield tables.rejects_by_grasps(builder.results)
    elif any("reject" in one for one in builder.results.data["methods"].values()):
        yield Text(TOO_FEW)
