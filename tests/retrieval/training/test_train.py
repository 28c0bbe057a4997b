"""Training: shared images, bit-exact resumption, interruption, frozen towers, and several ranks."""

import dataclasses
import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn import functional

from retrieval.data.dataset import Split, load_grasps, make_split
from retrieval.data.pairs import PairSampler
from retrieval.errors import CheckpointError, ConfigError, DatasetError, JobInterrupted
from retrieval.model.checkpoint import load_checkpoint, read_tensors
from retrieval.model.fusion import Matcher
from retrieval.model.losses.listwise import contrastive_loss, listwise_loss
from retrieval.model.losses.loss import Loss, match_loss
from retrieval.training import distributed
from retrieval.training.batches import FrozenFeatures, TrainedFeatures
from retrieval.training.initial_weights import build_matcher
from retrieval.training.loop import state_path
from retrieval.training.train import Trainer, WeightedLosses, batch_loss, set_training_mode, shuffle_fingers, train
from tests.conftest import TINY
from tests.waiting import run_process, wait_until

CPU = torch.device("cpu")


def with_training(config, **changes):
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **changes))


def load(source, batch, step=0):
    """Return the loaded batch of a step."""
    return next(iter(source.batches(None, [(step, batch)])))


def trainer_for(recording, out, config=TINY):
    grasps = load_grasps(recording)
    return Trainer(config, make_split(grasps, validation=0.25, test=0.2, seed=0), grasps, out, source="test")


def same_weights(left, right):
    return all(torch.equal(left[name], right[name]) for name in left)


def test_each_distinct_image_passes_through_its_tower_once(recording, tmp_path, monkeypatch):
    trainer = trainer_for(recording, tmp_path / "m.safetensors")
    batch = trainer.sampler.batch(0, 4)
    assert len(batch.labels) == 16  # pairs of 4 touches and at most 16 photos
    counts = {"touch": 0, "photo": 0}
    for name, tower in (("touch", trainer.matcher.touch_tower), ("photo", trainer.matcher.photo_tower)):
        tower.register_forward_hook(
            lambda _, images, __, name=name: counts.update({name: counts[name] + len(images[0])})
        )
    trainer.loss(0, load(trainer.features, batch))
    assert counts == {"touch": 2 * 4, "photo": len(set(batch.photos))}


def test_the_loss_of_a_batch_is_the_mean_over_its_single_pairs(recording):
    """Without the contrastive term and dropout, the loss is exactly the paper's."""
    config = with_training(TINY, weights={}, precision="float32")
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, standardise=False, dropout=0.0))
    torch.manual_seed(0)
    matcher = build_matcher(config)
    sampler = PairSampler(load_grasps(recording), seed=0)
    source = TrainedFeatures(config, CPU)
    loaded = load(source, sampler.batch(0, 3))
    losses = WeightedLosses(config.training.weights, matcher, 9)
    loss = batch_loss(matcher, losses, loaded.batch, *source.train_features(matcher, loaded))
    batch = loaded.batch
    one_by_one = torch.cat(
        [
            matcher(loaded.touches[touch][None], loaded.photos[photo][None])
            for touch, photo in zip(batch.touch_index, batch.photo_index, strict=True)
        ]
    )
    torch.testing.assert_close(loss, match_loss(one_by_one, torch.from_numpy(batch.labels)), rtol=1e-5, atol=1e-6)


def test_each_loss_is_added_with_its_weight(recording):
    config = with_training(TINY, weights={"contrastive": 0.3, "listwise": 0.7}, precision="float32")
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, dropout=0.0))
    torch.manual_seed(0)
    matcher = build_matcher(config)
    source = TrainedFeatures(config, CPU)
    loaded = load(source, PairSampler(load_grasps(recording), seed=0).batch(0, 3))
    features = [part.detach() for part in source.train_features(matcher, loaded)]
    matcher.eval()
    loss = batch_loss(matcher, WeightedLosses(config.training.weights, matcher, 9), loaded.batch, *features)
    touch, photo = matcher.touch_encoding(features[0]), matcher.photo_encoding(features[1])
    logits = matcher.head(touch.partial[loaded.batch.touch_index], photo.partial[loaded.batch.photo_index])
    objects = torch.from_numpy(loaded.batch.touch_objects), torch.from_numpy(loaded.batch.photo_objects)
    expected = match_loss(logits, torch.from_numpy(loaded.batch.labels))
    expected = expected + 0.3 * contrastive_loss(touch.embedding, photo.embedding, *objects, matcher.log_scale)
    expected = expected + 0.7 * listwise_loss(matcher.head(touch.partial[:, None], photo.partial[None]), *objects)
    assert loss.item() == expected.item()


