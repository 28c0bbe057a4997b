"""Tables of an evaluation: each function returns a table block of the document."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from retrieval.metrics.registry import METRICS
from retrieval.model.posterior import FORMULA
from retrieval.report.document import Table
from retrieval.report.numbers import (
    FEW_OBJECTS_MARK,
    FEW_OBJECTS_NOTE,
    MISSING_VALUE,
    Summary,
    format_number,
    interval,
    percent,
    points,
    probability,
    with_interval,
)
from retrieval.report.results import IMPOSTORS, Results, measure_label, method_label

Column = tuple[str, str]
"""Heading and measure."""


def section(results: Results, name: str) -> Table | None:
    """Return a row for each method and a column for each measured metric of a section; None if there is none."""
    return _table(results, [(metric.column, key) for key, metric in METRICS.items() if metric.section == name])


def measures(results: Results, keys: Sequence[str]) -> Table | None:
    """Return a row for each method and a column for each of these measures; None if there is none."""
    return _table(results, [(measure_label(key), key) for key in keys])


def _with_notes(table: Table) -> Table:
    """Return the table, with the explanation of its marks below."""
    if any(FEW_OBJECTS_MARK in cell for row in table.rows for cell in row):
        return dataclasses.replace(table, notes=(*table.notes, FEW_OBJECTS_NOTE))
    return table


def _table(results: Results, columns: Sequence[Column]) -> Table | None:
    notes = _without_threshold(results) if any(key == "pair_accuracy" for _, key in columns) else []
    columns = [column for column in columns if any(results.summary(name, column[1]) for name in results.methods)]
    if not columns:
        return None
    rows = [
        (method_label(name), *(with_interval(results.summary(name, key)) for _, key in columns))
        for name in results.methods
    ]
    chance = ["chance, closed form"]
    for _, key in columns:
        found = [summary for name in results.methods if (summary := results.summary(name, key))]
        chance.append(" or ".join(sorted({percent(summary["chance"][0]) for summary in found})) or MISSING_VALUE)
    return _with_notes(
        Table(
            ("method, %", *(heading for heading, _ in columns)),
            (*rows, tuple(chance)),
            (*_basis(results, list(dict.fromkeys(key for _, key in columns))), *notes),
        )
    )


def _without_threshold(results: Results) -> list[str]:
    """Return the reasons why methods have no pair accuracy."""
    reasons: dict[str, list[str]] = {}
    for name in results.methods:
        if why := (results.data["methods"][name].get("pair_threshold") or {}).get("reason"):
            reasons.setdefault(why, []).append(method_label(name))
    return [f"No pair accuracy of {', '.join(names)}: {why}." for why, names in reasons.items()]


def _basis(results: Results, keys: Sequence[str]) -> list[str]:
    """Return queries, objects and gallery of the columns; measures with the same basis are grouped."""
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
    """Return queries, objects and gallery of a measure as a sentence."""
    return f"{summary['queries']:,} queries of {summary['objects']} objects. Gallery: {summary['gallery']}."


def comparisons(results: Results) -> Table:
    """Return the paired differences between methods on the same queries."""
    rows = [
        (
            f"{method_label(one['a'])} − {method_label(one['b'])}",
            measure_label(one["measure"]),
            points(one),
            probability(one["p"]),
        )
        for one in results.data["comparisons"]
    ]
    note = "Same queries for both. Interval: bootstrap over objects; p: two-sided sign-flip test over objects."
    return _with_notes(Table(("methods", "measure", "difference, points", "p"), tuple(rows), (note,), frozenset({1})))


def controls(results: Results) -> Table:
    """Return the measures of the controls of late fusion, and whether they equal chance."""
    keys = ("pair_accuracy", "topn_k5")
    real = (with_interval(results.summary("late_fusion", key)) for key in keys)
    rows = [("the result", "late fusion without a control", *real, "")]
    for name, control in results.data["controls"].items():
        values, at_chance = (control["measures"].get(key) for key in keys), MISSING_VALUE
        if found := next((control["measures"][key] for key in keys if key in control["measures"]), None):
            at_chance = "yes" if found["low"][0] <= found["chance"][0] <= found["high"][0] else "no"
        rows.append((name, control["description"], *map(with_interval, values), at_chance))
    header = ("control", "description", *(f"{measure_label(key)}, %" for key in keys), "chance in the interval")
    return _with_notes(Table(header, tuple(rows), tuple(_without_threshold(results)), words=frozenset({1})))


def ceilings(results: Results) -> Table:
    """Return the measures of CCA between touch and photo, and between two touches or two photos of an object."""
    keys = ("pair_accuracy", "topn_k5", "topn_k10")
    rows = [
        (name.replace("_", " "), one["description"], *(with_interval(one["measures"].get(key)) for key in keys))
        for name, one in results.data["ceilings"].items()
    ]
    if "cca" in results.methods:
        real = (with_interval(results.summary("cca", key)) for key in keys)
        rows.insert(0, ("touch to photo", "the result of CCA", *real))
    header = ("ceiling", "description", *(f"{measure_label(key)}, %" for key in keys))
    return _with_notes(Table(header, tuple(rows), words=frozenset({1})))


def rejects(results: Results) -> Table:
    """Return the measures of the decision that the object is in the catalogue."""
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
        "Balanced accuracy: a query is accepted if the posterior, fitted on validation objects, is at least as high "
        f"for the gallery as for none of its objects: {FORMULA}.",
    )
    return _with_notes(Table(header, tuple(rows), notes))


def verification(results: Results) -> Table:
    """Return the equal error rate, and the false-reject rate at each false-accept rate, by impostors and grasps."""
    found = results.data["verification"]
    fars = sorted(next(iter(found["random"].values()))["frr"], key=float, reverse=True)
    rows = [
        (label, grasps, *map(_supported_rate, (one["eer"], *(one["frr"][far] for far in fars))))
        for kind, label in IMPOSTORS.items()
        for grasps, one in sorted(found[kind].items(), key=lambda item: int(item[0]))
    ]
    header = ("impostors", "grasps", "EER, %", *(f"FRR at a FAR of {100 * float(far):g} %, %" for far in fars))
    note = "Interval: each object counts as one trial (Clopper and Pearson)."
    return Table(header, tuple(rows), (note,), words=frozenset({0}))


def _supported_rate(rate: Mapping[str, Any]) -> str:
    """Return a rate with its interval in percent, or the number of objects that it needs."""
    if rate["value"] is not None:
        return interval(rate["value"], rate["low"], rate["high"])
    needed = rate["objects_needed"]
    return "refused: no errors" if needed is None else f"refused: needs {needed:,} objects"


def _has_entry(results: Results, name: str, entry: str) -> bool:
    return bool(results.data["methods"][name].get(entry))


def times(results: Results) -> Table:
    """Return the run times of each method."""
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
    cpus, threads = (machine.get(key, MISSING_VALUE) for key in ("cpus", "threads"))
    touch_ms, photo_ms = (format_number(towers.get(key)) for key in ("touch_ms", "photo_ms"))
    note = (
        f"On {cpus} CPU(s) with {threads} thread(s). Times of the methods without the towers: one query is one touch "
        "against the whole gallery, with precomputed features. The towers, shared by all methods, take "
        f"{touch_ms} ms for a touch and {photo_ms} ms for a photo."
    )
    return Table(("method", *columns.values()), tuple(rows), (note,))


def split(results: Results) -> Table:
    """Return the objects of each part of the split."""
    found = results.data["split"]
    rows = tuple(
        (part, str(len(found[part])), ", ".join(sorted(found[part]))) for part in ("train", "validation", "test")
    )
    return Table(("part", "objects", "ids"), rows, words=frozenset({2}))
