"""A model of touches only: its fit, what is compared, and the way from `train` to a query."""

import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.errors import BadInput, DatasetError
from retrieval.training.features import Features
from retrieval.training.touches import Touches, divide, fit_maps, recognition
from tests import synthetic


def grasp(number, object_id, sequence=None, session=None):
    return Grasp(str(number), object_id, sequence, None, (), (), session=session)


def test_codes_have_the_cosines_of_whitening_within_objects():
    rng = np.random.default_rng(0)
    x, owner = rng.normal(size=(12, 4)).astype(np.float32), np.repeat(np.arange(4), 3)
    scaled = (x - x.mean(0)) / x.std(0)
    scaled /= np.sqrt((scaled**2).sum() / 12)  # all variances of the tower add up to 1
    within = np.concatenate([scaled[owner == name] - scaled[owner == name].mean(0) for name in range(4)])
    covariance = within.T @ within / 12 + 0.3 * (scaled**2).mean() * np.eye(4)
    expected = scaled @ np.linalg.inv(covariance) @ scaled.T
    found = fit_maps(x, [4], owner, [0.3])[0.3](x)
    np.testing.assert_allclose(found @ found.T, expected, rtol=1e-4, atol=1e-4)


def test_touches_are_divided_by_session_else_by_sequence_else_one_by_one():
    names = [name for name in "abcdef" for _ in range(4)]
    has_sessions, _, turn = divide([grasp(n, name, session="xy"[n % 2]) for n, name in enumerate(names)])
    assert (has_sessions, turn.tolist()) == (True, [0, 1] * 12)
    has_sessions, _, turn = divide([grasp(n, name, f"{name}{n % 4 // 2}") for n, name in enumerate(names)])
    assert (has_sessions, turn.tolist()) == (False, [0, 0, 1, 1] * 6)
    assert divide([grasp(n, name) for n, name in enumerate(names)])[2].tolist() == [0, 1, 2, 0] * 6
    few = [grasp(n, f"{n % 44}", session="y" if n % 44 < 11 and n > 87 else "x") for n in range(132)]
    assert not divide(few)[0]  # 11 of 44 objects would calibrate the model alone
    with pytest.raises(BadInput, match=r"6 objects with touches of two sequences; 5 object\(s\) have them"):
        divide([grasp(n, name, "f" if name == "f" else None) for n, name in enumerate(names)])


def test_a_touch_is_not_compared_with_touches_of_its_own_turn():
    """Its own turn has an equal touch, and the other turn only one of the other object."""
    codes = np.array([[1, 0], [0, 1], [1, 0], [0.6, 0.8]], np.float32)
    features = Features(tuple("0123"), tuple("aabb"), codes[:, None], codes)
    touches = Touches(features, features.owner, np.arange(4), np.array([0, 1, 1, 0]))

    found = recognition(touches, lambda _: SimpleNamespace(map=lambda rows: rows), "two objects")
    assert found.chance == 0.5
    # Object a: references 0 and 1 of turn 0 and 1; each touch is nearer to the touch of b. Object b likewise.
    assert found.values.ravel().tolist() == [0, 0, 0, 0]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Six objects with a touch in each of two sessions, and no photos."""
    folder = synthetic.write_recording(
        tmp_path_factory.mktemp("touches") / "recording", synthetic.make_objects(6), 2, fingers="a"
    )
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    for number, line in enumerate(lines):
        del line["photo_file_name"], line["sequence_id"]
        line["session"] = "monday" if number % 2 else "friday"
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_a_recording_of_touches_only_is_trained_indexed_and_queried(recording, tmp_path, capsys):
    grasps = load_grasps(recording)
    with pytest.raises(DatasetError, match="as in a recording of touches only; `retrieve train` fits a model"):
        assert grasps[0].photo
    model, index, catalogue = (str(tmp_path / name) for name in ("m.safetensors", "index", "catalog"))
    assert main(["train", str(recording), "--init", "random", "--out", model]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"\nthe same 6 objects .* 16.7\nthe same 6 objects, low-pass control .* 16.7\n", printed)
    for one in grasps:
        if one.session == "monday":
            (tmp_path / "catalog" / one.object_id).mkdir(parents=True)
            shutil.copy(one.touches[0], tmp_path / "catalog" / one.object_id / "touch_1_a.png")
    assert main(["build-index", catalogue, "--model", model, "--out", index]) == 0
    capsys.readouterr()
    touch = next(one for one in grasps if one.session == "friday")
    assert main(["query", "--gelsight", str(touch.touches[0]), "--index", index, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["results"]) == 6
    shutil.copy(touch.touches[0], tmp_path / "catalog" / touch.object_id / "front.png")
    assert main(["build-index", catalogue, "--model", model, "--out", index]) == 0
    assert "1 picture(s) left out: the model was fitted to touches only" in capsys.readouterr().err
