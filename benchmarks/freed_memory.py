"""Training and encoding with freed memory kept in the process (`keep_freed_memory`), and returned to the system.

    python -m benchmarks.freed_memory

Each repetition is a new process with two threads; the arms run in turn. The tower is that of the shipped checkpoint,
with random images: a training step of 96 photos above the frozen stem, and the encoding of 64 photos.
"""

import argparse
import json
import subprocess
import sys

from benchmarks.common import REPETITIONS, Times, as_text, spread

PROGRAM = """
import json, sys, time
import numpy as np
import torch
from retrieval.console.memory import keep_freed_memory
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.encode import autocast, encode_photos, to_batch
from retrieval.search.defaults import shipped_model

if sys.argv[1] == "kept":
    keep_freed_memory()
torch.set_num_threads(2)
checkpoint = load_checkpoint(shipped_model())
matcher, settings = checkpoint.matcher, checkpoint.config.preprocessing
shape = 96, settings.photo_px, len(settings.views) * settings.photo_px, 3
images = list(np.random.default_rng(0).random(shape, dtype=np.float32))
seconds = {}
matcher.eval()
for _ in range(3):  # the last one counts
    start = time.perf_counter()
    encode_photos(matcher, images[:64], 16)
    seconds["encoding"] = time.perf_counter() - start
batch = to_batch(images)
for parameter in matcher.photo_tower.stem_layers().parameters():
    parameter.requires_grad_(False)
for _ in range(3):
    start = time.perf_counter()
    with autocast(batch.device, "auto"):
        loss = matcher.photo_features(batch).float().square().mean()
    loss.backward()
    seconds["training step"] = time.perf_counter() - start
print(json.dumps(seconds))
"""


def main() -> int:
    """Print a line for each kind of work."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=REPETITIONS)
    repetitions = parser.parse_args().repetitions
    runs = [{arm: run(arm) for arm in ("returned", "kept")} for _ in range(repetitions)]
    for work in runs[0]["kept"]:
        times = Times({arm: [each[arm][work] for each in runs] for arm in ("returned", "kept")})
        each = [f"{spread([1e3 * one for one in some], 'ms')} with memory {arm}" for arm, some in times.seconds.items()]
        print(f"{work}: {', '.join(each)}: {as_text(times.ratio('returned', 'kept'))} faster")
    return 0


def run(arm: str) -> dict[str, float]:
    """Return the seconds of each kind of work in a new process."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, arm], capture_output=True, text=True, check=True)
    seconds: dict[str, float] = json.loads(done.stdout)
    return seconds


if __name__ == "__main__":
    raise SystemExit(main())
