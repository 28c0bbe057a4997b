"""Three recordings of touches on seen objects and one on an unseen object; contact is strongest in one frame of 30."""

from pathlib import Path

import cv2
import numpy as np

from tests.miniatures import picture

RECORDINGS = (("seen", "1", "rec_00000"), ("seen", "1", "rec_00001"), ("seen", "12", "rec_00000"))
UNSEEN = (("unseen", "3", "rec_00000"),)
GRASPS = len(RECORDINGS + UNSEEN)
FRAMES, PRESSED = 31, 15


def write(folder: Path, between: str = "images") -> None:
    for number, (part, session, recording) in enumerate(RECORDINGS + UNSEEN):
        root = folder / f"data_{part}" / between
        for frame in range(FRAMES):
            depth = 100 if frame == PRESSED else 5 if frame else 0
            gel = np.full((32, 40, 3), 60 + number, np.uint8)
            gel[8:24, 8:32] += np.uint8(depth)
            path = root / "touch" / session / recording / f"frame{frame:04}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cv2.imencode(".jpg", gel)[1].tobytes())
            picture(root / "vision" / session / recording / f"frame{frame:04}.jpg", 100 * number + frame)
    (folder / "data_lst").mkdir()
    (folder / "data_lst/train_touch2vision.txt").write_text("data/data_seen/1.jpg " * 8)
