"""Tables of an evaluation: results in, blocks of the document out."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from retrieval.methods import TRIVIAL_BASELINES
from retrieval.metrics.registry import METRICS
from retrieval.model.posterior import FORMULA
from retrieval.report.document import Table
from retrieval.report.results import (
    FEW_OBJECTS_MARK,
    FEW_OBJECTS_NOTE,
    MISSING_VALUE,
    Results,
    Summary,
    few_objects_mark,
    format_number,
    measure_label,
    method_label,
    percent,
    with_interval,
)

Column = tuple[str, str, int]
"""Heading, measure, place in the measure's list of values."""


def section(results: Results, name: str) -> Table | None:
    """A row for each method and a column for each metric of the section that was taken; None where none was."""
    return _table(results, [(metric.column, key, 0) for key, metric in METRICS.items() if metric.section == name])


def measures(results: Results, keys: Sequence[str]) -> Table | None:
    """The same of any metrics."""
    return _table(results, [(measure_label(key), key, 0) for key in keys])


def guesses(results: Results, measure: str) -> Table | None:
    """A guess curve in numbers: a column for each number of guesses."""
    lengths = [len(found["value"]) for name in results.methods if (found := results.summary(name, measure))]
    return _table(results, [(f"N = {place + 1}", measure, place) for place in range(max(lengths, default=0))])


def _with_notes(table: Table) -> Table:
    """The table, with what its marks mean below it."""
    if any(FEW_OBJECTS_MARK in cell for row in table.rows for cell in row):
        return dataclasses.replace(table, notes=(*table.notes, FEW_OBJECTS_NOTE))
    return table


def _table(results: Results, columns: Sequence[Column]) -> Table | None:
    notes = _without_threshold(results) if any(key == "pair_accuracy" for _, key, _ in columns) else []
    columns = [column for column in columns if any(results.summary(name, column[1]) for name in results.methods)]
    if not columns:
        return None
    rows = [
        (method_label(name), *(with_interval(results.summary(name, key), place) for _, key, place in columns))
        for name in results.methods
    ]
    chance = ["chance, closed form"]
    for _, key, place in columns:
        found = [summary for name in results.methods if (summary := results.summary(name, key))]
        chance.append(" or ".join(sorted({percent(summary["chance"][place]) for summary in found})) or MISSING_VALUE)
    return _with_notes(
        Table(
            ("method, %", *(heading for heading, _, _ in columns)),
            (*rows, tuple(chance)),
            (*_basis(results, list(dict.fromkeys(key for _, key, _ in columns))), *notes),
            bold=frozenset(_best(results, columns)),
        )
    )


def _without_threshold(results: Results) -> list[str]:
    """Which methods have no pair accuracy, and why."""
    reasons: dict[str, list[str]] = {}
    for name in results.methods:
        if why := (results.data["methods"][name].get("pair_threshold") or {}).get("reason"):
            reasons.setdefault(why, []).append(method_label(name))
    return [f"No pair accuracy of {', '.join(names)}: {why}." for why, names in reasons.items()]


def _best(results: Results, columns: Sequence[Column]) -> list[tuple[int, int]]:
    """The highest value of each column, where one is highest."""
    found = []
    for at, (_, key, place) in enumerate(columns, start=1):
        values = {
            row: summary["value"][place]
            for row, name in enumerate(results.methods)
            if (summary := results.summary(name, key)) and summary["value"][place] is not None
        }
        highest = [row for row, value in values.items() if value == max(values.values())]
        if len(highest) == 1 < len(values):
            found.append((highest[0], at))
    return found


def _basis(results: Results, keys: Sequence[str]) -> list[str]:
    """Queries, objects and gallery of the columns, those of one basis named together."""
    bases: dict[str, list[str]] = {}
    for key in keys:
        for name in results.methods:
            if found := results.summary(name, key):
                labels = bases.setdefault(basis(found), [])
                if measure_label(key) not in labels:
                    labels.append(measure_label(key))
    if len(bases) == 1:
        return list(bases)
    return [f"{'; '.join(labels)}: {text}" for text, labels in bases.items()]


def basis(summary: Summary) -> str:
    """What a measure was taken over, in words."""
    return f"{summary['queries']:,} queries of {summary['objects']} objects. Gallery: {summary['gallery']}."


