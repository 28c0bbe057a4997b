"""Training the gate (`retrieval.training.gate`): did a grasp succeed, judged from its gel images?

Like the authors' classifier it sees one finger at a time and is asked of both; what differs, and why:

* It judges the frame AFTER the lift where the recording has it, as the authors' collection code does, else the frame
  during the grasp. What slips is gone after the lift, but pressed the gel like any other before: on 569 grasps of the
  simulated rig the later frame told all, on three splits, while the frame during the grasp (0.60 to 0.71 right) let
  half of the slips pass and threw away a fifth of what was held, of some objects three quarters.
  `GateSettings(frame="during")` judges T itself, for rigs that do not lift.
* The loss is taken on the highest logit of the fingers, since that alone decides. With the grasp's label on each
  finger, a finger that hangs in the air beside a good grasp would teach that an empty gel is a success; and of two
  answers that were each fitted to be right alone, the higher one accepts more than either.
* Batches hold as many held as failed grasps, so probability 1/2 is at even odds whatever the rig's luck.

A gate chooses the touches that a matcher later trains on, so it makes them easier: log what it rejects.
"""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.console.progress import Bar
from retrieval.data.dataset import Attempt, ImageCache, Split, data_digest, load_attempts, make_split, recording_source
from retrieval.data.loading import worker_pool
from retrieval.errors import ConfigError, DatasetError
from retrieval.metrics.intervals import FEW_OBJECTS
from retrieval.metrics.k_way import grouped_interval
from retrieval.model.checkpoint import require_writable, write_tensors
from retrieval.model.encode import batches, one_thread, touch_batch
from retrieval.model.losses.match import match_loss
from retrieval.training.fit import Plan, fit
from retrieval.training.gate import TASK, GateSettings, GraspNet, GraspSuccessGate
from retrieval.training.gate import load_gate as load_gate

BATCH = 32
LEARNING_RATE = 3e-3  # and halved after each quarter of the steps, as by the authors
VALIDATION = 0.25  # share of the objects, as by the authors
BRIGHTNESS, CONTRAST = 20 / 255, 0.1  # the lamps may change by so much between two frames
_GREY_LEVEL = 1 / 255


@dataclass(frozen=True)
class GateReport:
    """How a gate did on objects that it was not trained on.

    The last step is kept and no threshold chosen, so these objects were used for nothing else. interval: 95 % for the
    accuracy, widened for grasps of one object being alike. chance: accuracy of always giving the commoner answer.
    accepted: (accepted, all) by outcome. least: the object whose held grasps are accepted least often, and how often.
    """

    path: str
    frame: str
    train_grasps: int
    train_held: int
    validation_grasps: int
    validation_objects: int
    accuracy: float
    interval: tuple[float, float]
    chance: float
    accepted: dict[str, tuple[int, int]]
    lowest_acceptance: tuple[str, float] | None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return dataclasses.asdict(self)

    def lines(self) -> Iterator[str]:
        """The report for people."""
        yield (
            f"{self.path}: judges the frame {self.frame} the grasp; trained on {self.train_grasps} grasps, "
            f"{self.train_held} of them held"
        )
        yield (
            f"accuracy {self.accuracy:.3f} (95 %: {self.interval[0]:.3f} to {self.interval[1]:.3f}) on "
            f"{self.validation_grasps} grasps of {self.validation_objects} other objects; always giving the commoner "
            f"answer: {self.chance:.3f}"
        )
        if self.validation_objects < FEW_OBJECTS:
            yield (
                f"so few objects ({self.validation_objects}) cannot show how much objects differ: the interval is too "
                "narrow, and holds the truth less often than in 95 % of cases (2 objects: 79 %, 3: 86 %, 4: 89 %)"
            )
        yield "accepted: " + ", ".join(f"{part} of {whole} {name}" for name, (part, whole) in self.accepted.items())
        if self.lowest_acceptance:
            yield f"held grasps are accepted least often of {self.lowest_acceptance[0]}: {self.lowest_acceptance[1]:.0%}"