class Proxies(Loss):
    """A loss with a random matrix as its parameter."""

    def __init__(self, embedding_dim, objects):
        super().__init__(embedding_dim, objects)
        self.proxies = nn.Embedding(objects, embedding_dim)

    def forward(self, batch):
        return functional.cross_entropy(batch.touch.embedding @ self.proxies.weight.T, batch.touch_objects)


OWN = TINY.using(losses={"contrastive": 0.5, Proxies: 0.5})


def test_the_parameters_of_a_loss_are_trained_and_not_stored_in_the_checkpoint(recording, tmp_path):
    trainer = trainer_for(recording, tmp_path / "m.safetensors", OWN)
    assert list(trainer.losses.weights) == ["contrastive", f"{__name__}:Proxies"]
    first = {name: tensor.clone() for name, tensor in trainer.losses.state_dict().items()}
    assert first["terms.1.proxies.weight"].shape == (len(trainer.split.train), 16)
    trainer.run(quiet=True)
    assert all(not torch.equal(first[name], now) for name, now in trainer.losses.state_dict().items())
    tensors, header = read_tensors(tmp_path / "m.safetensors")
    assert not [name for name in tensors if "proxies" in name or "terms" in name]
    assert header["config"]["training"][f"{__name__}:Proxies_weight"] == 0.5
    assert load_checkpoint(tmp_path / "m.safetensors").config.has_embeddings


def test_a_loss_with_parameters_resumes_bit_for_bit(recording, tmp_path):
    whole, parts = trainer_for(recording, tmp_path / "a.safetensors", OWN), tmp_path / "b.safetensors"
    whole.run(quiet=True)
    broken = trainer_for(recording, parts, OWN)
    with pytest.raises(RuntimeError, match="power cut"):
        stop_after(broken, 3)
    resumed = trainer_for(recording, parts, OWN)
    resumed.run(quiet=True)
    assert same_weights(whole.losses.state_dict(), resumed.losses.state_dict())
    assert same_weights(whole.matcher.state_dict(), resumed.matcher.state_dict())


def test_an_unknown_loss_is_refused_before_an_image_is_read(recording, tmp_path):
    config = with_training(TINY, weights={"triplet": 1.0})
    with pytest.raises(ConfigError, match="loss must be one of contrastive, listwise, pooled_listwise; got 'triplet'"):
        train(recording, tmp_path / "m.safetensors", config, quiet=True)


def test_a_contrastive_weight_of_zero_leaves_the_projections_unchanged(recording, tmp_path):
    out = tmp_path / "m.safetensors"
    train(recording, out, with_training(TINY, weights={}), quiet=True)
    torch.manual_seed(TINY.training.seed)
    first = build_matcher(TINY).state_dict()
    last = load_checkpoint(out).matcher.state_dict()
    assert torch.equal(first["touch_projection.weight"], last["touch_projection.weight"])
    assert torch.equal(first["log_scale"], last["log_scale"])
    assert not torch.equal(first["head.second.weight"], last["head.second.weight"])


def test_a_resumed_training_gives_the_bits_of_an_uninterrupted_one(recording, tmp_path):
    whole, parts = trainer_for(recording, tmp_path / "a.safetensors"), tmp_path / "b.safetensors"
    whole.run(quiet=True)
    broken = trainer_for(recording, parts)
    with pytest.raises(RuntimeError, match="power cut"):
        stop_after(broken, 3)
    resumed = trainer_for(recording, parts)
    resumed.run(quiet=True)
    assert same_weights(whole.matcher.state_dict(), resumed.matcher.state_dict())
    assert (tmp_path / "a.safetensors").read_bytes() == parts.read_bytes()
    assert not state_path(parts).exists()


