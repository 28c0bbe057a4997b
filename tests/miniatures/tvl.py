"""HCT: data1 with three timestamp folders, data2 with one, each with three frames in contact and one without.

Rows of one folder are in both parts of the published split.
"""

import json
from pathlib import Path

from tests.miniatures import picture

CONTACTS = {"data1": ("0-1702507215.615537", "1-1702507300.1", "10-1702507400.2"), "data2": ("0-1702600000.5",)}
FRAMES = ("9-0.025303125381469727", "165-0.0253", "170-0.03534817695617676")
AWAY = "225-0.01"
TEST = {"data1/1-1702507300.1": (0, 1, 2), "data1/10-1702507400.2": (2,)}
"""Frames in test.csv; all others are in train.csv."""
GRASPS = 4 * 3


def write(folder: Path) -> None:
    seed = 0
    for data, contacts in CONTACTS.items():
        root = folder / "hct" / data
        lists: dict[str, dict[str, list[str]]] = {"contact": {}, "not_contact": {}}
        rows: dict[str, list[str]] = {"train": [], "test": []}
        for contact in contacts:
            picture(root / contact / "tactile_bg_latent.jpg", 5000 + seed)
            for number, frame in enumerate((*FRAMES, AWAY)):
                seed += 1
                picture(root / contact / "tactile" / f"{frame}.jpg", seed)
                picture(root / contact / "vision" / f"{frame}.jpg", 1000 + seed, (20, 30))
                paths = {kind: f"{contact}/{kind}/{frame}.jpg" for kind in ("vision", "tactile")}
                paths["background"] = f"{contact}/tactile_bg_latent.jpg"
                for kind, path in paths.items():
                    lists["not_contact" if frame == AWAY else "contact"].setdefault(kind, []).append(path)
                if frame != AWAY:
                    side = "test" if number in TEST.get(f"{data}/{contact}", ()) else "train"
                    rows[side].append(", ".join([*paths.values(), '"smooth, hard, cool"']))
        for name, listed in lists.items():
            (root / f"{name}.json").write_text(json.dumps(listed))
        for side, lines in rows.items():
            (root / f"{side}.csv").write_text("url,tactile,tactile_background,caption\n" + "\n".join(lines) + "\n")
