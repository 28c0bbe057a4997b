"""Train the grasp-success gate (`retrieval.model.gate`), which classifies a grasp from its gel images.

Like the authors' classifier, it processes one finger at a time and combines the fingers. The differences and reasons:

* It uses the frame AFTER the lift if the recording has it, like the authors' collection code, else the frame during
  the grasp. An object that slips is absent after the lift, but it presses the gel like any other during the grasp. On
  569 grasps of the simulated rig, the later frame classified all grasps correctly on three splits. The frame during the
  grasp (accuracy 0.60 to 0.71) accepted half of the slips and rejected a fifth of the held grasps, three quarters for
  some objects. It is for rigs that do not lift.
* The loss uses the highest logit of the fingers, because only this logit decides. With the grasp's label on each
  finger, a finger without contact in a good grasp would teach that an empty gel is a success. And the maximum of two
  outputs that were fitted separately accepts more grasps than each of them.
* Batches contain equal numbers of held and failed grasps, so probability 1/2 means even odds at any success rate.

A gate selects the touches that a matcher later trains on, so it makes them easier: log the grasps that it rejects.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, load_attempts, make_split, recording_licence
from retrieval.errors import DatasetError
from retrieval.metrics.intervals import grouped_interval
from retrieval.model.checkpoint import require_writable, write_tensors
from retrieval.model.encode import one_thread, touch_batch
from retrieval.model.gate import TASK, GraspNet, GraspSuccessGate
from retrieval.model.losses.loss import match_loss
from retrieval.training.batches import BatchImages
from retrieval.training.initial_weights import made_from
from retrieval.training.loop import Plan, train_loop

BATCH = 32
LEARNING_RATE = 3e-3  # halved after each quarter of the steps, as the authors do
VALIDATION = 0.25  # fraction of the objects, as the authors use
BRIGHTNESS, CONTRAST = 20 / 255, 0.1  # largest change of the lamps between two frames


def train_gate(recording: Path, out: Path, *, iterations: int = 400, seed: int = 0) -> dict[str, Any]:
    """Train a gate on the successful and failed grasps of a recording and write it to `out`.

    A quarter of the objects are for validation. Training takes half a minute, plus 15 ms for each grasp. The gate uses
    the frame after the lift, or the frame during the grasp if any grasp lacks the former. The same seed gives the same
    gate.

    Returns:
        The metrics in the file: the frame that the gate uses; "train_grasps", "train_held", "validation_grasps" and
        "validation_objects"; the "accuracy" on validation objects, its 95 % "interval" (grasps of one object are
        dependent) and "chance", the accuracy of always predicting the more frequent class.

    Raises:
        DatasetError: The recording lacks successful grasps, failed grasps, or no-contact frames.
        CheckpointError: `out` cannot be written.
    """
    require_writable(out)
    grasps = load_attempts(recording)
    frame = "after" if all(grasp.after for grasp in grasps) else "during"
    split = make_split(grasps, validation=VALIDATION, test=0, seed=seed)
    train, validation = (
        [grasp for grasp in grasps if grasp.object_id in objects] for objects in (split.train, split.validation)
    )
    is_held, is_held_validation = (np.array([grasp.held for grasp in part]) for part in (train, validation))
    if is_held.all() or not is_held.any():
        raise DatasetError(
            f"the training objects of seed {seed} must have both successful and failed grasps; got {is_held.sum()} "
            f"successful of {len(train)}; collect without a gate to record failures too"
        )
    with one_thread():
        gate = GraspSuccessGate(_train_net(_differences(train, frame), is_held, iterations, seed), frame)
        differences = torch.split(_differences(validation, frame), BATCH)
        accepted = np.array([max(logits) >= 0 for part in differences for logits in gate.score(part)])
    is_correct = accepted == is_held_validation
    owner = np.array([grasp.object_id for grasp in validation])
    by_object = [is_correct[owner == name].tolist() for name in np.unique(owner)]
    metrics = {
        "frame": frame,
        "train_grasps": len(train),
        "train_held": int(is_held.sum()),
        "validation_grasps": len(validation),
        "validation_objects": len(by_object),
        "accuracy": float(is_correct.mean()),
        "interval": grouped_interval(by_object),
        "chance": float(max(is_held_validation.mean(), 1 - is_held_validation.mean())),
    }
    provenance = {
        "iterations": iterations,
        "seed": seed,
        **made_from(recording, grasps, [recording_licence(recording)]),
        "metrics": metrics,
    }
    header = {"task": TASK, "frame": frame, "split": split.to_dict(), "provenance": provenance}
    write_tensors(out, gate.net.state_dict(), header)
    return metrics


def _differences(grasps: Sequence[Grasp], frame: str) -> Tensor:
    """Return the differences (B, fingers, 3, px, px) of a frame of each grasp from its no-contact frames."""
    images, differences = BatchImages(GraspSuccessGate.preprocessing), []
    with Bar("reading", len(grasps), "grasps") as bar:
        for grasp in grasps:
            touches = grasp.after if frame == "after" else grasp.touches
            differences.append(images.touch(dataclasses.replace(grasp, touches=touches)))
            bar.advance()
    return touch_batch(differences)


def _train_net(differences: Tensor, is_held: NDArray[np.bool_], iterations: int, seed: int) -> GraspNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = GraspNet()
    first = differences[draw_batch(is_held, 0, seed)[0]]
    net.scale.fill_(max(float(first.square().mean().sqrt()), 1 / 255))  # at least a grey level

    def loss(step: int, _: int) -> Tensor:
        rows, rng = draw_batch(is_held, step, seed)
        return gate_loss(net(augment(differences[rows], rng)), torch.from_numpy(is_held[rows]).float())

    optimizer, plan = torch.optim.Adam(net.parameters()), Plan(iterations, LEARNING_RATE, "halving")
    train_loop(net, optimizer, plan, lambda steps: steps, loss, title="training")
    return net


def gate_loss(logits: Tensor, held: Tensor) -> Tensor:
    """Return the cross-entropy of each grasp's highest logit, from logits (B, fingers) and labels (B,) 0 or 1."""
    return match_loss(logits.amax(1), held)


def draw_batch(is_held: NDArray[np.bool_], step: int, seed: int) -> tuple[NDArray[np.int64], np.random.Generator]:
    """Draw the rows of equal numbers of held and failed grasps, from seed and step only; also return the generator."""
    rng = np.random.default_rng([seed, step])
    kinds = np.flatnonzero(is_held), np.flatnonzero(~is_held)
    return np.concatenate([rng.choice(kind, BATCH // 2, replace=len(kind) < BATCH // 2) for kind in kinds]), rng


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
