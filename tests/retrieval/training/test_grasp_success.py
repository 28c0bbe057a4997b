"""The grasp-success gate: its training data, its decisions, and invalid inputs."""

import json
import pickle
from typing import NamedTuple

import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_attempts, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, CheckpointError, DatasetError, NumericalError
from retrieval.model.checkpoint import load_checkpoint, read_tensors
from retrieval.model.gate import GraspNet, GraspSuccessGate, load_gate
from retrieval.training.grasp_success import BATCH, augment, draw_batch, gate_loss, train_gate
from robot.recording.folder import RecordingWriter

OBJECTS = tuple("abcdefgh")
ENOUGH = 150  # steps
OUTCOMES = ("held", "held", "missed", "slipped")
LEAN = np.linspace(100, 150, 32).astype(np.uint8)[None, :, None].repeat(24, 0).repeat(3, 2)  # a gel without contact


class Frames(NamedTuple):
    """One finger's frames, as a rig returns them."""

    before: np.ndarray | None
    during: np.ndarray | None
    after: np.ndarray | None = None


def gel(rng, touched):
    """Return (24, 32, 3) uint8: the gel with noise and, if touched, a disc lit from one side."""
    picture = LEAN + rng.normal(0, 1.5, LEAN.shape)
    if touched:
        y, x = np.mgrid[:24, :32]
        u, v = x - rng.uniform(8, 24), y - rng.uniform(8, 16)
        picture += 40 * (u / 6 * (np.hypot(u, v) < 6))[..., None] * np.array([1, -1, 0.3])
    return np.clip(picture, 0, 255).astype(np.uint8)


def fingers(seed, during="ab", after="ab"):
    """Return the frames of one grasp; `during` and `after` name the fingers with contact in these frames."""
    rng = np.random.default_rng(seed)
    return {name: Frames(gel(rng, False), gel(rng, name in during), gel(rng, name in after)) for name in ("a", "b")}


def write(folder, outcomes=OUTCOMES, objects=OBJECTS, columns=("during", "before", "after"), **fields):
    """Write a grasp of each outcome for each object: a slip looks held until the lift, a miss never does."""
    touched = {"held": ("ab", "ab"), "slipped": ("ab", ""), "missed": ("", "")}
    with RecordingWriter(folder, {"source": "test", "sensor": "drawn"}) as writer:
        for number, name in enumerate(objects):
            for turn, outcome in enumerate(outcomes):
                images = {
                    f"touch_{finger}_{column}".removesuffix("_during"): getattr(frames, column)
                    for finger, frames in fingers([number, turn], *touched[outcome]).items()
                    for column in columns
                }
                values = {"outcome": outcome, "grasped": outcome == "held"} | fields
                values = {key: value for key, value in values.items() if value is not None}
                writer.append(f"{name}-{turn}", name, {"photo": LEAN, **images}, **values)
    return folder


@pytest.fixture(autouse=True, scope="module")
def _small_images():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GraspSuccessGate, "preprocessing", Preprocessing(touch_px=24, background="difference"))
        yield


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    return write(tmp_path_factory.mktemp("attempts") / "recording")


@pytest.fixture(scope="module")
def trained(attempts, tmp_path_factory):
    """Gates for the frame during the grasp and after the lift, by name: (file, report)."""
    folder = tmp_path_factory.mktemp("gate")
    recordings = {"during": write(folder / "recording", columns=("during", "before")), "after": attempts}
    files = {frame: folder / f"{frame}.safetensors" for frame in recordings}
    return {frame: (files[frame], train_gate(recordings[frame], files[frame], iterations=ENOUGH)) for frame in files}


@pytest.fixture(scope="module")
def gate(trained):
    return load_gate(trained["after"][0])


# Grasps and their labels -----------------------------------------------------------------------------------


def test_failed_grasps_are_read_for_the_gate_and_left_out_for_the_matcher(attempts):
    read = load_attempts(attempts)
    assert [item.outcome for item in read] == list(OUTCOMES) * len(OBJECTS)
    assert [item.held for item in read] == [True, True, False, False] * len(OBJECTS)
    assert [path.stem for path in read[0].after] == [path.stem + "_after" for path in read[0].touches]
    assert len(load_grasps(attempts)) == 2 * len(OBJECTS)


