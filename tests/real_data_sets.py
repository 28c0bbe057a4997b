"""Miniatures for `retrieve evaluate --protocol`: small data sets with as many objects as the protocols need."""

from pathlib import Path

from tests.miniatures import billets, estimate_modulus, feeling_of_success, objectfolder, physiclear, vt60

CLASSES = ("01_stapler", "02_bottleempty", "03_ball", "04_box", "05_bear", "06_shoe", "07_mug", "09_bowl", "10_can")


def write_vt60(folder: Path, instances: int = 2) -> None:
    names = (*CLASSES, "08_bottlefull")
    objects = {(kind, f"{number:02}"): f"nick{number}" for kind in names for number in range(1, instances + 1)}
    vt60.write(folder, objects, touches=4, photos=2)


def write_billets(folder: Path) -> None:
    names = ("ground1", "welded1", "welded2", "welded3")
    billets.write(folder, [(name, f"{place:02}") for name in names for place in range(1, 17)])


def write(folder: Path) -> None:
    write_vt60(folder / "vt60", instances=3)
    write_billets(folder / "billets")
    names = [str(number) for number in range(1, 25)]
    split = {"train": names[:12], "val": names[12:14], "test": names[14:]}
    objectfolder.write(folder / "objectfolder", objects=names, split=split)
    physiclear.write(folder / "physiclear")
    estimate_modulus.write(folder / "estimate-modulus")
    feeling_of_success.write(folder / "feeling-of-success", (120,), of_an_object=4)
