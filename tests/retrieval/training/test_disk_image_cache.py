"""The disk image cache: its images equal decoded ones bit for bit, and changed or damaged ones are decoded again."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
import torch

from retrieval.commands.main import main
from retrieval.data.dataset import load_grasps
from retrieval.data.pairs import PairSampler
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
    """Twelve photos in a copy of a recording: a tuple of files for each."""
    folder = shutil.copytree(recording, tmp_path / "copy")
    return [(grasp.photo,) for grasp in load_grasps(folder)[:12]]


@pytest.fixture
def decoded(monkeypatch):
    """The photo files that are decoded, in order."""
    files, load = [], Preprocessing.load_photo

    def counting(self, path):
        files.append(path)
        return load(self, path)

    monkeypatch.setattr(Preprocessing, "load_photo", counting)
    return files


def cache_decoded(folder, photos, preprocessing=TINY.preprocessing):
    images = DiskImageCache(preprocessing.load_photo, folder, "photo", preprocessing.digest())
    images.cache_decoded(photos, quiet=True)
    return images


def batch_of(recording, config, folder=None):
    grasps = load_grasps(recording)
    with TrainedFeatures(config, CPU) as source:
        if folder:
            source.fill_cache(folder, grasps, quiet=True)
        return source.prepare(None, PairSampler(grasps, seed=0).batch(0, 6)).result()


@pytest.mark.parametrize("background", ["none", "difference"])
def test_a_batch_of_cached_images_equals_one_of_decoded_images_bit_for_bit(recording, tmp_path, background):
    preprocessing = dataclasses.replace(TINY.preprocessing, background=background)
    config = dataclasses.replace(TINY, preprocessing=preprocessing)
    plain, ours = batch_of(recording, config), batch_of(recording, config, tmp_path / "cache")
    assert torch.equal(plain.touches, ours.touches)
    assert torch.equal(plain.photos, ours.photos)
    assert plain.photos.stride() == ours.photos.stride()
    rounded = torch.round(plain.photos * 255) / 255  # eight bits would store these values
    assert 0 < (rounded - plain.photos).abs().max() <= 0.5001 / 255


@pytest.mark.slow
def test_a_training_on_cached_images_gives_the_same_bits(recording, tmp_path, decoded):
    train(recording, tmp_path / "plain.safetensors", TINY, quiet=True)
    train(recording, tmp_path / "first.safetensors", TINY, cache=tmp_path / "cache", quiet=True)
    decoded.clear()
    train(recording, tmp_path / "second.safetensors", TINY, cache=tmp_path / "cache", quiet=True)
    assert not decoded
    plain, first, second = (read_tensors(tmp_path / f"{name}.safetensors")[0] for name in ("plain", "first", "second"))
    assert plain.keys() == first.keys() == second.keys()
    for name, tensor in plain.items():
        assert torch.equal(tensor, first[name]), name
        assert torch.equal(tensor, second[name]), name


def test_pretraining_on_cached_pictures_gives_the_same_weights(quick, tmp_path, monkeypatch):  # noqa: F811
    folder = write_pictures(tmp_path / "pictures", "touch")
    relief.train_relief(folder, tmp_path / "plain.safetensors", RELIEF, iterations=3, quiet=True)
    for _ in range(2):
        out = tmp_path / "cached.safetensors"
        relief.train_relief(folder, out, RELIEF, iterations=3, cache=tmp_path / "cache", quiet=True)
        plain, ours = read_tensors(tmp_path / "plain.safetensors")[0], read_tensors(out)[0]
        assert all(torch.equal(plain[name], ours[name]) for name in plain)
        monkeypatch.setattr(Preprocessing, "load_touch", lambda *_: pytest.fail("decoded again"))


def test_only_the_changed_part_of_a_recording_is_decoded_again(photos, tmp_path, decoded):
    cache_decoded(tmp_path / "cache", photos)
    (changed,), (other,) = photos[6], photos[11]
    changed.write_bytes(other.read_bytes())
    decoded.clear()
    images = cache_decoded(tmp_path / "cache", photos)
    assert set(decoded) == {path for (path,) in photos[5:10]}
    np.testing.assert_array_equal(images(changed), LOAD(other))


def test_another_preprocessing_gives_another_image(photos, tmp_path):
    cache_decoded(tmp_path / "cache", photos)
    wider = dataclasses.replace(TINY.preprocessing, photo_px=64)
    assert cache_decoded(tmp_path / "cache", photos, wider)(*photos[0]).shape == (64, 64, 3)


def test_an_interrupted_job_continues_with_complete_parts(photos, tmp_path, monkeypatch, decoded):
    folder, count = tmp_path / "cache", []

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
def test_a_damaged_part_is_decoded_again_with_a_warning(photos, tmp_path, caplog, harm):
    folder = tmp_path / "cache"
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


def test_an_image_that_is_not_cached_is_loaded(photos, tmp_path):
    images = cache_decoded(tmp_path / "cache", photos[:3])
    np.testing.assert_array_equal(images(*photos[7]), LOAD(*photos[7]))


def test_few_images_are_in_memory_while_a_part_is_written(photos, tmp_path, monkeypatch):
    alive, counts = [], []
    monkeypatch.setattr(disk_image_cache, "_AHEAD", 2)

    class Tracked(np.ndarray):
        def __del__(self):
            alive.pop()

    def load(path):
        alive.append(path)
        counts.append(len(alive))
        return LOAD(path).view(Tracked)

    DiskImageCache(load, tmp_path / "cache", "photo", "tracked").cache_decoded(photos, quiet=True)
    assert max(counts) <= 4


def test_a_disk_without_space_is_refused_before_anything_is_written(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(10**12, 10**12, 331_775))
    with pytest.raises(BadInput, match=r"needs 0.00 GB for 12 decoded images"):  # of 27,648 bytes each
        cache_decoded(tmp_path / "cache", photos)
    assert not (tmp_path / "cache").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(10**12, 10**12, 331_776))
    cache_decoded(tmp_path / "cache", photos)


def test_the_size_is_printed_only_if_something_must_be_decoded(photos, tmp_path, capsys):
    for expected in (True, False):
        DiskImageCache(LOAD, tmp_path / "cache", "photo", "").cache_decoded(photos)
        assert ("cache takes 0.00 GB for 12 decoded images (photo)" in capsys.readouterr().err) == expected


def test_a_missing_picture_is_an_error_in_one_sentence(photos, tmp_path):
    photos[4][0].unlink()
    with pytest.raises(DatasetError, match=r"cannot be read .*run `retrieve check`"):
        cache_decoded(tmp_path / "cache", photos)


def test_ranks_distribute_the_decoding(photos, tmp_path, monkeypatch, decoded):
    """The first rank finds the part that the second one wrote."""
    folder, counts = tmp_path / "cache", []
    monkeypatch.setattr(distributed, "world_size", lambda: 2)

    def second_rank(*_):
        counts.append(len(decoded))
        with monkeypatch.context() as second:
            second.setattr(distributed, "rank", lambda: 1)
            second.setattr(distributed, "any_rank", lambda *_: False)
            cache_decoded(folder, photos)
        counts.append(len(decoded))
        return False

    monkeypatch.setattr(distributed, "any_rank", second_rank)
    cache_decoded(folder, photos)
    for_size = 1  # each rank decodes one image to compute the size
    assert counts == [for_size + 7, 2 * for_size + 12]  # parts of 5 and 2, then the part of 5
    assert len(decoded) == counts[1]


def test_frozen_towers_and_gates_accept_no_cache(recording, tmp_path, capsys):
    with pytest.raises(ConfigError, match="read each image once"):
        train(recording, tmp_path / "m.safetensors", with_training(TINY, freeze_towers=True), cache=tmp_path / "cache")
    words = ["train", str(recording), "--out", str(tmp_path / "gate.safetensors"), "--cache", str(tmp_path / "cache")]
    assert main([*words, "--task", "grasp-success"]) == 2
    assert "--cache does not apply to --task grasp-success" in capsys.readouterr().err


@pytest.mark.slow
def test_two_ranks_cache_images_for_each_other(recording, settings, tmp_path):  # noqa: F811
    words = command(recording, tmp_path / "m.safetensors", settings(), 2)
    done = subprocess.run([*words, "--cache", str(tmp_path / "cache")], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    kinds = [path.name.split("-")[0] for path in (tmp_path / "cache").iterdir()]
    assert (kinds.count("photo"), kinds.count("touch")) == (1, 1)
