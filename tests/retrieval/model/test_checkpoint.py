"""Checkpoints: round trips, one clear error for every kind of damage, and a crash that leaves the old file."""

import dataclasses
import hashlib
import json
import os
from unittest.mock import Mock

import numpy as np
import pytest
import safetensors.torch
import torch
from safetensors import safe_open

from retrieval.data.dataset import Split
from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import (
    Checkpoint,
    load_checkpoint,
    read_tensors,
    store_checkpoint,
    write_tensors,
)
from retrieval.model.checkpoint_info import FORMAT, read_checkpoint_info
from retrieval.model.fusion import GelHead, Matcher
from retrieval.model.gate import load_gate
from retrieval.model.gel_check import GelCheck
from retrieval.model.posterior import Posterior
from tests.conftest import TINY
from tests.reference_model import REFERENCE_CALIBRATION

SPLIT = Split(seed=3, train=("cup", "mug"), validation=("jar", "pan"), test=("red ball", "Töpfchen"))
POSTERIOR = Posterior(slope=1.25, offset=-0.5, dependence=0.375, tests=40)
GEL_CHECK = GelCheck(
    foreign_above=1.5, contact_above=-2.0, level_above=None, rates={"touches_rejected_as_foreign": 0.0625}
)
PROVENANCE = {
    "step": 4,
    "source": "a rig",
    "data_digest": "0123456789abcdef" * 4,
    "metrics": {"validation_auc": 0.987654321, "pairs": 12},
}


def save(path, **changes):
    torch.manual_seed(0)
    matcher = Matcher(TINY.matcher)
    if changes.get("gel_check"):
        matcher.gel_head = GelHead(matcher.touch_tower.feature_count)
    contents = {"split": SPLIT, "posterior": POSTERIOR, "provenance": PROVENANCE} | changes
    store_checkpoint(Checkpoint(path, "", TINY, matcher=matcher, **contents), path)
    return matcher


def rewrite(path, *, tensors=None, **header):
    """Write the checkpoint again, well formed, with other tensors or header entries."""
    state, stored = read_tensors(path)
    write_tensors(path, {**state, **(tensors or {})}, stored | header)


@pytest.fixture
def saved(tmp_path):
    save(tmp_path / "m.safetensors")
    return tmp_path / "m.safetensors"


def test_every_tensor_and_every_header_entry_comes_back_and_makes_an_equal_file(tmp_path):
    first, second = tmp_path / "deep" / "er" / "m.safetensors", tmp_path / "again.safetensors"
    queries = np.ones((2, TINY.matcher.partial_width), np.float16)
    before = save(first, gel_check=GEL_CHECK, queries=queries).state_dict()
    loaded, info = load_checkpoint(first), read_checkpoint_info(first)
    after = loaded.matcher.state_dict()
    assert before.keys() == after.keys()
    for name, tensor in before.items():
        assert torch.equal(tensor, after[name]), name
        assert tensor.dtype == after[name].dtype
    assert (loaded.config, loaded.split, loaded.path, loaded.provenance) == (TINY, SPLIT, first, PROVENANCE)
    for each in (loaded, info):
        assert (each.posterior, each.gel_check, each.references) == (POSTERIOR, GEL_CHECK, None)
    assert np.array_equal(loaded.queries, queries)
    digest = hashlib.sha256(first.read_bytes()).hexdigest()
    assert (loaded.digest, info.digest) == (digest, digest)
    store_checkpoint(loaded, second)
    assert first.read_bytes() == second.read_bytes()


def test_a_path_in_a_header_need_not_be_utf8(saved, tmp_path):
    named = dataclasses.replace(load_checkpoint(saved), provenance={**PROVENANCE, "source": "caf\udce9.pth"})
    store_checkpoint(named, tmp_path / "named.safetensors")
    assert load_checkpoint(tmp_path / "named.safetensors").provenance == named.provenance


def test_the_model_card_describes_the_model(saved):
    card = saved.with_suffix(".md").read_text()
    for line in (
        "Matches touches of 2 gel image(s) with photos. Tower `small`, output `pooled`.",
        "* Trained on: a rig (data digest `0123456789abcdef`)",
        "* Best step: 4 of 6, seed 0",
        "* Objects: 2 train, 2 validation, 2 test",
        "* validation auc: 0.9877",
        "* Probabilities: fitted on 40 sets of validation touches; slope 1.250, offset -0.500",
    ):
        assert f"\n{line}" in card


def test_what_is_not_a_regular_file_is_refused_without_being_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for read in (load_checkpoint, read_checkpoint_info, load_gate):
        for name in ("pipe", "zero", "."):
            with pytest.raises(CheckpointError, match="not a regular file"):
                read(tmp_path / name)
        with pytest.raises(CheckpointError, match=r"no .* at .*none\.safetensors"):
            read(tmp_path / "none.safetensors")


