"""Training on several ranks, as `torchrun` starts them: the figures of one process, and what a lost rank costs.

Their gradients and statistics are compared in tests/retrieval/training/test_train.py. Weights drift apart from the
second step on as those of two single processes do whose first weights differ in the eighth digit: Adam's first steps
are as long where a gradient is next to nothing as where it is large. So figures are compared where the towers stand
still, and in double precision where they are trained.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from retrieval.model.checkpoint import load_checkpoint
from retrieval.training.state import state_path
from tests import ray_processes
from tests.retrieval.training.test_train import TINY_TOML
from tests.waiting import run_process, wait_until

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


def command(recording, out, config, ranks=2, program="retrieval"):
    start = TORCHRUN if ranks == 2 else [sys.executable]
    return [*start, "-m", program, "train", str(recording), "--out", str(out), "--config", str(config)]


@pytest.fixture
def settings(tmp_path):
    """Writes the settings of a training with these lines instead of its own."""

    def written(**instead):
        text = TINY_TOML
        for name, value in instead.items():
            line = f"{name} = {value}"
            text, found = re.subn(rf"^{name} = .*$", line, text, flags=re.MULTILINE)
            text = text if found else text.replace("[training]", f"[training]\n{line}")
        path = tmp_path / "tiny.toml"
        path.write_text(text)
        return path

    return written


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "instead"),
    [
        ("retrieval", {"freeze_towers": "true", "validate_every": 20}),
        ("benchmarks.models.in_double", {"iterations": 40, "validate_every": 40}),
    ],
)
def test_two_ranks_reach_the_figures_of_one_process(program, instead, recording, settings, tmp_path):
    config, made = settings(**instead), []
    for ranks in (1, 2):
        out = tmp_path / f"{ranks}.safetensors"
        done = subprocess.run(
            command(recording, out, config, ranks, program),
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
def test_a_rank_that_is_killed_ends_the_job_and_resume_goes_on(victim, recording, settings, tmp_path):
    out, config = tmp_path / "m.safetensors", settings(iterations=100_000, validate_every=5)
    with run_process(command(recording, out, config), env=ENVIRONMENT) as process:
        wait_until(lambda: state_path(out).exists() or process.poll() is not None, limit_s=240)
        ranks = sorted(ray_processes.processes_named(r".*-m retrieval train|.*-u -m retrieval", process.pid))
        assert len(ranks) == 2
        os.kill(ranks[victim], signal.SIGKILL)
        process.communicate(timeout=240)  # a rank that waited for the other one would wait for half an hour
    assert process.returncode != 0
    assert not set(ranks) & set(ray_processes.parents())
    state = state_path(out).stat().st_mtime_ns
    with run_process([*command(recording, out, config), "--resume"], env=ENVIRONMENT) as process:
        wait_until(lambda: state_path(out).stat().st_mtime_ns != state or process.poll() is not None, limit_s=240)
        assert process.poll() is None, process.stderr.read()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=240)
    assert "--resume goes on from here" in said
