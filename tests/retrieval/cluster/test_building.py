"""Embedding on GPUs: how many processes request one from Ray, and that a build computes on the model's device.

No GPU is needed: the device is PyTorch's `meta`, which computes only shapes and raises an error if data are read
without a copy to the CPU.
"""

from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from retrieval.indexing import candidates
from retrieval.indexing.build import build_index
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
    report = build_index(catalogue_with_touches, model, tmp_path / "index")
    assert (report.embedded, report.references["touches"]) == (22, 8)
    partial = model.config.matcher.partial_width
    assert sum(shape[0] for shape in fetched if shape[1:] == (partial,)) == 22 + 8


def test_measurements_work_on_any_device_of_the_model(catalogue, tmp_path, fetched, monkeypatch):
    monkeypatch.setattr(candidates, "EXHAUSTIVE_LIMIT", 5)
    checkpoint = checkpoint_of()
    checkpoint.matcher.to("meta")
    report = build_index(catalogue, checkpoint, tmp_path / "index")
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
