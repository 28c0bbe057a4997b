"""PhysiCLeAR: GelSight Mini videos of presses on named object parts, without photos.

    <part>_<k>.mov    320 x 240, about 110 frames; the first one is without contact (extra `importers`)

The videos can also be in `dataset/`. A part is an object, a video a sequence. A video provides `frames` grasps
(default 5): the frames that differ most from the first one, in order of time. The first frame is their no-contact
frame. There are no photos: the gel image itself replaces the photo, so the recording is for touch-to-touch search only
(`retrieve benchmark real`), and `retrieve check` reports each of its grasps as an error. The recording has the order of
the file names, part by part.
"""

import heapq
import re
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_extra,
    import_items,
    numbered_files,
    safe_name,
    video_stream,
)
from robot.recording.folder import Recording, SharedImage

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
        "There are no photos: the gel image itself replaces each photo. Do not train a matcher on it.",
        "The videos of a part were made one after the other, and light and gel drift: the no-contact frame alone "
        "identifies the part far above chance. Print this control, and results with each touch minus its "
        "no-contact frame, added to one common no-contact frame.",
        "Videos were made in two sessions: those of 50 frames have another light than those of 126 frames.",
        "Frames of one video are nearly the same: hold out whole videos, which are the sequences.",
    ),
    unverified=("that the first frame of every video is without contact",),
)
_VIDEO = re.compile(r"(?P<part>.+)_(\d{1,9})\.mov", re.IGNORECASE)
_WHAT = "a video"

Frame = NDArray[np.uint8]


def import_physiclear(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import the frames of strongest contact from the videos in `src`.

    Args:
        src: Folder of the data set.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        frames: Grasps per video.

    Raises:
        ImporterError: There is no video, or av is missing.
    """
    src = Path(src)
    if frames < 1:
        raise ImporterError(f"frames must be at least 1, got {frames}")
    videos = numbered_files(src / "dataset" if (src / "dataset").is_dir() else src, _VIDEO)
    if not len(videos):
        raise DATA_SET.mismatch_error(src, "it contains no such video")
    import_extra("av", _WHAT)
    items = (item for match, path in videos for item in _items(match["part"], path, frames))
    return import_items(DATA_SET, items, out, total=len(videos) * frames, progress=progress)


def _items(part: str, path: Path, frames: int) -> Iterator[Item | Skip]:
    sequence = safe_name(path.stem)
    video = StrongestFrames(path, frames)
    before = SharedImage(safe_name(sequence, "no_contact"), video.no_contact)  # type: ignore[arg-type]  # import_items calls it
    for number in range(frames):
        name = safe_name(sequence, str(number + 1))
        touch = SharedImage(name, partial(video.frame, number))  # type: ignore[arg-type]
        images = {"photo": touch, "touch_a": touch, "touch_a_before": before}
        yield Item(name, part, images, {"sequence_id": sequence})


class StrongestFrames:
    """The frames of strongest contact in one video, which is decoded once, on first use.

    Reading raises ImporterError.
    """

    def __init__(self, path: Path, count: int) -> None:
        """Store the path; nothing is decoded yet.

        Args:
            path: The video.
            count: Number of frames.
        """
        self._path, self._count = path, count

    def no_contact(self) -> Frame:
        """Return the first frame: (H, W, 3) uint8, RGB."""
        return self._read[0]

    def frame(self, number: int) -> Frame:
        """Return one of the frames of strongest contact: (H, W, 3) uint8, RGB.

        Args:
            number: Its number in order of time, from 0.
        """
        return self._read[1 + number]

    @cached_property
    def _read(self) -> list[Frame]:
        decoded = self._decoded()
        first = next(decoded, None)
        if first is None:
            raise ImporterError("its video contains no frame")
        strongest: list[tuple[float, int, Frame]] = []
        for number, frame in enumerate(decoded):
            if frame.shape != first.shape:
                raise ImporterError("the frames of its video differ in size")
            change = float(np.abs(frame.astype(np.int16) - first).mean())
            # Among equal changes the earlier frame stays. Numbers differ, so frames are never compared.
            heapq.heappush(strongest, (change, -number, frame))
            if len(strongest) > self._count:
                heapq.heappop(strongest)
        if len(strongest) < self._count:
            raise ImporterError(f"its video must have at least {1 + self._count} frames, got {1 + len(strongest)}")
        if not strongest[0][0]:
            raise ImporterError("its video has too few frames that differ from the first one")
        return [first, *(frame for _, _, frame in sorted(strongest, key=lambda entry: -entry[1]))]

    def _decoded(self) -> Iterator[Frame]:
        av = import_extra("av", _WHAT)
        try:
            with av.open(str(self._path)) as video:
                for frame in video.decode(video_stream(video)):
                    yield frame.to_ndarray(format="rgb24")
        except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
            raise ImporterError("its video cannot be decoded") from error
