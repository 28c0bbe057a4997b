"""YCB-Slide: a DIGIT slid by hand over ten YCB objects, with a webcam that shows it.

    real/<object>/dataset_<k>/frames/frame_0000000.jpg           the gel, 60 s at 30 Hz
    real/<object>/dataset_<k>/webcam_frames/frame_0000000.jpg    the scene
    real/<object>/dataset_<k>/*.npy                              poses, pickled: they are never opened

Frames a few thirtieths of a second apart show nearly the same, so one in `every` is imported (30: one a second), with
the webcam's frame of the same number. A log is a sequence. Simulated logs have no photos and are not imported.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import DataSet, Item, Progress, Skip, import_items, safe_name, subfolders
from robot.recording.folder import Recording

DATA_SET = DataSet(
    source="YCB-Slide",
    licence="CC BY-SA 4.0",
    citation="Suresh, Si, Anderson, Kaess, Mukadam, MidasTouch: Monte-Carlo inference over distributions across "
    "sliding touch, CoRL 2022",
    sensor="DIGIT",
    rig="by hand, the object in a vise; webcam",
    expects="`real/<object>/dataset_<k>/frames/` and `webcam_frames/`",
    caveats=(
        "Ten objects are few, and the webcam shows the vise, the hand and one place: print the control of the photo's "
        "background beside every result.",
    ),
    unverified=(
        "that frames of the same number were taken at the same time: the pickled tables that say so are not opened",
        "whether a log has a frame without contact: none is kept as background",
    ),
)
_FRAME = re.compile(r"frame_(\d+)\.jpe?g")
_LOG = re.compile(r"dataset_\d+")


def import_ycb_slide(src: Path, out: Path, progress: Progress | None = None, *, every: int = 30) -> Recording:
    """Import one frame in `every` of the logs below `src`. Raises ImporterError where there is none."""
    src = Path(src)
    if every < 1:
        raise ImporterError(f"every must be at least 1, got {every}")
    if not src.is_dir():
        raise DATA_SET.mismatch_error(src, "it is no folder")
    root = src / "real" if (src / "real").is_dir() else src
    logs = [log for each in subfolders(root) for log in subfolders(each) if _LOG.fullmatch(log.name)]
    counts = [len(_frames(log, every)) for log in logs]
    if not sum(counts):
        simulated = (src / "sim").is_dir() or any(root.glob("*/*/tactile_images"))
        raise DATA_SET.mismatch_error(src, "simulated logs have no photos" if simulated else "it holds no frame")
    return import_items(DATA_SET, _items(logs, every), out, total=sum(counts), progress=progress)


def _frames(log: Path, every: int) -> list[str]:
    """Names of the frames to import, in order; the folder is listed, no file is opened."""
    folder = log / "frames"
    if not folder.is_dir():
        return []
    return sorted(
        path.name for path in folder.iterdir() if (match := _FRAME.fullmatch(path.name)) and int(match[1]) % every == 0
    )


def _items(logs: list[Path], every: int) -> Iterator[Item | Skip]:
    for log in logs:
        sequence = safe_name(log.parent.name, log.name)
        for frame in _frames(log, every):
            photo = log / "webcam_frames" / frame
            name = safe_name(sequence, frame.split(".")[0])
            images = {"photo": photo, "touch_a": log / "frames" / frame}
            yield Item(name, log.parent.name, images, {"sequence_id": sequence})
