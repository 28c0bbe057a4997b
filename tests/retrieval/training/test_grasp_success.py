"""The grasp-success gate: its training data, its decisions, and invalid inputs."""

import json
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from retrieval.data.dataset import load_attempts, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, CheckpointError, ConfigError, DatasetError, NumericalError
from retrieval.model.checkpoint import load_checkpoint, read_tensors, write_tensors
from retrieval.training.gate import GateSettings, GraspNet, GraspSuccessGate, load_gate
from retrieval.training.grasp_success import BATCH, augment, draw_batch, gate_loss, train_gate
from robot.recording.folder import RecordingWriter

OBJECTS = tuple("abcdefgh")
DURING, AFTER = (GateSettings(touch_px=24, frame=frame) for frame in ("during", "after"))
ENOUGH = 150  # steps
OUTCOMES = ("held", "held", "missed", "slipped")
LEAN = np.linspace(100, 150, 32).astype(np.uint8)[None, :, None].repeat(24, 0).repeat(3, 2)  # a gel without contact


@dataclass(frozen=True)
class Frames:
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
    suffix = {"during": "", "before": "_before", "after": "_after"}
    with RecordingWriter(folder, {"source": "test", "sensor": "drawn"}) as writer:
        for number, name in enumerate(objects):
            for turn, outcome in enumerate(outcomes):
                touched = {"held": ("ab", "ab"), "slipped": ("ab", ""), "missed": ("", "")}.get(outcome, ("", ""))
                shots = fingers([number, turn], *touched)
                images = {
                    f"touch_{finger}{suffix[column]}": getattr(frames, column)
                    for finger, frames in shots.items()
                    for column in columns
                }
                values = {"outcome": outcome, "grasped": outcome == "held"} | fields
                values = {key: value for key, value in values.items() if value is not None}
                writer.append(f"{name}-{turn}", name, {"photo": LEAN, **images}, **values)
    return Path(folder)


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    """8 objects, each held twice, missed once and slipped once."""
    return write(tmp_path_factory.mktemp("attempts") / "recording")


@pytest.fixture(scope="module")
def misses(tmp_path_factory):
    """8 objects, each held twice and missed twice."""
    return write(tmp_path_factory.mktemp("misses") / "recording", ("held", "held", "missed", "missed"))


@pytest.fixture(scope="module")
def trained(misses, tmp_path_factory):
    """A gate trained on held and missed grasps, and its report."""
    out = tmp_path_factory.mktemp("gate") / "gate.safetensors"
    return out, train_gate(misses, out, settings=DURING, iterations=ENOUGH, quiet=True)


# Grasps and their labels -----------------------------------------------------------------------------------


def test_failed_grasps_are_read_for_the_gate_and_left_out_for_the_matcher(attempts):
    rows = [json.loads(line) for line in (attempts / "metadata.jsonl").read_text().splitlines()]
    read = load_attempts(attempts)
    assert [item.grasp.grasp_id for item in read] == [row["grasp_id"] for row in rows]
    assert [item.outcome for item in read] == list(OUTCOMES) * len(OBJECTS)
    assert [item.held for item in read] == [True, True, False, False] * len(OBJECTS)
    assert read[0].after == tuple(attempts / rows[0][f"touch_{finger}_after_file_name"] for finger in "ab")
    assert len(load_grasps(attempts)) == 2 * len(OBJECTS)


def test_the_outcome_counts_and_not_the_decision_of_another_gate(tmp_path):
    folder = write(tmp_path / "r", ("held", "slipped"), grasped=True)
    assert [item.held for item in load_attempts(folder)] == [True, False] * len(OBJECTS)


def test_without_outcomes_the_field_grasped_counts(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "test", "sensor": "drawn"}) as writer:
        for number, grasped in enumerate((True, False, None)):
            fields = {} if grasped is None else {"grasped": grasped}
            writer.append(str(number), "mug", {"photo": LEAN, "touch_a": LEAN}, **fields)
        writer.append("3", "mug", {"photo": LEAN, "touch_a": LEAN}, outcome="no_plan", grasped=False)
    assert [(item.grasp.grasp_id, item.outcome) for item in load_attempts(tmp_path / "r")] == [
        ("0", "held"),
        ("1", "failed"),
    ]


def test_a_recording_without_grasp_results_is_refused(tmp_path):
    folder = write(tmp_path / "r", ("held",), outcome=None, grasped=None)
    with pytest.raises(DatasetError, match=r"no grasp in .* has a recorded result"):
        load_attempts(folder)


# Training --------------------------------------------------------------------------------------------------


