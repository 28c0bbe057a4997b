"""SSVTP: touches of a DIGIT on a robot and photos of the same places, on cloths, ropes and other soft things.

In the layout of TVL (tactile-vlm.github.io), with captions.

    ssvtp/
        images_tac/image_<n>_tac.jpg    images_rgb/image_<n>_rgb.jpg    text/labels_<n>.txt
        train.csv (url,tactile,caption)    test.csv (url,caption)

Each pair is its own object, because the data set does not state which pairs show one thing. Pairs were taken one
after the other, so `block` consecutive pairs are one sequence, as a surrogate. `tac_background.png` is part of TVL's
code, not of the data set. If it is copied next to the folders, it is the no-contact frame of all pairs.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    DataSetMetadata,
    Images,
    Item,
    NumberedFiles,
    Progress,
    Skip,
    import_items,
    numbered_files,
)
from robot.importers.row_splits import RowSplit
from robot.importers.tvl import TERMS, csv_rows
from robot.recording.folder import Recording, SharedImage

DATA_SET = DataSet(
    source="tactile-vlm.github.io, SSVTP",
    licence=NOT_STATED,
    terms=TERMS,
    citation="Kerr, Huang, Wilcox, Hoque, Ichnowski, Calandra, Goldberg, Self-Supervised Visuo-Tactile Pretraining to "
    "Locate and Follow Garment Features, RSS 2023",
    sensor="DIGIT",
    rig="robot arm, camera and sensor on its wrist",
    expects="`images_tac/image_<n>_tac.jpg` and `images_rgb/image_<n>_rgb.jpg`, or `ssvtp` with these files",
    background="one frame for all grasps",
    caveats=(
        "Each pair counts as an object with one grasp; neighbouring pairs may show overlapping places of one thing. "
        "Blocks of consecutive pairs are one sequence: a surrogate, because the data set does not mark where a thing "
        "begins.",
        "The single no-contact frame is older than most touches: later drift remains in the difference.",
    ),
    unverified=("that pairs are numbered in the order of capture", "sizes of the photos"),
)
_TOUCH = re.compile(r"image_(\d{1,9})_tac\.(jpg|jpeg|png)", re.IGNORECASE)
_URL = re.compile(r".*image_(\d{1,9})_rgb\.\w+")


def import_ssvtp(src: Path, out: Path, progress: Progress | None = None, *, block: int = 50) -> Recording:
    """Import the pairs below `src`.

    Args:
        src: Folder of the data set.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        block: Consecutive pairs per sequence.

    Raises:
        ImporterError: There is no pair, or `block` is invalid.
    """
    if block < 1:
        raise ImporterError(f"block must be at least 1, got {block}")
    root = Path(src) / "ssvtp" if (Path(src) / "ssvtp").is_dir() else Path(src)
    touches = numbered_files(root / "images_tac", _TOUCH)
    if not len(touches):
        raise DATA_SET.mismatch_error(Path(src), "images_tac/ is missing or contains no such file")
    known = {int(match[1]) for match, _ in touches}
    split, captions = RowSplit("published"), dict[str, dict[str, Any]]()
    same: dict[str | None, dict[str, Any]] = {}  # many pairs share a caption
    for side in ("train", "test"):
        for row in csv_rows(root / f"{side}.csv"):
            url = _URL.fullmatch(row.get("url") or "")
            if url and int(url[1]) in known:
                number = int(url[1])
                split.add(side, _object(number), _sequence(number, block))
                caption = row.get("caption")
                captions[_object(number)] = same.setdefault(caption, {"caption": caption})
    del known
    splits, leaks = split.object_splits()
    background = root / "tac_background.png"
    facts = replace(DATA_SET, caveats=(*DATA_SET.caveats, *leaks))
    return import_items(
        facts if background.is_file() else replace(facts, background="none"),
        _items(root, touches, background, block),
        out,
        total=len(touches),
        progress=progress,
        metadata=DataSetMetadata(captions, splits),
    )


def _object(number: int) -> str:
    return f"pair-{number}"


def _sequence(number: int, block: int) -> str:
    return f"block-{number // block}"


def _items(root: Path, touches: NumberedFiles, background: Path, block: int) -> Iterator[Item | Skip]:
    for match, touch in touches:
        number = int(match[1])
        photo = next((path for suffix in ("jpg", "png") if (path := _photo(root, match[1], suffix)).exists()), None)
        images: Images = {"photo": photo or _photo(root, match[1], "jpg"), "touch_a": touch}
        if background.is_file():
            images = {**images, "touch_a_before": SharedImage("no_contact", background)}
        yield Item(_object(number), _object(number), images, {"sequence_id": _sequence(number, block)})


def _photo(root: Path, number: str, suffix: str) -> Path:
    return root / "images_rgb" / f"image_{number}_rgb.{suffix}"
