"""The loader: its settings change the speed only."""

import dataclasses
import threading
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
import torch

from retrieval.data.dataset import load_grasps
from retrieval.data.loading import map_in_order, prefetch, worker_count
from retrieval.data.pairs import PairSampler
from retrieval.errors import ConfigError
from retrieval.model.config import Config, load_config
from retrieval.training.batches import TrainedFeatures
from tests.conftest import TINY
from tests.retrieval.training.test_train import same_weights, trainer_for, with_training

SLOW = {"workers": 1, "prefetch": 1, "pinned_memory": False}
FAST = {"workers": 3, "prefetch": 4, "pinned_memory": True}


def test_batches_and_trained_weights_are_bit_equal_for_all_loader_settings(recording, tmp_path):
    made = []
    for name, settings in (("slow", SLOW), ("fast", FAST)):
        config = with_training(TINY, **settings)
        with TrainedFeatures(config, torch.device("cpu")) as source:
            loaded = source.prepare(None, PairSampler(load_grasps(recording), seed=0).batch(0, 6)).result()
        trainer = trainer_for(recording, tmp_path / f"{name}.safetensors", config)
        trainer.run(quiet=True)
        made.append((loaded, trainer.matcher.state_dict()))
    (slow, weights), (fast, others) = made
    assert torch.equal(slow.touches, fast.touches)
    assert torch.equal(slow.photos, fast.photos)
    assert same_weights(weights, others)
    assert (tmp_path / "slow.safetensors").read_bytes() == (tmp_path / "fast.safetensors").read_bytes()


def test_a_training_resumes_with_other_loader_settings(recording, tmp_path):
    out = tmp_path / "m.safetensors"
    first = trainer_for(recording, out, with_training(TINY, **SLOW))
    first._validate_and_save()
    other = trainer_for(recording, out, with_training(TINY, **FAST))
    other.resume()
    assert first.config == other.config


@pytest.mark.parametrize("depth", [1, 3])
def test_results_are_in_order_while_depth_later_ones_are_prepared(depth):
    started = []

    def work(number):
        started.append(number)
        done = Future()
        done.set_result(number)
        return done

    for number, result in enumerate(prefetch(map(work, range(6)), depth)):
        assert result == number
        assert started == list(range(min(6, number + depth + 1)))


def test_the_configured_number_of_workers_load_at_once():
    together = threading.Barrier(3, timeout=10)
    with ThreadPoolExecutor(3) as pool:
        assert list(map_in_order(pool, lambda item: (together.wait(), item)[1], range(6))) == list(range(6))


def test_auto_is_one_worker_for_each_core_of_a_rank(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(8)), raising=False)
    assert (worker_count("auto"), worker_count(3)) == (8, 3)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert worker_count("auto") == 2
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "16")
    assert worker_count("auto") == 1


def test_a_file_configures_the_loader_and_a_checkpoint_does_not_store_its_settings(tmp_path):
    file = tmp_path / "loader.toml"
    file.write_text("[training]\nworkers = 4\nprefetch = 3\npinned_memory = false\n")
    training = load_config(str(file)).training
    assert (training.workers, training.prefetch, training.pinned_memory) == (4, 3, False)
    assert not {"workers", "prefetch", "pinned_memory"} & training.to_dict().keys()
    file.write_text('[training]\nworkers = "auto"\n')
    assert load_config(str(file)).training.workers == "auto"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"workers": 0}, "training.workers must be a whole number >= 1, got 0"),
        ({"workers": "many"}, "training.workers must be \"auto\" or a whole number >= 1, got 'many'"),
        ({"workers": True}, "training.workers must be a whole number or a text in quotes, got True"),
        ({"prefetch": 0}, "training.prefetch must be a whole number >= 1, got 0"),
        ({"pinned_memory": 1}, "training.pinned_memory must be true or false, got 1"),
    ],
)
def test_an_invalid_loader_setting_is_refused(settings, message):
    with pytest.raises(ConfigError) as refused:
        Config.from_dict({"training": settings})
    assert str(refused.value) == message


def test_a_training_reports_the_speed_of_the_loader_and_the_towers_once(recording, tmp_path, capsys):
    trainer_for(recording, tmp_path / "m.safetensors", with_training(TINY, workers=2)).run()
    lines = [line for line in capsys.readouterr().err.splitlines() if "loader:" in line]
    assert len(lines) == 1
    assert "loader: 2 worker(s) can decode" in lines[0]
    assert "images/s; the towers take" in lines[0]
    frozen = dataclasses.replace(with_training(TINY, freeze_towers=True))
    trainer_for(recording, tmp_path / "frozen.safetensors", frozen).run()
    assert "loader:" not in capsys.readouterr().err
