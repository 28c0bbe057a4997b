"""Train the grasp-success gate (`retrieval.model.gate`), which classifies a grasp from its gel images.

Like the authors' classifier, it processes one finger at a time and combines the fingers. The differences and reasons:

* It uses the frame AFTER the lift if the recording has it, like the authors' collection code, else the frame during
  the grasp. An object that slips is absent after the lift, but it presses the gel like any other during the grasp. On
  569 grasps of the simulated rig, the later frame classified all grasps correctly on three splits. The frame during the
  grasp (accuracy 0.60 to 0.71) accepted half of the slips and rejected a fifth of the held grasps, three quarters for
  some objects. `GateSettings(frame="during")` uses the touch itself, for rigs that do not lift.
* The loss uses the highest logit of the fingers, because only this logit decides. With the grasp's label on each
  finger, a finger without contact in a good grasp would teach that an empty gel is a success. And the maximum of two
  outputs that were fitted separately accepts more grasps than each of them.
* Batches contain equal numbers of held and failed grasps, so probability 1/2 means even odds at any success rate.

A gate selects the touches that a matcher later trains on, so it makes them easier: log the grasps that it rejects.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, ImageCache, load_attempts, make_split, recording_licence
from retrieval.errors import DatasetError
from retrieval.metrics.intervals import grouped_interval
from retrieval.model.checkpoint import require_writable, write_tensors
from retrieval.model.encode import batches, one_thread, touch_batch
from retrieval.model.gate import TASK, GateSettings, GraspNet, GraspSuccessGate
from retrieval.model.losses.loss import match_loss
from retrieval.training.initial_weights import made_from
from retrieval.training.loop import Plan, train_loop

BATCH = 32
LEARNING_RATE = 3e-3  # halved after each quarter of the steps, as the authors do
VALIDATION = 0.25  # fraction of the objects, as the authors use
BRIGHTNESS, CONTRAST = 20 / 255, 0.1  # largest change of the lamps between two frames

Differences = Callable[[Sequence[Grasp]], list[list[NDArray[np.float32]]]]


def train_gate(
    recording: Path, out: Path, *, iterations: int = 400, seed: int = 0, settings: GateSettings | None = None
) -> dict[str, Any]:
    """Train a gate on the successful and failed grasps of a recording and write it to `out`.

    A quarter of the objects are for validation. Training takes half a minute, plus 15 ms for each grasp.

    By default, the gate uses the frame after the lift, or the frame during the grasp if any grasp lacks the former. The
    same seed gives the same gate.

    Returns:
        The metrics in the file: the frame that the gate uses; "train_grasps", "train_held", "validation_grasps" and
        "validation_objects"; the "accuracy" on validation objects, its 95 % "interval" (grasps of one object are
        dependent) and "chance", the accuracy of always predicting the more frequent class; and (accepted, all) grasps
        by outcome, "accepted".

    Raises:
        DatasetError: The recording lacks successful grasps, failed grasps, or required frames.
        CheckpointError: `out` cannot be written.
    """
    require_writable(out)
    grasps = load_attempts(recording)
    settings = settings or GateSettings(frame="after" if all(grasp.after for grasp in grasps) else "during")
    _require_frames(grasps, settings.frame)
    split = make_split(grasps, validation=VALIDATION, test=0, seed=seed)
    train, validation = (
        [grasp for grasp in grasps if grasp.object_id in objects] for objects in (split.train, split.validation)
    )
    held = sum(grasp.held for grasp in train)
    if held in (0, len(train)):
        raise DatasetError(
            f"the training objects of seed {seed} must have both successful and failed grasps; got {held} successful "
            f"of {len(train)}; collect without a gate to record failures too"
        )
    load = ImageCache(settings.preprocessing().load_touch)

    def differences(grasps: Sequence[Grasp]) -> list[list[NDArray[np.float32]]]:
        """Return the differences of the fingers of each grasp."""
        return [
            [load(*pair) for pair in zip(_frames(grasp, settings.frame), grasp.backgrounds, strict=True)]
            for grasp in grasps
        ]

    logits: list[float] = []  # each grasp's highest logit
    with one_thread():
        gate = GraspSuccessGate(_train_net(train, differences, iterations, seed), settings)
        with Bar("validating", len(validation), "grasps") as bar:
            for part in batches(validation, BATCH):
                logits += map(max, gate.score(differences(part)))
                bar.advance(len(part))
    is_held, accepted = np.array([grasp.held for grasp in validation]), np.array(logits) >= 0
    is_correct, outcomes = accepted == is_held, [grasp.outcome for grasp in validation]
    owner = np.array([grasp.object_id for grasp in validation])
    by_object = [is_correct[owner == name].tolist() for name in np.unique(owner)]
    metrics = {
        "frame": settings.frame,
        "train_grasps": len(train),
        "train_held": held,
        "validation_grasps": len(validation),
        "validation_objects": len(by_object),
        "accuracy": float(is_correct.mean()),
        "interval": grouped_interval(by_object),
        "chance": float(max(is_held.mean(), 1 - is_held.mean())),
        "accepted": {
            name: (sum(accepted[[each == name for each in outcomes]].tolist()), count)
            for name, count in sorted(Counter(outcomes).items())
        },
    }
    provenance = {
        "iterations": iterations,
        "seed": seed,
        **made_from(recording, grasps, [recording_licence(recording)]),
        "outcomes": dict(Counter(grasp.outcome for grasp in grasps)),
        "metrics": metrics,
    }
    header = {"task": TASK, "gate": dataclasses.asdict(settings), "split": split.to_dict(), "provenance": provenance}
    write_tensors(out, gate.net.state_dict(), header)
    return metrics


def _frames(grasp: Grasp, frame: str) -> tuple[Path, ...]:
    return grasp.after if frame == "after" else grasp.touches


def _require_frames(grasps: Sequence[Grasp], frame: str) -> None:
    for grasp in grasps:
        for moment, files in (("before", grasp.backgrounds), (frame, _frames(grasp, frame))):
            if len(files) != len(grasp.touches):
                raise DatasetError(
                    f"a gate compares the frames before and {frame} of each finger; {grasp.grasp_id} has "
                    f"{len(files)} {moment} for {len(grasp.touches)} finger(s); record them (touch_a_{moment})"
                )


def _train_net(grasps: list[Grasp], differences: Differences, iterations: int, seed: int) -> GraspNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = GraspNet()
    first = touch_batch(differences(draw_batch(grasps, 0, seed)[0]))
    net.scale.fill_(max(float(first.square().mean().sqrt()), 1 / 255))  # at least a grey level

    def loss(step: int, _: int) -> Tensor:
        batch, rng = draw_batch(grasps, step, seed)
        images = augment(touch_batch(differences(batch)), rng)
        return gate_loss(net(images), torch.tensor([float(grasp.held) for grasp in batch]))

    optimizer, plan = torch.optim.Adam(net.parameters()), Plan(iterations, LEARNING_RATE, "halving")
    train_loop(net, optimizer, plan, lambda steps: steps, loss, title="training")
    return net


def gate_loss(logits: Tensor, held: Tensor) -> Tensor:
    """Return the cross-entropy of each grasp's highest logit, from logits (B, fingers) and labels (B,) 0 or 1."""
    return match_loss(logits.amax(1), held)


def draw_batch(grasps: Sequence[Grasp], step: int, seed: int) -> tuple[list[Grasp], np.random.Generator]:
    """Draw equal numbers of held and failed grasps, from seed and step only; also return the random generator."""
    rng = np.random.default_rng([seed, step])
    drawn: list[Grasp] = []
    for held in (True, False):
        kind = [grasp for grasp in grasps if grasp.held == held]
        drawn += [kind[row] for row in rng.choice(len(kind), BATCH // 2, replace=len(kind) < BATCH // 2)]
    return drawn, rng


def augment(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Flip differences (B, fingers, 3, px, px) and change their light, randomly for each finger.

    A lamp that is brighter by b in the later frame adds b to the difference; contrast c multiplies it by c.
    """
    count = images.shape[:2]
    for axis in (3, 4):
        flipped = torch.from_numpy(rng.random(count) < 0.5)[..., None, None, None]
        images = torch.where(flipped, images.flip(axis), images)
    contrast, brightness = (
        torch.from_numpy(rng.uniform(*bounds, count).astype(np.float32))[..., None, None, None]
        for bounds in ((1 - CONTRAST, 1 + CONTRAST), (-BRIGHTNESS, BRIGHTNESS))
    )
    return images * contrast + brightness
