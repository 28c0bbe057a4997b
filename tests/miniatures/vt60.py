"""Two bottles, both empty and full, and a ball; another ball has photos only. Numbers are not padded."""

from collections.abc import Mapping
from pathlib import Path

from tests.miniatures import picture

OBJECTS = {
    ("02_bottleempty", "01"): "buxton",
    ("02_bottleempty", "02"): "volvic",
    ("03_ball", "01"): "yellow_beachball",
    ("08_bottlefull", "01"): "buxton",
    ("08_bottlefull", "02"): "volvic",
}
TOUCHES, PHOTOS = 12, 5
GRASPS = TOUCHES * len(OBJECTS)


def write(
    folder: Path, objects: Mapping[tuple[str, str], str] = OBJECTS, touches: int = TOUCHES, photos: int = PHOTOS
) -> None:
    picture(folder / "touch/baselineForCalibration.jpg", 0, grey=True)
    for number, ((kind, instance), nickname) in enumerate(objects.items()):
        name, one = kind.partition("_")[2], int(instance)
        for k in range(1, touches + 1):
            file = f"touch_{one}_img_{k}_name_{name}_{nickname}_at_{37821 - k}_6073_{24880 + k}.jpg"
            picture(folder / "touch" / kind / instance / file, 1000 * number + k, grey=True)
        for k in range(1, photos + 1):
            file = f"IMG_inst_{one}_img_{k}_validframeID_{7 * k + 1}.jpg"
            picture(folder / "vision" / kind / instance / file, 1000 * number + 500 + k, (10, 10))
    picture(folder / "vision/03_ball/07/IMG_inst_7_img_1_validframeID_8.jpg", 9000, (10, 10))
    (folder / "vision/03_ball/01/Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
