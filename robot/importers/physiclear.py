"""PhysiCLeAR: GelSight Mini videos of presses on named object parts, without photos.

    <part>_<k>.mov    320 x 240, about 110 frames; the first one is without contact (extra `importers`)

The videos can also be in `dataset/`. A part is an object, a video a sequence. A video provides `frames` grasps
(default 5): the frames that differ most from the first one, in order of time. The first frame is their no-contact
frame. There are no photos: the gel image itself replaces the photo, so the recording is for touch-to-touch search only
(`retrieve evaluate --protocol`), and `retrieve check` reports each of its grasps as an error. The recording has the
order of the file names, part by part.
"""

import heapq
import itertools
import re
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import Count, typed
from robot.errors import ImporterError
from robot.importers.episodes import NO_USABLE_FRAME, first_usable, thumbnail
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_extra,
    import_items,
    numbered_files,
)
from robot.recording.folder import Recording, SharedImage, safe_name

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
    """Import `frames` grasps of each video in `src`.

    Raises:
        ImporterError: There is no video, or av is missing.
    """
    typed(frames, Count, "frames", error=ImporterError)
    videos = numbered_files(src / "dataset" if (src / "dataset").is_dir() else src, _VIDEO)
    if not videos:
        raise DATA_SET.mismatch_error(src, "it contains no such video")
    import_extra("av", _WHAT)
    items = (item for match, path in videos for item in _items(match["part"], path, frames))
    return import_items(
        DATA_SET, items, out, total=len(videos) * frames, progress=progress, source=src, options={"frames": frames}
    )


def _items(part: str, path: Path, frames: int) -> Iterator[Item | Skip]:
    sequence = safe_name(path.stem)
    left_out: dict[str, int] = {}
    read = cache(partial(strongest_frames, path, frames, left_out=left_out))  # decoded once, on first use
    before = SharedImage(safe_name(sequence, "no_contact"), lambda: read()[0])  # type: ignore[arg-type]  # import_items calls it
    for number in range(1, frames + 1):
        name = safe_name(sequence, str(number))
        touch = SharedImage(name, lambda number=number: read()[number])  # type: ignore[arg-type]
        images = {"photo": touch, "touch_a": touch, "touch_a_before": before}
        yield Item(name, part, images, {"sequence_id": sequence}, left_out)


def strongest_frames(path: Path, count: int, start: int = 0, left_out: dict[str, int] | None = None) -> list[Frame]:
    """Return the first frame of a video and the `count` that differ most from it, in order of time: (H, W, 3) RGB.

    The first one is number `start`, or a later one if frames at the start are unusable, such as black ones; their
    number is stored in `left_out`.

    Raises:
        ImporterError: The video cannot be decoded, or too few of its frames differ from the first.
    """
    av = import_extra("av", _WHAT)
    try:
        with av.open(str(path)) as video:
            decoded = (frame.to_ndarray(format="rgb24") for frame in video.decode(video=0))
            frames = itertools.islice(decoded, start, None)
            first = next(frames, None)
            if first is None:
                raise ImporterError("its video contains no frame")
            thumbnails = [thumbnail(first)]

            def changes() -> Iterator[tuple[float, int, Frame]]:
                """Yield numbers that differ, so frames are not compared; of equal changes the earlier is taken."""
                for number, frame in enumerate(frames):
                    thumbnails.append(thumbnail(frame))
                    yield float(np.abs(frame.astype(np.int16) - first).mean()), -number, frame

            strongest = heapq.nlargest(count, changes())
    except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
        raise ImporterError("its video cannot be decoded") from error
    usable = first_usable(thumbnails)
    if usable is None:
        raise ImporterError(NO_USABLE_FRAME)
    if usable and not start:
        if left_out is not None:
            left_out[safe_name(path.stem)] = usable
        return strongest_frames(path, count, usable)
    if len(strongest) < count or not strongest[-1][0]:
        raise ImporterError(f"its video must have at least {count} frames that differ from the first one")
    return [first, *(frame for _, _, frame in sorted(strongest, key=lambda entry: -entry[1]))]
