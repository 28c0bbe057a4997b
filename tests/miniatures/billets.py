"""Three places of two billets, and what lies beside them."""

from pathlib import Path

from tests.miniatures import picture

GRASPS = 3


def write(folder: Path) -> None:
    places = [("welded1", "01"), ("welded1", "02"), ("ground1", "01")]
    for seed, (billet, place) in enumerate(places):
        picture(folder / billet / f"{place}_touch.png", seed)
        picture(folder / billet / f"{place}_photo.jpg", 10 + seed)
    (folder / "LICENSE").write_text("GPL")
