"""Embedding on graphics cards: who asks Ray for one, and that all a build needs of the model is asked of the device.

There is no card here. Ray hands out as many as it is told that it has, and the device is PyTorch's `meta`, which
computes shapes alone and refuses what is read off it without being fetched.
"""

import os
from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from indexes.store.sharded import read_sharded_manifest
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build import measuring
from retrieval.search.build.build_index import build_index
from retrieval.search.sharding.build_sharded import build_sharded
from tests import reference_model
from tests.retrieval.search.test_operating import checkpoint_of

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # Ray's own warnings
    pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`"),
]


@pytest.fixture
def fetched(monkeypatch):
    """Shapes that were fetched from the device, as which unit vectors arrive; single numbers are 0."""
    shapes, plain, number = [], torch.Tensor.cpu, torch.Tensor.__float__

    def cpu(tensor):
        if not tensor.is_meta:
            return plain(tensor)
        shapes.append(tuple(tensor.shape))
        return torch.nn.functional.normalize(torch.ones(tensor.shape), dim=-1)

    monkeypatch.setattr(torch.Tensor, "cpu", cpu)
    monkeypatch.setattr(torch.Tensor, "__float__", lambda tensor: 0.0 if tensor.is_meta else number(tensor))
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)  # of which `meta` knows nothing
    return shapes


def test_photos_and_touches_are_encoded_where_the_model_lies(catalogue_with_touches, tmp_path, fetched):
    model = reference_model.write_reference_model(tmp_path / "felt.safetensors")
    model.matcher.to("meta")
    report = build_index(catalogue_with_touches, model, tmp_path / "index", quiet=True)
    assert (report.embedded, report.references["touches"]) == (22, 8)
    partial = model.config.matcher.partial_width
    assert sum(shape[0] for shape in fetched if shape[1:] == (partial,)) == 22 + 8


def test_what_is_measured_is_measured_wherever_the_model_lies(catalogue, tmp_path, fetched, monkeypatch):
    monkeypatch.setattr(measuring, "EXHAUSTIVE_LIMIT", 5)
    checkpoint = checkpoint_of()
    checkpoint.matcher.to("meta")
    report = build_index(catalogue, checkpoint, tmp_path / "index", min_recall=0.5, max_ms=1000.0, quiet=True)
    assert (report.embedded, report.candidates["queries"]) == (24, len(checkpoint.queries))
    assert (len(checkpoint.queries), checkpoint.config.matcher.embedding_dim) in fetched


def nodes(*resources):
    """A Ray of such machines, where PyTorch sees cards or not."""

    def ray(sees=True):
        task = SimpleNamespace(remote=lambda: sees)
        return SimpleNamespace(
            nodes=lambda: (
                [{"Alive": True, "Resources": each} for each in resources]
                + [{"Alive": False, "Resources": {"CPU": 99.0, "GPU": 9.0}}]
            ),
            remote=lambda **asked: lambda function: task if asked == {"num_cpus": 0, "num_gpus": 1} else None,
            get=lambda answer: answer,
        )

    return ray


def test_there_are_as_many_processes_as_cards_else_as_processors(capsys):
    from retrieval.cluster.building import ray_worker_pool

    assert ray_worker_pool(nodes({"CPU": 4.0}, {"CPU": 8.0})()) == (12, 1, 0)
    assert ray_worker_pool(nodes({"memory": 1.0})()) == (1, 1, 0)
    mixed = nodes({"CPU": 64.0}, {"CPU": 16.0, "GPU": 2.0}, {"CPU": 30.0, "GPU": 4.0})
    assert ray_worker_pool(mixed()) == (6, 7, 1)  # of the machine with the fewest processors for a card
    assert ray_worker_pool(nodes({"CPU": 2.0, "GPU": 8.0})()) == (8, 1, 1)
    assert not capsys.readouterr().err
    assert ray_worker_pool(mixed(sees=False)) == (110, 1, 0)
    assert "PyTorch cannot use them there: processors embed" in capsys.readouterr().err


@pytest.mark.slow
def test_each_process_of_the_pool_asks_ray_for_a_card_of_its_own(catalogue, model, tmp_path, monkeypatch, capsys):
    from retrieval.cluster import building
    from retrieval.cluster.session import ray_session

    told = tmp_path / "told"
    told.mkdir()

    class Telling(building.ShardBuildWorker):
        def _answer(self, job):
            import ray

            gpus = ray.get_runtime_context().get_accelerator_ids()["GPU"]
            (told / job.folder).write_text(f"{gpus} {os.environ['CUDA_VISIBLE_DEVICES']} {torch.get_num_threads()}")
            return super()._answer(job)

    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setenv("RAY_OVERRIDE_RESOURCES", '{"CPU": 4, "GPU": 2}')
    checkpoint = load_checkpoint(model)
    with ray_session() as ray:
        assert (ray.cluster_resources()["GPU"], building.ray_worker_pool(ray)) == (2, (4, 1, 0))
        assert "PyTorch cannot use them there" in capsys.readouterr().err
        monkeypatch.setattr(building, "_has_gpu", lambda: True)
        monkeypatch.setattr(building, "ShardBuildWorker", Telling)
        report = build_sharded(catalogue, checkpoint, tmp_path / "c", 4, quiet=True, run=building.ray_runner())
    assert (report.photos, report.embedded) == (24, 24)
    names = [entry.folder for entry in read_sharded_manifest(tmp_path / "c").shards]
    assert {(told / name).read_text() for name in names} <= {"['0'] 0 2", "['1'] 1 2"}
