"""Pictures and a briefly trained model for several test files; each is created once per session."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import faiss
import pytest
import torch
from hypothesis import HealthCheck, settings

from retrieval.console.progress import Bar
from retrieval.data.preprocessing import Preprocessing
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from tests import synthetic

# With `-n 2` each process has one thread: two processes with more threads slow each other down on two cores.
THREADS = 1 if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1 else 2
torch.set_num_threads(THREADS)
faiss.omp_set_num_threads(THREADS)
cv2.setNumThreads(THREADS)

# No test depends on timing: neither on the time of an example nor on the time to generate the first one.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


TINY = Config(
    MatcherConfig(tower="small", tower_output="pooled", hidden=32, standardise=True, embedding_dim=16),
    TrainingConfig(
        init="random",
        iterations=6,
        touches_per_batch=4,
        positives_per_touch=2,
        negatives_per_touch=2,
        weights={"contrastive": 1.0},
        validation_fraction=0.25,
        test_fraction=0.2,
        validate_every=3,
        learning_rate=1e-3,
    ),
    Preprocessing(touch_px=32, photo_px=48),
)


@pytest.fixture(scope="session")
def _cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _own_state(_cache_folder: Path) -> Iterator[None]:
    """Separate the cache of each test from those of the user and of other tests, and its switch of progress.

    All tests use one folder, which is emptied after each: creating one per test takes half a minute in total.
    """
    with pytest.MonkeyPatch.context() as patch:  # not the test's own, which may replace functions of the clean-up
        patch.setenv("XDG_CACHE_HOME", str(_cache_folder))
        patch.setattr(Bar, "is_on", False)
        yield
    shutil.rmtree(_cache_folder)
    _cache_folder.mkdir()


@pytest.fixture
def no_fsync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable fsync, for tests that write thousands of small files and do not test crashes."""
    monkeypatch.setattr("os.fsync", lambda descriptor: None)


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of synthetic pictures: 12 objects, 3 grasps each, two fingers, with no-contact frames."""
    return synthetic.write_recording(tmp_path_factory.mktemp("recording") / "recording", synthetic.make_objects(12), 3)


@pytest.fixture(scope="session")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue of 8 objects that are not in the recording, 3 photos each. Copy it before changes."""
    return synthetic.write_catalogue(
        tmp_path_factory.mktemp("catalogue") / "catalog", synthetic.make_objects(8, seed=9)
    )


@pytest.fixture
def catalogue_copy(catalogue: Path, tmp_path: Path) -> Path:
    """A copy of the catalogue, for changes."""
    return shutil.copytree(catalogue, tmp_path / "catalog")


@pytest.fixture(scope="session")
def touches(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[Path, ...]]]:
    """Three touches of each object of the catalogue, by object."""
    return synthetic.write_queries(tmp_path_factory.mktemp("touches"), synthetic.make_objects(8, seed=9), 3)


@pytest.fixture
def catalogue_with_touches(catalogue_copy: Path, touches: dict[str, list[tuple[Path, ...]]]) -> Path:
    """The catalogue with two touches of each of its first four objects; the third has no photo."""
    names = sorted(touches)[:4]
    for name in names:
        for number, files in enumerate(touches[name][:2]):
            synthetic.put_touch(catalogue_copy, name, number, files)
    for photo in (catalogue_copy / names[2]).glob("*.jpg"):
        photo.unlink()
    return catalogue_copy


@pytest.fixture(scope="session")
def two_grasps(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, ...]]:
    """The gel images (a, b) of two grasps of the catalogue's first object."""
    objects = synthetic.make_objects(1, seed=9)
    return synthetic.write_queries(tmp_path_factory.mktemp("touch"), objects, 2)[objects[0].object_id]


@pytest.fixture(scope="session")
def touch(two_grasps: list[tuple[Path, ...]]) -> tuple[Path, ...]:
    """The gel images (a, b) of one grasp of the catalogue's first object."""
    return two_grasps[0]


@pytest.fixture(scope="session")
def model(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after six training steps: it works like any other, but its scores are nearly random."""
    from retrieval.training.trainer import train_matcher

    out = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    train_matcher(recording, out, TINY)
    return out


@pytest.fixture
def checkpoint(model: Path) -> Any:
    """The loaded checkpoint."""
    from retrieval.model.checkpoint import load_checkpoint

    return load_checkpoint(model)


@pytest.fixture(scope="session")
def index(catalogue: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The index of the catalogue: 24 photos of 8 objects. Do not change it."""
    from retrieval.indexing.build import build_index
    from retrieval.model.checkpoint import load_checkpoint

    out = tmp_path_factory.mktemp("search") / "index"
    build_index(catalogue, load_checkpoint(model), out)
    return out


@pytest.fixture(scope="session")
def grasps(tmp_path_factory: pytest.TempPathFactory) -> list[list[tuple[Path, ...]]]:
    """Files of three grasps of each of the first two objects of the catalogue."""
    objects = synthetic.make_objects(2, seed=9)
    return list(synthetic.write_queries(tmp_path_factory.mktemp("grasps"), objects, 3).values())


@pytest.fixture(scope="session")
def cluster(catalogue: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The index of the catalogue in four shards. Do not change it."""
    from retrieval.indexing.sharded import build_sharded
    from retrieval.model.checkpoint import load_checkpoint

    out = tmp_path_factory.mktemp("cluster") / "cluster"
    build_sharded(catalogue, load_checkpoint(model), out, 4)
    return out


@pytest.fixture(scope="module")
def searcher(index: Path) -> Iterator[Any]:
    """The opened index."""
    from retrieval.search.searcher import Searcher

    with Searcher.open(index) as opened:
        yield opened


@pytest.fixture
def embedded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the photos in each batch that the photo tower encodes in this process."""
    from retrieval.indexing import codes

    sizes: list[int] = []
    make = codes.torch_photo_encoder

    def counting_encoder(matcher: Any) -> Any:
        encode = make(matcher)

        def counting_encode(images: Any) -> Any:
            sizes.append(len(images))
            return encode(images)

        return counting_encode

    monkeypatch.setattr(codes, "torch_photo_encoder", counting_encoder)
    return sizes


def pytest_configure() -> None:
    """Make downloads fail at once, and enable Ctrl-C.

    A process that a shell starts with `&` ignores Ctrl-C, and so would every process that a test starts and interrupts.
    """
    os.environ["HF_HUB_OFFLINE"] = "1"
    os.environ["OMP_NUM_THREADS"] = str(THREADS)  # for processes that tests start
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
