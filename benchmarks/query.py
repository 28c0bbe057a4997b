"""A query on an open index, stage by stage, compared with the bare forward pass of the tactile tower."""

import shutil
import statistics
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.common import REPETITIONS, ResultLine, as_text, duration, in_turns, matcher_of
from indexes.store.folder import IndexStore
from indexes.store.rows import Row
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.checkpoint_info import fingerprint, read_scorer
from retrieval.model.config import Config
from retrieval.model.encode import TorchEncoder, touch_batch
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.fusion import Matcher
from retrieval.model.fusion_scorer import to_stored
from retrieval.model.onnx_encoder import OnnxEncoder
from retrieval.model.posterior import Posterior
from retrieval.model.shipped import shipped_model
from retrieval.model.touch_reader import TouchEncoder
from retrieval.search.searcher import Searcher
from retrieval.search.shard import FolderShard

PHOTOS, CANDIDATES = 10_000, 132
"""Candidates that benchmarks.scale finds necessary for this many photos; build-index stores the number."""
GEL_PX = (240, 320)
STAGES = ("decode", "encode", "candidates", "rerank")


def measure(config: Config, photos: int = PHOTOS, repetitions: int = REPETITIONS) -> Iterator[ResultLine]:
    """Yield one line for each installed backend, for a model with random weights."""
    with tempfile.TemporaryDirectory() as name:
        yield from _lines(Path(name), stored_checkpoint(Path(name), matcher_of(config), config), photos, repetitions)


def measure_shipped(photos: int = PHOTOS, repetitions: int = REPETITIONS) -> Iterator[ResultLine]:
    """Yield the same for the shipped checkpoint, and the time of `Searcher.open` after all imports."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        checkpoint = load_checkpoint(Path(shutil.copy(shipped_model(), folder / "model.safetensors")))
        yield from _lines(folder, checkpoint, photos, repetitions)
        times = in_turns({"open": lambda: Searcher.open(folder / "index")}, repetitions)
        yield ResultLine(
            "query",
            checkpoint.config.matcher.tower,
            f"an index of {photos} photos is opened and verified in {duration(times.median('open'))}",
            {"photos": photos, "open_s": times.median("open")},
        )


def _lines(folder: Path, checkpoint: Checkpoint, photos: int, repetitions: int) -> Iterator[ResultLine]:
    write_index(folder / "index", checkpoint, photos)
    touch = gel_images(folder, checkpoint.config.matcher.fingers)
    for encoder in encoders(folder, checkpoint):
        yield _line(folder / "index", checkpoint, encoder, touch, repetitions)


def _line(
    index: Path, checkpoint: Checkpoint, encoder: TouchEncoder, touch: list[Path], repetitions: int
) -> ResultLine:
    searcher = searcher_of(index, checkpoint, encoder)
    images = [checkpoint.config.preprocessing.load_touch(path) for path in touch]
    timings: list[dict[str, float]] = []
    arms = {
        "query": lambda: timings.append(searcher.query([touch]).timing_ms),
        "bare": _bare(checkpoint.matcher, encoder, images),
    }
    times = in_turns(arms, repetitions)
    ratio = times.ratio("query", "bare")
    stages = {stage: statistics.median(each[stage] for each in timings) for stage in STAGES}
    shown = ", ".join(f"{stage} {ms:.3g}" for stage, ms in stages.items())
    return ResultLine(
        "query",
        checkpoint.config.matcher.tower,
        f"{encoder.name}, {searcher.info.photos} photos, {CANDIDATES} reranked: {duration(times.median('query'))} "
        f"({shown} ms), {duration(times.median('bare'))} for the bare tower on the same images: {as_text(ratio)}",
        {"photos": searcher.info.photos, "ratio": ratio[0], **{f"{stage}_ms": ms for stage, ms in stages.items()}},
    )


def searcher_of(index: Path, checkpoint: Checkpoint, encoder: TouchEncoder) -> Searcher:
    """Return a searcher that encodes touches with this encoder."""
    scorer = read_scorer(checkpoint)
    shard = FolderShard(IndexStore(index).open(threads=1), scorer, checkpoint.config.has_embeddings)
    return Searcher(index, shard, checkpoint, encoder, scorer)


def _bare(matcher: Matcher, encoder: TouchEncoder, images: list[np.ndarray]):
    """Return only the forward pass, on prepared images; in PyTorch with folded weights, as in a query."""
    if isinstance(encoder, OnnxEncoder):
        return lambda: encoder.encode([images])
    tower, batch = TorchEncoder(matcher)._fast.touch_tower, touch_batch([images]).flatten(0, 1)

    @torch.inference_mode()
    def forward() -> torch.Tensor:
        return tower._encode((batch - tower.mean) / tower.std)

    return forward


def encoders(folder: Path, checkpoint: Checkpoint) -> Iterator[TouchEncoder]:
    """Yield PyTorch, and ONNX Runtime if it is installed."""
    yield TorchEncoder(checkpoint.matcher)
    if find_spec("onnx") and find_spec("onnxruntime"):
        path = folder / "exported.onnx"
        path.write_bytes(touch_encoder_to_onnx(checkpoint))
        yield OnnxEncoder(path, checkpoint.digest)


def stored_checkpoint(folder: Path, matcher: Matcher, config: Config) -> Checkpoint:
    """Write the matcher to a file and load it."""
    about = {"source": "random weights", "step": 0, "data_digest": "0" * 64, "metrics": {}}
    path = folder / "model.safetensors"
    store_checkpoint(Checkpoint(path, "", config, about, matcher=matcher), path)
    return load_checkpoint(path)


def write_index(out: Path, checkpoint: Checkpoint, photos: int) -> None:
    """Write an index of synthetic photos, three of each object: random partial activations and unit embeddings."""
    rng, matcher = np.random.default_rng(0), checkpoint.config.matcher
    partials = rng.uniform(-1, 1, (photos, matcher.partial_width)).astype(np.float32)
    embeddings = rng.normal(size=(photos, matcher.embedding_dim)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    names = [f"object-{number // 3:06d}/{number % 3}.jpg" for number in range(photos)]
    IndexStore(out).write(
        [Row(name, name.split("/")[0], f"{number:064x}") for number, name in enumerate(names)],
        embeddings,
        to_stored(partials, matcher.pooled_width),
        documents={"calibration": Posterior().to_dict()},
        fingerprint=fingerprint(checkpoint),
        about={"catalogue": str(out), "checkpoint": str(checkpoint.path), "candidates": {"k": CANDIDATES}},
    )


def gel_images(folder: Path, fingers: int) -> list[Path]:
    """Write one smooth picture for each finger, of the sensor's size and in a rig's file format."""
    rows, columns = (np.linspace(0, 9, size) for size in GEL_PX)
    paths = [folder / f"{finger}.jpg" for finger in range(fingers)]
    for number, path in enumerate(paths):
        waves = [np.sin((k + 1) * rows + number)[:, None] * np.cos((k + 2) * columns)[None] for k in range(3)]
        Image.fromarray((127 + 100 * np.stack(waves, axis=2)).astype(np.uint8)).save(path, quality=95)
    return paths
