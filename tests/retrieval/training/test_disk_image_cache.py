"""Images decoded once and kept: to the bit what decoding gives, and what changed or broke is decoded again."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
import torch

from retrieval.commands.main import main
from retrieval.data.dataset import PairSampler, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, ConfigError, DatasetError
from retrieval.model.checkpoint import read_tensors
from retrieval.training import disk_image_cache, distributed, relief
from retrieval.training.batches import TrainedFeatures
from retrieval.training.disk_image_cache import DiskImageCache
from retrieval.training.train import train
from tests.conftest import TINY
from tests.retrieval.training.test_ranks import ENVIRONMENT, command, settings  # noqa: F401
from tests.retrieval.training.test_relief import CONFIG as RELIEF
from tests.retrieval.training.test_relief import quick, write_pictures  # noqa: F401
from tests.retrieval.training.test_train import with_training

CPU = torch.device("cpu")
LOAD = TINY.preprocessing.load_photo


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(disk_image_cache, "_PART", 5)


@pytest.fixture
def photos(recording, tmp_path):
    """Twelve photos of a recording, to change: a tuple of files for each."""
    folder = shutil.copytree(recording, tmp_path / "copy")
    return [(grasp.photo,) for grasp in load_grasps(folder)[:12]]


@pytest.fixture
def decoded(monkeypatch):
    """The photo files that were decoded, in order."""
    files, load = [], Preprocessing.load_photo

    def counting(self, path):
        files.append(path)
        return load(self, path)

    monkeypatch.setattr(Preprocessing, "load_photo", counting)
    return files


def cache_decoded(folder, photos, seen=TINY.preprocessing):
    images = DiskImageCache(seen.load_photo, folder, "photo", seen.digest())
    images.cache_decoded(photos, quiet=True)
    return images


def batch_of(recording, config, folder=None):
    grasps = load_grasps(recording)
    with TrainedFeatures(config, CPU) as source:
        if folder:
            source.cache_decoded(folder, grasps, quiet=True)
        return source.prepare(None, PairSampler(grasps, seed=0).batch(0, 6)).result()


@pytest.mark.parametrize("background", ["none", "difference"])
def test_a_batch_of_kept_images_is_that_of_decoded_ones_to_the_bit(recording, tmp_path, background):
    seen = dataclasses.replace(TINY.preprocessing, background=background)
    config = dataclasses.replace(TINY, preprocessing=seen)
    plain, ours = batch_of(recording, config), batch_of(recording, config, tmp_path / "kept")
    assert torch.equal(plain.touches, ours.touches)
    assert torch.equal(plain.photos, ours.photos)
    assert plain.photos.stride() == ours.photos.stride()
    rounded = torch.round(plain.photos * 255) / 255  # what eight bits would have kept
    assert 0 < (rounded - plain.photos).abs().max() <= 0.5001 / 255


@pytest.mark.slow
def test_a_training_on_kept_images_ends_bit_for_bit_where_another_ends(recording, tmp_path, decoded):
    train(recording, tmp_path / "plain.safetensors", TINY, quiet=True)
    train(recording, tmp_path / "first.safetensors", TINY, cache=tmp_path / "kept", quiet=True)
    decoded.clear()
    train(recording, tmp_path / "second.safetensors", TINY, cache=tmp_path / "kept", quiet=True)
    assert not decoded
    plain, first, second = (read_tensors(tmp_path / f"{name}.safetensors")[0] for name in ("plain", "first", "second"))
    assert plain.keys() == first.keys() == second.keys()
    for name, tensor in plain.items():
        assert torch.equal(tensor, first[name]), name
        assert torch.equal(tensor, second[name]), name


def test_relief_is_learned_from_kept_pictures_as_from_others(quick, tmp_path, monkeypatch):  # noqa: F811
    folder = write_pictures(tmp_path / "pictures", "touch")
    relief.train_relief(folder, tmp_path / "plain.safetensors", RELIEF, iterations=3, quiet=True)
    for _ in range(2):
        out = tmp_path / "kept.safetensors"
        relief.train_relief(folder, out, RELIEF, iterations=3, cache=tmp_path / "kept", quiet=True)
        plain, ours = read_tensors(tmp_path / "plain.safetensors")[0], read_tensors(out)[0]
        assert all(torch.equal(plain[name], ours[name]) for name in plain)
        monkeypatch.setattr(Preprocessing, "load_touch", lambda *_: pytest.fail("decoded again"))


def test_of_a_changed_recording_the_changed_part_alone_is_decoded_again(photos, tmp_path, decoded):
    cache_decoded(tmp_path / "kept", photos)
    (changed,), (other,) = photos[6], photos[11]
    changed.write_bytes(other.read_bytes())
    decoded.clear()
    images = cache_decoded(tmp_path / "kept", photos)
    assert set(decoded) == {path for (path,) in photos[5:10]}
    np.testing.assert_array_equal(images(changed), LOAD(other))


def test_another_preprocessing_is_another_image(photos, tmp_path):
    cache_decoded(tmp_path / "kept", photos)
    wider = dataclasses.replace(TINY.preprocessing, photo_px=64)
    assert cache_decoded(tmp_path / "kept", photos, wider)(*photos[0]).shape == (64, 64, 3)


def test_what_was_interrupted_goes_on_with_whole_parts(photos, tmp_path, monkeypatch, decoded):
    folder, count = tmp_path / "kept", []

    def failing(path):
        count.append(path)
        if len(count) > 8:  # within the second part, whose first images are written
            raise RuntimeError("the power failed")
        return LOAD(path)

    monkeypatch.setattr(disk_image_cache, "_AHEAD", 1)
    with pytest.raises(RuntimeError, match="the power failed"):
        DiskImageCache(failing, folder, "photo", TINY.preprocessing.digest()).cache_decoded(photos, quiet=True)
    assert len(list(folder.iterdir())) == 1
    decoded.clear()
    images = cache_decoded(folder, photos)
    assert set(decoded) == {path for (path,) in photos[5:]}
    for (path,) in photos:
        np.testing.assert_array_equal(images(path), LOAD(path))


@pytest.mark.parametrize("harm", ["cut", "empty", "of others", "pickled", "folder"])
def test_a_damaged_part_is_decoded_again_and_said(photos, tmp_path, caplog, harm):
    folder = tmp_path / "kept"
    cache_decoded(folder, photos)
    part = min(folder.iterdir())
    data = part.read_bytes()
    if harm == "cut":
        part.write_bytes(data[:-1])
    elif harm == "empty":
        part.write_bytes(b"")
    elif harm == "of others":
        np.save(part, np.zeros((3, 48, 48, 3), np.float32))
    elif harm == "pickled":
        np.save(part, np.array([{}], dtype=object), allow_pickle=True)
    else:
        part.unlink()
        part.mkdir()
        with pytest.raises(IsADirectoryError):
            cache_decoded(folder, photos)
        return
    images = cache_decoded(folder, photos)
    assert "decoded again" in caplog.text
    assert part.read_bytes() == data
    for (path,) in photos:
        np.testing.assert_array_equal(images(path), LOAD(path))


def test_an_image_that_was_not_kept_is_loaded(photos, tmp_path):
    images = cache_decoded(tmp_path / "kept", photos[:3])
    np.testing.assert_array_equal(images(*photos[7]), LOAD(*photos[7]))


def test_few_images_are_in_memory_while_a_part_is_written(photos, tmp_path, monkeypatch):
    alive, most = [], []
    monkeypatch.setattr(disk_image_cache, "_AHEAD", 2)

    class Noted(np.ndarray):
        def __del__(self):
            alive.pop()

    def load(path):
        alive.append(path)
        most.append(len(alive))
        return LOAD(path).view(Noted)

    DiskImageCache(load, tmp_path / "kept", "photo", "noted").cache_decoded(photos, quiet=True)
    assert max(most) <= 4


def test_a_disk_without_room_is_refused_before_anything_is_written(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(10**12, 10**12, 331_775))
    with pytest.raises(BadInput, match=r"must have room for 0.00 GB for 12 decoded images"):  # of 27,648 bytes each
        cache_decoded(tmp_path / "kept", photos)
    assert not (tmp_path / "kept").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(10**12, 10**12, 331_776))
    cache_decoded(tmp_path / "kept", photos)


def test_the_size_is_said_before_and_nothing_where_all_is_there(photos, tmp_path, capsys):
    for said in (True, False):
        DiskImageCache(LOAD, tmp_path / "kept", "photo", "").cache_decoded(photos)
        assert ("kept takes 0.00 GB for 12 decoded images (photo)" in capsys.readouterr().err) == said


def test_a_missing_picture_is_an_error_in_a_sentence(photos, tmp_path):
    photos[4][0].unlink()
    with pytest.raises(DatasetError, match=r"cannot be read .*run `retrieve check`"):
        cache_decoded(tmp_path / "kept", photos)


def test_ranks_share_the_decoding(photos, tmp_path, monkeypatch, decoded):
    """The first one finds what the second made meanwhile."""
    folder, counts = tmp_path / "kept", []
    monkeypatch.setattr(distributed, "world_size", lambda: 2)

    def second_rank(*_):
        counts.append(len(decoded))
        with monkeypatch.context() as there:
            there.setattr(distributed, "rank", lambda: 1)
            there.setattr(distributed, "any_rank", lambda *_: False)
            cache_decoded(folder, photos)
        counts.append(len(decoded))
        return False

    monkeypatch.setattr(distributed, "any_rank", second_rank)
    cache_decoded(folder, photos)
    asked_for_size = 1
    assert counts == [asked_for_size + 7, 2 * asked_for_size + 12]  # parts of 5 and 2, then the one of 5
    assert len(decoded) == counts[1]


def test_frozen_towers_and_gates_take_no_cache(recording, tmp_path, capsys):
    with pytest.raises(ConfigError, match="look at each once"):
        train(recording, tmp_path / "m.safetensors", with_training(TINY, freeze_towers=True), cache=tmp_path / "kept")
    words = ["train", str(recording), "--out", str(tmp_path / "gate.safetensors"), "--cache", str(tmp_path / "kept")]
    assert main([*words, "--task", "grasp-success"]) == 2
    assert "--cache is of matchers" in capsys.readouterr().err


@pytest.mark.slow
def test_two_ranks_keep_images_for_each_other(recording, settings, tmp_path):  # noqa: F811
    words = command(recording, tmp_path / "m.safetensors", settings(), 2)
    done = subprocess.run([*words, "--cache", str(tmp_path / "kept")], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    kinds = [path.name.split("-")[0] for path in (tmp_path / "kept").iterdir()]
    assert (kinds.count("photo"), kinds.count("touch")) == (1, 1)