WITH_ENCODER = dataclasses.replace(
    with_training(TINY, distil_steps=4), matcher=dataclasses.replace(TINY.matcher, candidate_width=8)
)
WITHOUT_ENCODER = dataclasses.replace(WITH_ENCODER, matcher=TINY.matcher)


def test_a_candidate_encoder_is_distilled_after_the_last_step_and_queries_are_stored(recording, tmp_path):
    trainer = trainer_for(recording, tmp_path / "m.safetensors", WITH_ENCODER)
    made = trainer.run(quiet=True)
    assert made.config == WITH_ENCODER
    assert made.matcher.candidate_encoder is not None
    assert made.queries.shape == (len(trainer.validation.grasps), WITH_ENCODER.matcher.partial_width)
    assert not state_path(trainer.out).exists()


def test_a_candidate_encoder_changes_no_other_weights(recording, tmp_path):
    for name, config in (("a", WITH_ENCODER), ("b", TINY)):
        trainer_for(recording, tmp_path / f"{name}.safetensors", config).run(quiet=True)
    distilled, plain = (load_checkpoint(tmp_path / f"{name}.safetensors").matcher.state_dict() for name in "ab")
    assert same_weights(plain, distilled)
    assert {name.split(".")[0] for name in distilled.keys() - plain.keys()} == {"candidate_encoder"}


def power_cut(*_, **__):
    raise RuntimeError("power cut")


def power_cut_before_deleting(path):
    unlink = Path.unlink

    def guarded(file, missing_ok=False):
        return power_cut() if file == path else unlink(file, missing_ok)

    return guarded


@pytest.mark.parametrize(
    "where", ["while the candidate encoder is trained", "before the state is deleted", "at the posterior"]
)
def test_a_power_cut_after_the_last_step_changes_no_bit(where, recording, tmp_path, monkeypatch):
    """The cut comes before the complete checkpoint is written, or after that, while the state still exists."""
    trainer_for(recording, tmp_path / "a.safetensors", WITH_ENCODER).run(quiet=True)
    broken = trainer_for(recording, tmp_path / "b.safetensors", WITH_ENCODER)
    with monkeypatch.context() as cut:
        if where == "before the state is deleted":
            cut.setattr(Path, "unlink", power_cut_before_deleting(state_path(broken.out)))
        else:
            in_distillation = where == "while the candidate encoder is trained"
            step = "distil.distillation_loss" if in_distillation else "train.calibrate_checkpoint"
            cut.setattr(f"retrieval.training.{step}", power_cut)
        with pytest.raises(RuntimeError, match="power cut"):
            broken.run(quiet=True)
    assert (load_checkpoint(broken.out).matcher.candidate_encoder is not None) == (
        where == "before the state is deleted"
    )
    resumed = trainer_for(recording, broken.out, WITH_ENCODER)
    resumed.loss = lambda *_: pytest.fail("made a step")
    resumed.run(quiet=True)
    assert (tmp_path / "a.safetensors").read_bytes() == broken.out.read_bytes()
    assert not state_path(broken.out).exists()


@pytest.mark.parametrize("step", ["distil.distillation_loss", "train.calibrate_checkpoint"])
def test_ctrl_c_after_the_last_step_leaves_a_usable_checkpoint_that_resuming_completes(
    step, recording, tmp_path, monkeypatch
):
    whole, broken = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    train(recording, whole, WITH_ENCODER, quiet=True)
    module, name = step.split(".")
    function = getattr(import_module(f"retrieval.training.{module}"), name)
    message = r"can already rank photos; run the same command"
    with monkeypatch.context() as interrupting:
        interrupting.setattr(f"retrieval.training.{step}", interrupted_before(function))
        with pytest.raises(JobInterrupted, match=message):
            train(recording, broken, WITH_ENCODER, quiet=True)
    left = load_checkpoint(broken)
    assert (left.config, left.posterior) == (WITHOUT_ENCODER, None)
    assert state_path(broken).exists()
    made = train(recording, broken, WITH_ENCODER, quiet=True)
    assert made.config == WITH_ENCODER
    assert made.posterior is not None
    assert whole.read_bytes() == broken.read_bytes()
    assert not state_path(broken).exists()


