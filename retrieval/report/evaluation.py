"""The report of an evaluation: Markdown, one HTML page and figures, from results.json.

Every number comes from results.json or timings.json; the report measures nothing.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from retrieval.report import error_analysis, method_comparison, tables
from retrieval.report.builder import Builder
from retrieval.report.document import (
    Block,
    Details,
    Document,
    Listing,
    Section,
    Table,
    Text,
    capitalized,
    write_document,
)
from retrieval.report.numbers import FEW_OBJECTS_MARK, FEW_OBJECTS_NOTE, percent, with_interval
from retrieval.report.results import measure_label, method_label, read_results

PAPER = (
    "For orientation only: on its own data (98 real objects, real GelSight fingers) the paper reports a pair accuracy "
    "of 64.3 % (chance 50 %) on its 18 unseen objects (Lin, Calandra, Levine: Learning to Identify Object Instances by "
    "Touch, ICRA 2019). Its objects and pictures differ, so the numbers are not comparable."
)
SIMULATION = (
    "This recording is simulated. It can show that the code works, how methods compare on the same data, and how "
    "accuracy depends on objects, grasps and time. It cannot show the accuracy on real sensors and real objects: a "
    "program generates relief, material and light; photo and touch come from one geometry without wear, dirt or "
    "calibration errors; and objects differ only in the properties that the program varies."
)


def write_report(out: Path) -> list[Path]:
    """Write report.md, report.html and figures/ from results.json, and from timings.json if it exists.

    Args:
        out: Folder of results.json, to which the report is written.

    Returns:
        The written files.

    Raises:
        BadInput: The results cannot be read.
        RetrievalError: matplotlib is not installed.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny")
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))
    >>> done = retrieval.evaluate("lab", Path("summaries"), config=config, methods=["cca", "chance"], quiet=True)
    >>> [path.name for path in retrieval.write_report(Path("summaries"))][:2]
    ['report.md', 'report.html']
    """
    results = read_results(out)
    builder = Builder(results)
    sections = [Section(title, tuple(block for block in build(builder) if block)) for title, build in SECTIONS.items()]
    document = Document(
        f"Which object was touched? Evaluation on {results.data['recording']['path_name']}",
        tuple(_lead(builder)),
        tuple(section for section in sections if section.blocks),
    )
    return write_document(document, out)


def _lead(builder: Builder) -> Iterator[Block]:
    data = builder.results.data
    parts, recording = data["split"], data["recording"]
    yield Text(
        f"{recording['objects']} objects, {recording['grasps']:,} grasps, source: {recording['source']}. "
        f"The methods were trained on {len(parts['train'])} objects. Settings were selected and probabilities "
        f"calibrated on {len(parts['validation'])} others. The results below are from {len(parts['test'])} unseen "
        f"objects. Seeds: {', '.join(map(str, data['setting']['seeds']))}."
    )
    keys = ("pair_accuracy", "topn_k5", "topn_k5_g5_p3")
    found = [(key, summary) for key in keys if (summary := builder.results.summary(builder.main, key))]
    summaries = [
        f"{measure_label(key)}: {with_interval(summary)} (chance {percent(summary['chance'][0])})"
        for key, summary in found
    ]
    text = (
        f"{capitalized(method_label(builder.main))} on unseen objects, in percent. {capitalized('; '.join(summaries))}."
    )
    yield Text(f"{text} {FEW_OBJECTS_NOTE}" if FEW_OBJECTS_MARK in text else text)
    if builder.results.simulated:
        yield Text(SIMULATION)
    yield Text(PAPER)


def _setting(builder: Builder) -> Iterator[Block | None]:
    data = builder.results.data
    setting, features, recording = data["setting"], data["setting"]["features"], data["recording"]
    plain = {key: value for key, value in sorted(setting.items()) if isinstance(value, str | int | float)}
    rows = (
        ("recording", f"{recording['path_name']} ({recording['source']})"),
        ("digest of the recording", recording["digest"]),
        ("features", f"touch {features['touch']} x {features['fingers']} finger(s), photo {features['photo']}"),
        ("digest of the features", features["digest"]),
        ("seed of the split", str(data["split"]["seed"])),
        *((key, f"{value:,}" if isinstance(value, int) else str(value)) for key, value in plain.items()),
        ("software", f"touch-retrieval {data['software']}"),
    )
    yield Table(("setting", "value"), rows, words=frozenset({1}))
    yield Details("Objects of each part", (tables.split(builder.results),))
    yield Details("Configuration", (Listing.of_json(setting["config"]),))
    if selected := {
        name: one["best_params"] for name, one in data["methods"].items() if any(one.get("best_params") or ())
    }:
        yield Details("Parameters selected on validation objects, for each seed", (Listing.of_json(selected),))


SECTIONS: dict[str, Callable[[Builder], Iterator[Block | None]]] = {
    "Comparison of methods": method_comparison.method_overview,
    "Top-N accuracy": method_comparison.topn_curves,
    "Several grasps": method_comparison.grasps,
    "Accuracy and time": method_comparison.time,
    "Full gallery": method_comparison.gallery,
    "Differences between methods": method_comparison.comparisons,
    "Controls": method_comparison.controls,
    "Ceilings": method_comparison.ceilings,
    "Accuracy by object": error_analysis.objects,
    "Confusions": error_analysis.confusions,
    "Calibration": error_analysis.calibration,
    "Is the object in the catalogue?": error_analysis.reject,
    "Is it the expected object?": error_analysis.verification,
    "Settings": _setting,
}
