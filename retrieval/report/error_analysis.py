"""Report sections on single objects, queries and decisions: accuracy, confusions, calibration, rejection."""

from collections.abc import Iterator
from functools import partial

from retrieval.model.verification import ERRORS_NEEDED
from retrieval.report import plots, tables
from retrieval.report.builder import Builder
from retrieval.report.document import Block, Details, Listing, Picture, Table, Text
from retrieval.report.numbers import percent
from retrieval.report.results import file_name, method_label

TOO_FEW = "Not evaluated: the open-set decision requires at least three validation objects and three test objects."


def objects(builder: Builder) -> Iterator[Block | None]:
    """Yield the top-1 accuracy of every object, among test objects and among all."""
    yield from builder.each("per_object", _per_object_blocks)


def _per_object_blocks(builder: Builder, name: str) -> Iterator[Block]:
    label, per_object = method_label(name), builder.results.data["methods"][name]["per_object"]
    for key, candidates in (
        ("test", "(a) candidates: test objects only"),
        ("all", "(b) candidates: all objects (red: test, grey: validation, blue: training)"),
    ):
        if not (accuracy := per_object.get(f"{key}_candidates")):
            continue
        best, worst = max(accuracy, key=accuracy.__getitem__), min(accuracy, key=accuracy.__getitem__)
        low, high = percent(accuracy[worst]), percent(accuracy[best])
        yield Picture(
            f"objects-{key}-{file_name(name)}",
            f"Bars, {label}, {candidates}: {high} % ({best}) to {low} % ({worst}).",
            f"Top-1 accuracy among five objects for each object, {label}; {candidates}.",
            partial(plots.objects, builder.results, name, key),
        )


def confusions(builder: Builder) -> Iterator[Block | None]:
    """Yield the most frequent confusions."""
    yield from builder.each("confusions", _confusion_blocks)


def _confusion_blocks(builder: Builder, name: str) -> Iterator[Block]:
    pairs = builder.results.data["methods"][name]["confusions"]
    rows = tuple((one["object_id"], one["mistaken_for"], percent(one["share"], 0)) for one in pairs)
    note = (
        f"The fraction of the touches of an object for which {method_label(name)} ranked another one first in the full "
        "gallery of unseen objects."
    )
    yield Table(("object", "mistaken for", "of its touches, %"), rows, (note,), words=frozenset({1}))


# Decisions -----------------------------------------------------------------------------------------


def calibration(builder: Builder) -> Iterator[Block | None]:
    """Yield the calibration of the probabilities."""
    yield from builder.each("reliability", _reliability)
    found = {name: builder.results.data["methods"][name] for name in builder.results.methods}
    if fitted := {name: one["calibration"] for name, one in found.items() if one.get("calibration")}:
        yield Details("Calibration fitted on validation objects", (Listing.of_json(fitted),))


def _reliability(builder: Builder, name: str) -> Iterator[Block]:
    diagrams = builder.results.data["methods"][name]["reliability"]
    descriptions = [
        f"{text}: ECE {percent(diagrams[key]['ece'])} %" for key, text in plots.RELIABILITIES.items() if key in diagrams
    ]
    yield Picture(
        f"reliability-{file_name(name)}",
        f"Reliability diagrams, {method_label(name)}. {'; '.join(descriptions)}.",
        f"Fraction of right answers against the probability that {method_label(name)} stated; a calibrated method is "
        "on the diagonal. Below: number of answers (logarithmic).",
        lambda: plots.reliability(builder.results, name),
    )


def reject(builder: Builder) -> Iterator[Block | None]:
    """Yield the decision whether an object is in the catalogue (open-set identification)."""
    found = {name: one["reject"] for name, one in builder.results.data["methods"].items() if one.get("reject")}
    if found:
        descriptions = [
            f"{method_label(name)} {percent(one['auroc']['value'][0])} % "
            f"({percent(one['risk_coverage'][-1][1])} % wrong if all queries are answered)"
            for name, one in found.items()
        ]
        yield Picture(
            "reject",
            f"ROC curves, and risk against coverage; areas under the ROC curves: {', '.join(descriptions)}.",
            "Each query is used twice: with its object in the gallery, and without it. Left: ROC curve of the decision "
            "that the gallery contains the object; the grey line marks 95 % true accepts. Right: fraction of wrong "
            "top-1 answers; half of the queries have no right answer, so a method that answers all of them ends on or "
            "above the grey line.",
            lambda: plots.reject(builder.results),
        )
        yield tables.rejects(builder.results)
    elif any("reject" in one for one in builder.results.data["methods"].values()):
        yield Text(TOO_FEW)


def verification(builder: Builder) -> Iterator[Block | None]:
    """Yield the error rates of late fusion in verification, by number of grasps."""
    if found := builder.results.data.get("verification"):
        one = next(iter(found["random"].values()))
        yield tables.verification(builder.results)
        yield Text(
            f"{one['sequences']:,} sequences of grasps of {one['objects']} unseen objects. A sequence is accepted if "
            "its largest log likelihood ratio so far reaches the threshold. Impostors: every other unseen object, or "
            "the one whose photos have the most similar embeddings. A FAR is refused if the trials would contain fewer "
            f"than {ERRORS_NEEDED} errors (rule of 30)."
        )
