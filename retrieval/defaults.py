"""What a command uses where the user names no model or index: the last one made, else the shipped one.

The last ones are remembered in `$XDG_STATE_HOME/touch-retrieval/last.json` (`~/.local/state` where it is not set).
"""

import json
import os
from importlib import resources
from pathlib import Path

from retrieval.errors import BadInput, CheckpointError

SHIPPED = "simulated-mobilenet.safetensors"


def shipped_model() -> Path:
    """The checkpoint that comes with the package; trained on the simulated rig, for trying the program out."""
    return Path(str(resources.files("retrieval") / "shipped" / SHIPPED))


def find_model(given: str | None) -> tuple[Path, str]:
    """The checkpoint to use and why: the one given, else the last trained, else the shipped one."""
    if given is not None:
        return Path(given), "given"
    if (last := _last().get("model")) and Path(last).is_file():
        return Path(last), "the last one trained"
    if shipped_model().is_file():
        return shipped_model(), "shipped; trained on the simulated rig: train your own for real sensors"
    raise CheckpointError("there is no trained model; make one with `retrieve train`, or name it with --model")


def find_index(given: str | None) -> tuple[Path, str]:
    """The index to use and why: the one given, else ./index, else the last one built."""
    if given is not None:
        return Path(given), "given"
    here = Path("index")
    if (here / "CURRENT").is_file():
        return here, "in this folder"
    if (last := _last().get("index")) and (Path(last) / "CURRENT").is_file():
        return Path(last), "the last one built"
    raise BadInput("there is no index here and none was built before; run `retrieve build-index CATALOGUE` first")


def remember(kind: str, path: Path) -> None:
    """Note `path` as the last "model" or "index". Quietly does nothing where the note cannot be written."""
    note = {**_last(), kind: str(path.resolve())}
    try:
        _state_file().parent.mkdir(parents=True, exist_ok=True)
        beside = _state_file().with_suffix(f".{os.getpid()}.tmp")
        beside.write_text(json.dumps(note), "utf-8")
        beside.replace(_state_file())
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return


def _last() -> dict[str, str]:
    try:
        note = json.loads(_state_file().read_text("utf-8"))
    except (OSError, RuntimeError, ValueError):
        return {}
    return {key: value for key, value in note.items() if isinstance(value, str)} if isinstance(note, dict) else {}


def _state_file() -> Path:
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "touch-retrieval" / "last.json"
