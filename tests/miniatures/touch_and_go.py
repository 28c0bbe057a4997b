"""Three videos of Touch and Go, with two runs of contact each: one of six frames, for five grasps, and one of three.

One line has the label -1, one material has no line. train.txt and test.txt contain whole videos.
"""

from pathlib import Path

from tests.miniatures import picture

VIDEOS = ("20220601_182052", "20220601_190000", "20220607_133934")
RUNS = {range(2, 8): 3, range(10, 13): 1}
"""Frames in contact -> their label."""
GRASPS = len(VIDEOS) * (5 + 3)


def write(folder: Path) -> None:
    lines: dict[str, list[str]] = {video: [] for video in VIDEOS}
    for number, video in enumerate(VIDEOS):
        for frame in range(13):
            name = f"{frame:010d}.jpg"
            picture(folder / "dataset" / video / "gelsight_frame" / name, 1000 * number + frame)
            picture(folder / "dataset" / video / "video_frame" / name, 1000 * number + 500 + frame, (20, 30))
        for frames, label in RUNS.items():
            lines[video] += [f"{video}/{frame:010d}.jpg,{label}" for frame in frames]
    text = ["20220601_182052/0000000009.jpg,-1", *(line for of_video in lines.values() for line in of_video)]
    (folder / "label.txt").write_text("\n".join(text))  # the last line has no newline
    (folder / "category_reference.txt").write_text("Concrete: 0\nPlastic: 1 (hard)\nWood: 3\n")
    (folder / "train.txt").write_text("\n".join(lines[VIDEOS[0]] + lines[VIDEOS[1]]))
    (folder / "test.txt").write_text("\n".join(lines[VIDEOS[2]]))
