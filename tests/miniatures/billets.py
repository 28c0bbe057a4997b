"""Three places of two billets, and a licence file."""

from collections.abc import Sequence
from pathlib import Path

from tests.miniatures import picture

GRASPS = 3
PLACES = (("welded1", "01"), ("welded1", "02"), ("ground1", "01"))


def write(folder: Path, places: Sequence[tuple[str, str]] = PLACES) -> None:
    for seed, (billet, place) in enumerate(places):
        picture(folder / billet / f"{place}_touch.png", seed)
        picture(folder / billet / f"{place}_photo.jpg", 1000 + seed)
    (folder / "LICENSE").write_text("GPL")