def train_gate(
    recording: Path,
    out: Path,
    *,
    iterations: int = 400,
    seed: int = 0,
    settings: GateSettings | None = None,
    quiet: bool = False,
) -> GateReport:
    """Train a gate on the successful and failed grasps of a recording and write it to `out`.

    settings: by default the frame after the lift is judged, or where grasps lack it, the one during the grasp. A
    quarter of the objects judge the gate. It takes half a minute, and 15 ms for each grasp; the same seed gives the
    same gate. Raises DatasetError for a recording without both kinds of grasps or without the frames to compare,
    CheckpointError where `out` cannot be written.
    """
    if iterations < 1:
        raise ConfigError(f"iterations must be at least 1; got {iterations}")
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed must be in [0, 2^32); got {seed}")
    require_writable(out)
    attempts = load_attempts(recording)
    settings = settings or GateSettings(frame="after" if all(attempt.after for attempt in attempts) else "during")
    _require_frames(attempts, settings.frame)
    _require_both_outcomes(attempts, f"{recording} must hold")
    split = make_split([attempt.grasp for attempt in attempts], validation=VALIDATION, test=0, seed=seed)
    train, validation = (
        [attempt for attempt in attempts if attempt.grasp.object_id in objects]
        for objects in (split.train, split.validation)
    )
    _require_both_outcomes(train, f"the training objects of seed {seed} must have")
    with worker_pool() as pool, one_thread():
        differences = _DifferenceLoader(settings, pool)
        gate = GraspSuccessGate(_train_net(train, differences, iterations, seed, quiet), settings)
        with Bar("judge", len(validation), "grasps", quiet=quiet) as bar:
            logits: list[float] = []  # the highest of each grasp
            for part in batches(validation, BATCH):
                logits += [max(fingers) for fingers in gate.score(differences(part))]
                bar.advance(len(part))
    report = _report(out, settings.frame, train, validation, np.array(logits))
    _save(out, gate, split, attempts, recording, report, {"iterations": iterations, "seed": seed})
    return report


def _require_frames(attempts: Sequence[Attempt], frame: str) -> None:
    for attempt in attempts:
        grasp, judged = attempt.grasp, attempt.after if frame == "after" else attempt.grasp.touches
        for moment, files in (("before", grasp.backgrounds), (frame, judged)):
            if len(files) != len(grasp.touches):
                raise DatasetError(
                    f"a gate compares the frames before and {frame} of each finger; {grasp.grasp_id} has "
                    f"{len(files)} {moment} for {len(grasp.touches)} finger(s); record them (touch_a_{moment})"
                )


def _require_both_outcomes(attempts: Sequence[Attempt], who: str) -> None:
    held = sum(attempt.held for attempt in attempts)
    if held in (0, len(attempts)):
        raise DatasetError(
            f"{who} both successful and failed grasps; got {held} successful of {len(attempts)}; "
            "collect without a gate, so that failures are recorded too"
        )


class _DifferenceLoader:
    """The differences of grasps, decoded by a pool of workers and kept in memory."""

    def __init__(self, settings: GateSettings, pool: Executor) -> None:
        self._frame, self._pool = settings.frame, pool
        self._load = ImageCache(settings.preprocessing().load_touch)

    def __call__(self, attempts: Sequence[Attempt]) -> list[list[NDArray[np.float32]]]:
        distinct = {attempt.grasp.grasp_id: attempt for attempt in attempts}  # no two threads read one file
        read = dict(zip(distinct, self._pool.map(self._of, distinct.values()), strict=True))
        return [read[attempt.grasp.grasp_id] for attempt in attempts]

    def _of(self, attempt: Attempt) -> list[NDArray[np.float32]]:
        judged = attempt.after if self._frame == "after" else attempt.grasp.touches
        return [self._load(*pair) for pair in zip(judged, attempt.grasp.backgrounds, strict=True)]


