"""The report of an evaluation: Markdown, one HTML page and figures, from results.json.

Every number comes from results.json; the report measures nothing. A report of one protocol has a
section for each part; a report of several has a section for each protocol, with folded parts. A part without results is
left out.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from retrieval.console.output import show
from retrieval.evaluation.aggregate import RULE
from retrieval.evaluation.results import Details, Results, read_results
from retrieval.metrics.registry import SET_SIZES, grasps_metric_name
from retrieval.model.verification import ERRORS_NEEDED
from retrieval.report import plots, tables
from retrieval.report.document import (
    Block,
    Document,
    Picture,
    Section,
    Table,
    Text,
    capitalized,
    write_document,
)
from retrieval.report.numbers import FEW_OBJECTS_MARK, FEW_OBJECTS_NOTE, percent, with_interval
from retrieval.report.results import ProtocolView, views
from retrieval.report.terminal import print_columns

SIMULATION = (
    "This recording is simulated. It can show that the code works, how methods compare on the same data, and how "
    "accuracy depends on objects, grasps and time. It cannot show the accuracy on real sensors and real objects: a "
    "program generates relief, material and light; photo and touch come from one geometry without wear, dirt or "
    "calibration errors; and objects differ only in the properties that the program varies."
)
INTERVALS_OF_UNITS = (
    "Brackets contain 95 % intervals of a bootstrap that resamples {unit}s, because queries of one {unit} are "
    "correlated. Every value is the mean over {unit}s of each {unit}'s mean, averaged over seeds. The interval covers "
    "other {unit}s of this kind; it does not cover another recording, split or rig. {ties}"
)
INTERVALS_OF_CHOICES = (
    "Every value is the mean over choices of test objects. Brackets contain 95 % intervals that cover the choice of "
    "test and training objects (corrected resampled t-test, because choices share objects). {ties}"
)
TIES = "Ties get their expected rank, so a constant scorer gets exactly chance."
GALLERY = "From a touch to all photos of the unseen objects; any photo of the object is right."
CONTROLS = (
    "The same method on inputs without the information of interest. Permuted touches, no-contact frames and the order "
    "of capture should be at chance. Low-pass touches contain light and coarse shape, so they may be above chance."
)
CEILINGS = (
    "CCA trained and tested within one modality. Matching between touch and photo can hardly be better than the worse "
    "of the two. The difference between that ceiling and the result is due to the change of modality."
)
TOO_FEW = "Not evaluated: the open-set decision requires at least three validation objects and three test objects."

Blocks = Iterator[Block | None]


def write_report(out: Path) -> list[Path]:
    """Write report.md, report.html and figures/ from results.json.

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
    >>> done = retrieval.evaluate("lab", Path("summaries"), config=config, methods=["cca", "chance"])
    >>> [path.name for path in retrieval.write_report(Path("summaries"))][:2]
    ['report.md', 'report.html']
    """
    results = read_results(out / "results.json")
    found = views(results)
    blocks: list[Block] = []
    if any(row.verdict for view in found for row in view.result.rows.values()):
        blocks.append(Text(RULE))
    blocks += [Text(f"{name} was skipped: {why}.") for name, why in results.skipped.items()]
    names = [view.result.title for view in found]
    if len(found) == 1:
        names = [f"{found[0].result.recording.name}: {names[0]}"]
        blocks += [*_lead(found[0]), *_parts(found[0])]
    for view in found if len(found) > 1 else ():
        first, *others = _parts(view)
        blocks.append(Section(view.result.title, (*_lead(view), *first.blocks, *others)))
    blocks.append(Section("Settings", (_settings(results),)))
    return write_document(Document(f"Which object was touched? Evaluation on {', '.join(names)}", tuple(blocks)), out)


def print_results(results: Results) -> None:
    """Print a table of each protocol, with its queries, objects and gallery, and the verdicts."""
    for view in views(results):
        if table := tables.measures(view, {key: view.measure_label(key) for key in view.headlines}):
            print_columns(view.result.title, table.header, table.rows, words=(0,))
            for note in filter(None, (view.note, *table.notes)):
                show(note)
        for line in tables.verdicts(view):
            show(line)


def _parts(view: ProtocolView) -> list[Section]:
    """Return all parts that have results."""
    parts = [Section(title, tuple(block for block in build(view) if block)) for title, build in PARTS.items()]
    return [part for part in parts if part.blocks]


def _lead(view: ProtocolView) -> Iterator[Text]:
    recording, splits = view.result.recording, view.result.folds[0]
    counts = f"{len(splits)} {'choices' if view.result.unit == 'choice' else 'folds'}"
    if len(splits) == 1:
        counts = ", ".join(f"{len(splits[0][part])} {label} objects" for part, label in tables.PARTS.items())
    yield Text(
        f"{view.result.rule} {recording.objects} objects, {recording.grasps:,} grasps, source: {recording.source}; "
        f"{counts}."
    )
    if view.note:
        yield Text(capitalized(view.note))
    if verdicts := tables.verdicts(view):
        yield from (Text(line, warn="does not count" in line) for line in verdicts)
    else:
        values = [
            f"{view.measure_label(key)} {with_interval(summary)} (chance {percent(summary.chance[0])})"
            for key in view.headlines
            if (summary := view.summary(view.main_row, key))
        ]
        text = f"{capitalized(view.label(view.main_row))}, in percent: {'; '.join(values)}."
        yield Text(f"{text} {FEW_OBJECTS_NOTE}" if FEW_OBJECTS_MARK in text else text)
    if "simulat" in recording.source.lower():
        yield Text(SIMULATION)
    yield from (Text(sentence) for sentence in view.result.published_results)


# Methods ---------------------------------------------------------------------------------------------


def _methods(view: ProtocolView) -> Blocks:
    if keys := view.headlines[:5]:
        yield Picture(
            view.figure_name("overview"),
            "Dots with intervals: each measure of each method; the table below has the numbers.",
            "Value and 95 % interval of each method; dashed: chance in closed form.",
            lambda: plots.overview(view, keys),
        )
    yield tables.section(view, "main")
    of_choices = view.result.unit == "choice"
    yield Text((INTERVALS_OF_CHOICES if of_choices else INTERVALS_OF_UNITS).format(unit=view.result.unit, ties=TIES))


def _topn(view: ProtocolView) -> Blocks:
    if keys := [key for key in ("topn_k5", "topn_k10") if view.summaries(key)]:
        yield Picture(
            view.figure_name("guess-curves"),
            "Rising curves: top-N accuracy of each method against N.",
            "How often the object is among the first N answers, with K − 1 other objects as candidates. Bands: 95 % "
            "intervals.",
            lambda: plots.topn_curves(view, keys),
        )


def _grasps(view: ProtocolView) -> Blocks:
    if any(map(view.summaries, map(grasps_metric_name, SET_SIZES))):
        yield Picture(
            view.figure_name("grasps"),
            "Top-1 accuracy against grasps in a query; the table below has the numbers.",
            "A query of several grasps of one object against three photos of each of five objects. Dashed: chance.",
            lambda: plots.grasps(view),
        )
        yield tables.section(view, "grasps")


def _explained(text: str, table: Table | None) -> Blocks:
    return iter([Text(text), table] if table else [])


# Objects -------------------------------------------------------------------------------------------


def _each(view: ProtocolView, show_row: Callable[[ProtocolView, str, Details], Iterator[Block]]) -> Blocks:
    """Yield the blocks of the main row, then, folded, of the other learned rows."""
    for name, details in view.details.items():
        if name in view.learned and (blocks := tuple(show_row(view, name, details))):
            yield from blocks if name == view.main_row else (Section(capitalized(view.label(name)), blocks),)


def _objects(view: ProtocolView, name: str, details: Details) -> Iterator[Block]:
    label = view.label(name)
    for key, measure, words in (
        ("test", "topn_k5", "(a) candidates: test objects only"),
        ("all", "topn_k5_all_objects", "(b) candidates: all objects (red: test, grey: validation, blue: training)"),
    ):
        if details.per_object.get(f"{key}_candidates"):
            yield Picture(
                view.figure_name(f"objects-{key}-{name}"),
                f"Bars: accuracy of each object, {label}, {words}.",
                f"Top-1 accuracy among five objects for each object, {label}; {words}.",
                partial(plots.objects, view, name, f"{key}_candidates", measure),
            )


# Decisions -----------------------------------------------------------------------------------------


def _reliability(view: ProtocolView, name: str, details: Details) -> Iterator[Block]:
    label = view.label(name)
    if details.reliability:
        ece = ", ".join(f"{kind} {percent(found['ece'])} %" for kind, found in details.reliability.items())
        yield Picture(
            view.figure_name(f"reliability-{name}"),
            f"Reliability diagrams, {label}. ECE: {ece}.",
            f"Right answers against the probability that {label} stated; a calibrated method is on the diagonal.",
            partial(plots.reliability, view, name),
        )


def _reject(view: ProtocolView) -> Blocks:
    found = {name: details.reject for name, details in view.details.items() if details.reject}
    if found:
        yield Picture(
            view.figure_name("reject"),
            "ROC curves; the table below has the areas under them.",
            "Each query is used twice: with its object in the gallery, and without it. ROC curve of the decision that "
            "the gallery contains the object; the grey line marks 95 % true accepts.",
            lambda: plots.reject(view),
        )
        yield tables.rejects(view, found)
    elif view.details:
        yield Text(TOO_FEW)


def _verification(view: ProtocolView, _: str, details: Details) -> Iterator[Block]:
    if details.verification:
        one = next(iter(details.verification["random"].values()))
        yield tables.verification(details.verification)
        yield Text(
            f"{one.sequences:,} sequences of grasps of {one.objects} unseen objects. A sequence is accepted if "
            "its largest log likelihood ratio so far reaches the threshold. Impostors: every other unseen object, or "
            "the one whose photos have the most similar embeddings. A FAR is refused if the trials would contain fewer "
            f"than {ERRORS_NEEDED} errors (rule of 30)."
        )


# Settings ------------------------------------------------------------------------------------------


def _recording(view: ProtocolView) -> Blocks:
    recording = view.result.recording
    rows = [("recording", f"{recording.name} ({recording.source})"), ("digest of the recording", recording.digest)]
    yield Table(("property", "value"), tuple(rows), words=frozenset({1}))
    if len(view.result.folds[0]) == 1:
        yield Section("Objects of each part", (tables.split(view.result.folds[0][0]),))


def _settings(results: Results) -> Table:
    setting = results.setting
    rows = [
        ("preset", setting.preset),
        ("seeds", ", ".join(map(str, setting.seeds))),
        ("software", f"touch-retrieval {results.software}"),
    ]
    if setting.model:
        rows.insert(1, ("digest of the model", setting.model))
    note = (
        "results.json has the whole configuration, the calibrations and the parameters that methods selected. Single "
        "objects and decisions are those of the first seed."
    )
    return Table(("setting", "value"), tuple(rows), (note,), frozenset({1}))


PARTS: dict[str, Callable[[ProtocolView], Blocks]] = {
    "Comparison of methods": _methods,
    "Top-N accuracy": _topn,
    "Several grasps": _grasps,
    "Full gallery": lambda view: _explained(GALLERY, tables.section(view, "gallery")),
    "Differences": lambda view: iter([tables.differences(view)]),
    "Controls": lambda view: _explained(CONTROLS, tables.controls(view, view.result.controls)),
    "Ceilings": lambda view: _explained(CEILINGS, tables.controls(view, view.result.ceilings)),
    "Accuracy by object": lambda view: _each(view, _objects),
    "Confusions": lambda view: _each(view, tables.confusions),
    "Calibration": lambda view: _each(view, _reliability),
    "Is the object in the catalogue?": _reject,
    "Is it the expected object?": lambda view: _each(view, _verification),
    "Recording": _recording,
}
