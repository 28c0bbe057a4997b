"""PhysiCLeAR: two parts, three press videos of each.

A video begins without contact; then a bump with the pattern of the part grows and fades. The name of a part may contain
digits and underscores.
"""

from pathlib import Path

import numpy as np

from tests.miniatures import pixels

PARTS, VIDEOS, FRAMES, IMPORTED = ("apple", "usb_3_plug"), 3, 12, 5
GRASPS = len(PARTS) * VIDEOS * IMPORTED
SIZE = (48, 64)


def write(folder: Path, parts: tuple[str, ...] = PARTS, videos: int = VIDEOS) -> None:
    for number, part in enumerate(parts):
        for k in range(videos):
            write_video(folder / f"{part}_{k}.mov", presses(number, k))


def presses(part: int, video: int, frames: int = FRAMES) -> list[np.ndarray]:
    """Return frames (H, W, 3) uint8: contact rises from 0 to the middle and falls; the gel drifts with the part."""
    rest = np.full((*SIZE, 3), 90 + 8 * part, np.float64) + video
    bump = pixels(500 + part, SIZE).astype(np.float64) - 128
    middle = frames // 2
    strength = [max(0, 1 - abs(number - middle) / middle) for number in range(frames)]
    return [np.clip(rest + 0.6 * contact * bump, 0, 255).astype(np.uint8) for contact in strength]


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as video:
        stream = video.add_stream("mpeg4", rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for frame in frames:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        video.mux(stream.encode())
