"""Training on Ray: the ranks are those of `torchrun`, and a lost rank costs the steps since the last state."""

import os
import signal
import threading
import time
from importlib.util import find_spec

import pytest

from retrieval.commands.main import main
from retrieval.errors import BadInput
from retrieval.model.checkpoint import load_checkpoint
from retrieval.training.loop import state_path
from retrieval.training.trainer import train_matcher
from tests import ray_processes
from tests.conftest import TINY
from tests.retrieval.training.test_train import with_training

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # Ray's own warnings
    pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`"),
]
RANK = r"ray::RayTrainWorker|ray::_RayTrainWorker|ray::RayTrainWorker__execute"


def train_on_ray(*words, **how):
    from retrieval.cluster.training import train_on_ray as train_on_cluster

    return train_on_cluster(*words, **how)


@pytest.mark.slow
def test_two_ranks_on_ray_train_the_same_model_as_one_process(recording, tmp_path):
    config = with_training(TINY, freeze_towers=True)  # see tests/retrieval/training/test_ranks.py
    one = train_matcher(recording, tmp_path / "one.safetensors", config, quiet=True)
    two = train_on_ray(recording, tmp_path / "two.safetensors", config, workers=2)
    assert two.provenance["step"] == one.provenance["step"]
    assert two.provenance["metrics"] == pytest.approx(one.provenance["metrics"], abs=1e-3)
    assert not state_path(tmp_path / "two.safetensors").exists()


@pytest.mark.slow
def test_a_rank_that_is_killed_costs_the_steps_since_the_last_state(recording, tmp_path):
    out, done = tmp_path / "m.safetensors", {}
    config = with_training(TINY, freeze_towers=True, iterations=600, validate_every=50)
    expected = train_matcher(recording, tmp_path / "calm.safetensors", config, quiet=True)

    def work():
        done["checkpoint"] = train_on_ray(recording, out, config, workers=2)

    thread, killed = threading.Thread(target=work), 0
    thread.start()
    until = time.monotonic() + 400
    while thread.is_alive() and not killed and time.monotonic() < until:
        if state_path(out).exists() and (ranks := ray_processes.processes_named(RANK)):
            os.kill(ranks[-1], signal.SIGKILL)
            killed += 1
        time.sleep(0.005)
    thread.join(600)
    assert killed
    assert done["checkpoint"].provenance["metrics"] == pytest.approx(expected.provenance["metrics"], abs=1e-3)
    assert load_checkpoint(out).posterior is not None


@pytest.mark.slow
def test_an_error_of_a_rank_is_raised_as_a_clear_error(recording, tmp_path):
    config = with_training(TINY, init=str(tmp_path / "nothing.pth"))
    with pytest.raises(BadInput, match=r"nothing\.pth"):
        train_on_ray(recording, tmp_path / "m.safetensors", config, workers=1)


@pytest.mark.parametrize("options", [["--cluster", "--task", "grasp-success"], ["--workers", "2"]])
def test_cluster_options_are_only_for_matchers_on_a_cluster(options, recording, tmp_path, capsys):
    assert main(["train", str(recording), "--out", str(tmp_path / "m.safetensors"), *options]) == 2
    assert "--cluster needs --config" in capsys.readouterr().err
