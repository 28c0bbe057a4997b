"""Rebuild an index: CPU time of one thread for one new photo among many.

    python -m benchmarks.again --photos 100000

The photos are small files, three in the folder of an object. Their codes are random, put into the cache of the index,
so that a large catalogue is ready in a minute. Large files would take longer to read, which is not measured here.

Every build is a separate process. Its time is without start-up until the model is loaded, which every command needs,
and without decoding and encoding of the new photo. For comparison, `os.walk` and `os.stat` over the folders are timed.
"""

import argparse
import hashlib
import io
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from _touch_retrieval.cache import Cache
from indexes.kinds.faiss_index import load_faiss
from retrieval.indexing.build import CACHE, build_index
from retrieval.indexing.codes import photo_encoder
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import batches, encode_photos
from retrieval.model.fusion_scorer import to_stored
from retrieval.model.shipped import shipped_model

PHOTOS, ROUNDS = 10_000, 3
OLD_S = 3600


def measure(photos: int = PHOTOS, rounds: int = ROUNDS) -> tuple[str, dict[str, float]]:
    """Time builds without new photos and with a new one, in turn; return a sentence, and the median seconds by name."""
    checkpoint = load_checkpoint(shipped_model())
    with tempfile.TemporaryDirectory() as name:
        catalogue, index = Path(name) / "catalog", Path(name) / "index"
        picture = write_catalogue(catalogue, photos)
        write_codes(catalogue, index, checkpoint)
        times: dict[str, list[float]] = defaultdict(list)
        _build(catalogue, index, 0)
        for number in range(rounds):
            times["looking"].append(_cpu_s(lambda: _stat_files(catalogue)))
            times["nothing"].append(_build(catalogue, index, 0))
            _write(catalogue / "new" / f"{number}.jpg", picture + b"new %d" % number)
            times["one"].append(_build(catalogue, index, 1))
    median = {arm: float(np.median(seconds)) for arm, seconds in times.items()}
    shown = ", ".join(
        f"{label} {median[arm]:.2f} s ({min(times[arm]):.2f} to {max(times[arm]):.2f})"
        for arm, label in (
            ("one", "one new photo"),
            ("nothing", "no new photo"),
            ("looking", "`os.walk` and `os.stat` alone"),
        )
    )
    return f"{photos} photos, CPU time of one thread: {shown}", median


def build(catalogue: Path, index: Path, new: int) -> float:
    """Build again with `new` photos in the folder "new"; return the CPU seconds without those that encode a photo."""
    torch.set_num_threads(1)
    checkpoint = load_checkpoint(shipped_model())
    load_faiss()
    encoding_s = 0.0
    if new:
        path = max((catalogue / "new").iterdir())

        def encode() -> None:
            encode_photos(checkpoint.matcher, [checkpoint.config.preprocessing.load_photo(path)])

        def on_a_thread() -> None:  # as the build does
            with ThreadPoolExecutor(1) as pool:
                pool.submit(encode).result()

        encode()  # the first time takes longer
        encoding_s = _cpu_s(on_a_thread)
    start = time.process_time()
    report = build_index(catalogue, checkpoint, index)
    assert report.embedded == new, report
    return time.process_time() - start - encoding_s


def _build(catalogue: Path, index: Path, new: int) -> float:
    """Run `build` in a separate process."""
    command = [sys.executable, "-m", "benchmarks.again", "--build", str(catalogue), str(index), str(new)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


def _stat_files(folder: Path) -> None:
    for path, _, names in os.walk(folder):
        for name in names:
            os.stat(f"{path}/{name}")


def write_catalogue(folder: Path, photos: int) -> bytes:
    """Write files of one picture, each with unique bytes at its end, three per object, an hour old.

    Returns the content of the picture file.
    """
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(256, size=(32, 32, 3), dtype=np.uint8)).save(buffer, "JPEG")
    for number in range(photos):
        _write(folder / f"object-{number // 3:06d}" / f"{number % 3}.jpg", buffer.getvalue() + b"%d" % number)
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    os.utime(path, (time.time() - OLD_S,) * 2)


def write_codes(catalogue: Path, out: Path, checkpoint: Checkpoint) -> None:
    """Put random codes of all photos into the cache of the index."""
    rng, matcher = np.random.default_rng(0), checkpoint.config.matcher
    encoder = photo_encoder(checkpoint)
    with Cache(out / CACHE) as cache:
        for some in batches(sorted(catalogue.rglob("*.jpg")), 1000):
            records = np.zeros(len(some), encoder.layout)
            embeddings = rng.normal(size=(len(some), matcher.embedding_dim)).astype(np.float32)
            records["embeddings"] = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)
            partials = rng.uniform(-1, 1, (len(some), matcher.partial_width)).astype(np.float32)
            for name, array in to_stored(partials, matcher.pooled_width).items():
                records[name] = array
            keys = [encoder.key((path.name,), [hashlib.sha256(path.read_bytes()).hexdigest()]) for path in some]
            cache.add(dict(zip(keys, map(bytes, records), strict=True)))


def _cpu_s(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> None:
    """Print the sentence."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.again", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=float, default=PHOTOS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--build", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.build:
        catalogue, index, new = arguments.build
        print(build(Path(catalogue), Path(index), int(new)))
        return
    print(measure(int(arguments.photos), arguments.rounds)[0])


if __name__ == "__main__":
    main()
