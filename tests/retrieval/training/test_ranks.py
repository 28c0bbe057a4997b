"""Training on several ranks, started by `torchrun`: the same results as one process, and recovery from a lost rank.

tests/retrieval/training/test_train.py compares gradients and statistics. From the second step on, the weights of two
ranks and of one process drift apart, like those of two processes whose initial weights differ in the eighth digit:
Adam's first steps have the same length for small and large gradients. So results are compared with frozen towers.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from retrieval.model.checkpoint import load_checkpoint
from retrieval.training.loop import state_path
from tests import ray_processes
from tests.retrieval.training.test_train import TINY_TOML
from tests.waiting import run_process, wait_until

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


def command(recording, out, config, ranks=2):
    start = TORCHRUN if ranks == 2 else [sys.executable]
    return [*start, "-m", "retrieval", "train", str(recording), "--out", str(out), "--config", str(config)]


@pytest.fixture
def settings(tmp_path):
    """Function that writes the settings of a training with changed values and returns the file."""

    def write(**changes):
        text = TINY_TOML
        for name, value in changes.items():
            line = f"{name} = {value}"
            text, found = re.subn(rf"^{name} = .*$", line, text, flags=re.MULTILINE)
            text = text if found else text.replace("[training]", f"[training]\n{line}")
        path = tmp_path / "tiny.toml"
        path.write_text(text)
        return path

    return write


@pytest.mark.slow
def test_two_ranks_give_the_results_of_one_process(recording, settings, tmp_path):
    config, made = settings(freeze_towers="true", validate_every=20), []
    for ranks in (1, 2):
        out = tmp_path / f"{ranks}.safetensors"
        done = subprocess.run(
            command(recording, out, config, ranks),
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        made.append(load_checkpoint(out).provenance)
    one, two = made
    assert two["step"] == one["step"]
    assert two["metrics"] == pytest.approx(one["metrics"], abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, -1])
def test_a_killed_rank_ends_the_job_and_the_same_command_continues_it(victim, recording, settings, tmp_path):
    out, config = tmp_path / "m.safetensors", settings(iterations=100_000, validate_every=5)
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
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=240)
    assert "run the same command to continue" in output
