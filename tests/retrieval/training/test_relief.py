"""Pretraining of a tower on labelled pictures, and its weights in a matcher."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from retrieval.commands.main import main
from retrieval.data.labelled_pictures import load_labelled
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import CheckpointError, ConfigError, DatasetError
from retrieval.model.checkpoint import read_tensors
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.training import relief
from retrieval.training.augmentation import augment
from retrieval.training.initial_weights import build_matcher
from retrieval.training.relief import centre_crop, train_relief

CONFIG = Config(
    MatcherConfig(tower="small", tower_output="pooled", hidden=8),
    TrainingConfig(init="random", precision="float32"),
    Preprocessing(touch_px=32, photo_px=40, background="difference+0.5"),
)


def write_pictures(folder, kind="photo", objects=24):
    """Write a picture of stripes or squares for each object, with pitches of 8 to 16 pixels."""
    (folder / "images").mkdir(parents=True)
    (folder / "pictures.json").write_text(json.dumps({"schema_version": 1, "kind": kind, "seed": 0}))
    rng, lines = np.random.default_rng(0), []
    for number in range(objects):
        pitch, squares = 8 + number % 9, number % 2 == 0
        y, x = np.mgrid[:96, :96]
        waves = np.sign(np.sin(2 * np.pi * (x + rng.integers(20)) / pitch))
        if squares:
            waves = waves * np.sign(np.sin(2 * np.pi * (y + rng.integers(20)) / pitch))
        picture = np.clip(128 + 60 * waves + rng.normal(0, 5, waves.shape), 0, 255).astype(np.uint8)
        row = {"object_id": f"thing-{number}", "relief": "squares" if squares else "stripes"}
        row |= {"file_name": f"images/{number}.png", "pitch_mm": float(pitch), "amplitude_mm": 1.0}
        row |= {"shape": "box" if number % 3 else "tube", "aspect": 1.0 + number % 4, "sharpness": 0.3}
        cv2.imwrite(str(folder / row["file_name"]), np.repeat(picture[..., None], 3, axis=2))
        if kind == "touch":
            row |= {"finger": "a", "before_file_name": f"images/{number}-before.png"}
            cv2.imwrite(str(folder / row["before_file_name"]), np.full((96, 96, 3), 128, np.uint8))
        lines.append(json.dumps(row) + "\n")
    (folder / "metadata.jsonl").write_text("".join(lines))
    return folder


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(relief, "BATCH", 8)
    monkeypatch.setattr(relief, "VALIDATION", 0.25)


@pytest.mark.parametrize("kind", ["photo", "touch"])
def test_families_are_recognised_on_held_out_objects(quick, tmp_path, kind):
    folder = write_pictures(tmp_path / "pictures", kind, objects=40)
    report = train_relief(folder, tmp_path / "tower.safetensors", CONFIG, iterations=60, quiet=True)
    assert (report.kind, report.objects, report.steps) == (kind, 40, 60)
    assert report.families["relief"][0] >= 0.9
    assert [chance for _, chance in report.families.values()] == [0.5, 0.5]
    assert report.sizes["sharpness"] == 0.0  # it does not vary


def test_training_uses_touches_with_and_without_background_and_evaluation_the_matchers_policy(tmp_path):
    kind, pictures = load_labelled(write_pictures(tmp_path / "pictures", "touch"))
    for policy in ("difference+0.5", "none"):
        settings = dataclasses.replace(CONFIG.preprocessing, background=policy)
        training = relief.ReliefTraining(kind, pictures, dataclasses.replace(CONFIG, preprocessing=settings), 1)
        evaluated = training._images(pictures[:1])
        expected = settings.load_touch(pictures[0].file, pictures[0].before)
        assert np.abs(evaluated[0].permute(1, 2, 0).numpy() - expected).max() < 1 / 255
        images = training._images(pictures[:1] * 40, np.random.default_rng(0))
        same = [torch.equal(one, evaluated[0]) for one in images]
        assert 10 < sum(same) < 30
        assert len({float(one.mean()) for one in images}) == 2


@pytest.mark.parametrize("side", ["photo", "touch"])
def test_the_weights_initialise_only_the_tower_of_their_side(quick, tmp_path, side):
    folder, out = write_pictures(tmp_path / "pictures", side), tmp_path / "tower.safetensors"
    train_relief(folder, out, CONFIG, iterations=3, quiet=True)
    training = dataclasses.replace(CONFIG.training, **{f"init_{side}": str(out)})
    made = build_matcher(dataclasses.replace(CONFIG, training=training))
    pretrained = read_tensors(out)[0]
    towers = {"photo": made.photo_tower.state_dict(), "touch": made.touch_tower.state_dict()}
    other = towers.pop("touch" if side == "photo" else "photo")
    for name, tensor in towers[side].items():
        torch.testing.assert_close(tensor, pretrained[name], rtol=0, atol=0)
    assert any(not torch.equal(other[name], pretrained[name]) for name in pretrained)


def test_an_interrupted_training_ends_like_an_uninterrupted_one(quick, tmp_path, monkeypatch):
    folder = write_pictures(tmp_path / "pictures")
    train_relief(folder, tmp_path / "whole.safetensors", CONFIG, iterations=8, quiet=True)
    monkeypatch.setattr(relief, "SAVE_EVERY", 3)
    steps, loss = [], relief.ReliefTraining._loss

    def fail_at_step_6(self, batch):
        steps.append(self.step)
        if len(steps) == 6:
            raise RuntimeError("the power failed")
        return loss(self, batch)

    out = tmp_path / "parts.safetensors"
    with monkeypatch.context() as failing:
        failing.setattr(relief.ReliefTraining, "_loss", fail_at_step_6)
        with pytest.raises(RuntimeError, match="the power failed"):
            train_relief(folder, out, CONFIG, iterations=8, quiet=True)
    with pytest.raises(CheckpointError, match="--resume"):
        train_relief(folder, out, CONFIG, iterations=8, quiet=True)
    with pytest.raises(CheckpointError, match="belongs to a training run with another"):
        train_relief(folder, out, CONFIG, iterations=9, resume=True, quiet=True)
    others = write_pictures(tmp_path / "others")
    labels = (others / "metadata.jsonl").read_text()
    (others / "metadata.jsonl").write_text(
        labels.replace('"sharpness": 0.3', '"sharpness": 0.9')
    )  # the same number of labels
    with pytest.raises(CheckpointError, match="belongs to a training run with another"):
        train_relief(others, out, CONFIG, iterations=8, resume=True, quiet=True)
    train_relief(folder, out, CONFIG, iterations=8, resume=True, quiet=True)
    whole, parts = (read_tensors(tmp_path / f"{name}.safetensors")[0] for name in ("whole", "parts"))
    for name, tensor in whole.items():
        torch.testing.assert_close(parts[name], tensor, rtol=0, atol=0)
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == ["parts.safetensors", "whole.safetensors"]


def test_augmentation_keeps_a_gels_left_and_right_and_its_lamps():
    gel = torch.zeros(64, 3, 20, 20)
    gel[:, 0, :, :10] = 0.8
    gel[:, 2, :, 10:] = 0.8
    images = augment(gel, "touch", np.random.default_rng(0))
    assert (images[:, 0, :, :5].mean((1, 2)) > images[:, 0, :, 15:].mean((1, 2))).all()
    assert (images[:, 2, :, 15:].mean((1, 2)) > images[:, 2, :, :5].mean((1, 2))).all()


def test_photos_are_evaluated_by_their_grey_middle():
    photo = torch.rand(2, 3, 20, 20)
    middle = centre_crop(photo, "photo")
    assert middle.shape == (2, 3, 16, 16)
    torch.testing.assert_close(middle[:, 1], photo[:, :, 2:18, 2:18].mean(1), atol=1e-5, rtol=0)
    assert centre_crop(photo, "touch") is photo


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("pictures.json", "{", "retrieve collect --photos-only"),
        ("pictures.json", '{"kind": "film"}', "kind must be photo or touch"),
        ("metadata.jsonl", "", "no picture yet"),
        ("metadata.jsonl", '{"object_id": "a"}\n', "line 1: not a labelled picture"),
        (
            "metadata.jsonl",
            '{"file_name": "a.png", "object_id": "a", "relief": "ribs", "shape": "box", "pitch_mm": 2, '
            '"amplitude_mm": 1, "aspect": 0.5, "sharpness": 0}\n',
            "aspect at least 1",
        ),
        ("metadata.jsonl", "[]\n", "line 1: not a labelled picture"),
    ],
)
def test_an_invalid_folder_of_labelled_pictures_is_refused(tmp_path, file, content, message):
    folder = write_pictures(tmp_path / "pictures", objects=2)
    (folder / file).write_text(content)
    with pytest.raises(DatasetError, match=message):
        load_labelled(folder)


def test_negative_differences_are_refused_since_eight_bits_would_turn_them_bright(tmp_path):
    signed = dataclasses.replace(CONFIG.preprocessing, background="difference")
    with pytest.raises(ConfigError, match=r"difference\+0.5"):
        train_relief(tmp_path, tmp_path / "tower.safetensors", dataclasses.replace(CONFIG, preprocessing=signed))


def test_a_single_family_is_refused(quick, tmp_path):
    folder = write_pictures(tmp_path / "pictures", objects=4)
    lines = (folder / "metadata.jsonl").read_text().replace("squares", "stripes")
    (folder / "metadata.jsonl").write_text(lines)
    with pytest.raises(DatasetError, match="at least two relief families"):
        train_relief(folder, tmp_path / "tower.safetensors", CONFIG, iterations=2, quiet=True)


def test_the_command_line_collects_pictures_and_trains_on_them(quick, tmp_path, capsys):
    small = tmp_path / "small.toml"
    small.write_text(
        '[matcher]\ntower = "small"\ntower_output = "pooled"\n[training]\ninit = "random"\n'
        "[preprocessing]\ntouch_px = 32\nphoto_px = 32\n"
    )
    for kind in ("photo", "touch"):
        pictures, out = tmp_path / kind, tmp_path / f"{kind}.safetensors"
        words = ["--rig", "sim", "--objects", "6", "--seed", "3", "--out", str(pictures)]
        assert main(["collect", f"--{'photos' if kind == 'photo' else 'touches'}-only", *words]) == 0
        words = ["--out", str(out), "--config", str(small), "--iterations", "2"]
        assert main(["train", str(pictures), "--task", "relief", *words]) == 0
        assert f"as --init-{kind}" in capsys.readouterr().err
        assert out.is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["collect", "--photos-only", "--touches-only", "--out", "x"], "cannot be combined"),
        (["collect", "--photos-only", "--preview", "--out", "x"], "cannot be combined"),
        (["train", "x", "--task", "relief", "--out", "y.safetensors", "--init-photo", "z"], "does not take --split"),
        (
            ["train", "x", "--task", "grasp-success", "--out", "y.safetensors", "--init-photo", "z"],
            "--init-photo does not apply",
        ),
        (["train", "x", "--task", "relief", "--out", "y.safetensors", "--iterations", "0"], "must be from 1 to"),
        (["train", "x", "--task", "relief", "--out", "y.safetensors"], "--photos-only"),
    ],
)
def test_incompatible_options_are_refused(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(words) in (1, 2)
    assert message in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