def interrupted_before(function):
    """Return a function that sends Ctrl-C and then calls `function`."""

    def interrupted(*arguments, **keywords):
        os.kill(os.getpid(), signal.SIGINT)
        return function(*arguments, **keywords)

    return interrupted


def stop_after(trainer, steps):
    """Run and fail like a power cut in the step after `steps`, when the state of that step is on disk."""
    loss = trainer.loss

    def failing(step, loaded):
        if step == steps:
            raise RuntimeError("power cut")
        return loss(step, loaded)

    trainer.loss = failing
    trainer.run(quiet=True)


def test_an_unfinished_training_is_neither_overwritten_nor_continued_by_another(recording, tmp_path):
    out = tmp_path / "m.safetensors"
    with pytest.raises(RuntimeError, match="power cut"):
        stop_after(trainer_for(recording, out), 3)
    with pytest.raises(CheckpointError, match=r"another config; .* delete the file"):
        train(recording, out, with_training(TINY, learning_rate=1e-4), quiet=True)


def test_ctrl_c_leaves_a_usable_checkpoint_and_a_state_to_resume(recording, tmp_path):
    trainer = trainer_for(
        recording, tmp_path / "m.safetensors", with_training(TINY, iterations=1000, validate_every=900)
    )
    loss = trainer.loss

    def interrupted(step, loaded):
        if step == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return loss(step, loaded)

    trainer.loss = interrupted
    with pytest.raises(JobInterrupted, match=r"step 2 of 1000.*run the same command to continue"):
        trainer.run(quiet=True)
    assert load_checkpoint(tmp_path / "m.safetensors").provenance["step"] == 2
    assert state_path(tmp_path / "m.safetensors").exists()


def test_frozen_towers_encode_each_image_once_and_do_not_change(recording, tmp_path):
    config = with_training(TINY, freeze_towers=True)
    # ResNet-18 has batch statistics, which would change if a tower were ever in training mode.
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, tower="resnet18"))
    trainer = trainer_for(recording, tmp_path / "m.safetensors", config)
    before = {name: value.clone() for name, value in trainer.matcher.photo_tower.state_dict().items()}
    counts = []
    trainer.matcher.photo_tower.register_forward_hook(lambda _, images, __: counts.append(len(images[0])))
    trainer.run(quiet=True)
    assert isinstance(trainer.features, FrozenFeatures)
    assert same_weights(before, trainer.matcher.photo_tower.state_dict())
    known = {photo for part in trainer.sampler.photos for photo in part} | set(trainer.validation.photos)
    assert sum(counts) <= len(known)


def test_frozen_batch_norm_keeps_its_running_statistics(recording):
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, tower="resnet18"))
    matcher = Matcher(config.matcher)
    before = matcher.photo_tower.bn1.running_mean.clone()
    set_training_mode(matcher, dataclasses.replace(config.training, freeze_batch_norm=True))
    matcher.photo_tower(torch.rand(2, 3, 32, 32))
    assert torch.equal(before, matcher.photo_tower.bn1.running_mean)
    set_training_mode(matcher, config.training)
    matcher.photo_tower(torch.rand(2, 3, 32, 32))
    assert not torch.equal(before, matcher.photo_tower.bn1.running_mean)


def test_training_reads_the_number_of_fingers_from_the_recording(model):
    assert load_checkpoint(model).config.matcher.fingers == 2


def test_a_background_policy_needs_no_contact_frames(recording, tmp_path):
    grasps = [dataclasses.replace(grasp, backgrounds=()) for grasp in load_grasps(recording)]
    config = dataclasses.replace(TINY, preprocessing=dataclasses.replace(TINY.preprocessing, background="difference"))
    split = make_split(grasps, validation=0.25, test=0.2, seed=0)
    with pytest.raises(DatasetError, match="no-contact frame for each finger"):
        Trainer(config, split, grasps, tmp_path / "m.safetensors", source="test").run(quiet=True)
    train(recording, tmp_path / "n.safetensors", with_training(config, iterations=1), quiet=True)