def _train_net(
    attempts: list[Attempt], differences: _DifferenceLoader, iterations: int, seed: int, quiet: bool
) -> GraspNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = GraspNet()
    first = touch_batch(differences(draw_batch(attempts, 0, seed)[0]))
    net.scale.fill_(max(float(first.square().mean().sqrt()), _GREY_LEVEL))

    def loss(step: int) -> Tensor:
        batch, rng = draw_batch(attempts, step, seed)
        images = augment(touch_batch(differences(batch)), rng)
        return gate_loss(net(images), torch.tensor([float(attempt.held) for attempt in batch]))

    with Bar("train", iterations, "steps", quiet=quiet) as bar:
        fit(
            torch.optim.Adam(net.parameters()),
            Plan(iterations, LEARNING_RATE, "halving"),
            range(iterations),
            loss,
            bar=bar,
        )
    return net


def gate_loss(logits: Tensor, held: Tensor) -> Tensor:
    """Cross-entropy of the highest logit of each grasp. logits (B, fingers); held (B,) of 0 and 1."""
    return match_loss(logits.amax(1), held)


def draw_batch(attempts: Sequence[Attempt], step: int, seed: int) -> tuple[list[Attempt], np.random.Generator]:
    """As many held as failed grasps, drawn by seed and step alone; and the generator, for what else is random."""
    rng = np.random.default_rng([seed, step])
    drawn: list[Attempt] = []
    for held in (True, False):
        kind = [attempt for attempt in attempts if attempt.held == held]
        drawn += [kind[row] for row in rng.choice(len(kind), BATCH // 2, replace=len(kind) < BATCH // 2)]
    return drawn, rng


def augment(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Differences (B, fingers, 3, px, px) flipped either way, and as if the lamps had changed: each finger its own.

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


def _report(
    out: Path, frame: str, train: list[Attempt], validation: list[Attempt], logits: NDArray[np.float64]
) -> GateReport:
    accepted = logits >= 0
    held = np.array([attempt.held for attempt in validation])
    right = _group_flags([attempt.grasp.object_id for attempt in validation], accepted == held)
    good = _group_flags([attempt.grasp.object_id for attempt in validation if attempt.held], accepted[held])
    lowest_acceptance = min(((sum(part) / len(part), name) for name, part in good.items()), default=None)
    return GateReport(
        path=str(out),
        frame=frame,
        train_grasps=len(train),
        train_held=sum(attempt.held for attempt in train),
        validation_grasps=len(validation),
        validation_objects=len(right),
        accuracy=float((accepted == held).mean()),
        interval=grouped_interval(list(right.values())),
        chance=float(max(held.mean(), 1 - held.mean())),
        accepted={
            name: (sum(part), len(part))
            for name, part in _group_flags([attempt.outcome for attempt in validation], accepted).items()
        },
        lowest_acceptance=lowest_acceptance and (lowest_acceptance[1], lowest_acceptance[0]),
    )


def _group_flags(names: Sequence[str], flags: NDArray[np.bool_]) -> dict[str, list[bool]]:
    groups: dict[str, list[bool]] = defaultdict(list)
    for name, flag in zip(names, flags.tolist(), strict=True):
        groups[name].append(flag)
    return dict(sorted(groups.items()))


def _save(
    out: Path,
    gate: GraspSuccessGate,
    split: Split,
    attempts: Sequence[Attempt],
    recording: Path,
    report: GateReport,
    training: Mapping[str, int],
) -> None:
    provenance = {
        **training,
        "source": recording_source(recording),
        "data_digest": data_digest(attempt.grasp for attempt in attempts),
        "outcomes": dict(Counter(attempt.outcome for attempt in attempts)),
        "metrics": {key: value for key, value in report.to_dict().items() if key != "path"},
    }
    header = {"task": TASK, "gate": dataclasses.asdict(gate.settings), "split": split.to_dict()}
    write_tensors(out, gate.net.state_dict(), {**header, "provenance": provenance})
