"""VT60: grey touches of one optical finger and turntable photos of 60 everyday objects, ten classes.

    touch/<NN_class>/<II>/touch_<id>_img_<k>_name_<class>_<nickname>_at_<x>_<y>_<z>.jpg    about 125 per object, grey
    touch/baselineForCalibration.jpg                                                       the finger without contact
    vision/<NN_class>/<II>/IMG_inst_<II>_img_<k>_validframeID_<f>.jpg                      about 40 per object

An object is `<NN_class>-<II>`; recording.json lists class, instance and nickname under `objects`. There are no photos
of the moment of a touch: touch number i of an object, in order of k, gets photo number i modulo the number of photos.
An object was touched in one session, which is its sequence.
"""

import filecmp
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    subfolders,
)
from robot.recording.folder import Recording, SharedImage, safe_name

DATA_SET = DataSet(
    source="github.com/Exhor/deep_visuotactile_classification",
    licence=NOT_STATED,
    terms="its files state none, so we may not pass the images on",
    citation="Corradi, Hall, Iravani, Object recognition combining vision and touch, Robotics and Biomimetics 4:2 "
    "(2017), doi 10.1186/s40638-017-0058-2",
    sensor="hemispherical optical finger (VT60)",
    rig="robot arm, one finger; photos on a turntable, one table and one light for all",
    expects="`touch/<NN_class>/<II>/`, `vision/<NN_class>/<II>/`, `touch/baselineForCalibration.jpg`",
    background="one frame for all grasps",
    caveats=(
        "08_bottlefull and 02_bottleempty are the same bottles, full and empty: photos cannot distinguish them. They "
        "have the same sequence_id, so drawn splits do not separate them; leave one of the classes out of a gallery.",
        "The no-contact frame is touch 4 of the first stapler, byte for byte (that touch is skipped), and the finger's "
        "light drifts: the smallest difference of an object's touches from it is 3 grey levels for that stapler and 17 "
        "for a ball. So the difference identifies the object even without contact; it ranks contact strength only "
        "within an object.",
        "Objects were touched class by class, so drift of the finger may identify the class, and a touch low-passed to "
        "8 x 6 identifies nearly as much as the whole touch: print this low-pass control next to every result.",
    ),
)
_TOUCH = re.compile(r"touch_(\d+)_img_(\d+)_name_(?P<class>[^_]+)_(?P<nickname>.+)_at_.*\.jpe?g", re.IGNORECASE)
_PHOTO = re.compile(r"IMG_inst_(\d+)_img_(\d+)_.*\.jpe?g", re.IGNORECASE)
_CLASS = re.compile(r"\d+_(.+)")
_SAME_OBJECTS = {"bottleempty": "bottle", "bottlefull": "bottle"}
"""Classes that contain the same objects."""


_Files = list[tuple[re.Match[str], Path]]


def import_vt60(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the objects below `src`.

    Raises:
        ImporterError: `src` has no touch/ or vision/ with classes.
    """
    for part in ("touch", "vision"):
        if not (src / part).is_dir():
            raise DATA_SET.mismatch_error(src, f"it has no {part}/ (the folder is code/data/vt60 of the repository)")
    classes = (folder for folder in subfolders(src / "touch") if _CLASS.fullmatch(folder.name))
    folders = [folder for kind in classes for folder in subfolders(kind)]
    touches = {folder: files for folder in folders if (files := numbered_files(folder, _TOUCH))}
    if not touches:
        raise DATA_SET.mismatch_error(
            src, "it contains no touch_<id>_img_<k>_name_<class>_<nickname>_at_<x>_<y>_<z>.jpg"
        )
    no_contact = src / "touch" / "baselineForCalibration.jpg"
    has_frame = no_contact.is_file()
    objects = {
        _name(folder): {
            "class": folder.parent.name.partition("_")[2],
            "instance": folder.name,
            "nickname": files[0][0]["nickname"],
        }
        for folder, files in touches.items()
    }
    return import_items(
        DATA_SET if has_frame else replace(DATA_SET, background="none"),
        _items(src, touches, objects, no_contact if has_frame else None),
        out,
        total=sum(map(len, touches.values())),
        progress=progress,
        source=src,
        objects=objects,
    )


def _name(folder: Path) -> str:
    return safe_name(folder.parent.name, folder.name)


def _items(
    src: Path, touches: Mapping[Path, _Files], objects: Mapping[str, Mapping[str, str]], no_contact: Path | None
) -> Iterator[Item | Skip]:
    background = {"touch_a_before": SharedImage("no_contact", no_contact)} if no_contact else {}
    for photographed in (instance for kind in subfolders(src / "vision") for instance in subfolders(kind)):
        if src / "touch" / photographed.parent.name / photographed.name not in touches:
            yield Skip("photos of an object without touches", f"{photographed.parent.name}/{photographed.name}")
    for folder, files in touches.items():
        object_id = _name(folder)
        photos = [path for _, path in numbered_files(src / "vision" / folder.parent.name / folder.name, _PHOTO)]
        common = _SAME_OBJECTS.get(objects[object_id]["class"])
        sequence = f"{common}-{objects[object_id]['nickname']}" if common else object_id
        for number, (match, touch) in enumerate(files):
            name = safe_name(object_id, match[2])
            if not photos:
                yield Skip("its object has no photo", name)
            elif no_contact and touch.is_file() and filecmp.cmp(touch, no_contact, shallow=False):
                yield Skip("its touch is the no-contact frame itself", name)
            else:
                photo = photos[number % len(photos)]
                shared = SharedImage(safe_name(object_id, photo.stem), photo)
                images: Images = {"photo": shared, "touch_a": touch, **background}
                yield Item(name, object_id, images, {"sequence_id": sequence})