def test_bfloat16_is_refused_where_it_would_be_emulated(recording, tmp_path, monkeypatch):
    monkeypatch.setattr("retrieval.model.encode.has_fast_bfloat16", lambda device: False)
    with pytest.raises(ConfigError, match="bfloat16 needs hardware"):
        train(recording, tmp_path / "m.safetensors", with_training(TINY, precision="bfloat16"), quiet=True)


def test_a_diverging_training_is_an_error_and_writes_nothing(recording, tmp_path):
    from retrieval.errors import NumericalError

    trainer = trainer_for(recording, tmp_path / "m.safetensors")
    with torch.no_grad():
        trainer.matcher.head.out.bias.fill_(torch.nan)
    with pytest.raises(NumericalError, match="lower learning_rate"):
        trainer.run(quiet=True)
    assert not (tmp_path / "m.safetensors").exists()


GRADIENTS = """
import sys, torch
from pathlib import Path
from retrieval.training import distributed
from retrieval.training.batches import TrainedFeatures
from retrieval.data.dataset import load_grasps
from retrieval.data.pairs import PairSampler
from retrieval.model.losses.listwise import contrastive_loss
from retrieval.training.initial_weights import build_matcher
from retrieval.training.train import WeightedLosses, batch_loss, set_training_mode
from tests.conftest import TINY
from tests.retrieval.training.test_train import load, with_training

torch.set_num_threads(1)
distributed.start()
torch.manual_seed(0)
# With bfloat16 hardware, towers in training would round differently in batches of another size.
config = with_training(TINY, precision="float32")
matcher = build_matcher(config)
set_training_mode(matcher, config.training)
losses = WeightedLosses(config.training.weights, matcher, 9)


def contrastive(touch, photo, touch_objects, photo_objects):
    objects = torch.from_numpy(touch_objects), torch.from_numpy(photo_objects)
    touch, photo = matcher.touch_encoding(touch).embedding, matcher.photo_encoding(photo).embedding
    return contrastive_loss(touch, photo, *objects, matcher.log_scale)


def loss(loaded):
    batch = loaded.batch
    if sys.argv[3] == "local":  # the naive way: every rank's loss uses its own images only
        touches, photos = (distributed.rank_rows(len(rows)) for rows in (batch.grasps, batch.photos))
        touch, photo = matcher.touch_features(loaded.touches), matcher.photo_features(loaded.photos)
        return contrastive(touch, photo, batch.touch_objects[touches], batch.photo_objects[photos])
    touch, photo = source.train_features(matcher, loaded)
    if sys.argv[3] == "contrast":
        return contrastive(touch, photo, batch.touch_objects, batch.photo_objects)
    return batch_loss(matcher, losses, batch, touch, photo)


source = TrainedFeatures(config, torch.device("cpu"))
loaded = load(source, PairSampler(load_grasps(Path(sys.argv[1])), seed=0).batch(0, 5))
torch.manual_seed(1)
averaged = distributed.averaging_gradients(torch.nn.ModuleList([matcher, losses]), loss)
averaged(loaded).backward()
if distributed.rank() == 0:
    torch.save({name: value.grad for name, value in matcher.named_parameters() if value.grad is not None}, sys.argv[2])
distributed.stop()
"""


def gradients(recording, tmp_path, ranks, loss):
    """Return the gradients of one batch, computed by `ranks` ranks."""
    script, out = tmp_path / "gradients.py", tmp_path / f"{loss}{ranks}.pt"
    script.write_text(GRADIENTS)
    run_ranks(script, ranks, recording, out, loss)
    return torch.load(out, weights_only=True)


def difference(ours, reference):
    """Return the largest difference of a gradient, relative to the largest gradient."""
    scale = max(float(value.abs().max()) for value in reference.values())
    return max(float((ours[name] - reference[name]).abs().max()) for name in reference) / scale


