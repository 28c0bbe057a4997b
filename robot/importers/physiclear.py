"""PhysiCLeAR: GelSight Mini videos of presses on named object parts, without photos.

    <part>_<k>.mov    320 x 240, about 110 frames; the first one shows the untouched gel (extra `importers`)

Also `dataset/<part>_<k>.mov` below the folder. A part is an object, a video a sequence. Of a video `frames` grasps are
kept (5): the frames that differ most from the first one, in order of time; the first frame is their no-contact frame.
Nobody took a photo: the gel image itself stands in its place, so the recording is for touch-to-touch search only
(`retrieve benchmark real`), and `retrieve check` calls each of its grasps an error. The order of the recording is that
of the file names, part by part.
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
    licence="none stated; the videos are not ours to give on",
    citation="Yu, Lin, Xiao, Duan, Soh, Octopi: Object Property Reasoning with Large Tactile-Language Models, RSS 2024",
    sensor="GelSight Mini",
    rig="by hand",
    expects="`<part>_<k>.mov`, or `dataset/` with them in it",
    background="the first frame of each video",
    caveats=(
        "There are no photos: the gel image itself stands in place of each photo. Do not train a matcher on it.",
        "The videos of a part were made one after the other, and light and gel drift: the no-contact frame alone names "
        "the part far above chance. Print that control, and the contact difference on one common no-contact frame.",
        "Videos were made in two sittings: those of 50 frames show another light than those of 126 frames.",
        "Frames of one video are nearly alike: leave whole videos out, which are the sequences.",
    ),
    unverified=("that the first frame of every video is without contact",),
)
_VIDEO = re.compile(r"(?P<part>.+)_(\d{1,9})\.mov", re.IGNORECASE)
_WHAT = "a video"

Frame = NDArray[np.uint8]


def import_physiclear(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import the frames of strongest contact of the videos in `src`. Raises ImporterError where there is no video, and
    without av.
    """
    src = Path(src)
    if frames < 1:
        raise ImporterError(f"frames must be at least 1, got {frames}")
    videos = numbered_files(src / "dataset" if (src / "dataset").is_dir() else src, _VIDEO)
    if not len(videos):
        raise DATA_SET.mismatch_error(src, "it holds no such video")
    import_extra("av", _WHAT)
    items = (item for match, path in videos for item in _items(match["part"], path, frames))
    return import_items(DATA_SET, items, out, total=len(videos) * frames, progress=progress)


def _items(part: str, path: Path, frames: int) -> Iterator[Item | Skip]:
    sequence = safe_name(path.stem)
    press = StrongestFrames(path, frames)
    before = SharedImage(safe_name(sequence, "no_contact"), press.no_contact)  # type: ignore[arg-type]  # import_items calls it
    for place in range(frames):
        name = safe_name(sequence, str(place + 1))
        touch = SharedImage(name, partial(press.frame, place))  # type: ignore[arg-type]
        images = {"photo": touch, "touch_a": touch, "touch_a_before": before}
        yield Item(name, part, images, {"sequence_id": sequence})


class StrongestFrames:
    """The frames of strongest contact of one video, which is decoded once, when the first of them is asked for.

    path: of the video. count: how many frames are kept. Reading raises ImporterError.
    """

    def __init__(self, path: Path, count: int) -> None:
        self._path, self._count = path, count

    def no_contact(self) -> Frame:
        """The first frame, (H, W, 3), red first."""
        return self._read[0]

    def frame(self, place: int) -> Frame:
        """One of the frames of strongest contact, in order of time."""
        return self._read[1 + place]

    @cached_property
    def _read(self) -> list[Frame]:
        decoded = self._decoded()
        first = next(decoded, None)
        if first is None:
            raise ImporterError("its video holds no frame")
        strongest: list[tuple[float, int, Frame]] = []
        for place, frame in enumerate(decoded):
            if frame.shape != first.shape:
                raise ImporterError("the frames of its video differ in size")
            change = float(np.abs(frame.astype(np.int16) - first).mean())
            # Of equal changes the earlier frame is kept; places differ, so frames are never compared.
            heapq.heappush(strongest, (change, -place, frame))
            if len(strongest) > self._count:
                heapq.heappop(strongest)
        if len(strongest) < self._count:
            raise ImporterError(f"its video has {1 + len(strongest)} frames, fewer than {1 + self._count}")
        if not strongest[0][0]:
            raise ImporterError("its video has too few frames that differ from the first one")
        return [first, *(frame for _, _, frame in sorted(strongest, key=lambda each: -each[1]))]

    def _decoded(self) -> Iterator[Frame]:
        av = import_extra("av", _WHAT)
        try:
            with av.open(str(self._path)) as film:
                for frame in film.decode(video_stream(film)):
                    yield frame.to_ndarray(format="rgb24")
        except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
            raise ImporterError("its video cannot be decoded") from error
