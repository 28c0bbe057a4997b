"""The paper's training run: it continues after Ctrl-C, and says how long it will take."""

import os
import signal

from models import paper
from retrieval.training.loop import state_path

STEPS = 24
TINY = f"""
[matcher]
tower = "small"
tower_output = "pooled"
hidden = 32
[training]
init = "random"
iterations = {STEPS}
touches_per_batch = 2
validation_fraction = 0.25
test_fraction = 0.42
[preprocessing]
touch_px = 32
photo_px = 48
"""


def test_an_interrupted_run_continues_to_the_same_checkpoint_and_both_runs_print_their_estimates(
    recording, tmp_path, monkeypatch, capsys
):
    (tmp_path / "tiny.toml").write_text(TINY)
    words = [str(recording), "--config", str(tmp_path / "tiny.toml"), "--out"]
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    commands = []
    monkeypatch.setattr(paper, "run_command", lambda words: commands.append(words) or 0)
    assert paper.main([*words, str(whole)]) == 0
    printed = capsys.readouterr()
    assert f"{STEPS} steps take at least" in printed.err
    assert f"s: {STEPS} steps take" in printed.err
    ((command, evaluated, *_),) = commands
    assert (command, evaluated) == ("evaluate", str(recording))
    with monkeypatch.context() as patch:
        loss = paper.Trainer.loss

        def interrupted(self, step, loaded):
            if step == 9:
                os.kill(os.getpid(), signal.SIGINT)
            return loss(self, step, loaded)

        patch.setattr(paper.Trainer, "loss", interrupted)
        assert paper.main([*words, str(parts)]) == 1
    assert f"Stopped at step 10 of {STEPS}" in capsys.readouterr().err
    assert state_path(parts).exists()
    monkeypatch.setattr(paper, "TIMED_STEPS", 5)
    assert paper.main([*words, str(parts)]) == 0
    assert f"s: {STEPS} steps take" in capsys.readouterr().err
    assert whole.read_bytes() == parts.read_bytes()
