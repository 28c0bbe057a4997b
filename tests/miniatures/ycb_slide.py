"""Two objects with two logs of 61 frames each, and pickled tables that run a program if they are unpickled."""

from pathlib import Path

from tests.miniatures import encoded

GRASPS = 2 * 2 * 3  # one frame per second: 0, 30, 60


def write(folder: Path) -> None:
    for number, name in enumerate(("004_sugar_box", "035_power_drill")):
        for log in (0, 1):
            path = folder / "real" / name / f"dataset_{log}"
            for kind, shift in (("frames", 0), ("webcam_frames", 500)):
                (path / kind).mkdir(parents=True)
                for frame in range(61):
                    seed = 1000 * number + 100 * log + shift + frame
                    (path / kind / f"frame_{frame:07}.jpg").write_bytes(encoded(".jpg", seed))
            for table in ("digit_data.npy", "synced_data.npy"):
                (path / table).write_bytes(b"cposix\nsystem\n(S'false'\ntR.")
            (path / "frames.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42")
        (folder / "real" / name / "alignment.npy").write_bytes(b"\x93NUMPY")
