"""Two objects, three touches and two photos each, and a picture of neither kind."""

from pathlib import Path

from tests.miniatures import picture

GRASPS = 6


def write(folder: Path) -> None:
    for number, name in enumerate(("mug", "tin can")):
        for k in (1, 2, 10):
            picture(folder / name / f"touch_{k}.png", 100 * number + k)
        for k in (1, 2):
            picture(folder / name / f"photo_{k}.jpg", 100 * number + 50 + k)
    picture(folder / "mug/notes.png", 999)
