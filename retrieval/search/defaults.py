"""What a command uses where the user names no model or index: what lies in the working folder, else what is shipped.

Which model was trained and which index built last is remembered for each working folder on its own, in
`$XDG_STATE_HOME/touch-retrieval/last.json` (`~/.local/state` where it is not set): a training in one folder never
changes what a command in another one does.
"""

import json
import os
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from _touch_retrieval.files import file_digest, read_json, write_atomically
from retrieval.data.storage import is_url, url_or_path
from retrieval.errors import BadInput, CheckpointError

if TYPE_CHECKING:
    from indexes.store.manifest import Manifest
    from indexes.store.sharded import ShardedManifest

SHIPPED = {2: "simulated-mobilenet.safetensors", 1: "simulated-mobilenet-one-finger.safetensors"}
"""The checkpoints that come with the package, by the gel images of a touch."""
SHIPPED_NAMES = {"shipped": 2, "shipped-one-finger": 1}
"""What they are called where a command takes a checkpoint."""
INDEX = Path("index")
"""Where `build-index` writes and `query` looks, if nothing else is said."""

MAX_FOLDERS = 100
"""Of how many working folders it is remembered what was made there last."""


def shipped_model(fingers: int = 2) -> Path:
    """The checkpoint that comes with the package; trained on the simulated rig, for trying the program out.

    fingers: gel images of a touch. Raises BadInput for more than two.

    >>> retrieval.shipped_model().name
    'simulated-mobilenet.safetensors'
    """
    if fingers not in SHIPPED:
        raise BadInput(f"models for touches of 1 and of 2 gel images come with the package; got {fingers}")
    return Path(str(resources.files("retrieval") / "shipped" / SHIPPED[fingers]))


def is_shipped(path: Path) -> bool:
    """Whether this is a checkpoint in the folder of the package, wherever links lead."""
    return path.resolve() in [shipped_model(fingers).resolve() for fingers in SHIPPED]


def find_model(given: str | None, index: str | Path = INDEX) -> tuple[Path, str]:
    """The checkpoint to use and why: the one given, else that of `index`, else the last trained here, else the shipped.

    given: a path, or one of `SHIPPED_NAMES`. Raises CheckpointError where there is none, or where that of `index` is gone.
    """
    if given in SHIPPED_NAMES:
        return shipped_model(SHIPPED_NAMES[given]), "shipped; trained on the simulated rig"
    if given is not None:
        return Path(given), "given"
    from indexes.errors import IndexesError

    here = _last_model()
    manifest: Manifest | ShardedManifest | None = None
    with suppress(IndexesError):  # no usable index is none
        manifest = manifest_of(index)
    if manifest is not None:
        own = model_of(manifest)
        newer = f"; {here} was trained in this folder too: name it to take it" if here not in (None, own) else ""
        return own, f"the one that {index} was built with{newer}"
    if here is not None:
        return here, "the last one trained in this folder"
    if shipped_model().is_file():
        return shipped_model(), "shipped; trained on the simulated rig: train your own for real sensors"
    raise CheckpointError("there is no trained model; make one with `retrieve train`, or name it with --model")


def manifest_of(index: str | Path) -> "Manifest | ShardedManifest":
    """What an index folder, or a cluster of them, says of what it holds now. Raises the errors of `indexes.store`, and
    StorageError of what lies behind a URL.
    """
    from indexes.store.folder import IndexStore
    from indexes.store.manifest import read_manifest
    from retrieval.search.sharding.object_store import is_sharded, read_sharded_manifest

    return (
        read_sharded_manifest(index) if is_sharded(index) else read_manifest(Path(index) / IndexStore(index).current())
    )


def model_of(manifest: "Manifest | ShardedManifest") -> Path:
    """The checkpoint that built an index: where it lay then, else the last trained here or the shipped one, if equal.

    Raises CheckpointError where none is.
    """
    path = Path(str(manifest.about.get("checkpoint")))
    if path.is_file():
        return path
    for other in (_last_model(), shipped_model()):
        if other is not None and other.is_file() and file_digest(other) == manifest.fingerprint.get("checkpoint"):
            return other
    raise CheckpointError(
        f"the model of this index is no longer at {path}; name it with --model, or build the index again with another"
    )


def find_index(given: str | None) -> tuple[str | Path, str]:
    """The index to use, a folder or a URL, and why: the one given, else ./index, else the last one built from this
    folder. Raises BadInput where there is none.
    """
    if given is not None:
        if not is_url(given) and Path(given).is_file():
            raise BadInput(f"{given} is a file; an index is a folder, which `retrieve build-index` writes")
        return url_or_path(given), "given"
    if _is_index(INDEX):
        return INDEX, "in this folder"
    if (last := _last_of_folder().get("index")) and (is_url(last) or _is_index(Path(last))):
        return url_or_path(last), "the last one built from this folder"
    raise BadInput(
        "there is no index in this folder and none was built from it; run `retrieve build-index CATALOGUE` first, "
        "or name one with --index"
    )


def _is_index(folder: Path) -> bool:
    """Whether an index folder or a cluster of them lies there."""
    return any((folder / name).is_file() for name in ("CURRENT", "SHARDS.json"))


def remember(kind: str, path: str | Path) -> None:
    """Note `path` as the last "model" or "index" made from the working folder; does nothing where it cannot."""
    try:
        here = str(Path.cwd())
        notes = _read_state()
        mine = {**notes.pop(here, {}), kind: str(path if is_url(path) else Path(path).resolve())}
        notes = {**dict(list(notes.items())[-MAX_FOLDERS + 1 :]), here: mine}
        _state_file().parent.mkdir(parents=True, exist_ok=True)
        write_atomically(_state_file(), json.dumps(notes).encode())
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return


def _last_model() -> Path | None:
    """The last model trained from the working folder, while it is there."""
    path = Path(_last_of_folder().get("model", ""))
    return path if path.is_file() else None


def _last_of_folder() -> dict[str, str]:
    """The last "model" and "index" that were made from the working folder, by their whole paths."""
    try:
        return _read_state().get(str(Path.cwd()), {})
    except OSError:  # the working folder was removed
        return {}


def _read_state() -> dict[str, dict[str, str]]:
    """By working folder, the one noted last at the end."""
    try:
        notes = read_json(_state_file())
    except (OSError, RuntimeError, ValueError):
        return {}
    mine = notes.items() if isinstance(notes, dict) else ()
    return {
        folder: {kind: path for kind, path in noted.items() if isinstance(path, str)}
        for folder, noted in mine
        if isinstance(noted, dict)
    }


def _state_file() -> Path:
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "touch-retrieval" / "last.json"
