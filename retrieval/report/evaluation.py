"""The report of an evaluation: results.json and the recording's pictures in, Markdown, one HTML page and figures out.

Every number comes from results.json or timings.json; nothing is measured here.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from retrieval.data.dataset import AnyRecording, load_grasps
from retrieval.report import error_analysis, method_comparison, tables
from retrieval.report.builder import Builder
from retrieval.report.document import Block, Details, Document, Listing, Section, Table, Text, write_document
from retrieval.report.results import (
    FEW_OBJECTS_MARK,
    FEW_OBJECTS_NOTE,
    capitalized,
    measure_label,
    method_label,
    percent,
    read_results,
    with_interval,
)

PAPER = (
    "For orientation only: on its own data (98 real objects, real GelSight fingers) the paper reports a pair accuracy "
    "of 64.3 % (chance 50 %) on its 18 unseen objects (Lin, Calandra, Levine: Learning to Identify Object Instances by "
    "Touch, ICRA 2019). Other objects, other pictures: it is no rival to the numbers here."
)
SIMULATION = (
    "This recording is simulated. It can show that the code works, how methods compare on the same data, and how "
    "accuracy moves with objects, grasps and time. It cannot say how well any of them does on real sensors and real "
    "objects: relief, material and light are drawn from a program, photo and touch come from one geometry without "
    "wear, dirt or error of calibration, and objects differ only by what the program varies."
)


def write_report(out: Path, recording: AnyRecording | None) -> list[Path]:
    """Write report.md, report.html and figures/ under `out` from its results.json (and timings.json where it is).

    recording: where the pictures of the galleries are; None leaves the galleries out. Returns the files written.
    Raises BadInput for results that cannot be read, DatasetError for a recording that cannot, RetrievalError where
    matplotlib is missing.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny")
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))
    >>> done = retrieval.evaluate("lab", Path("summaries"), config=config, methods=["cca", "chance"], quiet=True)
    >>> [path.name for path in retrieval.write_report(Path("summaries"), "lab")][:2]
    ['report.md', 'report.html']
    """
    results = read_results(out)
    grasps = {grasp.grasp_id: grasp for grasp in load_grasps(recording)} if recording else {}
    builder = Builder(results, grasps, out)
    sections = [Section(title, tuple(block for block in build(builder) if block)) for title, build in SECTIONS.items()]
    document = Document(
        f"Which object was touched? Evaluation on {results.data['recording']['path_name']}",
        tuple(_lead(builder)),
        tuple(section for section in sections if section.blocks),
    )
    return [*write_document(document, out), *builder.figures]


def _lead(builder: Builder) -> Iterator[Block]:
    data = builder.results.data
    parts, recording = data["split"], data["recording"]
    yield Text(
        f"{recording['objects']} objects, {recording['grasps']:,} grasps, source: {recording['source']}. "
        f"Fitted on {len(parts['train'])} objects, chosen and calibrated on {len(parts['validation'])}, judged on "
        f"{len(parts['test'])} that nothing has seen. Seeds: {', '.join(map(str, data['setting']['seeds']))}."
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
    if audit := data.get("audit"):
        yield Text(f"Leakage audit: {audit['verdict']}", warn=not audit["clean"])
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
    if chosen := {
        name: one["best_params"] for name, one in data["methods"].items() if any(one.get("best_params") or ())
    }:
        yield Details("Chosen on validation objects, for each seed", (Listing.of_json(chosen),))


def _everything(builder: Builder) -> Iterator[Block | None]:
    yield Details("Every measure of every method", (tables.everything(builder.results),))


SECTIONS: dict[str, Callable[[Builder], Iterator[Block | None]]] = {
    "Methods side by side": method_comparison.method_overview,
    "Guess curves": method_comparison.guess_curves,
    "More grasps of an object, more photos": method_comparison.grasps_and_photos,
    "Accuracy and time": method_comparison.time,
    "Full gallery": method_comparison.gallery,
    "Differences between methods": method_comparison.comparisons,
    "Controls": method_comparison.controls,
    "Ceilings": method_comparison.ceilings,
    "Touches that hardly press": method_comparison.low_contact,
    "Leakage audit": method_comparison.audit,
    "Object by object": error_analysis.objects,
    "What was mistaken for what": error_analysis.confusions,
    "Best and worst queries": error_analysis.examples,
    "Calibration": error_analysis.calibration,
    "Is the object in the catalogue?": error_analysis.reject,
    "How this was made": _setting,
    "Every number": _everything,
}
