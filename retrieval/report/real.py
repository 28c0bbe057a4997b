"""The report of the real-data benchmark: Markdown and HTML, from results.json."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from retrieval.console.output import show
from retrieval.evaluation.real import PROTOCOLS, SCHEMA_VERSION
from retrieval.evaluation.real.verdict import CONTROL_NAMES, RULE
from retrieval.report.document import Block, Details, Document, Listing, Section, Table, Text, write_document
from retrieval.report.numbers import (
    FEW_OBJECTS_MARK,
    FEW_OBJECTS_NOTE,
    MISSING_VALUE,
    percent,
    points,
    probability,
    with_interval,
)
from retrieval.report.results import METHOD_LABELS, method_label, read_results_file
from retrieval.report.terminal import print_columns

Entry = Mapping[str, Any]
INTERVALS = (
    "In percent. Brackets contain 95 % intervals that resample {unit}s, because queries of one {unit} are correlated; "
    "seeds are averaged first. Ties get their expected rank, so a constant scorer gets exactly chance."
)
INTERVALS_OVER_CHOICES = (
    "In percent: the mean over choices of test objects. Brackets contain 95 % intervals that cover the choice of test "
    "and training objects (corrected resampled t-test, because choices share objects). Ties get their expected "
    "rank, so a constant scorer gets exactly chance."
)
LOW_PASS_LABEL = "low-pass control (8 x 6)"


def write_report(out: Path) -> list[Path]:
    """Write report.md and report.html from results.json.

    Args:
        out: Folder of results.json, to which the report is written.

    Returns:
        The written files.

    Raises:
        BadInput: The results cannot be read.
    """
    results = read_results_file(out / "results.json", SCHEMA_VERSION, "benchmark real")
    entries = _ordered(results)
    sections = [Section(entry["title"], tuple(_section(entry))) for entry in entries.values()]
    lead: tuple[Block, ...] = (
        Text(RULE),
        *(Text(f"{name} was skipped: {why}.") for name, why in results["skipped"].items()),
    )
    settings = Section("Settings", (Details("Settings", (Listing.of_json(results["setting"]),)),))
    document = Document("Identification by touch on real data", lead, (*sections, settings))
    return write_document(document, out)


def _ordered(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the protocols and their rows in their canonical order; the file's order is alphabetical."""
    entries: Mapping[str, Entry] = results["protocols"]

    def place(name: str, known: list[str] = [*METHOD_LABELS, *PROTOCOLS]) -> tuple[int, str]:  # noqa: B006
        return known.index(name) if name in known else len(known), name

    return {
        name: {
            **entries[name],
            "labels": dict(entries[name]["labels"]),
            "rows": {row: entries[name]["rows"][row] for row in sorted(entries[name]["rows"], key=place)},
        }
        for name in sorted(entries, key=place)
    }


def print_verdicts(results: Mapping[str, Any]) -> None:
    """Print a table and the verdicts of each protocol."""
    for entry in _ordered(results).values():
        table = numbers(entry)
        print_columns(entry["title"], table.header, table.rows, words=(0,))
        for line in verdicts(entry):
            show(line)


def _section(entry: Entry) -> Iterator[Block]:
    recording = entry["recording"]
    seeds = len(entry["folds"])
    yield Text(
        f"{entry['rule']} {recording['objects']} objects, {recording['grasps']:,} grasps, {seeds} seed(s), "
        f"{len(entry['folds'][0])} {entry['unit'] if entry['unit'] == 'choice' else 'fold'}(s) each."
    )
    yield from (Text(line, warn="does not count" in line) for line in verdicts(entry))
    yield numbers(entry)
    yield from (Text(anchor) for anchor in entry["published_results"])
    yield Text("Controls:")
    yield controls(entry)
    for table in (choices(entry),):
        if table:
            yield table
    yield Details("Against the controls, all measures", (differences(entry),))
    if compared := towers(entry):
        yield compared


# Verdicts and tables -----------------------------------------------------------------------------------


def verdicts(entry: Entry) -> list[str]:
    """Return a sentence for each row except the trivial baselines."""
    label = entry["labels"][entry["main"]]
    return [
        f"{_label(name, row)}, {label}: {with_interval(row['measures'][entry['main']])}, "
        f"{'above' if row['verdict']['above_chance'] else 'not significantly different from'} chance "
        f"({percent(row['measures'][entry['main']]['chance'][0])}); {row['verdict']['words']}."
        for name, row in entry["rows"].items()
        if row["verdict"]
    ]


