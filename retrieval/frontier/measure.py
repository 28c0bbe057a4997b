"""Measure the error and time of each approximation of a search (one row of the report).

Each finished row is stored, so a stopped run continues with the missing rows.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from _touch_retrieval.files import file_digest
from retrieval.console.output import say
from retrieval.data.dataset import AnyRecording, folder_of
from retrieval.evaluation.cache import cached_document, write_document
from retrieval.frontier import APPROXIMATIONS, load_approximation
from retrieval.frontier.clock import machine
from retrieval.frontier.points import ApproximationResult
from retrieval.frontier.report import write_frontier
from retrieval.frontier.sample import QUICK, Sample, Scale
from retrieval.search.defaults import shipped_model
from retrieval.version import __version__

FORMAT = 2


def measure_frontier(
    out: Path,
    model: str | Path | None,
    recording: AnyRecording | Callable[[], Path],
    *,
    only: Iterable[str] = (),
    photos: int = Scale.photos,
    queries: int = Scale.queries,
    repeats: int = Scale.repeats,
    quick: bool = False,
    table: Mapping[str, str] = APPROXIMATIONS,
    model_free: Collection[str] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Measure the error and the run time of each approximation; write frontier.json, frontier.html and figures/.

    Stored rows are reused if software, model, recording, scale and machine are the same.

    Args:
        out: Folder of the results.
        model: A checkpoint; None for the shipped one.
        recording: Grasps of unseen objects; a function that returns the folder is called only if a row needs it.
        only: Names of rows; empty for all.
        photos: Number of photos of a synthetic catalogue. The features of each are a weighted mean of those of two
            photos of the recording.
        queries: Largest number of query touches for that catalogue.
        repeats: Number of timings; the result is their median.
        quick: Use the smallest grids and sizes, as a smoke test.
        table: Name to "module:function" of each approximation.
        model_free: Names of rows that depend on neither the model nor the grasps.
        quiet: No output on stderr.

    Returns:
        The content of frontier.json.

    Raises:
        ConfigError: A name is unknown. Errors of the measurements pass through.

    >>> from pathlib import Path
    >>> options = {"only": ["partials"], "quick": True, "quiet": True}
    >>> document = retrieval.measure_frontier(Path("frontier"), "model.safetensors", "lab", **options)
    >>> document["rows"]["partials"]["title"]
    'Number format of stored partial activations'
    """
    out.mkdir(parents=True, exist_ok=True)
    smaller = {name: min(getattr(QUICK, name), value) for name, value in (("photos", photos), ("queries", queries))}
    scale = dataclasses.replace(QUICK, **smaller) if quick else Scale(photos, queries, repeats=repeats)
    grasps = recording if callable(recording) else lambda: folder_of(recording)
    sample = Sample(Path(model or shipped_model()), grasps, out / "features", scale, quiet)
    document = measure(sample, out, only, table=table, model_free=model_free)
    write_frontier(out, document)
    return document


def measure(
    sample: Sample,
    out: Path,
    only: Iterable[str] = (),
    *,
    table: Mapping[str, str] = APPROXIMATIONS,
    model_free: Collection[str] = (),
) -> dict[str, Any]:
    """Measure approximations and write `out`/frontier.json.

    Stored rows are reused if software, model, recording, scale and machine are the same. Each row, measured or stored,
    is printed on stderr: one line for each plot of error against time (`Panel`).

    Args:
        sample: Model, grasps and scale.
        out: Folder of the results.
        only: Names of `table`; empty for all.
        table: Name -> "module:function" of each approximation.
        model_free: Names of rows that depend on neither the model nor the grasps.

    Returns:
        The content of frontier.json.

    Raises:
        ConfigError: A name is unknown. Errors of the measurements pass through.
    """
    names = list(dict.fromkeys(only)) or list(table)
    works = {name: load_approximation(name, table) for name in names}
    rows = {name: _row(sample, out, name, work, name in model_free) for name, work in works.items()}
    document = {
        "software": __version__,
        "machine": machine(),
        "model": file_digest(sample.model),
        "scale": dataclasses.asdict(sample.scale),
        "rows": {name: row.to_dict() for name, row in rows.items()},
    }
    write_document(out / "frontier.json", document)
    return document


def _row(
    sample: Sample, out: Path, name: str, work: Callable[[Sample], ApproximationResult], is_model_free: bool
) -> ApproximationResult:
    cache_key: dict[str, Any] = {"name": name, "format": FORMAT, "software": __version__, "machine": machine()}
    cache_key["scale"] = dataclasses.asdict(sample.scale)
    if not is_model_free:
        cache_key |= {"model": file_digest(sample.model), "grasps": sample.digest}

    def make() -> dict[str, Any]:
        if not sample.quiet:
            say(f"frontier: measuring {name}")
        return work(sample).to_dict()

    row = ApproximationResult.from_dict(cached_document(out / "parts" / f"{name}.json", cache_key, make))
    if not sample.quiet:
        for line in row.lines():
            say(f"{name}: {line}")
    return row
