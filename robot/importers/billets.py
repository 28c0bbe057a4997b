"""Steel billets: GelSight Mini touches and phone photos of the same places.

Of every place there is one touch and one photo:

    <billet>/<place>_touch.png     one finger
    <billet>/<place>_photo.jpg

A place is an object (it is what a photo can name) with one grasp; its billet is the sequence, for the places of a
billet were captured in one go.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import DataSet, Item, Progress, Skip, import_items, subfolders
from robot.recording.folder import Recording

DATA_SET = DataSet(
    source="github.com/rumilog/gelsight-contrastive-learning",
    licence="GPL-3.0, with its source; the images are not ours to give on under another licence",
    citation="github.com/rumilog/gelsight-contrastive-learning, no paper",
    sensor="GelSight Mini",
    rig="by hand, phone camera",
    expects="pairs `<billet>/<place>_touch.png`, `<billet>/<place>_photo.jpg`",
    caveats=(
        "Light and gel drift from billet to billet: on the ground billets an 8 x 6 thumbnail of a blurred touch "
        "names the billet far above chance. That is the capture leaking, not touch: print that control beside "
        "every result, split by sequence_id, prefer the welded billets, give exact intervals: 9 billets are few.",
    ),
)
_FILE = re.compile(r"(?P<place>.+)_(?P<kind>touch|photo)\.(png|jpg|jpeg)", re.IGNORECASE)
_Files = dict[str, Path]  # "photo" and "touch" of one place


def import_billets(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the billets below `src`. Raises ImporterError for a source without any pair."""
    src = Path(src)
    total, pairs = 0, False
    for item in _places(src):
        total, pairs = total + 1, pairs or isinstance(item, Item)
    if not pairs:
        raise DATA_SET.mismatch_error(src, "it holds no pair")
    return import_items(DATA_SET, _places(src), out, total=total, progress=progress)


def _places(src: Path) -> Iterator[Item | Skip]:
    for billet in subfolders(src):
        for place, files in sorted(_find_files(billet).items()):
            name = f"{billet.name}-{place}"
            if len(files) < 2:
                yield Skip("its photo or touch is missing", f"{billet.name}/{next(iter(files.values())).name}")
            else:
                images = {"photo": files["photo"], "touch_a": files["touch"]}
                yield Item(name, name, images, {"sequence_id": billet.name})


def _find_files(billet: Path) -> dict[str, _Files]:
    """The files of one billet by place. Raises ImporterError."""
    found: dict[str, _Files] = defaultdict(dict)
    try:
        for path in sorted(billet.iterdir()):
            match = _FILE.fullmatch(path.name)
            if match and not path.name.startswith("."):
                found[match["place"]][match["kind"].lower()] = path
    except OSError as error:
        raise ImporterError(f"{billet} cannot be read: {error.strerror}") from error
    return found