def test_misses_and_held_grasps_of_new_objects_are_distinguished(trained):
    _, report = trained
    assert (report.train_grasps, report.train_held, report.validation_grasps, report.validation_objects) == (
        24,
        12,
        8,
        2,
    )
    assert report.accepted == {"held": (4, 4), "missed": (0, 4)}
    assert (report.accuracy, report.chance) == (1.0, 0.5)
    assert report.interval == pytest.approx((0.025 ** (1 / 8), 1.0))


def test_the_frame_after_the_lift_shows_a_slip_that_the_frame_during_the_grasp_does_not(attempts, tmp_path):
    """In these pictures a grasp that slips looks exactly like a held one until the lift."""
    after = train_gate(attempts, tmp_path / "a.safetensors", settings=AFTER, iterations=ENOUGH, quiet=True)
    during = train_gate(attempts, tmp_path / "d.safetensors", settings=DURING, iterations=ENOUGH, quiet=True)
    assert after.accepted == {"held": (4, 4), "missed": (0, 2), "slipped": (0, 2)}
    assert during.accepted["missed"] == (0, 2)
    assert after.accuracy > during.accuracy


def test_the_frame_after_the_lift_is_used_if_there_is_one(attempts, tmp_path):
    def frame(folder):
        return train_gate(folder, tmp_path / "g.safetensors", iterations=1, quiet=True).frame

    assert frame(attempts) == "after"
    assert frame(write(tmp_path / "r", columns=("during", "before"))) == "during"
    assert load_gate(tmp_path / "g.safetensors").settings == GateSettings(frame="during")


def test_the_report_contains_the_chance_accuracy_and_the_accepted_grasps(trained):
    text = "\n".join(trained[1].lines())
    assert "accuracy 1.000 (95 %: 0.631 to 1.000) on 8 grasps of 2 other objects" in text
    assert "always predicting the more frequent class: 0.500" in text
    assert "accepted: 4 of 4 held, 0 of 4 missed" in text


def test_the_file_contains_its_provenance(trained, misses):
    out, report = trained
    header = read_tensors(out)[1]
    assert header["task"] == "grasp-success"
    provenance = header["provenance"]
    assert provenance["source"] == "test"
    assert (provenance["iterations"], provenance["seed"]) == (ENOUGH, 0)
    assert provenance["outcomes"] == {"held": 16, "missed": 16}
    assert provenance["metrics"]["accuracy"] == report.accuracy
    assert not set(header["split"]["train"]) & set(header["split"]["validation"])
    assert str(misses) not in json.dumps(header)


def test_the_same_seed_gives_the_same_file_and_the_global_random_state_is_unchanged(misses, tmp_path):
    files = [tmp_path / f"{name}.safetensors" for name in "xyz"]
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    for path, seed in zip(files, (1, 1, 2), strict=True):
        train_gate(misses, path, iterations=3, seed=seed, quiet=True)
    assert torch.equal(torch.rand(3), expected)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert files[0].read_bytes() != files[2].read_bytes()


def test_only_the_required_frames_are_read_and_each_once(attempts, tmp_path, monkeypatch):
    read = []
    load = Preprocessing.load_touch
    monkeypatch.setattr(Preprocessing, "load_touch", lambda self, *paths: read.append(paths) or load(self, *paths))
    train_gate(attempts, tmp_path / "g.safetensors", iterations=5, settings=DURING, quiet=True)
    names = [path.stem for pair in read for path in pair]
    assert len(set(names)) == len(names)
    assert not [name for name in names if name.endswith("_after")]