def test_the_outcome_counts_and_without_it_the_field_grasped(tmp_path):
    """The decision of another gate does not count."""
    folder = write(tmp_path / "outcomes", ("held", "slipped"), grasped=True)
    assert [item.held for item in load_attempts(folder)] == [True, False] * len(OBJECTS)
    with RecordingWriter(tmp_path / "grasped", {"source": "test", "sensor": "drawn"}) as writer:
        for number, fields in enumerate(({"grasped": True}, {"grasped": False}, {}, {"outcome": "no_plan"})):
            writer.append(str(number), "mug", {"photo": LEAN, "touch_a": LEAN}, **fields)
    read = load_attempts(tmp_path / "grasped")
    assert [(item.grasp_id, item.outcome) for item in read] == [("0", "held"), ("1", "failed")]


# Training --------------------------------------------------------------------------------------------------


def test_the_report_and_the_file_state_accuracy_and_chance_of_other_objects(trained, attempts):
    out, report = trained["after"]
    counts = [report[name] for name in ("train_grasps", "train_held", "validation_grasps", "validation_objects")]
    assert counts == [24, 12, 8, 2]
    assert (report["accuracy"], report["chance"]) == (1.0, 0.5)
    assert report["accuracy"] > trained["during"][1]["accuracy"]  # a slip looks held until the lift
    assert report["interval"] == pytest.approx((0.025 ** (1 / 8), 1.0))
    header = read_tensors(out)[1]
    assert header["provenance"]["metrics"]["accuracy"] == report["accuracy"]
    assert not set(header["split"]["train"]) & set(header["split"]["validation"])
    assert str(attempts) not in json.dumps(header)


def test_the_frame_after_the_lift_is_used_if_there_is_one(trained):
    for frame, (file, report) in trained.items():
        assert report["frame"] == load_gate(file).frame == frame


def test_the_same_seed_gives_the_same_file_and_the_global_random_state_is_unchanged(attempts, tmp_path):
    path, state, files = tmp_path / "gate.safetensors", torch.get_rng_state(), []
    for seed in (1, 1, 2):
        train_gate(attempts, path, iterations=3, seed=seed)
        files.append(path.read_bytes())
    assert torch.equal(torch.get_rng_state(), state)
    assert files[0] == files[1] != files[2]


