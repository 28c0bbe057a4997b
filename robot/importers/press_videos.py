"""Grasps from videos of presses, without photos: a video is a sequence, its strongest frames are grasps.

A video provides `frames` grasps: the frames that differ most from the first one, in order of time. The first frame is
their no-contact frame.
"""

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import Count, typed
from robot.errors import ImporterError
from robot.extras import import_extra
from robot.importers.episodes import NO_USABLE_FRAME, first_usable, thumbnail
from robot.importers.importing import DataSet, Item, Progress, Skip, import_items
from robot.recording.folder import Recording, SharedImage, safe_name

WHAT = "a video"
NO_PHOTOS = "There are no photos, so touches are compared with touches: `retrieve evaluate --protocol`."

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Press:
    """A video of one press of an object; `sequence` is its name, `session` that of its sitting, None if unknown."""

    object_id: str
    sequence: str
    video: Path
    session: str | None


def import_presses(
    data_set: DataSet, presses: list[Press], src: Path, out: Path, progress: Progress | None, frames: int
) -> Recording:
    """Import `frames` grasps of each press.

    Raises:
        ImporterError: There is no press, or av is missing.
    """
    typed(frames, Count, "frames", error=ImporterError)
    if not presses:
        raise data_set.mismatch_error(src, "it contains no such video")
    import_extra("av", WHAT)
    items = (item for press in presses for item in _items(press, frames))
    return import_items(
        data_set, items, out, total=len(presses) * frames, progress=progress, source=src, options={"frames": frames}
    )


def _items(press: Press, frames: int) -> Iterator[Item | Skip]:
    left_out: dict[str, int] = {}
    read = cache(partial(strongest_frames, press.video, frames, left_out=left_out))  # decoded once, on first use
    before = SharedImage(safe_name(press.sequence, "no_contact"), lambda: read()[0])  # type: ignore[arg-type]  # import_items calls it
    fields = {"sequence_id": press.sequence} | ({"session": press.session} if press.session else {})
    for number in range(1, frames + 1):
        name = safe_name(press.sequence, str(number))
        images = {"touch_a": lambda number=number: read()[number], "touch_a_before": before}
        yield Item(name, press.object_id, images, fields, left_out)  # type: ignore[arg-type]


def frame_count(path: Path) -> int:
    """Return the number of frames that the header of a video states; 0 if it cannot be read."""
    av = import_extra("av", WHAT)
    try:
        with av.open(str(path)) as video:
            return int(video.streams.video[0].frames)
    except (av.error.FFmpegError, OSError, ValueError, IndexError):
        return 0


def strongest_frames(path: Path, count: int, start: int = 0, left_out: dict[str, int] | None = None) -> list[Frame]:
    """Return the first frame of a video and the `count` that differ most from it, in order of time: (H, W, 3) RGB.

    The first one is number `start`, or a later one if frames at the start are unusable, such as black ones; their
    number is stored in `left_out`.

    Raises:
        ImporterError: The video cannot be decoded, or too few of its frames differ from the first.
    """
    av = import_extra("av", WHAT)
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
