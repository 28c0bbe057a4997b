"""Training on several ranks, started by `torchrun`: the same results as one process, and recovery from a lost rank.

From the second step on, the weights of two ranks and of one process drift apart, like those of two processes whose
initial weights differ in the eighth digit: Adam's first steps have the same length for small and large gradients. So
gradients are compared with towers in training, and results with frozen towers.
"""

import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from retrieval.errors import ConfigError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.training import distributed
from retrieval.training.loop import state_path
from tests import ray_processes
from tests.retrieval.training.test_train import NORM, trainer_for, with_training
from tests.waiting import run_process, wait_until

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
MATCHER = """
[matcher]
tower = "small"
tower_output = "pooled"
hidden = 16
candidate_width = 8
embedding_dim = 8
standardise = true
[preprocessing]
touch_px = 32
photo_px = 32
[training]
init = "random"
touches_per_batch = 2
distil_steps = 3
validation_fraction = 0.25
contrastive_weight = 1.0
"""


def write_config(folder, **training):
    path = folder / "tiny.toml"
    path.write_text(MATCHER + "\n".join(f"{name} = {value}" for name, value in training.items()))
    return path


def command(recording, out, config, ranks=2):
    start = TORCHRUN if ranks == 2 else [sys.executable]
    return [*start, "-m", "retrieval", "train", str(recording), "--out", str(out), "--config", str(config)]


def run(arguments):
    done = subprocess.run(arguments, env=ENVIRONMENT, capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, "Warning" in done.stderr) == (0, False), done.stderr


@pytest.mark.slow
def test_two_ranks_give_the_results_of_one_process(recording, tmp_path):
    """No rank looks for the files before the other has written them."""
    config, made = write_config(tmp_path, freeze_towers="true", iterations=40, validate_every=20), []
    for ranks in (1, 2):
        out = tmp_path / f"{ranks}.safetensors"
        run(command(recording, out, config, ranks))
        made.append(load_checkpoint(out))
    one, two = (each.provenance for each in made)
    assert (two["step"], two["metrics"]) == (one["step"], pytest.approx(one["metrics"], abs=1e-3))
    assert made[1].matcher.candidate_encoder is not None


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, -1])
def test_a_killed_rank_ends_the_job_and_the_same_command_continues_it(victim, recording, tmp_path):
    out, config = tmp_path / "m.safetensors", write_config(tmp_path, iterations=100_000, validate_every=5)
    with run_process(command(recording, out, config), env=ENVIRONMENT) as process:
        wait_until(lambda: state_path(out).exists() or process.poll() is not None, limit_s=240)
        ranks = sorted(ray_processes.processes_named(r".*-m retrieval train|.*-u -m retrieval", process.pid))
        assert len(ranks) == 2
        os.kill(ranks[victim], signal.SIGKILL)
        process.communicate(timeout=240)  # a rank that waits for the other one would wait half an hour
    assert process.returncode != 0
    assert not set(ranks) & set(ray_processes.parents())
    state = state_path(out).stat().st_mtime_ns
    with run_process(command(recording, out, config), env=ENVIRONMENT) as process:
        wait_until(lambda: state_path(out).stat().st_mtime_ns != state or process.poll() is not None, limit_s=240)
        assert process.poll() is None, process.stderr.read()
        process.send_signal(signal.SIGINT)  # both ranks stop after the same step
        _, output = process.communicate(timeout=240)
    assert "run the same command to continue" in output


GRADIENTS = """
import sys, torch
from pathlib import Path
from retrieval.training import distributed
from retrieval.training.batches import TrainedFeatures
from retrieval.data.dataset import load_grasps
from retrieval.data.pairs import PairSampler
from retrieval.training.initial_weights import build_matcher
from retrieval.training.trainer import WeightedLosses, batch_loss, set_training_mode
from tests.conftest import TINY
from tests.retrieval.training.test_train import load, with_training

torch.set_num_threads(1)
distributed.start()
# With bfloat16 hardware, towers in training would round differently in batches of another size.
config = with_training(TINY, precision="float32")
source = TrainedFeatures(config, torch.device("cpu"))
loaded = load(source, PairSampler(load_grasps(Path(sys.argv[1])), seed=0).batch(0, 5))


def loss(loaded):
    return batch_loss(matcher, losses, loaded.batch, *source.train_features(matcher, loaded))


torch.manual_seed(0)
matcher = build_matcher(config)
set_training_mode(matcher, config.training)
losses = WeightedLosses(config.training.weights, matcher, 9)
torch.manual_seed(1)
averaged = distributed.averaging_gradients(torch.nn.ModuleList([matcher, losses]), loss)
averaged(loaded).backward()
gradients = {name: value.grad for name, value in matcher.named_parameters() if value.grad is not None}
if distributed.rank() == 0:
    torch.save(gradients, sys.argv[2])
distributed.stop()
"""


@pytest.mark.slow
def test_two_ranks_have_the_gradient_of_one_process(recording, tmp_path):
    script = tmp_path / "gradients.py"
    script.write_text(GRADIENTS)
    for ranks, start in ((1, [sys.executable]), (2, TORCHRUN)):
        run([*start, str(script), str(recording), str(tmp_path / f"{ranks}.pt")])
    one, two = (torch.load(tmp_path / f"{ranks}.pt", weights_only=True) for ranks in (1, 2))
    scale = max(float(value.abs().max()) for value in one.values())
    assert max(float((two[name] - one[name]).abs().max()) for name in one) < 1e-5 * scale  # summed in another order


@pytest.mark.parametrize("settings", [{}, {"freeze_batch_norm": True}, {"freeze_towers": True}])
def test_ranks_of_cpus_must_freeze_batch_norm(settings, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    refusal = nullcontext() if settings else pytest.raises(ConfigError, match=r"2 ranks on CPUs.*freeze_batch_norm")
    with refusal:
        trainer_for(recording, tmp_path / "m.safetensors", with_training(NORM, **settings))
