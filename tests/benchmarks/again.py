"""Building again: CPU time of one thread, for one new photo among many, and where the time goes.

    python -m tests.benchmarks.again --photos 100000

The photos are small files, three in the folder of an object; the codes of the first generation are drawn, not encoded,
so that a large catalogue is there in a minute. Large files would take longer to read, which is what is left out.
"""

import argparse
import hashlib
import io
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from indexes.store.folder import IndexStore
from indexes.store.tables import Block
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import encode_photos
from retrieval.model.stored import fingerprint
from retrieval.search.build import build_index
from retrieval.search.defaults import shipped_model
from retrieval.search.operating import Asked
from tests.benchmarks.common import Line

PHOTOS, ROUNDS = 10_000, 3
OLD_S = 3600


def measure(photos: int = PHOTOS, rounds: int = ROUNDS) -> Iterator[Line]:
    """A line for the first build over an index that noted no looks, and one each for nothing and one photo changed."""
    checkpoint, threads = load_checkpoint(shipped_model()), torch.get_num_threads()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        catalogue, index = Path(name) / "catalog", Path(name) / "index"
        picture = write_catalogue(catalogue, photos)
        write_index(catalogue, index, checkpoint)
        told: dict[str, list[float]] = {"unnoted": [], "verify": [], "nothing": [], "one": []}
        told["unnoted"].append(_build_s(catalogue, checkpoint, index, 0))
        for number in range(rounds):
            told["nothing"].append(_build_s(catalogue, checkpoint, index, 0))
            told["verify"].append(_build_s(catalogue, checkpoint, index, 0, verify=True))
            _write(catalogue / "new" / f"{number}.jpg", picture + b"new %d" % number)
            told["one"].append(_build_s(catalogue, checkpoint, index, 1))
        image = checkpoint.config.preprocessing.load_photo(catalogue / "new" / "0.jpg")
        encoding = min(_cpu_s(lambda: encode_photos(checkpoint.matcher, [image])) for _ in range(rounds))
    torch.set_num_threads(threads)
    median = {arm: float(np.median(seconds)) for arm, seconds in told.items()}
    shown = ", ".join(
        f"{what} {median[arm]:.2f} s ({min(told[arm]):.2f} to {max(told[arm]):.2f})"
        for arm, what in (
            ("one", "one new photo"),
            ("nothing", "nothing new"),
            ("verify", "all read again"),
            ("unnoted", "an index that noted no looks"),
        )
    )
    text = f"{photos} photos, CPU time of one thread: {shown}; encoding the photo alone {encoding:.2f} s"
    yield Line("again", checkpoint.config.matcher.tower, text, {"photos": photos, "encoding": encoding, **median})


def write_catalogue(folder: Path, photos: int) -> bytes:
    """Files of one picture, each with bytes of its own at the end, three an object; an hour old. Gives the picture."""
    held = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(256, size=(32, 32, 3), dtype=np.uint8)).save(held, "JPEG")
    for number in range(photos):
        _write(folder / f"object-{number // 3:06d}" / f"{number % 3}.jpg", held.getvalue() + b"%d" % number)
    return held.getvalue()


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    os.utime(path, (time.time() - OLD_S,) * 2)


def write_index(catalogue: Path, out: Path, checkpoint: Checkpoint) -> None:
    """The index over the catalogue, as `build_index` would have written it but for the codes."""
    rng, matcher, paths = np.random.default_rng(0), checkpoint.config.matcher, sorted(catalogue.rglob("*.jpg"))
    embeddings = rng.normal(size=(len(paths), matcher.embedding_dim)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    rows = []
    for path in paths:
        name = path.relative_to(catalogue).as_posix()
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        rows.append({"id": name, "object_id": path.parent.name, "path": name, "digest": digest, "metadata": {}})
    halves, asked = rng.normal(size=(len(paths), matcher.half)).astype(np.float16), asdict(Asked())
    measured = {"k": 100, "winner_recall": 1.0, "interval": [0.99, 1.0], "queries": 398, "ms": 1.0}
    measured |= {"exhaustive_ms": 1.0, "kind": "flat", "parameters": {}, "asked": asked, "changed": 0}
    IndexStore(out).write_blocks(
        [Block(rows, embeddings, {"halves": halves})],
        {"calibration": checkpoint.posterior.to_dict()} if checkpoint.posterior else {},
        fingerprint=fingerprint(checkpoint),
        about={
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": str(catalogue.resolve()),
            "objects_from": "folder",
            "asked": asked,
            "half_error": 1e-3,
            "reason": "Drawn codes.",
            "candidates": measured | {"photos": len(rows)},
        },
    )


def _build_s(catalogue: Path, checkpoint: Checkpoint, index: Path, new: int, verify: bool = False) -> float:
    def build() -> None:
        report = build_index(catalogue, checkpoint, index, verify=verify, quiet=True)
        assert report.embedded == new, report

    return _cpu_s(build)


def _cpu_s(work) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> None:
    """Print the line."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.again", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=float, default=PHOTOS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    arguments = parser.parse_args()
    for line in measure(int(arguments.photos), arguments.rounds):
        print(line)


if __name__ == "__main__":
    main()