def test_batches_contain_equal_numbers_of_both_kinds_and_depend_only_on_seed_and_step(attempts):
    few = load_attempts(attempts)[:8]
    for step in range(5):
        batch, rng = draw_batch(few, step, seed=3)
        again, same = draw_batch(few, step, seed=3)
        assert [item.held for item in batch] == [True] * (BATCH // 2) + [False] * (BATCH // 2)
        assert batch == again
        assert rng.random() == same.random()
    assert draw_batch(few, 0, seed=3)[0] != draw_batch(few, 1, seed=3)[0]
    assert draw_batch(few, 0, seed=3)[0] != draw_batch(few, 0, seed=4)[0]


def test_the_loss_uses_the_deciding_finger_and_an_idle_finger_gets_no_gradient():
    logits = torch.tensor([[3.0, -2.0], [1.0, -4.0]], requires_grad=True)
    held = torch.tensor([1.0, 0.0])
    loss = gate_loss(logits, held)
    assert loss.item() == pytest.approx((np.log1p(np.exp(-3.0)) + np.log1p(np.exp(1.0))) / 2)
    loss.backward()
    assert logits.grad[0, 0] < 0 < logits.grad[1, 0]
    assert logits.grad[:, 1].tolist() == [0, 0]
    naive = logits.detach().clone().requires_grad_()
    binary_cross_entropy_with_logits(naive, held[:, None].expand(2, 2)).backward()
    assert naive.grad[0, 1] < 0  # with the grasp's label on every finger, an empty gel is trained towards success


def test_the_loss_is_finite_although_probabilities_are_not():
    logits = torch.tensor([[200.0, 300.0]])
    assert gate_loss(logits, torch.tensor([0.0])).item() == pytest.approx(300.0)
    assert torch.log(1 - torch.sigmoid(logits.amax(1))).isinf().all()  # the naive formula


def test_augmentation_flips_and_relights_each_finger_independently():
    images = torch.zeros(64, 2, 3, 8, 8)
    images[..., 0, 0] = 0.5  # one corner
    changed = augment(images, np.random.default_rng(0))
    corners = changed[..., [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners.argmax(-1)[:, 0] != corners.argmax(-1)[:, 1]).any()
    for corner in range(4):
        assert 0.15 < (corners.argmax(-1)[..., 0] == corner).float().mean() < 0.35
    brightness = changed[..., 4, 4]
    assert brightness.abs().max() <= 20 / 255
    assert brightness.min() < -18 / 255 < 18 / 255 < brightness.max()
    contrast = (corners.amax(-1) - brightness) / 0.5
    assert 0.9 - 1e-6 <= contrast.min() < 0.92
    assert 1.08 < contrast.max() <= 1.1 + 1e-6
    assert torch.equal(brightness[..., 0], brightness[..., 2])  # a lamp changes all colours equally


def test_a_loss_that_is_not_finite_stops_the_training_and_writes_nothing(misses, tmp_path, monkeypatch):
    monkeypatch.setattr("retrieval.training.grasp_success.gate_loss", lambda logits, held: logits.sum() * torch.nan)
    with pytest.raises(NumericalError, match="step 0"):
        train_gate(misses, tmp_path / "g.safetensors", iterations=2, quiet=True)
    assert not (tmp_path / "g.safetensors").exists()


# What is refused -------------------------------------------------------------------------------------------


REFUSED = {
    "held grasps only": (
        {"outcomes": ("held",)},
        r"must contain both successful and failed grasps; got 8 successful of 8",
    ),
    "failed grasps only": (
        {"outcomes": ("missed",)},
        r"must contain both successful and failed grasps; got 0 successful",
    ),
    "no frame before": ({"columns": ("during",)}, r"a-0 has 0 before for 2 finger\(s\)"),
    "no frame after": ({"columns": ("during", "before")}, r"a-0 has 0 after for 2 finger\(s\)"),
    "too few objects": ({"objects": OBJECTS[:3]}, "needs two objects in each"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_recording_that_cannot_train_a_gate_is_refused(tmp_path, case):
    options, message = REFUSED[case]
    settings = AFTER if "after" in case else DURING
    with pytest.raises(DatasetError, match=message):
        train_gate(write(tmp_path / "r", **options), tmp_path / "g.safetensors", settings=settings, quiet=True)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="one of after, during; got 'later'"):
        GateSettings(frame="later")
    with pytest.raises(ConfigError, match="touch_px"):
        GateSettings(touch_px=0)


def test_an_output_that_cannot_be_written_is_an_error_before_the_first_step(misses, tmp_path, monkeypatch):
    monkeypatch.setattr("retrieval.training.grasp_success._train_net", lambda *_: pytest.fail("trained"))
    with pytest.raises(CheckpointError, match="is a folder"):
        train_gate(misses, tmp_path, quiet=True)


def test_a_matcher_is_not_a_gate_and_a_gate_is_not_a_matcher(model, trained):
    with pytest.raises(
        CheckpointError, match=r"not a grasp-success gate but .* a matcher; train a gate with `retrieve train --task"
    ):
        load_gate(model)
    with pytest.raises(
        CheckpointError, match="is a grasp-success classifier, not a matcher; use it with `retrieve collect --gate`"
    ):
        load_checkpoint(trained[0])


def test_a_damaged_gate_and_a_gate_with_other_settings_are_refused(trained, tmp_path):
    data = trained[0].read_bytes()
    (tmp_path / "bent.safetensors").write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    with pytest.raises(CheckpointError, match="damaged"):
        load_gate(tmp_path / "bent.safetensors")
    state, header = read_tensors(trained[0])
    for number, change in enumerate(({"gate": {"depth": 3}}, {"gate": {"touch_px": 0}}, {"gate": None})):
        write_tensors(tmp_path / f"{number}.safetensors", state, header | change)
        with pytest.raises(CheckpointError, match="is not a gate that this version can use"):
            load_gate(tmp_path / f"{number}.safetensors")
    write_tensors(tmp_path / "less.safetensors", {"scale": state["scale"]}, header)
    with pytest.raises(CheckpointError, match=r"weights do not fit"):
        load_gate(tmp_path / "less.safetensors")


# Use -------------------------------------------------------------------------------------------------------


def test_a_grasp_is_accepted_if_any_finger_has_contact(trained):
    gate = load_gate(trained[0])
    for touched, accepted in {"ab": True, "a": True, "b": True, "": False}.items():
        frames = fingers(77, during=touched, after="")
        assert gate(frames) is accepted
        assert {finger for finger, logit in gate.logits(frames).items() if logit >= 0} == set(touched)


@pytest.mark.parametrize(("logits", "accepted"), [((0.0, -9.0), True), ((-1e-30, -9.0), False), ((-9.0, 1e-30), True)])
def test_the_threshold_is_a_probability_of_exactly_one_half(monkeypatch, logits, accepted):
    gate = GraspSuccessGate(GraspNet(), DURING)
    monkeypatch.setattr(GraspSuccessGate, "score", lambda *_: [list(logits)])
    assert gate(fingers(0)) is accepted


def test_a_logit_that_is_not_finite_is_an_error_and_not_a_failed_grasp():
    """Finite weights can overflow; NaN >= 0 is False, so every grasp would be rejected silently."""
    net = GraspNet()
    torch.nn.init.constant_(net.last.weight, 3e38)
    torch.nn.init.constant_(net.layers[0].bias, 3e38)
    with pytest.raises(NumericalError, match="train the gate again"):
        GraspSuccessGate(net, DURING)(fingers(0))


def test_a_change_of_one_grey_level_does_not_wrap(trained):
    """In uint8 arithmetic, one level darker becomes 255 brighter."""
    gate, darker = load_gate(trained[0]), Frames(LEAN, LEAN - np.uint8(1))
    naive = darker.during - darker.before
    assert naive.min() == 255
    np.testing.assert_allclose(gate._difference("a", darker), -1 / 255, rtol=1e-4)
    assert not gate({"a": darker})


@pytest.mark.parametrize("level", [0, 255])
def test_black_white_and_unchanged_pictures_give_finite_logits(trained, level):
    flat = np.full((24, 32, 3), level, np.uint8)
    logits = load_gate(trained[0]).logits({"a": Frames(flat, flat), "b": Frames(flat, 255 - flat)})
    assert all(np.isfinite(value) for value in logits.values())


def test_a_fingers_logit_does_not_depend_on_other_fingers_or_the_image_size(trained):
    gate, frames = load_gate(trained[0]), fingers(78, during="a")
    both = gate.logits(frames)
    large = Frames(*(picture.repeat(4, 0).repeat(4, 1) for picture in (frames["a"].before, frames["a"].during)))
    assert gate.logits({"a": frames["a"]})["a"] == pytest.approx(both["a"], rel=1e-4)
    assert gate.logits({"x": frames["b"], "c": frames["a"]})["c"] == pytest.approx(both["a"], rel=1e-4)
    assert gate({"a": large})


def test_a_brighter_lamp_gives_no_frame_around_the_picture():
    """With zero padding, a change of the whole picture would have an edge."""
    layers = GraspNet().layers
    for layer, even in ((layers[0], True), (torch.nn.Conv2d(3, 16, 5, stride=2, padding=2), False)):
        maps = layer(torch.full((1, 3, 64, 64), 0.08)).flatten(2)
        assert bool((maps.amax(2) - maps.amin(2)).max() < 1e-5) is even


def test_a_gate_requires_the_frames_that_it_was_trained_on(misses, trained, tmp_path):
    train_gate(misses, tmp_path / "after.safetensors", settings=AFTER, iterations=ENOUGH, quiet=True)
    after, during = load_gate(tmp_path / "after.safetensors"), load_gate(trained[0])
    slipped = fingers(79, during="ab", after="")
    assert during(slipped)
    assert not after(slipped)
    with pytest.raises(BadInput, match="finger a has none after"):
        after({"a": Frames(LEAN, LEAN)})
    with pytest.raises(BadInput, match="finger a has none before"):
        during({"a": Frames(None, LEAN)})
    with pytest.raises(BadInput, match="at least one finger"):
        during({})
    with pytest.raises(BadInput, match="uint8"):
        during({"a": Frames(LEAN, LEAN / 255)})


def test_a_gate_can_be_sent_to_another_process(trained):
    gate, frames = load_gate(trained[0]), fingers(80)
    assert pickle.loads(pickle.dumps(gate)).logits(frames) == gate.logits(frames)  # noqa: S301
