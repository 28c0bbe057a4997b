"""Steel billets: GelSight Mini touches and phone photos of the same places.

There is one touch and one photo of each place:

    <billet>/<place>_touch.png     one finger
    <billet>/<place>_photo.jpg

A place is an object with one grasp, because a photo identifies a place. Its billet is the sequence, because the
places of a billet were captured in one session.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from robot.importers.importing import DataSet, Item, Progress, Skip, import_items, numbered_files, subfolders
from robot.recording.folder import Recording

DATA_SET = DataSet(
    source="github.com/rumilog/gelsight-contrastive-learning",
    licence="GPL-3.0",
    terms="the licence of the repository; we may not pass the images on under another licence",
    citation="github.com/rumilog/gelsight-contrastive-learning, no paper",
    sensor="GelSight Mini",
    rig="by hand, phone camera",
    expects="pairs `<billet>/<place>_touch.png`, `<billet>/<place>_photo.jpg`",
    caveats=(
        "Light and gel drift from billet to billet: a low-passed touch (8 x 6) of a ground (not welded) billet "
        "identifies the billet far above chance. This is leakage from the capture, not touch. Print this low-pass "
        "control next to every result, split by sequence_id, and prefer the welded billets. There are only 9 billets: "
        "state exact (Clopper-Pearson) intervals.",
    ),
)
_FILE = re.compile(r"(?P<place>[^.].*)_(?P<kind>touch|photo)\.(png|jpg|jpeg)", re.IGNORECASE)


def import_billets(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the billets below `src`.

    Raises:
        ImporterError: `src` contains no pair of photo and touch.
    """
    items = list(_places(src))
    if not any(isinstance(item, Item) for item in items):
        raise DATA_SET.mismatch_error(src, "it contains no pair")
    return import_items(DATA_SET, items, out, total=len(items), progress=progress, source=src)


def _places(src: Path) -> Iterator[Item | Skip]:
    for billet in subfolders(src):
        places: dict[str, dict[str, Path]] = defaultdict(dict)  # place -> "photo" and "touch" -> file
        for match, path in numbered_files(billet, _FILE):
            places[match["place"]][match["kind"].lower()] = path
        for place, files in sorted(places.items()):
            name = f"{billet.name}-{place}"
            if len(files) < 2:
                yield Skip("its photo or touch is missing", f"{billet.name}/{next(iter(files.values())).name}")
            else:
                images = {"photo": files["photo"], "touch_a": files["touch"]}
                yield Item(name, name, images, {"sequence_id": billet.name})