@pytest.mark.slow
def test_two_ranks_have_the_gradient_of_one_process(recording, tmp_path):
    one, two = (gradients(recording, tmp_path, ranks, "all") for ranks in (1, 2))
    assert difference(two, one) < 1e-5  # float32, summed in another order


@pytest.mark.slow
def test_negatives_of_one_rank_alone_would_give_another_gradient(recording, tmp_path):
    reference = gradients(recording, tmp_path, 1, "contrast")
    assert difference(gradients(recording, tmp_path, 2, "contrast"), reference) < 1e-5
    assert difference(gradients(recording, tmp_path, 2, "local"), reference) > 0.1


@pytest.mark.parametrize(
    ("negatives", "frozen", "shared"),
    [("auto", False, True), ("auto", True, False), ("dataset", False, False), ("batch", True, True)],
)
def test_negatives_come_from_the_batch_or_the_whole_set_as_configured(recording, tmp_path, negatives, frozen, shared):
    config = with_training(TINY, negatives=negatives, freeze_towers=frozen)
    assert trainer_for(recording, tmp_path / "m.safetensors", config).sampler.share_photos is shared


def test_without_validation_objects_the_checkpoint_is_the_last_step_without_a_posterior(recording, tmp_path):
    config = with_training(TINY, validation_fraction=0.0, iterations=4, validate_every=3)
    made = train(recording, tmp_path / "m.safetensors", config, quiet=True)
    assert made.split.validation == ()
    assert len(made.split.train) + len(made.split.test) == 12
    assert made.provenance["step"] == 4
    assert made.posterior is None


def run_ranks(script, ranks, *arguments):
    """Run a script on `ranks` ranks."""
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)] if ranks > 1 else []
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *torchrun, str(script), *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("settings", [{}, {"freeze_batch_norm": True}, {"freeze_towers": True}])
def test_ranks_of_cpus_must_freeze_batch_norm(settings, recording, tmp_path, monkeypatch):
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, tower="resnet18"))
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    refusal = nullcontext() if settings else pytest.raises(ConfigError, match=r"2 ranks on CPUs.*freeze_batch_norm")
    with refusal:
        trainer_for(recording, tmp_path / "m.safetensors", with_training(config, **settings))


TINY_TOML = """
[matcher]
tower = "small"
tower_output = "pooled"
hidden = 16
candidate_width = 8
embedding_dim = 8
standardise = true
[training]
init = "random"
iterations = 40
touches_per_batch = 2
distil_steps = 3
validate_every = 30
validation_fraction = 0.25
contrastive_weight = 1.0
[preprocessing]
touch_px = 32
photo_px = 32
"""


@pytest.mark.slow
def test_two_ranks_train_from_the_command_line_and_stop_together(recording, tmp_path):
    """A rank that left before the files are written, or stopped at another step, would make the other fail."""
    out, config = tmp_path / "m.safetensors", tmp_path / "tiny.toml"
    config.write_text(TINY_TOML.replace("iterations = 40", "iterations = 100000"))
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, "-m", "retrieval", "train", str(recording), "--out", str(out), "--config", str(config)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
    with run_process(command, env=environment) as process:
        wait_until(lambda: state_path(out).exists() or process.poll() is not None, limit_s=240)
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=240)
    assert "run the same command to continue" in output
    stopped = read_tensors(state_path(out))[1]["step"]
    assert stopped > 0
    # In a new, short training, no rank finds files before the other has written them.
    config.write_text(TINY_TOML.replace("iterations = 40", "iterations = 2"))
    state_path(out).unlink()
    out.unlink()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    made = load_checkpoint(out)
    assert made.provenance["step"] == 2
    assert made.matcher.candidate_encoder is not None


