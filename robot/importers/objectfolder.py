"""ObjectFolder: samples of ObjectFolder Real, and the packs of its cross-sensory retrieval benchmark.

    <index>/visual/0.png  <index>/tactile/0.png     samples of Real, index 1 to 100 of the public list

    vision/<object>/<instance>.png                  a pack of the benchmark, real or simulated
    touch/<object>/<instance>.png
    split.json                                      {"train": {"<object>": [instances]}, "val": ..., "test": ...}

The id of an object is its number, because names occur twice in the public list. A touch gets the photo with its own
number; without such a photo, touch number i gets photo number i modulo the number of photos. The split of a pack is
stored if its parts have different objects. Audio is ignored.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    subfolders,
)
from robot.recording.folder import Recording, SharedImage, safe_name
from robot.storage import read_json_object

DATA_SET = DataSet(
    source="ObjectFolder",
    licence=NOT_STATED,
    terms="ObjectFolder Real: see its page; simulated touches (ObjectFolder 2.0): CC BY 4.0",
    citation="Gao, Dou, Li and others, The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects, "
    "CVPR 2023",
    sensor="GelSight, real or simulated (Taxim)",
    rig="robot arm; photos of the object alone",
    expects="`<index>/visual/0.png` and `<index>/tactile/0.png`, or `vision/<object>/` and `touch/<object>/`",
    caveats=(
        "The benchmark counts any picture of the right object as correct (mAP, mean average precision). Some published "
        "numbers for real objects are those of training objects.",
    ),
    unverified=("whether the split of each pack is by object or by picture",),
)
_PICTURE = re.compile(r"(\d+)\.(png|jpg)")
_PARTS = {"train": "train", "val": "validation", "test": "test"}


def import_objectfolder(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the samples or the pack in `src`.

    Raises:
        ImporterError: `src` contains neither.
    """
    is_pack = (src / "vision").is_dir() and (src / "touch").is_dir()
    if is_pack:
        folders = [(folder.name, folder, src / "vision" / folder.name) for folder in subfolders(src / "touch")]
    else:
        folders = [(folder.name, folder / "tactile", folder / "visual") for folder in subfolders(src)]
    objects = {
        name: (touches, numbered_files(vision, _PICTURE))
        for name, touch, vision in folders
        if name.isdecimal() and (touches := numbered_files(touch, _PICTURE))
    }
    if not objects:
        raise DATA_SET.mismatch_error(src, "it contains no touch of that kind")
    return import_items(
        DATA_SET,
        _items(objects),
        out,
        total=sum(len(touches) for touches, _ in objects.values()),
        progress=progress,
        source=src,
        split=_split(src / "split.json") if is_pack else None,
    )


_Files = list[tuple[re.Match[str], Path]]


def _items(objects: Mapping[str, tuple[_Files, _Files]]) -> Iterator[Item | Skip]:
    for name, (touches, pictures) in objects.items():
        photos = {match[1]: path for match, path in pictures}
        for number, (match, path) in enumerate(touches):
            if not photos:
                yield Skip("its object has no photo", safe_name(name, match[1]))
                continue
            photo = photos.get(match[1]) or list(photos.values())[number % len(photos)]
            shared = SharedImage(safe_name(name, "photo", photo.stem), photo)
            yield Item(safe_name(name, match[1]), name, {"photo": shared, "touch_a": path})


def _split(path: Path) -> Mapping[str, Sequence[str]] | None:
    """Return the objects of each part, from {"<object>": [instances]} or [["<object>", instance], ...]."""
    if not path.is_file():
        return None
    document = read_json_object(path, ImporterError)
    try:
        return {
            part: sorted({str(row if isinstance(row, str) else row[0]) for row in document.get(key, ())})
            for key, part in _PARTS.items()
        }
    except (TypeError, IndexError) as error:
        raise ImporterError(f"{path} must list the objects of train, val and test: {error}") from error
