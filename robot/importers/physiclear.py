"""PhysiCLeAR: GelSight Mini videos of presses on named object parts, without photos.

    <part>_<k>.mov    320 x 240, about 110 frames; the first one is without contact (extra `importers`)

The videos can also be in `dataset/`. A part is an object, a video a sequence. A video provides `frames` grasps (default
5): the frames that differ most from the first one, in order of time. The first frame is their no-contact frame. The
recording has the order of the file names, part by part. The videos were made in two sessions, which differ in length:
`50-frames` and `126-frames`; a video of another length has no session.
"""

import re
from pathlib import Path

from robot.importers.importing import NOT_STATED, DataSet, Progress, numbered_files
from robot.importers.press_videos import NO_PHOTOS, Press, frame_count, import_presses
from robot.recording.folder import Recording, safe_name

DATA_SET = DataSet(
    source="PhysiCLeAR",
    licence=NOT_STATED,
    terms="its repository states none, so we may not pass the videos on",
    citation="Yu, Lin, Xiao, Duan, Soh, Octopi: Object Property Reasoning with Large Tactile-Language Models, RSS 2024",
    sensor="GelSight Mini",
    rig="by hand",
    expects="`<part>_<k>.mov`, or `dataset/` with these files",
    background="the first frame of each video",
    caveats=(
        NO_PHOTOS,
        "The videos of a part were made one after the other, and light and gel drift: the no-contact frame alone "
        "identifies the part far above chance. Print this control.",
        "Videos were made in two sessions: those of 50 frames have another light than those of 126 frames. Few parts "
        "were pressed in both.",
        "Frames of one video are nearly the same: hold out whole videos, which are the sequences.",
    ),
    unverified=("that the first frame of every video is without contact",),
)
_VIDEO = re.compile(r"(?P<part>.+)_(\d{1,9})\.mov", re.IGNORECASE)


def import_physiclear(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import `frames` grasps of each video in `src`.

    Raises:
        ImporterError: There is no video, or av is missing.
    """
    videos = numbered_files(src / "dataset" if (src / "dataset").is_dir() else src, _VIDEO)
    presses = [Press(match["part"], safe_name(path.stem), path, _session(path)) for match, path in videos]
    return import_presses(DATA_SET, presses, src, out, progress, frames)


def _session(video: Path) -> str | None:
    frames = frame_count(video)
    return "50-frames" if 40 <= frames <= 60 else "126-frames" if 110 <= frames <= 140 else None