def everything(results: Results) -> Table:
    """Every measure of every method with interval, chance, queries, objects, seeds and gallery."""
    known = [key for name in results.methods for key in results.data["methods"][name].get("measures", {})]
    keys = sorted(set(known), key=lambda key: known.index(key))
    rows = [
        (
            method_label(name),
            measure_label(key),
            "; ".join(with_interval(found, place) for place in range(len(found["value"]))),
            "; ".join(percent(share) for share in found["chance"]),
            ", ".join(percent(values[0]) for values in found["by_seed"]),
            f"{found['queries']:,}",
            str(found["objects"]),
            found["gallery"],
        )
        for key in keys
        for name in results.methods
        if (found := results.summary(name, key))
    ]
    header = ("method", "measure", "value [interval], %", "chance, %", "by seed, %", "queries", "objects", "gallery")
    return _with_notes(Table(header, tuple(rows), words=frozenset({1, 7})))


def comparisons(results: Results) -> Table:
    """Paired differences on the same queries."""
    rows = [
        (
            f"{method_label(one['a'])} − {method_label(one['b'])}",
            measure_label(one["measure"]),
            f"{100 * one['difference']:+.1f} [{100 * one['low']:+.1f}, {100 * one['high']:+.1f}]{few_objects_mark(one)}",
            probability(one["p"]),
        )
        for one in results.data["comparisons"]
    ]
    note = (
        "Same queries for both. Interval: bootstrap over objects; p: sign flips of the objects' differences, two-sided."
    )
    return _with_notes(Table(("methods", "measure", "difference, points", "p"), tuple(rows), (note,), frozenset({1})))


def probability(value: float) -> str:
    """A p-value: never 0."""
    return "< 0.0001" if value < 0.0001 else f"{value:.2g}" if value < 0.1 else f"{value:.2f}"


def controls(results: Results) -> Table:
    """What late fusion gives when the answer is taken out of its input, and whether that is chance."""
    keys = ("pair_accuracy", "topn_k5")
    real = (with_interval(results.summary("late_fusion", key)) for key in keys)
    rows = [("the result", "late fusion as it is", *real, "")]
    for name, control in results.data["controls"].items():
        left, at_chance = (control["measures"].get(key) for key in keys), MISSING_VALUE
        if found := next((control["measures"][key] for key in keys if key in control["measures"]), None):
            at_chance = "yes" if found["low"][0] <= found["chance"][0] <= found["high"][0] else "no"
        rows.append((name, control["description"], *map(with_interval, left), at_chance))
    header = ("control", "what was done", *(f"{measure_label(key)}, %" for key in keys), "chance in the interval")
    return _with_notes(Table(header, tuple(rows), tuple(_without_threshold(results)), words=frozenset({1})))


def ceilings(results: Results) -> Table:
    """CCA between touch and photo, and between two touches or two photos of an object."""
    keys = ("pair_accuracy", "topn_k5", "topn_k10")
    rows = [
        (name.replace("_", " "), one["description"], *(with_interval(one["measures"].get(key)) for key in keys))
        for name, one in results.data["ceilings"].items()
    ]
    if "cca" in results.methods:
        real = (with_interval(results.summary("cca", key)) for key in keys)
        rows.insert(0, ("touch to photo", "the result of CCA", *real))
    header = ("ceiling", "what was done", *(f"{measure_label(key)}, %" for key in keys))
    return _with_notes(Table(header, tuple(rows), words=frozenset({1})))


def low_contact(results: Results) -> Table:
    """The faintest touches and the others, of every method that looks at them."""
    keys = ("pair_accuracy", "topn_k5", "topn_k10")
    rows = [
        (method_label(name), words, *(with_interval(parts[part].get(key)) for key in keys))
        for name, parts in results.data["low_contact"]["methods"].items()
        if name not in TRIVIAL_BASELINES
        for part, words in (("low_contact", "faintest"), ("others", "others"))
    ]
    header = ("method", "touches", *(f"{measure_label(key)}, %" for key in keys))
    return _with_notes(Table(header, tuple(rows), words=frozenset({1})))


def rejects(results: Results) -> Table:
    """The decision that the object is in the catalogue."""
    found = {
        name: results.data["methods"][name]["reject"] for name in results.methods if _has_entry(results, name, "reject")
    }
    rows = [
        (
            method_label(name),
            with_interval(one["auroc"]),
            with_interval(one["false_accepts_at_95"]),
            with_interval(one["balanced_accuracy"]),
        )
        for name, one in found.items()
    ]
    first = next(iter(found.values()))["auroc"]
    header = ("method", "AUROC, %", "false accepts at 95 % true accepts, %", "balanced accuracy, %")
    notes = (
        f"{basis(first)} Chance is 50, 95 and 50 %.",
        "Balanced accuracy is that of accepting where the posterior, fitted on validation objects, thinks one of the "
        f"gallery's at least as likely as none: {FORMULA}.",
    )
    return _with_notes(Table(header, tuple(rows), notes))