def small_file(folder):
    state = {"weight": torch.tensor([1.5, -2.0, 0.25]), "steps": torch.tensor(7)}
    write_tensors(folder / "t.safetensors", state, {"split": {"train": ["mug"]}, "best": 0.125, "lr": 1e-05})
    return folder / "t.safetensors"


def test_a_file_cut_at_any_length_is_refused(tmp_path):
    path = small_file(tmp_path)
    data = path.read_bytes()
    for length in range(0, len(data), 3):
        path.write_bytes(data[:length])
        with pytest.raises(CheckpointError, match=r"t\.safetensors is not a readable \.safetensors file .*truncated"):
            read_tensors(path)


def test_a_flipped_bit_in_any_byte_is_refused_or_changes_nothing(tmp_path):
    """A naive reader loads most flips in a weight or in a digit of the header without an error."""
    path = small_file(tmp_path)
    data, (tensors, header) = path.read_bytes(), read_tensors(path)
    silent = 0
    for place in range(len(data)):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
        silent += loads_naively(path)
        try:
            got, found = read_tensors(path)
        except CheckpointError:
            continue
        assert found == header  # 1E-05 for 1e-05
        assert all(torch.equal(got[name], value) for name, value in tensors.items())
    assert silent > 50


def loads_naively(path):
    try:
        with safe_open(path, framework="pt") as file:
            return bool(json.loads(file.metadata()["touch_retrieval"])) and bool(
                file.get_tensor("weight").isfinite().all()
            )
    except Exception:
        return False


def with_header(text):
    """Return the bytes of a well-formed file with that text as our header; without one if None."""
    return safetensors.torch.save({"weight": torch.ones(2)}, None if text is None else {"touch_retrieval": text})


FOREIGN = r"contains weights but no header of ours; .*`retrieve train --init`"
OTHERS = [
    (with_header(None), FOREIGN),
    (safetensors.torch.save({"weight": torch.ones(2)}, {"format": "pt"}), FOREIGN),
    *[(with_header(text), r"header of .*m\.safetensors is damaged") for text in ("{", "3", "{}", "[" * 100_000)],
    *[
        (
            with_header(json.dumps({"format": version, "software": "9.9"})),
            rf"has checkpoint format {version}, this version reads {FORMAT}; install the touch-retrieval .*9\.9",
        )
        for version in (str(FORMAT), FORMAT + 1)
    ],
]


@pytest.mark.parametrize(("content", "message"), OTHERS, ids=map(str, range(len(OTHERS))))
def test_a_file_that_is_not_a_checkpoint_of_this_version_gets_an_error_that_names_its_kind(tmp_path, content, message):
    (tmp_path / "m.safetensors").write_bytes(content)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path / "m.safetensors")


def test_a_weight_that_is_not_finite_is_refused(saved):
    weight = read_tensors(saved)[0]["head.second.weight"].clone()
    weight[3, 4] = -float("inf")
    rewrite(saved, tensors={"head.second.weight": weight})
    with pytest.raises(CheckpointError, match="contains a NaN or infinite weight; train again with a lower learning"):
        load_checkpoint(saved)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"config": {"matcher": {"colour": 1}}}, "matcher has no setting 'colour'"),
        ({"config": [1]}, "it must be a table"),
        (
            {"config": dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, hidden=64)).to_dict()},
            r"weights do not fit its configuration: .*head\..*torch\.Size\(\[1?.*64\]\)",
        ),
        ({"split": {"train": ["a"]}}, "split must have .*; validation is missing"),
        ({"posterior": dataclasses.asdict(POSTERIOR) | {"formula": "another"}}, "posterior.formula"),
        ({"references": dataclasses.asdict(REFERENCE_CALIBRATION) | {"weight": -1.0}}, "references.weight must be"),
        ({"gel_check": dataclasses.asdict(GEL_CHECK) | {"level_above": "1"}}, "gel_check.level_above must be a number"),
    ],
)
def test_a_header_of_another_version_or_model_is_refused_with_the_wrong_entry(saved, entry, message):
    rewrite(saved, **entry)
    with pytest.raises(
        CheckpointError, match=rf"m\.safetensors is not a checkpoint that this version can use: .*{message}"
    ):
        load_checkpoint(saved)


@pytest.mark.parametrize(
    ("where", "error"),
    [("os.fsync", OSError(28, "No space left on device")), ("pathlib.Path.replace", KeyboardInterrupt())],
)
def test_a_failed_write_leaves_the_old_checkpoint_and_no_other_file(saved, monkeypatch, where, error):
    before, files = saved.read_bytes(), sorted(os.listdir(saved.parent))
    with monkeypatch.context() as patch:
        patch.setattr(where, Mock(side_effect=error))
        with pytest.raises(type(error)):
            save(saved, provenance=PROVENANCE | {"step": 6})
    assert saved.read_bytes() == before
    assert sorted(os.listdir(saved.parent)) == files == ["m.md", "m.safetensors"]
    assert load_checkpoint(saved).provenance["step"] == 4
