"""Measuring: every row once, kept under the folder by a digest of what made it, so that a stopped run goes on."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from _touch_retrieval.files import file_digest, read_json, write_atomically
from retrieval.console.output import say
from retrieval.frontier import APPROXIMATIONS, load_approximation
from retrieval.frontier.clock import machine
from retrieval.frontier.points import Row
from retrieval.frontier.sample import Sample
from retrieval.version import __version__

FORMAT = 1


def measure(
    sample: Sample,
    out: Path,
    only: Iterable[str] = (),
    *,
    table: Mapping[str, str] = APPROXIMATIONS,
    need_no_model: Collection[str] = (),
) -> dict[str, Any]:
    """Measure approximations and write `out`/frontier.json.

    Rows that the same software measured before with the same model, recording and scale on the same machine are read.
    Each row is printed on stderr as soon as it is measured, one line per panel.

    Args:
        sample: Model, grasps and scale.
        out: Folder of the results.
        only: Names of `table`; all of them where empty.
        table: Name -> "module:function" of what can be measured.
        need_no_model: Names whose rows depend on neither the model nor the grasps.

    Returns:
        The content of frontier.json.

    Raises:
        ConfigError: A name is unknown. What the measurements raise passes through.
    """
    asked = list(dict.fromkeys(only)) or list(table)
    works = {name: load_approximation(name, table) for name in asked}
    rows = {name: _row(sample, out, name, work, name in need_no_model) for name, work in works.items()}
    document = {
        "software": __version__,
        "machine": machine(),
        "model": file_digest(sample.model),
        "scale": dataclasses.asdict(sample.scale),
        "rows": {name: row.to_dict() for name, row in rows.items()},
    }
    write_atomically(out / "frontier.json", (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    return document


def _row(sample: Sample, out: Path, name: str, work: Callable[[Sample], Row], by_itself: bool) -> Row:
    path, key = out / "parts" / f"{name}.json", _digest(sample, name, by_itself)
    kept = _kept(path)
    if kept.get("made_by") == key:
        row = Row.from_dict(kept["row"])
    else:
        _say(sample, f"frontier: measuring {name}")
        row = work(sample)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps({"made_by": key, "row": row.to_dict()}, allow_nan=False).encode())
    for line in row.lines():
        _say(sample, f"{name}: {line}")
    return row


def _say(sample: Sample, text: str) -> None:
    if not sample.quiet:
        say(text)


def _kept(path: Path) -> dict[str, Any]:
    try:
        kept = read_json(path)
    except (OSError, ValueError):
        return {}
    return kept if isinstance(kept, dict) else {}


def _digest(sample: Sample, name: str, by_itself: bool) -> str:
    """A digest of all that makes a row: software, machine, scale, and the model and grasps unless it is by itself."""
    made_by: dict[str, Any] = {"name": name, "format": FORMAT, "software": __version__, "machine": machine()}
    made_by["scale"] = dataclasses.asdict(sample.scale)
    if not by_itself:
        made_by |= {"model": file_digest(sample.model), "grasps": sample.digest}
    return hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()