def rejects_by_grasps(results: Results) -> Table | None:
    """What more grasps of the object in hand do for that decision; None where there are single ones only."""
    found = {
        name: results.data["methods"][name]["reject"]["by_grasps"]
        for name in results.methods
        if _has_entry(results, name, "reject")
    }
    sizes = sorted({int(grasps) for one in found.values() for grasps in one})
    if len(sizes) < 2:
        return None
    measures = {"auroc": "AUROC", "false_accepts_at_95": "false accepts at 95 %"}
    rows = [
        (f"{method_label(name)}, {label}", *(with_interval(one.get(str(size), {}).get(key)) for size in sizes))
        for name, one in found.items()
        for key, label in measures.items()
    ]
    header = ("%, by grasps in a query", *map(str, sizes))
    note = "A set of grasps is asked as a whole; each number of grasps has a posterior of its own."
    return _with_notes(Table(header, tuple(rows), (note,)))


def _has_entry(results: Results, name: str, what: str) -> bool:
    return bool(results.data["methods"][name].get(what))


def calibrations(results: Results, kinds: Mapping[str, str]) -> Table:
    """Expected calibration errors."""
    found = {name: results.data["methods"][name].get("reliability") for name in results.methods}
    rows = [
        (method_label(name), *(percent(diagrams.get(kind, {}).get("ece")) for kind in kinds))
        for name, diagrams in found.items()
        if diagrams
    ]
    note = (
        "On test objects; fitted on validation objects. Among candidates, of which one is known to be true, it is the "
        "posterior's probability of the first guess, with a prior of none of 0."
    )
    return Table(("expected calibration error, %", *kinds.values()), tuple(rows), (note,))


def times(results: Results) -> Table:
    """How long each method takes."""
    columns = {
        "fit_s": "fit, s",
        "encode_touch_ms": "encode a touch, ms",
        "encode_photo_ms": "encode a photo, ms",
        "score_us_per_photo": "score a photo, µs",
        "query_ms": "a query, ms",
    }
    rows = [
        (method_label(name), *(format_number(results.time(name, key)) for key in columns))
        for name in results.methods
        if name in results.timings.get("methods", {})
    ]
    towers, machine = results.timings.get("encode", {}), results.timings.get("machine", {})
    note = (
        f"On {machine.get('cpus', MISSING_VALUE)} CPU(s) with {machine.get('threads', MISSING_VALUE)} thread(s). Times of the "
        "methods alone: one query is one touch against the whole gallery, features given. The towers, shared "
        f"by all methods, take {format_number(towers.get('touch_ms'))} ms for a touch and {format_number(towers.get('photo_ms'))} ms "
        "for a photo."
    )
    return Table(("method", *columns.values()), tuple(rows), (note,))


def split(results: Results) -> Table:
    """Objects of each part."""
    found = results.data["split"]
    rows = tuple(
        (part, str(len(found[part])), ", ".join(sorted(found[part]))) for part in ("train", "validation", "test")
    )
    return Table(("part", "objects", "which"), rows, words=frozenset({2}))


def audit(found: Any) -> Table:
    """Distances from the test frames to frames fitted or chosen on, beside those within an object."""
    points = [f"{100 * share:g} %" if share else "nearest" for share in found["quantiles"]]
    rows = []
    for kind, frames in found["frames"].items():
        for key, what in (
            ("to_train_validation", "to training and validation objects"),
            ("within_object", "to its own object"),
        ):
            values = [f"{value:.2f}" for value in frames[key] or ()] or [MISSING_VALUE] * len(points)
            counts = (
                (f"{frames['near_copies']} of {frames['checked']:,}", f"{frames['test']:,}")
                if key == "to_train_validation"
                else ("", "")
            )
            rows.append((f"{kind}, {what}", *values, *counts))
    return Table(
        ("nearest frame of each test frame", *points, "copies of those checked", "test frames"),
        tuple(rows),
        (f"Quantiles of the distance: {found['unit']}.",),
    )