def test_batches_contain_equal_numbers_of_both_kinds(attempts):
    is_held = np.array([attempt.held for attempt in load_attempts(attempts)[:8]])
    rows, _ = draw_batch(is_held, 0, 3)
    assert is_held[rows].tolist() == [True] * (BATCH // 2) + [False] * (BATCH // 2)


def test_the_loss_uses_the_deciding_finger_and_an_idle_finger_gets_no_gradient():
    logits = torch.tensor([[3.0, -2.0], [1.0, -4.0]], requires_grad=True)
    held = torch.tensor([1.0, 0.0])
    loss = gate_loss(logits, held)
    assert loss.item() == pytest.approx((np.log1p(np.exp(-3.0)) + np.log1p(np.exp(1.0))) / 2)
    loss.backward()
    assert logits.grad[0, 0] < 0 < logits.grad[1, 0]
    assert logits.grad[:, 1].tolist() == [0, 0]


def test_augmentation_flips_and_relights_each_finger_independently():
    images = torch.zeros(64, 2, 3, 8, 8)
    images[..., 0, 0] = 0.5  # one corner
    changed = augment(images, np.random.default_rng(0))
    corners = changed[..., [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners.argmax(-1)[:, 0] != corners.argmax(-1)[:, 1]).any()
    assert corners.argmax(-1)[..., 0].unique().tolist() == [0, 1, 2, 3]
    brightness = changed[..., 4, 4]
    assert 18 / 255 < brightness.abs().max() <= 20 / 255
    contrast = (corners.amax(-1) - brightness) / 0.5
    assert 0.9 - 1e-6 <= contrast.min() < 0.92 < 1.08 < contrast.max() <= 1.1 + 1e-6
    assert torch.equal(brightness[..., 0], brightness[..., 2])  # a lamp changes all colours equally


# What is refused -------------------------------------------------------------------------------------------


REFUSED = {
    "no results": ({"outcomes": ("held",), "outcome": None, "grasped": None}, "has a recorded result"),
    "held grasps only": ({"outcomes": ("held",)}, "got 6 successful of 6"),
    "no frame before": ({"columns": ("during", "after")}, "no-contact frame for each finger; .-0 has 0 for 2"),
    "too few objects": ({"objects": OBJECTS[:3]}, "needs two objects in each"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_recording_that_cannot_train_a_gate_is_refused(tmp_path, case):
    options, message = REFUSED[case]
    with pytest.raises(DatasetError, match=message):
        train_gate(write(tmp_path / "r", **options), tmp_path / "g.safetensors")


def test_files_that_are_not_of_a_gate_are_refused(attempts, model, trained, tmp_path):
    with pytest.raises(CheckpointError, match="must be a file"):
        train_gate(attempts, tmp_path)
    with pytest.raises(CheckpointError, match="retrieve train --task"):
        load_gate(model)
    with pytest.raises(CheckpointError, match="retrieve collect --gate"):
        load_checkpoint(trained["after"][0])


# Use -------------------------------------------------------------------------------------------------------


def test_a_grasp_is_accepted_if_any_finger_has_contact(gate):
    for touched, accepted in {"ab": True, "a": True, "b": True, "": False}.items():
        frames = fingers(77, after=touched)
        assert gate(frames) is accepted
    assert pickle.loads(pickle.dumps(gate))(frames) is accepted  # noqa: S301


def test_the_threshold_is_a_probability_of_exactly_one_half():
    """A network that ignores its input gives its bias as logit."""
    net = GraspNet()
    torch.nn.init.zeros_(net.last.weight)
    for logit, accepted in ((0.0, True), (-1e-30, False), (1e-30, True)):
        torch.nn.init.constant_(net.last.bias, logit)
        assert GraspSuccessGate(net, "during")(fingers(0)) is accepted


def test_a_logit_that_is_not_finite_is_an_error_and_not_a_failed_grasp():
    """Finite weights can overflow; NaN >= 0 is False, so every grasp would be rejected silently."""
    net = GraspNet()
    torch.nn.init.constant_(net.last.weight, 3e38)
    torch.nn.init.constant_(net.layers[0].bias, 3e38)
    with pytest.raises(NumericalError, match="train the gate again"):
        GraspSuccessGate(net, "during")(fingers(0))


def test_a_change_of_one_grey_level_does_not_wrap_and_flat_pictures_give_a_decision(gate):
    """In uint8 arithmetic, one level darker becomes 255 brighter."""
    darker = LEAN - np.uint8(1)
    assert (darker - LEAN).min() == 255
    assert not gate({"a": Frames(LEAN, LEAN, darker)})
    black, white = np.zeros((24, 32, 3), np.uint8), np.full((24, 32, 3), 255, np.uint8)
    assert gate({"a": Frames(black, black, black), "b": Frames(black, black, white)}) in (True, False)


def test_the_decision_does_not_depend_on_names_of_fingers_or_the_image_size(gate):
    frames = fingers(78, after="a")
    large = Frames(*(picture.repeat(4, 0).repeat(4, 1) for picture in frames["a"]))
    for given in ({"a": frames["a"]}, {"x": frames["b"], "c": frames["a"]}, {"a": large}):
        assert gate(given)


def test_a_gate_requires_the_frames_that_it_was_trained_on(gate, trained):
    during = load_gate(trained["during"][0])
    slipped = fingers(79, during="ab", after="")
    assert during(slipped)
    assert not gate(slipped)
    for used, frames, message in (
        (gate, {"a": Frames(LEAN, LEAN)}, "finger a has none after"),
        (during, {"a": Frames(None, LEAN)}, "finger a has none before"),
        (during, {"a": Frames(LEAN, LEAN / 255)}, "uint8"),
    ):
        with pytest.raises(BadInput, match=message):
            used(frames)
