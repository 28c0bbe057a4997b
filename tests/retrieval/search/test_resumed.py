"""`build-index` stopped or killed at any moment: finished embeddings are reused."""

import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from indexes.store.folder import IndexStore
from indexes.store.unfinished import NAME
from retrieval.commands.main import main
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build import embed
from retrieval.search.build.build_index import build_index

PHOTOS, BATCH = 24, 4

KILLED = """
import os, signal, sys, torch
from pathlib import Path
from retrieval.model import photo_encoder
from retrieval.search.build import embed
from retrieval.search.build.build_index import build_index
from retrieval.model.checkpoint import load_checkpoint

catalogue, model, index, fatal, batch = sys.argv[1:]
torch.set_num_threads(1)
embed.BATCH, encode, calls = int(batch), photo_encoder.encode_photos, []

def counted(*arguments):
    calls.append(1)
    if len(calls) == int(fatal):
        os.kill(os.getpid(), signal.SIGKILL)
    return encode(*arguments)

photo_encoder.encode_photos = counted
build_index(Path(catalogue), load_checkpoint(Path(model)), Path(index), quiet=True)
"""


def killed(catalogue, model, index, call):
    """Build in a process that is killed when it encodes batch number `call`."""
    arguments = [sys.executable, "-c", KILLED, *map(str, (catalogue, model, index, call, BATCH))]
    done = subprocess.run(arguments, capture_output=True, timeout=300, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr


def same(one, other):
    """Check that both generations have equal rows and codes, up to the order of sums in other batches."""
    assert one.rows == other.rows
    np.testing.assert_allclose(one.arrays["partials"][:], other.arrays["partials"][:], rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(one.embeddings[one.slots], other.embeddings[other.slots], atol=1e-5)


@pytest.mark.parametrize("call", [1, 2, 6])
def test_a_killed_first_build_is_resumed(call, catalogue_copy, model, tmp_path, embedded):
    index, checkpoint = tmp_path / "index", load_checkpoint(model)
    killed(catalogue_copy, model, index, call)
    assert not (index / "CURRENT").exists()
    stored = BATCH * (call - 1)
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert sum(embedded) == PHOTOS - stored
    assert (report.embedded, report.resumed, report.reused) == (PHOTOS - stored, stored, stored)
    assert not (index / NAME).exists()
    assert list(index.glob("*.tmp-*")) == []
    whole = build_index(catalogue_copy, checkpoint, tmp_path / "whole", quiet=True)
    same(IndexStore(index).open(), IndexStore(tmp_path / "whole").open())
    assert report.partial_error == pytest.approx(whole.partial_error, rel=0.05)  # in other batches


def test_two_kills_lose_nothing_even_if_photos_are_renamed_between_them(catalogue_copy, model, tmp_path, embedded):
    index = tmp_path / "index"
    killed(catalogue_copy, model, index, 3)
    for number, photo in enumerate(sorted(catalogue_copy.rglob("*.jpg"))):
        photo.rename(photo.with_name(f"again{number}.jpg"))
    killed(catalogue_copy, model, index, 3)
    report = build_index(catalogue_copy, load_checkpoint(model), index, quiet=True)
    assert (sum(embedded), report.resumed) == (PHOTOS - 4 * BATCH, 4 * BATCH)


def test_a_killed_rebuild_leaves_the_old_index_and_its_finished_embeddings(catalogue_copy, model, tmp_path, embedded):
    index, checkpoint = tmp_path / "index", load_checkpoint(model)
    objects = sorted(catalogue_copy.iterdir())
    away = shutil.move(objects[0], tmp_path / "away")
    build_index(catalogue_copy, checkpoint, index, quiet=True)
    shutil.move(away, objects[0])
    for path in objects[1].iterdir():
        path.write_bytes(path.read_bytes() + b"other content, the same image")
    killed(catalogue_copy, model, index, 2)
    assert IndexStore(index).open().count == PHOTOS - 3
    embedded.clear()
    report = build_index(catalogue_copy, checkpoint, index, quiet=True)
    assert (sum(embedded), report.embedded, report.resumed, report.reused) == (2, 2, 4, 22)
    assert "2 embedded, 4 from an interrupted build, 18 unchanged, 0 removed" in next(report.lines())


def test_codes_of_another_model_are_not_resumed(catalogue_copy, model, tmp_path, embedded):
    index, other = tmp_path / "index", tmp_path / "other.safetensors"
    killed(catalogue_copy, model, index, 4)
    from tests.retrieval.search.test_build import changed_model

    report = build_index(catalogue_copy, changed_model(load_checkpoint(model), other), index, quiet=True)
    assert (sum(embedded), report.resumed) == (PHOTOS, 0)
    assert not (index / NAME).exists()


def test_ctrl_c_keeps_the_finished_embeddings_and_reports_it(
    catalogue_copy, model, tmp_path, embedded, monkeypatch, capsys
):
    index, keep = tmp_path / "index", embed.UnfinishedBuild.add

    def interrupted(self, *arguments):
        keep(self, *arguments)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(embed.UnfinishedBuild, "add", interrupted)
    command = ["build-index", str(catalogue_copy), "--model", str(model), "--out", str(index)]
    assert main(command) == 1
    assert f"embedded photos are stored in {index}; run the same command to continue" in capsys.readouterr().err
    done = sum(embedded)
    monkeypatch.setattr(embed.UnfinishedBuild, "add", keep)
    assert main(command) == 0
    assert sum(embedded) == PHOTOS
    assert done >= 16
