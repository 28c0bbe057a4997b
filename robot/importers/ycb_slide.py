"""YCB-Slide: a DIGIT that slides by hand over ten YCB objects, with a webcam.

    real/<object>/dataset_<k>/frames/frame_0000000.jpg           the gel, 60 s at 30 Hz
    real/<object>/dataset_<k>/webcam_frames/frame_0000000.jpg    the scene
    real/<object>/dataset_<k>/*.npy                              poses, pickled: not opened

Consecutive frames are nearly the same, so one in `every` is imported (30: one per second), with the webcam frame of the
same number. A log is a sequence. Simulated logs have no photos and are not imported.
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
    terms="state the authors; pass changed data on under the same licence",
    citation="Suresh, Si, Anderson, Kaess, Mukadam, MidasTouch: Monte-Carlo inference over distributions across "
    "sliding touch, CoRL 2022",
    sensor="DIGIT",
    rig="by hand, the object in a vise; webcam",
    expects="`real/<object>/dataset_<k>/frames/` and `webcam_frames/`",
    caveats=(
        "There are only ten objects, and the webcam shows the vise, the hand and one place: print the control that "
        "sees only the margin of the photo next to every result.",
    ),
    unverified=(
        "that frames of the same number were taken at the same time: the pickled tables of times are not opened",
        "whether a log has a no-contact frame: none is imported",
    ),
)
_FRAME = re.compile(r"frame_(\d+)\.jpe?g")
_LOG = re.compile(r"dataset_\d+")


def import_ycb_slide(src: Path, out: Path, progress: Progress | None = None, *, every: int = 30) -> Recording:
    """Import one frame in `every` of the logs below `src`.

    Args:
        src: Folder of the data set.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        every: Distance of imported frames.

    Raises:
        ImporterError: There is no frame, or `every` is invalid.
    """
    src = Path(src)
    if every < 1:
        raise ImporterError(f"every must be at least 1, got {every}")
    if not src.is_dir():
        raise DATA_SET.mismatch_error(src, "it is not a folder")
    root = src / "real" if (src / "real").is_dir() else src
    logs = [log for folder in subfolders(root) for log in subfolders(folder) if _LOG.fullmatch(log.name)]
    counts = [len(_frames(log, every)) for log in logs]
    if not sum(counts):
        is_simulated = (src / "sim").is_dir() or any(root.glob("*/*/tactile_images"))
        raise DATA_SET.mismatch_error(src, "simulated logs have no photos" if is_simulated else "it contains no frame")
    return import_items(DATA_SET, _items(logs, every), out, total=sum(counts), progress=progress)


def _frames(log: Path, every: int) -> list[str]:
    """Return the names of the frames to import, in order, without opening a file."""
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
