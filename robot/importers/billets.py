"""Steel billets: GelSight Mini touches and phone photos of the same places.

Source: github.com/rumilog/gelsight-contrastive-learning, GPL-3.0.

    <billet>/<place>_touch.png     one finger
    <billet>/<place>_photo.jpg

A place is an object (it is what a photo can name) with one grasp; its billet is the sequence, for the places
of a billet were captured in one go. Files are copied byte for byte.
"""

import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

from robot.errors import ImporterError, RecordingError
from robot.importers import Progress
from robot.recording.folder import Recording, RecordingWriter, read_recording

_FILE = re.compile(r"(?P<place>.+)_(?P<kind>touch|photo)\.(png|jpg|jpeg)", re.IGNORECASE)
_TRAP = (
    "Light and gel drift from billet to billet: on the ground billets an 8 x 6 thumbnail of a blurred touch "
    "names the billet far above chance. That is the capture leaking, not touch: print that control beside "
    "every result, split by sequence_id, prefer the welded billets, give exact intervals: 9 billets are few."
)
_INFO = {
    "source": "github.com/rumilog/gelsight-contrastive-learning",
    "licence": "GPL-3.0, with its source; the images are not ours to give on under another licence",
    "sensor": "GelSight Mini",
    "rig": "by hand, phone camera",
    "seed": None,
    "background": "none",
}


def import_billets(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the billets below `src` into the recording `out`; continue it where it stopped.

    Places without both files, or with a damaged name or file, are skipped and told in the recording's notes.
    Raises ImporterError for a source without any pair, RecordingError, StorageError.
    """
    places, skipped = _find_places(Path(src))
    with RecordingWriter(out, {**_INFO, "notes": [_TRAP, *skipped]}) as writer:
        for done, (name, files) in enumerate(sorted(places.items()), start=1):
            if name not in writer.grasp_ids:
                skipped += _append(writer, name, files)
            if progress is not None:
                progress(done, len(places))
    recording = read_recording(out)
    return replace(recording, notes=(*recording.notes, *skipped, _TRAP))


_Files = dict[str, Path]  # "photo" and "touch" of one place


def _append(writer: RecordingWriter, name: str, files: _Files) -> list[str]:
    """Append one place; return why it was skipped, if it was."""
    images = {"photo": files["photo"], "touch_a": files["touch"]}
    try:
        writer.append(name, name, images, sequence_id=files["touch"].parent.name)
    except RecordingError as error:
        return [f"skipped {name}: {error}"]
    return []


def _find_places(src: Path) -> tuple[dict[str, _Files], list[str]]:
    """Return ("<billet>-<place>" -> files, what is skipped and why). Raises ImporterError."""
    places: dict[str, _Files] = {}
    skipped = []
    for (billet, place), files in _find_files(src).items():
        name = f"{billet}-{place}"
        if len(files) < 2:
            file = next(iter(files.values()))
            skipped.append(f"skipped {billet}/{file.name}: its photo or touch is missing")
        elif name in places:
            skipped.append(f"skipped {billet}/{place}: another place is called {name} already")
        else:
            places[name] = files
    if not places:
        raise ImporterError(
            f"{src} must hold pairs <billet>/<place>_touch.png, <billet>/<place>_photo.jpg, and holds none"
        )
    return places, skipped


def _find_files(src: Path) -> dict[tuple[str, str], _Files]:
    found: dict[tuple[str, str], _Files] = defaultdict(dict)
    try:
        for path in sorted(src.glob("*/*")):
            match = _FILE.fullmatch(path.name)
            if match and not path.name.startswith("."):
                found[path.parent.name, match["place"]][match["kind"].lower()] = path
    except OSError as error:
        raise ImporterError(f"{src} cannot be read: {error.strerror}") from error
    return found
