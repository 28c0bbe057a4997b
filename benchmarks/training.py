"""Images per second of tower training, compared with the bare forward and backward pass of a prepared batch.

    python -m benchmarks.training --recording recording/ --tower small mobilenet_v2 resnet50

    bare      forward pass, loss and backward pass of one batch
    cached    training steps, other images each time, from files that were decoded once (`--cache`), with the optimiser
    decoded   the same, each image decoded for its step, as in the first pass of a training run without such files

All arms run in turn. With one thread everything runs on one core, so that decoding takes time from the step, and the
figure is CPU time, which does not depend on other programs. With two threads it is wall-clock time. `--ranks`: two
processes of one thread, started like those of `torchrun`, in turn with one process of two threads and one of one.
Without `--recording` pictures are drawn. `--pictures` (of `collect --photos-only` or `--touches-only`) also trains the
tower of preset `relief`, whose pictures are rotated, shifted, relit and made noisy for each step.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import ResultLine, as_text, config_of, duration, in_turns
from retrieval.console.progress import Bar
from retrieval.data.dataset import ImageCache, load_grasps, make_split
from retrieval.data.labelled_pictures import load_labelled
from retrieval.data.loading import prefetch
from retrieval.model.config import PRECISIONS, Config, load_config
from retrieval.model.encode import has_fast_bfloat16
from retrieval.model.towers import TOWERS
from retrieval.training import distributed
from retrieval.training.batches import TrainedFeatures
from retrieval.training.fit import Plan, fit
from retrieval.training.relief import ReliefTraining
from retrieval.training.train import Trainer
from tests import synthetic

STEPS, REPETITIONS = 4, 5
ROUNDS = 3
"""Number of rounds of `--ranks`."""


@dataclass(frozen=True)
class Work:
    """One training run.

    Attributes:
        optimizer: the optimiser.
        prepare: returns the batch of a step.
        loss: returns the loss of a batch.
        images: number of images per step.
        before_step: called before each step of the optimiser.
    """

    optimizer: torch.optim.Optimizer
    prepare: Callable[[int], "Future[Any]"]
    loss: Callable[[Any], Tensor]
    images: int
    before_step: Callable[[], None] = lambda: None

    def steps(self, count: int) -> None:
        """Run this many training steps, without validation."""
        plan = Plan(2 * count, 1e-6, "constant", 2 * count)
        with Bar("", count, "steps", quiet=True) as bar:
            batches = prefetch(map(self.prepare, range(count)), 1)
            fit(self.optimizer, plan, batches, self.loss, bar=bar, before_step=self.before_step)

    def bare(self, batch: Any) -> None:
        """Run one forward and backward pass."""
        self.optimizer.zero_grad(set_to_none=True)
        self.loss(batch).backward()


@contextmanager
def matching(config: Config, recording: Path, folder: Path) -> Iterator[tuple[Trainer, dict[str, Work]]]:
    """Yield both ways to train towers on a recording; decoded images are cached in `folder`."""
    grasps, training = load_grasps(recording), config.training
    split = make_split(grasps, validation=training.validation_fraction, test=training.test_fraction, seed=0)
    trainer = Trainer(config, split, grasps, folder / "none.safetensors", "benchmark")
    with (
        TrainedFeatures(config, trainer.device, keep_bytes=0) as decoded,
        TrainedFeatures(config, trainer.device) as cached,
    ):
        cached.fill_cache(folder, grasps, quiet=True)
        trainer.features = cached

        def work(source: TrainedFeatures) -> Work:
            def prepare(step: int) -> "Future[Any]":
                return source.prepare(trainer.matcher, trainer.sampler.batch(step, training.touches_per_batch))

            batch = trainer.sampler.batch(0, training.touches_per_batch)
            images = len(batch.photos) + len(batch.grasps) * config.matcher.fingers
            return Work(
                trainer.optimizer,
                prepare,
                trainer.loss,
                images,
                lambda: distributed.average_gradients(trainer.matcher),
            )

        yield trainer, {"cached": work(cached), "decoded": work(decoded)}


@contextmanager
def relief(config: Config, pictures: Path, folder: Path) -> Iterator[dict[str, Work]]:
    """Yield both ways to train a tower on relief."""
    works: dict[str, Work] = {}
    with ThreadPoolExecutor(1) as prefetch:
        for name in ("cached", "decoded"):
            training = ReliefTraining(*load_labelled(pictures), config, STEPS)
            if name == "cached":
                training.cache_decoded(folder, quiet=True)
            else:
                training._variants = ImageCache(training._load, 0)
            batch = training._batch(0)
            works[name] = Work(
                training.optimizer,
                lambda step, training=training: prefetch.submit(training._batch, step),
                training._loss,
                len(batch[1]),
            )
        yield works


def rates(
    name: str, works: dict[str, Work], threads: int, steps: int = STEPS, repetitions: int = REPETITIONS
) -> Iterator[ResultLine]:
    """Yield images per second of each arm, and with one thread the parts of a step."""
    with running_on(threads):
        ready = works["cached"].prepare(0).result()
        arms = {name: lambda work=work: work.steps(steps) for name, work in works.items()}
        arms["bare"] = lambda: [works["cached"].bare(ready) for _ in range(steps)]
        clock = time.process_time if threads == 1 else time.perf_counter
        times = in_turns(arms, repetitions, clock)
        images = steps * works["cached"].images
        rate = {arm: images / times.median(arm) for arm in arms}
        ratio = {arm: times.ratio("bare", arm) for arm in works}
        yield ResultLine(
            "training",
            name,
            f"{threads} thread{'s' * (threads > 1)}: {rate['cached']:.3g} images per second from cached files, "
            f"{rate['decoded']:.3g} with decoding, {rate['bare']:.3g} by bare passes: {as_text(ratio['cached'])} and "
            f"{as_text(ratio['decoded'])} the bare rate",
            {f"{arm}_per_s": value for arm, value in rate.items()} | {f"ratio_{arm}": ratio[arm][0] for arm in works},
        )
        if threads == 1:
            yield parts(name, works, steps)


def parts(name: str, works: dict[str, Work], steps: int) -> ResultLine:
    """Return the CPU time of the parts of a step."""
    seconds: dict[str, list[float]] = {}

    def timed(part: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        seconds.setdefault(part, []).append(time.process_time() - start)
        return result

    cached = works["cached"]
    for step in range(steps):
        timed("draw and decode", lambda step=step: works["decoded"].prepare(step).result())
        batch = timed("draw and map", lambda step=step: cached.prepare(step).result())
        cached.optimizer.zero_grad(set_to_none=True)
        loss = timed("forward", lambda batch=batch: cached.loss(batch))
        timed("backward", loss.backward)
        timed("optimiser", cached.optimizer.step)
    medians = {part: float(np.median(each)) for part, each in seconds.items()}
    text = ", ".join(f"{part} {duration(value)}" for part, value in medians.items())
    return ResultLine("parts", name, text, {f"{part}_s": value for part, value in medians.items()})


def validation(name: str, trainer: Trainer) -> ResultLine:
    """Return the cost of a validation, also per training step, in CPU time of one thread."""
    start = time.process_time()
    with running_on(1):
        trainer.validate()
    spent, every = time.process_time() - start, trainer.config.training.validate_every
    text = (
        f"validation {duration(spent)}, {duration(spent / every)} for each of the {every} steps between two validations"
    )
    return ResultLine("parts", name, text, {"validation_s": spent, "validation_per_step_s": spent / every})


def rounding(name: str, trainer: Trainer, work: Work) -> ResultLine:
    """Compare the gradients in bfloat16 with those in float32, at the first weights."""
    ready = work.prepare(0).result()

    def gradient(precision: str) -> Tensor:
        training = dataclasses.replace(trainer.config.training, precision=precision)
        trainer.features.config = dataclasses.replace(trainer.config, training=training)
        work.bare(ready)  # the step draws the same dropout mask
        return torch.cat([each.grad.flatten() for each in trainer.matcher.parameters() if each.grad is not None])

    with running_on(1):
        exact, rounded = gradient("float32"), gradient("bfloat16")
    distance = float((rounded - exact).norm() / exact.norm())
    cosine = float(torch.nn.functional.cosine_similarity(rounded, exact, dim=0))
    text = f"gradients in bfloat16 differ by {distance:.2g} of their length from those in float32, cosine {cosine:.4f}"
    return ResultLine("rounding", name, text, {"apart": distance, "cosine": cosine})


@contextmanager
def running_on(threads: int) -> Iterator[None]:
    """Run PyTorch on this many threads; with one, all threads started here share one core."""
    before, cores = torch.get_num_threads(), os.sched_getaffinity(0)
    torch.set_num_threads(threads)
    if threads == 1:
        os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        torch.set_num_threads(before)


def ranks(towers: Sequence[str], recording: Path, precision: str, rounds: int = ROUNDS) -> Iterator[ResultLine]:
    """Compare two processes of one thread with one process of two threads and one of one, started in turn.

    Each prints the medians of its steps. Use the wall-clock time if nothing else runs. While other programs run,
    threads wait for one another; then the CPU time gives an upper bound for two processes, which also wait for each
    other.
    """
    two = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    start = {"two": (two, 1), "one": ([sys.executable], 2), "alone": ([sys.executable], 1)}
    for tower in towers:
        outputs: dict[str, list[list[float]]] = {name: [] for name in start}
        for _ in range(rounds):
            for name, (command, threads) in start.items():
                command = [*command, "-m", "benchmarks.training", "--rank", "--tower", tower]
                command += ["--recording", str(recording), "--precision", precision]
                settings = os.environ | {"OMP_NUM_THREADS": str(threads)}
                done = subprocess.run(command, env=settings, capture_output=True, text=True, check=True)
                outputs[name].append([float(word) for word in done.stdout.split()[-2:]])
        clock, cpu = ({name: np.array(each)[:, column] for name, each in outputs.items()} for column in (0, 1))
        ratio, by_cpu = _times(clock["one"], clock["two"]), _times(cpu["alone"], cpu["two"])
        seconds = {name: float(np.median(each)) for name, each in clock.items()}
        spent = {name: float(np.median(each)) for name, each in cpu.items()}
        yield ResultLine(
            "ranks",
            tower,
            f"a step takes {duration(seconds['two'])} on two processes of one thread, {duration(seconds['one'])} on "
            f"one of two: {as_text(ratio)} its rate; CPU time {duration(spent['two'])} of each of the two, "
            f"{duration(spent['alone'])} of one process of one thread: {as_text(by_cpu)} its rate at most",
            {f"{name}_s": each for name, each in seconds.items()}
            | {f"{name}_cpu_s": each for name, each in spent.items()}
            | {"ratio": ratio[0], "ratio_cpu": by_cpu[0]},
        )


def _times(slow: np.ndarray, fast: np.ndarray) -> tuple[float, float, float]:
    """Return the ratio of the medians, and the range over single rounds."""
    each = slow / fast
    return float(np.median(slow) / np.median(fast)), float(each.min()), float(each.max())


def as_rank(config: Config, recording: Path, steps: int = STEPS, repetitions: int = REPETITIONS) -> None:
    """Print the median seconds of a step on the first rank: wall-clock time and CPU time of this process."""
    distributed.start()
    taken = []
    with tempfile.TemporaryDirectory() as name, matching(config, recording, Path(name)) as (_, works):
        for _ in range(1 + repetitions):  # the first is not counted
            start = time.perf_counter(), time.process_time()
            works["cached"].steps(steps)
            taken.append([time.perf_counter() - start[0], time.process_time() - start[1]])
        if not distributed.rank():
            print(*np.median(taken[1:], axis=0) / steps)
    distributed.stop()


def configured(tower: str, precision: str, init: str = "random") -> Config:
    """Return `config_of` with this precision and these first weights."""
    config = config_of(tower).without_candidate_encoder()
    training = dataclasses.replace(config.training, precision=precision, init=init)
    return dataclasses.replace(config, training=training)


def main() -> None:
    """Print each line as soon as it is available."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description=__doc__.split("\n\n")[0])
    parser.add_argument("--recording", type=Path, help="training data (default: synthetic pictures)")
    parser.add_argument("--pictures", type=Path, help="labelled pictures, to train relief on")
    parser.add_argument("--tower", nargs="+", choices=sorted(TOWERS), default=["small", "mobilenet_v2"])
    parser.add_argument("--precision", choices=PRECISIONS, default="auto")
    parser.add_argument("--init", default="random", help="first weights, as in `retrieve train`")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--ranks", action="store_true", help="only compare two processes with one of two threads")
    parser.add_argument("--rank", action="store_true", help=argparse.SUPPRESS)  # a process of `--ranks`
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = arguments.recording
        if recording is None:
            recording = synthetic.write_recording(folder / "drawn", synthetic.make_objects(24), 6)
        if arguments.rank:
            as_rank(configured(arguments.tower[0], arguments.precision, arguments.init), recording)
            return
        for line in lines(arguments, recording, folder):
            print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


def lines(arguments: argparse.Namespace, recording: Path, folder: Path) -> Iterator[ResultLine]:
    """Yield the requested lines."""
    if arguments.ranks:
        yield from ranks(arguments.tower, recording, arguments.precision)
        return
    for tower in arguments.tower:
        with matching(configured(tower, arguments.precision, arguments.init), recording, folder) as (trainer, works):
            for threads in arguments.threads:
                yield from rates(tower, works, threads)
            yield validation(tower, trainer)
            if has_fast_bfloat16(trainer.device):
                yield rounding(tower, trainer, works["cached"])
    if arguments.pictures:
        config = load_config("relief")
        training = dataclasses.replace(config.training, init="random", precision=arguments.precision)
        with relief(dataclasses.replace(config, training=training), arguments.pictures, folder) as works:
            for threads in arguments.threads:
                yield from rates("relief", works, threads)


if __name__ == "__main__":
    main()