def test_a_split_that_leaks_or_lacks_objects_is_refused(recording, tmp_path):
    names = sorted({grasp.object_id for grasp in load_grasps(recording)})
    bad = {
        "shares 1 object": Split(0, tuple(names[:6]), tuple(names[5:9]), ()),
        "2 objects in the train part.*has 0": Split(0, ("nothing", "known"), tuple(names), ()),
        "2 objects in the validation part.*has 1": Split(0, tuple(names[:6]), (names[6], "unknown"), ()),
    }
    for message, split in bad.items():
        with pytest.raises(DatasetError, match=message):
            train(recording, tmp_path / "m.safetensors", TINY, split=split, quiet=True)


@pytest.mark.parametrize("name", ["folder", "model.md", "file/model.safetensors"])
def test_a_checkpoint_that_cannot_be_written_is_an_error_before_the_first_step(recording, tmp_path, monkeypatch, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    monkeypatch.setattr(Trainer, "loss", lambda *_: pytest.fail("trained"))
    message = r"is a folder; name the file|must be named \*.safetensors|cannot be written"
    with pytest.raises(CheckpointError, match=message):
        train(recording, tmp_path / name, TINY, quiet=True)


@pytest.mark.slow
def test_a_killed_training_resumes_from_its_last_state(recording, tmp_path):
    """The system sends SIGKILL to a training on the command line."""
    out = tmp_path / "m.safetensors"
    config = tmp_path / "tiny.toml"
    config.write_text(TINY_TOML.replace("validate_every = 30", "validate_every = 5"))
    command = [sys.executable, "-m", "retrieval", "train", str(recording), "--out", str(out), "--config", str(config)]
    with run_process(command) as process:
        wait_until(lambda: state_path(out).exists() or process.poll() is not None, limit_s=240)
    assert state_path(out).exists()
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(out).provenance["step"] > 0


def test_fingers_are_shuffled_within_a_touch_by_the_seed():
    features = torch.arange(24.0).view(4, 6)  # four touches of two fingers with three features
    torch.manual_seed(3)
    shuffled = shuffle_fingers(features, fingers=2)
    torch.manual_seed(3)
    assert torch.equal(shuffled, shuffle_fingers(features, fingers=2))
    swapped = features.view(4, 2, 3).flip(1).flatten(1)
    same, other = (shuffled == features).all(1), (shuffled == swapped).all(1)
    assert (same ^ other).all()
    repeated = torch.cat([shuffle_fingers(features, fingers=2) for _ in range(50)])
    assert 60 < int((repeated == swapped.repeat(50, 1)).all(1).sum()) < 140
    assert torch.equal(shuffle_fingers(features, fingers=1), features)


def test_training_continues_from_the_towers_and_the_head_of_a_checkpoint(model):
    """The initial weights that the checkpoint replaces are not read, so they need not be there."""
    started = build_matcher(with_training(TINY, start=str(model), init="missing.safetensors")).state_dict()
    assert same_weights(started, load_checkpoint(model).matcher.state_dict())


def test_a_checkpoint_with_layers_of_another_size_cannot_start_a_training(model):
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, hidden=64))
    with pytest.raises(CheckpointError, match=r"head\.\S+ is .*, must be"):
        build_matcher(with_training(config, start=str(model)))


def test_a_checkpoint_with_other_towers_cannot_start_a_training(model):
    """Otherwise the towers would keep random weights, if the other layers have the same sizes."""
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, tower="resnet18"))
    with pytest.raises(CheckpointError, match=r"it has no touch_tower\.\S+; use its configuration"):
        build_matcher(with_training(config, start=str(model)))


def test_the_towers_learn_at_their_own_rate(recording, tmp_path):
    """Adam's first step moves each weight by its learning rate, whatever the gradient."""
    config = with_training(TINY, iterations=1, tower_rate=0.25)
    trainer = trainer_for(recording, tmp_path / "m.safetensors", config)
    before = {name: tensor.clone() for name, tensor in trainer.matcher.named_parameters()}
    trainer.run(quiet=True)
    moved = {
        name: float((tensor - before[name]).abs().max().detach()) / config.training.learning_rate
        for name, tensor in trainer.matcher.named_parameters()
    }
    assert moved["touch_tower.stages.0.weight"] == pytest.approx(0.25, rel=0.01)
    assert moved["head.second.weight"] == pytest.approx(1.0, rel=0.01)
