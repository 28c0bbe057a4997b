"""Tables of an evaluation: each function returns a table block of one protocol, or None if there are no numbers."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from retrieval.evaluation.aggregate import CONTROL_NAMES
from retrieval.evaluation.results import (
    ControlResult,
    Details,
    Rate,
    Rejection,
    Summaries,
    VerificationRates,
)
from retrieval.metrics.intervals import Summary
from retrieval.metrics.registry import METRICS
from retrieval.model.posterior import FORMULA
from retrieval.report.document import Block, Table
from retrieval.report.numbers import (
    FEW_OBJECTS_MARK,
    FEW_OBJECTS_NOTE,
    MISSING_VALUE,
    difference,
    interval,
    p_value,
    percent,
    with_interval,
)
from retrieval.report.results import ProtocolView

Row = tuple[str, ...]
LOW_PASS_LABEL = "low-pass control (8 x 6)"
IMPOSTORS = {"random": "random", "similar": "most similar object"}
PARTS = {"train": "training", "validation": "validation", "test": "test"}
"""Parts of a split."""


def _marked(header: Row, rows: Iterable[Row], notes: Sequence[str] = (), words: Sequence[int] = ()) -> Table | None:
    """Return the table, with the explanation of its marks below; None without rows."""
    rows = tuple(rows)
    if any(FEW_OBJECTS_MARK in cell for row in rows for cell in row):
        notes = (*notes, FEW_OBJECTS_NOTE)
    return Table(header, rows, tuple(notes), frozenset(words)) if rows else None


# Measures --------------------------------------------------------------------------------------------


def section(view: ProtocolView, name: str) -> Table | None:
    """Return the measures of a section; a protocol with few measures has all of them in the section "main"."""
    if view.details:
        shown = {key: metric for key, metric in METRICS.items() if metric.section == name}
        return measures(view, {key: metric.short_label or metric.label for key, metric in shown.items()})
    return measures(view, dict(view.result.labels)) if name == "main" else None


def measures(view: ProtocolView, headings: Mapping[str, str]) -> Table | None:
    """Return a line for each row, its low-pass control and chance, and a column for each of these measures."""
    keys = [key for key in headings if view.summaries(key)]
    if not keys:
        return None
    rows: list[Row] = []
    for name, row in view.result.rows.items():
        counts = "" if row.verdict is None else "yes" if row.verdict.counts_as_touch else "no"
        rows.append((view.label(name), *_values(row.measures, keys), counts))
        if row.low_pass:
            rows.append((LOW_PASS_LABEL, *_values(row.low_pass, keys), ""))
    chances = ({percent(summary.chance[0]) for summary in view.summaries(key).values()} for key in keys)
    rows.append(("chance, closed form", *(" or ".join(sorted(values)) for values in chances), ""))
    header: Row = ("method, %", *(headings[key] for key in keys), "counts as touch")
    if not any(row.verdict for row in view.result.rows.values()):
        header, rows = header[:-1], [row[:-1] for row in rows]
    notes = _without_threshold(view) if "pair_accuracy" in headings else []
    return _marked(header, rows, _basis(view, keys) + notes)


def _values(measures: Summaries | None, keys: Sequence[str]) -> Iterator[str]:
    return (with_interval((measures or {}).get(key)) for key in keys)


def _without_threshold(view: ProtocolView) -> list[str]:
    reasons: dict[str, list[str]] = {}
    for name, details in view.details.items():
        if why := details.pair_threshold.reason:
            reasons.setdefault(why, []).append(view.label(name))
    return [f"No pair accuracy of {', '.join(names)}: {why}." for why, names in reasons.items()]


def _basis(view: ProtocolView, keys: Sequence[str]) -> list[str]:
    bases: dict[str, list[str]] = {}
    for key in keys:
        for summary in view.summaries(key).values():
            labels = bases.setdefault(basis(summary), [])
            if view.measure_label(key) not in labels:
                labels.append(view.measure_label(key))
    if len(bases) == 1:
        return list(bases)
    return [f"{'; '.join(labels)}: {text}" for text, labels in bases.items()]


def basis(summary: Summary) -> str:
    """Return queries, objects and gallery of a measure as a sentence."""
    return f"{summary.queries:,} queries of {summary.objects} objects. Gallery: {summary.gallery}."


# Differences and controls ----------------------------------------------------------------------------


def differences(view: ProtocolView) -> Table | None:
    """Return the paired differences between rows, and between rows and their controls, on the same queries."""
    found = [(view.label(one.b), one.a, one.measure, one.difference) for one in view.result.comparisons]
    for name, row in view.result.rows.items():
        for control, by_measure in row.differences.items():
            found += [(CONTROL_NAMES[control], name, key, one) for key, one in by_measure.items()]
    rows = [
        (f"{view.label(name)} − {other}", view.measure_label(key), difference(one), p_value(one.p))
        for other, name, key, one in found
    ]
    note = "Same queries for both. Interval: bootstrap over objects; p: two-sided sign-flip test over objects."
    return _marked(("rows", "measure", "difference, points", "p"), rows, (note,), words=(1,))


def verdicts(view: ProtocolView) -> list[str]:
    """Return a sentence for each row with a verdict: the main measure, and its differences from the controls."""
    main, sentences = view.result.main, []
    for name, row in view.result.rows.items():
        if row.verdict:
            reasons = []
            for control, found in row.differences.items():
                where = "over" if found[main].low > 0 else "below" if found[main].high < 0 else "against"
                reasons.append(f"{difference(found[main])} points {where} {CONTROL_NAMES[control]}")
            sentences.append(
                f"{view.label(name)}, {view.measure_label(main)}: {with_interval(row.measures[main])}, "
                f"{'above' if row.verdict.above_chance else 'not significantly different from'} chance "
                f"({percent(row.measures[main].chance[0])}); "
                f"{'counts' if row.verdict.counts_as_touch else 'does not count'} as touch: {'; '.join(reasons)}."
            )
    return sentences


def controls(view: ProtocolView, found: Mapping[str, ControlResult]) -> Table | None:
    """Return the main measures of controls or ceilings, at most three, below those of the methods that they use.

    The last column states whether a control is at chance.
    """
    main = dict.fromkeys([view.result.main, *view.headlines])
    keys = [key for key in main if any(key in (control.measures or {}) for control in found.values())][:3]
    methods = dict.fromkeys(control.method for control in found.values() if control.method in view.result.rows)
    rows = [
        ("the result", view.label(method), *_values(view.result.rows[method].measures, keys), "") for method in methods
    ]
    for name, control in found.items():
        at_chance = MISSING_VALUE
        if measure := next(iter((control.measures or {}).values()), None):
            at_chance = "yes" if measure.low[0] <= measure.chance[0] <= measure.high[0] else "no"
        description = f"{control.description} ({control.reason})" if control.reason else control.description
        rows.append((name, description, *_values(control.measures, keys), at_chance))
    header = ("inputs", "description", *(f"{view.measure_label(key)}, %" for key in keys), "chance in the interval")
    notes = _without_threshold(view) if "pair_accuracy" in keys else []
    return _marked(header, rows, notes, words=(1,)) if found else None


# Objects and decisions -------------------------------------------------------------------------------


def confusions(view: ProtocolView, name: str, details: Details) -> Iterator[Block]:
    """Yield the most frequent confusions of a row."""
    rows = tuple((one.object_id, one.mistaken_for, percent(one.share, 0)) for one in details.confusions)
    note = (
        f"The fraction of the touches of an object for which {view.label(name)} ranked another one first in the full "
        "gallery of unseen objects."
    )
    if rows:
        yield Table(("object", "mistaken for", "of its touches, %"), rows, (note,), words=frozenset({1}))


def rejects(view: ProtocolView, found: Mapping[str, Rejection[Summary]]) -> Table | None:
    """Return the measures of the decision whether the catalogue contains the object."""
    rows = [(view.label(name), *map(with_interval, (one.auroc, one.balanced_accuracy))) for name, one in found.items()]
    header = ("method", "AUROC, %", "balanced accuracy, %")
    notes = (
        f"{basis(next(iter(found.values())).auroc)} Chance is 50 %.",
        "Balanced accuracy: a query is accepted if the posterior, fitted on validation objects, is at least as high "
        f"for the gallery as for none of its objects: {FORMULA}.",
    )
    return _marked(header, rows, notes)


def verification(found: Mapping[str, Mapping[str, VerificationRates]]) -> Table:
    """Return the equal error rate, and the false-reject rate at each false-accept rate, by impostors and grasps."""
    fars = sorted(next(iter(found["random"].values())).frr, key=float, reverse=True)
    rows = [
        (label, grasps, *map(_supported_rate, (one.eer, *(one.frr[far] for far in fars))))
        for kind, label in IMPOSTORS.items()
        for grasps, one in sorted(found[kind].items(), key=lambda item: int(item[0]))
    ]
    header = ("impostors", "grasps", "EER, %", *(f"FRR at a FAR of {100 * float(far):g} %, %" for far in fars))
    note = "Interval: each object counts as one trial (Clopper and Pearson)."
    return Table(header, tuple(rows), (note,), words=frozenset({0}))


def _supported_rate(rate: Rate) -> str:
    """Return a rate with its interval in percent, or the number of objects that it needs."""
    if rate.value is not None and rate.low is not None and rate.high is not None:
        return interval(rate.value, rate.low, rate.high)
    return "refused: " + (f"needs {rate.objects_needed:,} objects" if rate.objects_needed else "no errors")


# Objects of a split -----------------------------------------------------------------------------------


def split(parts: Mapping[str, Sequence[str]]) -> Table:
    """Return the objects of each part of a split."""
    rows = tuple((label, str(len(parts[part])), ", ".join(sorted(parts[part]))) for part, label in PARTS.items())
    return Table(("part", "objects", "ids"), rows, words=frozenset({2}))
