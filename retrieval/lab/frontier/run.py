"""Measuring: every row once, kept under the folder by a digest of what made it, so that a stopped run goes on."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from indexes.store.files import file_digest, write_atomically
from indexes.store.regular import read_json
from retrieval.console.output import say
from retrieval.lab.frontier import APPROXIMATIONS, NEED_NOTHING, load_approximation
from retrieval.lab.frontier.clock import machine
from retrieval.lab.frontier.points import Row
from retrieval.lab.frontier.sample import Sample
from retrieval.version import __version__

FORMAT = 1


def measure(sample: Sample, out: Path, only: Iterable[str] = ()) -> dict[str, Any]:
    """Measure the rows `only` (all where empty) and write `out`/frontier.json; returns its content.

    Rows that were measured before by the same software, model, recording and scale on the same machine are read. A
    row is said on stderr as soon as it is there, a line a panel. Raises ConfigError for an unknown name, and what the
    measurements raise.
    """
    asked = list(dict.fromkeys(only)) or list(APPROXIMATIONS)
    for name in asked:
        load_approximation(name)
    rows = {name: _row(sample, out, name) for name in asked}
    document = {
        "software": __version__,
        "machine": machine(),
        "model": file_digest(sample.model),
        "scale": dataclasses.asdict(sample.scale),
        "rows": {name: row.to_dict() for name, row in rows.items()},
    }
    write_atomically(out / "frontier.json", (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    return document


def _row(sample: Sample, out: Path, name: str) -> Row:
    path, key = out / "parts" / f"{name}.json", _digest(sample, name)
    kept = _kept(path)
    if kept.get("made_by") == key:
        row = Row.from_dict(kept["row"])
    else:
        _say(sample, f"frontier: measuring {name}")
        row = load_approximation(name)(sample)
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


def _digest(sample: Sample, name: str) -> str:
    """A digest of all that makes a row: software, machine, scale, and the model and grasps where it needs them."""
    made_by: dict[str, Any] = {"name": name, "format": FORMAT, "software": __version__, "machine": machine()}
    made_by["scale"] = dataclasses.asdict(sample.scale)
    if name not in NEED_NOTHING:
        made_by |= {"model": file_digest(sample.model), "grasps": sample.digest}
    return hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()
