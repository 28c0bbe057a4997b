"""Two objects of two logs, 61 frames each, and the pickled tables, which are poison here."""

from pathlib import Path

from tests.miniatures import encoded

GRASPS = 2 * 2 * 3  # one frame a second: 0, 30, 60


def write(folder: Path) -> None:
    for number, name in enumerate(("004_sugar_box", "035_power_drill")):
        for log in (0, 1):
            place = folder / "real" / name / f"dataset_{log}"
            for kind, shift in (("frames", 0), ("webcam_frames", 500)):
                (place / kind).mkdir(parents=True)
                for frame in range(61):
                    seed = 1000 * number + 100 * log + shift + frame
                    (place / kind / f"frame_{frame:07}.jpg").write_bytes(encoded(".jpg", seed))
            for table in ("digit_data.npy", "synced_data.npy"):
                (place / table).write_bytes(b"cposix\nsystem\n(S'false'\ntR.")
            (place / "frames.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42")
        (folder / "real" / name / "alignment.npy").write_bytes(b"\x93NUMPY")
