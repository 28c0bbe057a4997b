"""The touch encoder as ONNX: the same numbers, no PyTorch in a query, and nothing stale or damaged in use."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from retrieval.commands.main import main
from retrieval.console.files import make_cache_folder
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, CheckpointError, NumericalError, RetrievalError
from retrieval.model import export as exporting
from retrieval.model import onnx_encoder
from retrieval.model.checkpoint import load_checkpoint, save_checkpoint
from retrieval.model.config import Config, MatcherConfig
from retrieval.model.encode import TorchEncoder, encode_touches, touch_features
from retrieval.model.export import export
from retrieval.model.fusion import GelHead, Matcher
from retrieval.model.onnx_encoder import OnnxEncoder, with_checksum
from retrieval.model.towers import OUTPUTS, TOWERS
from retrieval.search.build.build_index import build_index
from retrieval.search.query.searcher import Searcher
from tests.project.test_imports import run_blocked
from tests.project.test_project import PROJECT

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

PROVENANCE = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}


def timed(monkeypatch, torch_ms, onnx_ms):
    """The two encoders take these times; the clock decides nothing in a test."""
    times = [torch_ms, onnx_ms] * exporting.ROUNDS
    monkeypatch.setattr(exporting, "_ms", lambda function: times.pop(0))


@pytest.fixture
def onnx_wins(monkeypatch):
    timed(monkeypatch, 2.0, 1.0)


@pytest.fixture
def model_copy(model, tmp_path):
    """A copy of the model, to lay files beside."""
    return Path(shutil.copy(model, tmp_path / "m.safetensors"))


@pytest.fixture
def index(model_copy, catalogue, tmp_path):
    build_index(catalogue, load_checkpoint(model_copy), tmp_path / "index", quiet=True)
    return tmp_path / "index"


def touches_of(count, fingers, px):
    return np.random.default_rng(3).random((count, fingers, px, px, 3), dtype=np.float32)


def exported(path, config, seed=0, *, gel_head=False):
    """A matcher with random weights, and its exported encoder."""
    torch.manual_seed(seed)
    matcher = Matcher(config.matcher)
    if gel_head:
        matcher.gel_head = GelHead(matcher.touch_tower.feature_count)
    for module in matcher.modules():
        if isinstance(module, torch.nn.BatchNorm2d | torch.nn.BatchNorm1d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    save_checkpoint(path, matcher, config, split=None, provenance=PROVENANCE)
    checkpoint = load_checkpoint(path)
    path.with_suffix(".onnx").write_bytes(with_checksum(exporting.touch_encoder_to_onnx(checkpoint)))
    return checkpoint.matcher, OnnxEncoder(path.with_suffix(".onnx"), checkpoint.digest)


LARGE = ("resnet34", "resnet50")
MAKES = [{"tower": tower, "tower_output": "stages"} for tower in sorted(TOWERS) if tower not in LARGE]
MAKES += [{"tower_output": name} for name in OUTPUTS]
MAKES += [{"fingers": 1}, {"standardise": False}, {"candidate_width": 0}]


@pytest.mark.parametrize("make", MAKES, ids=str)
def test_the_exported_encoder_gives_pytorchs_numbers_for_any_number_of_touches(make, tmp_path):
    plain = {"tower": "small", "tower_output": "pooled", "hidden": 24, "standardise": True, "embedding_dim": 8}
    config = Config(MatcherConfig(**plain | {"candidate_width": 8} | make), preprocessing=Preprocessing(touch_px=32))
    matcher, encoder = exported(tmp_path / "m.safetensors", config)
    for count in (1, 3):
        touches = touches_of(count, config.matcher.fingers, 32)
        code, (partial, embedding, readings, levels) = encode_touches(matcher, touches), encoder.encode(touches)
        assert readings is levels is None  # without a gel head, and without no-contact frames
        # float32 in another order; random weights are worse conditioned than trained ones.
        assert np.abs(partial - code.partial.numpy()).max() <= 1e-4 * float(code.partial.abs().max())
        np.testing.assert_allclose(embedding, code.embedding.numpy(), atol=1e-4)


@pytest.mark.parametrize("fingers", [1, 2])
def test_what_tells_gel_images_from_others_is_exported_too(fingers, tmp_path):
    config = Config(
        MatcherConfig(tower="small", tower_output="pooled", hidden=8, fingers=fingers),
        preprocessing=Preprocessing(touch_px=32),
    )
    matcher, encoder = exported(tmp_path / "m.safetensors", config, gel_head=True)
    for count in (1, 3):
        touches = touches_of(count, fingers, 32)
        with torch.inference_mode():
            expected = matcher.gel_readings(touch_features(matcher, touches)).numpy()
        assert expected.shape == (count, fingers, 2)
        for ours in (encoder, TorchEncoder(matcher)):
            np.testing.assert_allclose(ours.encode(touches).readings, expected, atol=1e-5)


def test_the_encoder_in_pytorch_gives_what_encode_touches_gives(model):
    matcher = load_checkpoint(model).matcher
    touches = touches_of(2, 2, 32)
    partial, embedding, *_ = TorchEncoder(matcher).encode(touches)
    code = encode_touches(matcher, touches)
    assert np.array_equal(partial, code.partial.numpy())
    assert np.array_equal(embedding, code.embedding.numpy())


# In a query ------------------------------------------------------------------------------------------------------


def test_a_query_takes_the_export_that_lies_beside_the_model_and_ranks_the_same(model_copy, index, touch, onnx_wins):
    by_torch = Searcher.open(index).query([touch])
    export(load_checkpoint(model_copy))
    by_onnx = Searcher.open(index).query([touch])
    assert [by_torch.index["encoder"], by_onnx.index["encoder"]] == ["torch", "onnx"]
    assert [match.object_id for match in by_onnx.results] == [match.object_id for match in by_torch.results]
    for ours, theirs in zip(by_onnx.results, by_torch.results, strict=True):
        assert ours.logit == pytest.approx(theirs.logit, abs=1e-4)


def test_a_query_runs_with_torch_blocked_where_there_is_an_export(model_copy, index, touch, onnx_wins, tmp_path):
    files = [str(path) for path in touch]
    arguments = ["query", "--gelsight", *files, "--index", str(index), "--none-prior", "0", "--json"]
    code = f"import sys\nfrom retrieval.commands.main import main\nsys.exit(main({arguments!r}))"
    refused = run_blocked(code, ("torch",))
    assert refused.returncode == 1
    assert "blocked: torch" in refused.stderr
    export(load_checkpoint(model_copy))
    done = run_blocked(code, ("torch", "scipy", "robot", "onnx", "matplotlib", "sklearn"))
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["index"]["encoder"] == "onnx"
    assert len(document["results"]) == 8


def test_a_stale_export_is_not_used_and_a_warning_says_so(
    model_copy, index, touch, onnx_wins, catalogue, tmp_path, caplog
):
    export(load_checkpoint(model_copy))
    checkpoint = load_checkpoint(model_copy)
    save_checkpoint(model_copy, checkpoint.matcher, checkpoint.config, split=None, provenance=PROVENANCE)
    build_index(catalogue, load_checkpoint(model_copy), tmp_path / "index", quiet=True)
    assert Searcher.open(index).query([touch]).index["encoder"] == "torch"
    assert "m.onnx is the export of another checkpoint" in caplog.text
    assert "run `retrieve export` again" in caplog.text


@pytest.mark.parametrize("place", [10, -5, 0.5])
def test_an_export_with_a_flipped_bit_is_not_used_where_onnx_runtime_takes_it(place, model_copy, onnx_wins, caplog):
    checkpoint = load_checkpoint(model_copy)
    path = Path(export(checkpoint).path)
    data = bytearray(path.read_bytes())
    data[int(place * len(data)) if isinstance(place, float) else place] ^= 1
    path.write_bytes(data)
    assert onnx_encoder.find_export(checkpoint) is None
    assert "is damaged or no export" in caplog.text


def test_the_naive_way_loads_a_weight_with_a_flipped_bit(model_copy, onnx_wins):
    """What the checksum is for: ONNX Runtime opens the damaged model and answers with other numbers."""
    import onnxruntime

    path = Path(export(load_checkpoint(model_copy)).path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 64
    session = onnxruntime.InferenceSession(bytes(data), providers=["CPUExecutionProvider"])
    assert session.run(None, {"images": touches_of(1, 2, 32)})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        *[(with_checksum(b"model" * 100)[:length], "damaged or no export") for length in (0, 5, 100)],
        (with_checksum(b"model" * 100), "cannot be opened by ONNX Runtime"),
    ],
)
def test_a_truncated_export_and_a_sealed_file_that_is_no_onnx_model_are_refused(content, said, tmp_path):
    (tmp_path / "m.onnx").write_bytes(content)
    with pytest.raises(CheckpointError, match=said):
        OnnxEncoder(tmp_path / "m.onnx", "0" * 64)


def test_without_onnx_runtime_pytorch_serves(model_copy, onnx_wins, monkeypatch):
    checkpoint = load_checkpoint(model_copy)
    export(checkpoint)
    monkeypatch.setattr(onnx_encoder, "find_spec", lambda name: None)
    assert onnx_encoder.find_export(checkpoint) is None


@pytest.mark.parametrize("part", ["partial", "embedding"])
def test_an_encoder_that_gives_a_nan_is_refused_with_the_touch_named(part, model_copy, index, touch, monkeypatch):
    searcher = Searcher.open(index)
    codes = searcher.encoder.encode(touches_of(2, 2, 32))
    (codes.partials if part == "partial" else codes.embeddings)[1, 3] = np.nan
    monkeypatch.setattr(searcher.encoder, "encode", lambda touches: codes)
    with pytest.raises(NumericalError, match=f"the {part} of touch 2 holds a NaN"):
        searcher.query([touch, touch])


# The user's cache ------------------------------------------------------------------------------------------------


def test_a_checkpoint_without_an_export_beside_it_has_one_in_the_cache_once(model_copy, index, touch, onnx_wins):
    checkpoint = load_checkpoint(model_copy)
    made = exporting.export_to_cache(checkpoint)
    assert Path(made.path) == onnx_encoder.cached_export_path(checkpoint.digest)
    assert Searcher.open(index).query([touch]).index["encoder"] == "onnx"
    assert exporting.export_to_cache(checkpoint) is None
    assert not model_copy.with_suffix(".onnx").exists()


def test_the_export_beside_a_checkpoint_comes_first(model_copy, monkeypatch):
    timed(monkeypatch, 2.0, 1.0)
    checkpoint = load_checkpoint(model_copy)
    export(checkpoint)
    assert exporting.export_to_cache(checkpoint) is None
    assert not onnx_encoder.cached_export_path(checkpoint.digest).exists()


def given_away(path):
    """Another user's file, by its owner's id: that of nobody here."""
    os.chown(path, 4242, -1)


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
OPEN_TO_OTHERS = {
    "a file that its group can write": lambda path: path.chmod(0o664),
    "a file that all can write": lambda path: path.chmod(0o646),
    "a folder that all can write": lambda path: path.parent.chmod(0o1777),
    "a file of another user": given_away,
    "a folder of another user": lambda path: given_away(path.parent),
}


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=[needs_root] * ("of another user" in how)) for how in OPEN_TO_OTHERS]
)
def test_an_export_in_the_cache_that_others_may_have_written_is_not_used(
    how, model_copy, index, touch, onnx_wins, caplog
):
    """Whoever can write there can write its checksum too: this one would give other halves."""
    checkpoint = load_checkpoint(model_copy)
    path = onnx_encoder.cached_export_path(checkpoint.digest)
    exporting.export_to_cache(checkpoint)
    OPEN_TO_OTHERS[how](path)
    assert Searcher.open(index).query([touch]).index["encoder"] == "torch"
    (line,) = caplog.messages
    assert re.search(r"(belongs to another user|can be written to by other users).*PyTorch is used instead", line)


@pytest.mark.parametrize("how", ["a folder that all can write", "a file that all can write"])
def test_what_others_may_have_written_to_the_cache_is_made_again_where_only_the_user_writes(
    how, model_copy, onnx_wins, caplog, monkeypatch
):
    checkpoint = load_checkpoint(model_copy)
    path = onnx_encoder.cached_export_path(checkpoint.digest)
    exporting.export_to_cache(checkpoint)
    path.write_bytes(with_checksum(b"hostile"))
    OPEN_TO_OTHERS[how](path)
    timed(monkeypatch, 2.0, 1.0)
    made = exporting.export_to_cache(checkpoint)
    if "folder" in how:
        assert made is None
        assert "can be written to by other users (mode 1777" in caplog.text
        assert path.read_bytes() == with_checksum(b"hostile")
    else:
        assert made.path == str(path)
        assert (path.stat().st_mode & 0o777, OnnxEncoder(path, checkpoint.digest).name) == (0o644, "onnx")


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o277])
def test_the_cache_and_every_export_are_for_the_user_alone_to_write_whatever_the_umask(
    umask, model_copy, index, onnx_wins
):
    checkpoint = load_checkpoint(model_copy)
    folder = onnx_encoder.cached_export_path(checkpoint.digest).parent
    before = os.umask(umask)
    try:
        make_cache_folder(folder)
        made = Path(export(checkpoint).path) if umask != 0o277 else None
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700
    if made is not None:
        assert made.stat().st_mode & 0o777 == 0o644
        assert onnx_encoder.find_export(checkpoint).name == "onnx"


@needs_root
def test_an_export_beside_a_checkpoint_may_be_its_owners_and_nobody_elses(model_copy, onnx_wins, caplog):
    checkpoint = load_checkpoint(model_copy)
    beside = Path(export(checkpoint).path)
    given_away(model_copy)
    given_away(beside)
    assert onnx_encoder.find_export(checkpoint).name == "onnx"
    os.chown(beside, 4243, -1)
    assert onnx_encoder.find_export(checkpoint) is None
    assert "m.onnx belongs to another user (uid 4243); PyTorch is used instead" in caplog.text


@pytest.mark.parametrize("content", [with_checksum(b"model" * 100)[:-1], with_checksum(b"model" * 100)[:100], b"junk"])
def test_a_damaged_export_in_the_cache_is_made_again(model_copy, monkeypatch, content):
    checkpoint = load_checkpoint(model_copy)
    path = onnx_encoder.cached_export_path(checkpoint.digest)
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    timed(monkeypatch, 2.0, 1.0)
    assert Path(exporting.export_to_cache(checkpoint).path) == path
    assert OnnxEncoder(path, checkpoint.digest).name == "onnx"


@pytest.mark.parametrize("trouble", ["slower", "a file in the way", "no home"])
def test_without_a_cache_a_build_goes_on(trouble, model_copy, monkeypatch, tmp_path):
    timed(monkeypatch, 1.0, 2.0)
    (tmp_path / "file").touch()
    if trouble == "a file in the way":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    if trouble == "no home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    checkpoint = load_checkpoint(model_copy)
    assert exporting.export_to_cache(checkpoint) is None
    assert onnx_encoder.find_export(checkpoint) is None


# The command -----------------------------------------------------------------------------------------------------


def test_the_command_says_what_it_measured(model_copy, onnx_wins, capsys):
    assert main(["export", str(model_copy), "--json"]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document["path"] == str(model_copy.with_suffix(".onnx"))
    assert (document["torch_ms"], document["onnx_ms"]) == (2.0, 1.0)
    assert document["partial_difference"] < 1e-4
    assert "1.0 ms by ONNX Runtime, in 2.0 ms by PyTorch (2.00 times)" in err
    assert model_copy.with_suffix(".onnx").is_file()


def test_nothing_is_written_where_onnx_runtime_does_not_win_and_an_older_export_stays(model_copy, monkeypatch, capsys):
    model_copy.with_suffix(".onnx").write_bytes(with_checksum(b"older"))
    timed(monkeypatch, 1.0, 1.0)
    assert main(["export", str(model_copy)]) == 1
    assert "nothing is exported, as PyTorch is as fast on this machine" in capsys.readouterr().err
    assert model_copy.with_suffix(".onnx").read_bytes() == with_checksum(b"older")


def test_nothing_is_written_where_the_numbers_differ(model_copy, onnx_wins, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(RetrievalError, match="gives other numbers"):
        export(load_checkpoint(model_copy))
    assert sorted(path.suffix for path in model_copy.parent.iterdir()) == [".safetensors"]


def test_the_export_goes_where_it_is_asked_for(model_copy, onnx_wins, tmp_path):
    assert export(load_checkpoint(model_copy), tmp_path / "other.onnx").path == str(tmp_path / "other.onnx")
    assert not model_copy.with_suffix(".onnx").exists()
    with pytest.raises(BadInput, match=r"must be named \*\.onnx"):
        export(load_checkpoint(model_copy), tmp_path / "other.bin")


def test_what_to_install_is_said(model_copy, monkeypatch):
    monkeypatch.setattr(exporting, "find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"export needs onnx; install it with `pip install 'touch-retrieval\[onnx\]'`"):
        export(load_checkpoint(model_copy))


ONLY = """
import sys
from importlib.metadata import packages_distributions, requires
import packaging.requirements as listed

