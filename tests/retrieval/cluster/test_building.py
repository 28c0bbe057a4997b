"""Embedding on GPUs: which processes request one from Ray, and that a build computes on the model's device.

No GPU is needed. Ray assigns as many as its settings state, and the device is PyTorch's `meta`, which computes only
shapes and raises an error if data are read without a copy to the CPU.
"""

import os
from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from indexes.store.sharded import read_sharded_manifest
from retrieval.indexing import candidates
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from retrieval.model.checkpoint import load_checkpoint
from tests import reference_model
from tests.retrieval.indexing.test_candidates import checkpoint_of

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # Ray's own warnings
    pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`"),
]


@pytest.fixture
def fetched(monkeypatch):
    """Shapes of tensors copied from the device, which become unit vectors; single numbers are 0."""
    shapes, plain, number = [], torch.Tensor.cpu, torch.Tensor.__float__

    def cpu(tensor):
        if not tensor.is_meta:
            return plain(tensor)
        shapes.append(tuple(tensor.shape))
        return torch.nn.functional.normalize(torch.ones(tensor.shape), dim=-1)

    monkeypatch.setattr(torch.Tensor, "cpu", cpu)
    monkeypatch.setattr(torch.Tensor, "__float__", lambda tensor: 0.0 if tensor.is_meta else number(tensor))
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)  # not supported by `meta`
    return shapes


def test_photos_and_touches_are_encoded_on_the_models_device(catalogue_with_touches, tmp_path, fetched):
    model = reference_model.write_reference_model(tmp_path / "model.safetensors")
    model.matcher.to("meta")
    report = build_index(catalogue_with_touches, model, tmp_path / "index", quiet=True)
    assert (report.embedded, report.references["touches"]) == (22, 8)
    partial = model.config.matcher.partial_width
    assert sum(shape[0] for shape in fetched if shape[1:] == (partial,)) == 22 + 8


def test_measurements_work_on_any_device_of_the_model(catalogue, tmp_path, fetched, monkeypatch):
    monkeypatch.setattr(candidates, "EXHAUSTIVE_LIMIT", 5)
    checkpoint = checkpoint_of()
    checkpoint.matcher.to("meta")
    report = build_index(catalogue, checkpoint, tmp_path / "index", quiet=True)
    assert (report.embedded, report.candidates["queries"]) == (24, len(checkpoint.queries))
    assert (len(checkpoint.queries), checkpoint.config.matcher.embedding_dim) in fetched


def nodes(*resources):
    """A fake Ray with these machines, where PyTorch can use GPUs or not."""

    def ray(has_gpus=True):
        task = SimpleNamespace(remote=lambda: has_gpus)
        return SimpleNamespace(
            nodes=lambda: (
                [{"Alive": True, "Resources": each} for each in resources]
                + [{"Alive": False, "Resources": {"CPU": 99.0, "GPU": 9.0}}]
            ),
            remote=lambda **options: lambda function: task if options == {"num_cpus": 0, "num_gpus": 1} else None,
            get=lambda result: result,
        )

    return ray


def test_there_are_as_many_processes_as_gpus_or_else_cpus(capsys):
    from retrieval.cluster.building import ray_worker_pool

    assert ray_worker_pool(nodes({"CPU": 4.0}, {"CPU": 8.0})()) == (12, {"num_cpus": 1, "num_gpus": 0})
    assert ray_worker_pool(nodes({"memory": 1.0})()) == (1, {"num_cpus": 1, "num_gpus": 0})
    mixed = nodes({"CPU": 64.0}, {"CPU": 16.0, "GPU": 2.0}, {"CPU": 30.0, "GPU": 4.0})
    # The CPUs are those of the machine with the fewest for each GPU.
    assert ray_worker_pool(mixed()) == (6, {"num_cpus": 7, "num_gpus": 1})
    assert ray_worker_pool(nodes({"CPU": 2.0, "GPU": 8.0})()) == (8, {"num_cpus": 1, "num_gpus": 1})
    assert not capsys.readouterr().err
    assert ray_worker_pool(mixed(has_gpus=False)) == (110, {"num_cpus": 1, "num_gpus": 0})
    assert "PyTorch cannot use them there; CPUs embed the photos" in capsys.readouterr().err


@pytest.mark.slow
def test_each_process_of_the_pool_requests_its_own_gpu(catalogue, model, tmp_path, monkeypatch, capsys):
    from retrieval.cluster import building
    from retrieval.cluster.session import ray_session

    reports = tmp_path / "reports"
    reports.mkdir()

    class ReportingWorker(building.ShardBuildWorker):
        def _build(self, job):
            import ray

            gpus = ray.get_runtime_context().get_accelerator_ids()["GPU"]
            visible, threads = os.environ["CUDA_VISIBLE_DEVICES"], torch.get_num_threads()
            (reports / job.folder.name).write_text(f"{gpus} {visible} {threads}")
            return super()._build(job)

    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setenv("RAY_OVERRIDE_RESOURCES", '{"CPU": 4, "GPU": 2}')
    checkpoint = load_checkpoint(model)
    with ray_session() as ray:
        assert ray.cluster_resources()["GPU"] == 2
        assert building.ray_worker_pool(ray) == (4, {"num_cpus": 1, "num_gpus": 0})
        assert "PyTorch cannot use them there" in capsys.readouterr().err
        monkeypatch.setattr(building, "_has_gpu", lambda: True)
        monkeypatch.setattr(building, "ShardBuildWorker", ReportingWorker)
        report = build_sharded(catalogue, checkpoint, tmp_path / "c", 4, quiet=True, run=building.build_on_ray)
    assert (report.photos, report.embedded) == (24, 24)
    names = [entry.folder for entry in read_sharded_manifest(tmp_path / "c").shards]
    assert {(reports / name).read_text() for name in names} <= {"['0'] 0 2", "['1'] 1 2"}