def _label(name: str, row: Entry) -> str:
    """Return the label of a row: that of the method, or the name of an unadapted model."""
    return method_label(name) if row["model"] is None else f"{name} (unadapted)"


def numbers(entry: Entry) -> Table:
    """Return the main table: each method and its low-pass control, the other controls, and chance."""
    labels: Mapping[str, str] = entry["labels"]
    rows = []
    for name, row in entry["rows"].items():
        touch = {None: "", True: "yes", False: "no"}[row["verdict"] and row["verdict"]["counts_as_touch"]]
        rows.append((_label(name, row), *_values(row["measures"], labels), touch))
        if row["low_pass"]:
            rows.append((LOW_PASS_LABEL, *_values(row["low_pass"], labels), ""))
    for name, one in entry["controls"].items():
        if one["measures"]:
            rows.append((f"control: {name}", *_values(one["measures"], labels), ""))
    first = next(iter(entry["rows"].values()))["measures"]
    chance = [percent(first[key]["chance"][0]) if key in first else MISSING_VALUE for key in labels]
    rows.append(("chance, closed form", *chance, ""))
    basis = next(iter(first.values()))
    over_choices = entry["unit"] == "choice"
    queries = f"{basis['queries']:,} queries of {basis['objects']} {'object' if over_choices else entry['unit']}s"
    notes = [
        INTERVALS_OVER_CHOICES if over_choices else INTERVALS.format(unit=entry["unit"]),
        f"{queries} {'in total' if over_choices else 'per seed'}. Gallery: {basis['gallery']}.",
    ]
    if any(FEW_OBJECTS_MARK in cell for row in rows for cell in row):
        notes.append(FEW_OBJECTS_NOTE)
    header = ("method", *labels.values(), "counts as touch")
    return Table(header, tuple(rows), tuple(notes))


def _values(measures: Mapping[str, Any], labels: Mapping[str, str]) -> list[str]:
    return [with_interval(measures.get(key)) for key in labels]


def controls(entry: Entry) -> Table:
    """Return the description and the main measure of each control."""
    rows = [("low_pass", "each gel image is low-pass filtered to 8 x 6 pixels, in training and test", "see above")]
    for name, one in entry["controls"].items():
        value = with_interval(one["measures"].get(entry["main"])) if one["measures"] else f"none: {one['reason']}"
        rows.append((name, one["description"], value))
    header = ("control", "description", f"{entry['labels'][entry['main']]}, %")
    return Table(header, tuple(rows), words=frozenset({1, 2}))


def differences(entry: Entry) -> Table:
    """Return the paired differences between each row and its controls."""
    rows = [
        (_label(name, row), entry["labels"][key], control, points(one), probability(one["p"]))
        for name, row in entry["rows"].items()
        for which, control in CONTROL_NAMES.items()
        for key, one in (row[which] or {}).items()
        if key in entry["labels"]
    ]
    header = ("method", "measure", "control", "touch minus control, points", "p")
    return Table(header, tuple(rows), words=frozenset({1, 2}))


def towers(entry: Entry) -> Table | None:
    """Return the paired differences between each tower and the first one; None unless towers are compared."""
    rows = [
        (_label(name, row), entry["labels"][key], points(one), probability(one["p"]))
        for name, row in entry["rows"].items()
        for key, one in (row.get("tower_differences") or {}).items()
    ]
    header = ("tower", "measure", "points over the first tower, same representation", "p")
    return Table(header, tuple(rows), words=frozenset({1})) if rows else None


def choices(entry: Entry) -> Table | None:
    """Return the spread of the main measure over choices of test objects; None if the protocol has no choices."""
    if entry["unit"] != "choice":
        return None
    rows = []
    for name, row in entry["rows"].items():
        for label, measures in ((_label(name, row), row["measures"]), (LOW_PASS_LABEL, row["low_pass"])):
            if measures:
                rows.append((label, *_spread(measures[entry["main"]])))
    for name, one in entry["controls"].items():
        if one["measures"]:
            rows.append((f"control: {name}", *_spread(one["measures"][entry["main"]])))
    label = entry["labels"][entry["main"]]
    return Table((f"{label}, over choices", "mean, %", "minimum, %", "maximum, %", "choices"), tuple(rows))


def _spread(summary: Mapping[str, Any]) -> list[str]:
    values = (summary[key][0] for key in ("value", "min", "max"))
    return [*map(percent, values), str(len(summary["by_split"]))]