allowed, left = set(), {allowed!r}
while left:
    name = left.pop().lower().replace("_", "-")
    if name in allowed:
        continue
    allowed.add(name)
    needs = [listed.Requirement(each) for each in requires(name) or []]
    left |= {{need.name for need in needs if need.marker is None or need.marker.evaluate({{"extra": ""}})}}
theirs = {{
    module: {{owner.lower().replace("_", "-") for owner in owners}}
    for module, owners in packages_distributions().items()
}}
before = set(sys.modules)


class Guard:
    def find_spec(self, name, path=None, target=None):
        owners = theirs.get(name.partition(".")[0])
        if owners and not owners & (allowed | {{"touch-retrieval"}}):
            raise ModuleNotFoundError("not in the group: " + name)


sys.meta_path.insert(0, Guard())
sys.stdout.isatty = lambda: True  # in a terminal, rich draws the table
from retrieval.commands.main import main
code = main({arguments!r})
used = set().union(*(theirs.get(name.partition(".")[0], set()) for name in set(sys.modules) - before))
print(sorted({allowed!r} - used), file=sys.stderr)
sys.exit(code)
"""


def test_the_group_of_packages_for_queries_is_all_that_a_query_by_onnx_imports(
    model_copy, index, touch, onnx_wins, tmp_path
):
    """`pip install --group query` and the package without its dependencies are enough; nothing in the group is idle."""
    export(load_checkpoint(model_copy))
    group = {item.partition(">=")[0] for item in PROJECT["dependency-groups"]["query"]}
    asked = ["query", "--gelsight", *map(str, touch), "--index", str(index), "--html", str(tmp_path / "q.html")]
    asked += ["--none-prior", "0"]
    code = ONLY.format(allowed=group, arguments=asked)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert "Which object is in the hand?" in done.stdout
    assert done.stderr.splitlines()[-1] in ("[]", "['faiss-cpu']"), done.stderr  # an exact search does without faiss


def test_a_querys_words_and_a_wrong_index_import_no_encoder_and_no_pydantic(tmp_path):
    arguments = ["query", "--gelsight", "a.png", "--index", str(tmp_path)]
    code = f"from retrieval.commands.main import main\nmain({arguments!r})"
    done = run_blocked(code, ("torch", "onnxruntime", "onnx", "pydantic"))
    assert "run `retrieve build-index` first" in done.stderr, done.stderr
