"""`retrieve query` in a fresh process: the time of each step, with PyTorch and with ONNX Runtime."""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks.common import ResultLine
from benchmarks.query import STAGES, gel_images, write_index
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.onnx_encoder import EXPORT_SUFFIX
from retrieval.model.shipped import shipped_model

PHOTOS = 1000
REPETITIONS = 5

# The steps of `retrieve query` and `Searcher.open`, one at a time, in a separate process. A step's imports are those
# that earlier steps have not made.
PROGRAM = f"""
import sys, time
from importlib import import_module
started, index, model, backend, *touch = sys.argv[1:]
ms = {{"python": 1e3 * (time.time() - float(started))}}
def step(name, function):
    start = time.perf_counter()
    value = function()
    ms[name] = 1e3 * (time.perf_counter() - start)
    return value
ours = ("retrieval.commands.main", "retrieval.search.searcher")
for name in ("numpy", "PIL.Image", *ours, backend, "indexes.kinds.faiss_index"):
    step("import " + name, lambda: import_module(name))
from pathlib import Path
import retrieval.search.opening as opening
import retrieval.search.searcher as search
generation = step("open the index", lambda: opening.IndexStore(index).open(threads=1))
stored = step("read the checkpoint", lambda: import_module(
    "retrieval.model.checkpoint_info").read_checkpoint_info(Path(model)))
encoder = step("make the encoder", lambda: search.find_export(stored) or opening.torch_encoder(stored))
scorer = step("read the head", lambda: search.scorer_for(stored, generation.manifest.about))
shard = step("number objects", lambda: search.FolderShard(generation, scorer, stored.config.has_embeddings))
searcher = search.Searcher(Path(index), shard, stored, encoder, scorer)
result = searcher.query([touch])
assert result.index["encoder"] == ("torch" if backend == "torch" else "onnx")
for name in {STAGES!r}:
    ms[name] = result.timing_ms[name]
step("import retrieval.report.terminal", lambda: import_module("retrieval.report.terminal"))
step("print", lambda: import_module("retrieval.report.terminal").print_table(result))
import json
print(json.dumps(ms | {{"CPU": 1e3 * time.process_time()}}), file=sys.stderr)
"""


def measure(photos: int = PHOTOS, repetitions: int = REPETITIONS, model: Path | None = None) -> Iterator[ResultLine]:
    """Yield a line for `--help`, and one for each installed backend, with the shipped checkpoint."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        models = _models(folder, model or shipped_model())
        checkpoint = load_checkpoint(models["torch"])
        write_index(folder / "index", checkpoint, photos)
        touch = gel_images(folder, checkpoint.config.matcher.fingers)
        yield _help(repetitions)
        runs_of: dict[str, list[dict[str, float]]] = {backend: [] for backend in models}
        for _ in range(repetitions + 1):  # the first fills the disk cache and is not counted
            for backend, path in models.items():
                runs_of[backend].append(_steps(folder / "index", path, backend, touch))
        for backend, runs in runs_of.items():
            yield _line(backend, checkpoint, runs[1:], photos)


def _models(folder: Path, source: Path) -> dict[str, Path]:
    """Return backend -> the same checkpoint, without or with an export next to it."""
    backends = ["torch"] + (["onnxruntime"] if find_spec("onnx") and find_spec("onnxruntime") else [])
    models = {}
    for backend in backends:
        (folder / backend).mkdir()
        models[backend] = Path(shutil.copy(source, folder / backend / "model.safetensors"))
        if backend != "torch":
            path = models[backend]
            path.with_suffix(EXPORT_SUFFIX).write_bytes(touch_encoder_to_onnx(load_checkpoint(path)))
    return models


def _steps(index: Path, model: Path, backend: str, touch: Sequence[Path]) -> dict[str, float]:
    arguments = [str(item) for item in (time.time(), index, model, backend, *touch)]
    own = {**os.environ, "XDG_CACHE_HOME": str(model.parent)}  # no build has written an export there
    command = [sys.executable, "-c", PROGRAM, *arguments]
    done = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    steps: dict[str, float] = json.loads(done.stderr.splitlines()[-1])
    return steps


def _line(backend: str, checkpoint: Checkpoint, runs: Sequence[dict[str, float]], photos: int) -> ResultLine:
    cpu = [run.pop("CPU") for run in runs]
    ms = {step: statistics.median(run[step] for run in runs) for step in runs[0]}
    each = [sum(run.values()) for run in runs]
    total = statistics.median(each)
    shown = ", ".join(f"{step} {value:.0f}" for step, value in ms.items() if value >= 0.5)
    return ResultLine(
        "cold",
        checkpoint.config.matcher.tower,
        f"{backend}, {photos} photos: {total:.0f} ms per query in a fresh process, {statistics.median(cpu):.0f} of "
        f"CPU time: {shown}",
        {"photos": photos, "total_ms": total, **{f"{step} ms": value for step, value in ms.items()}},
        {"total_ms": each, "cpu_ms": cpu},
    )


def _help(repetitions: int) -> ResultLine:
    seconds = []
    for _ in range(repetitions + 1):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "retrieval", "--help"], capture_output=True, check=True)
        seconds.append(time.perf_counter() - start)
    median = 1e3 * statistics.median(seconds[1:])
    return ResultLine("cold", "no tower", f"`retrieve --help` takes {median:.0f} ms", {"help_ms": median})
