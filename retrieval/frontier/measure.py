"""Measure the error and time of each approximation of a search (one row of the report).

Each finished row is stored, so a stopped run continues with the missing rows.
"""

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any

import msgspec

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.files import file_digest, write_atomically
from _touch_retrieval.registry import Registry
from retrieval.console.output import say
from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording
from retrieval.frontier import APPROXIMATIONS
from retrieval.frontier.clock import machine
from retrieval.frontier.points import ApproximationResult
from retrieval.frontier.report import write_frontier
from retrieval.frontier.sample import Sample, Scale
from retrieval.model.shipped import shipped_model
from retrieval.version import __version__

FORMAT = 5


def measure_frontier(
    out: Path,
    model: str | Path | None,
    recording: AnyRecording | Callable[[], AnyRecording],
    *,
    only: Iterable[str] = (),
    photos: int = Scale.photos,
    queries: int = Scale.queries,
    repeats: int = Scale.repeats,
    quick: bool = False,
    table: Registry[Any] = APPROXIMATIONS,
    model_free: Collection[str] = (),
) -> dict[str, Any]:
    """Measure the error and the run time of each approximation; write frontier.json, frontier.html and figures/.

    Stored rows are reused if software, model, recording, scale and machine are the same. Each row, measured or stored,
    is printed on stderr where progress is shown: one line for each plot of error against time.

    Args:
        out: Folder of the results.
        model: A checkpoint; None for the shipped one.
        recording: Grasps of unseen objects; a function that returns them is called only if a row needs it.
        only: Names of rows; empty for all.
        photos: Number of photos of a synthetic catalogue. The features of each are a weighted mean of those of two
            photos of the recording.
        queries: Largest number of query touches.
        repeats: Number of timings; the result is their median.
        quick: Use the smallest grids and sizes, as a smoke test.
        table: The approximations.
        model_free: Names of rows that depend on neither the model nor the grasps.

    Returns:
        The content of frontier.json.

    Raises:
        ConfigError: A name is unknown. Errors of the measurements pass through.

    >>> from pathlib import Path
    >>> options = {"only": ["partials"], "quick": True}
    >>> document = retrieval.measure_frontier(Path("frontier"), "model.safetensors", "lab", **options)
    >>> document["rows"]["partials"]["title"]
    'Number format of stored partial activations'
    """
    works = {name: table.resolve(name) for name in only or table}
    scale = Scale(min(photos, 2000), min(queries, 12), 2, quick) if quick else Scale(photos, queries, repeats)
    grasps = recording if callable(recording) else lambda: recording
    sample = Sample(Path(model or shipped_model()), grasps, out, scale)
    rows, model_digest, here = dict[str, ApproximationResult](), file_digest(sample.model), machine()
    with Cache(out / "cache.sqlite") as cache:
        for name, work in works.items():
            digests = [] if name in model_free else [model_digest, sample.digest]
            key = cache_key("frontier", name, FORMAT, __version__, here, msgspec.to_builtins(scale), *digests)
            if (stored := cache.get(key)) is None:
                stored = msgspec.json.encode(work(sample))
                cache.add({key: stored})
            rows[name] = msgspec.json.decode(stored, type=ApproximationResult)
            if Bar.is_on:
                for line in rows[name].lines():
                    say(f"{name}: {line}")
    content = {"software": __version__, "machine": here, "model": model_digest, "scale": scale, "rows": rows}
    document = msgspec.json.encode(content)
    write_atomically(out / "frontier.json", msgspec.json.format(document, indent=1))
    write_frontier(out, rows, here, scale.quick)
    return msgspec.json.decode(document, type=dict[str, Any])
