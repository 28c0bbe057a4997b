"""SSVTP: pairs with gaps in their numbers, test.csv without a column for the touch, and TVL's no-contact frame."""

from pathlib import Path

from tests.miniatures import picture

NUMBERS = (0, 1, 2, 9, 10, 50, 51, 120)
TEST = (2, 10, 120)
GRASPS = len(NUMBERS)


def write(folder: Path) -> None:
    root = folder / "ssvtp"
    rows = {"train": ["url,tactile,caption"], "test": ["url,caption"]}
    for number in NUMBERS:
        picture(root / "images_tac" / f"image_{number}_tac.jpg", number, (16, 12))
        picture(root / "images_rgb" / f"image_{number}_rgb.jpg", 1000 + number, (20, 20))
        (root / "text").mkdir(exist_ok=True)
        (root / "text" / f"labels_{number}.txt").write_text("fuzzy, soft")
        url, touch = f"images_rgb/image_{number}_rgb.jpg", f"images_tac/image_{number}_tac.jpg"
        if number in TEST:
            rows["test"].append(f'{url},"fuzzy, soft"')
        else:
            rows["train"].append(f'{url},{touch},"fuzzy, soft"')
    for side, lines in rows.items():
        (root / f"{side}.csv").write_text("\n".join(lines) + "\n")
    picture(root / "tac_background.png", 7, (16, 12))
