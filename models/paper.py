"""The paper's training run (Lin, Calandra, Levine, ICRA 2019) on one GPU, and its accuracy on the test objects.

    python -m models.paper RECORDING --out paper.safetensors --init resnet50-0676ba61.pth

This trains the preset `paper`: ResNet-50 with ImageNet weights, 26,000 steps of 48 pairs. Without --init the weights
are downloaded; if this fails, the training starts from random ones. It is the training of `retrieve train --config
paper`, but it decodes all images first, keeps them in memory, and prints two estimates of its time: from the arithmetic
of the towers, and from the first steps. The towers compute in bfloat16 on a GPU that has it. The same command continues
an interrupted run. At the end it evaluates the checkpoint; the report is in paper-report/. On a CPU it takes days.
"""

import argparse
import itertools
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from retrieval.commands.main import main as run_command
from retrieval.commands.options import training_config
from retrieval.console.memory import keep_freed_memory
from retrieval.console.output import say
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.data.pairs import PairBatch
from retrieval.errors import RetrievalError
from retrieval.model.config import Config
from retrieval.model.encode import autocast
from retrieval.model.towers.tower import build_tower
from retrieval.training.trainer import Trainer, prepare_run

TIMED_STEPS = 20
"""First steps that the second estimate is made from."""


def main(argv: Sequence[str] | None = None) -> int:
    """Train, or continue, and evaluate; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="checkpoint to write (.safetensors)")
    parser.add_argument("--init", help="state dict of ResNet-50, torchvision's key names; or random")
    parser.add_argument("--config", default="paper", help="another preset or TOML file that trains towers")
    parser.add_argument("--iterations", type=int, help="another number of steps")
    arguments = parser.parse_args(argv)
    try:
        config = training_config(arguments.config, arguments.iterations, init=arguments.init, workers=0)
        train(arguments.recording, arguments.out, config)
    except RetrievalError as error:
        say(str(error))
        return error.exit_code
    report = arguments.out.with_name(f"{arguments.out.stem}-report")
    words = ["evaluate", str(arguments.recording), "--model", str(arguments.out), "--methods", "late_fusion,chance"]
    say(f"retrieve {' '.join(words)} --out {report}")
    return run_command([*words, "--out", str(report)])


def train(recording: Path, out: Path, config: Config) -> None:
    """Train as `retrieval.train`, with images in memory and estimates of the time.

    `config.training.workers` must be 0: a worker process would have a memory of its own.
    """
    trainer = prepare_run(recording, out, config)
    settings = trainer.config.training
    decode(trainer, [grasp for grasp in load_grasps(recording) if grasp.object_id not in trainer.split.test])
    rate = matrix_rate(trainer.device, settings.precision)
    operations = tower_operations(trainer.config, trainer.sampler.batch(0, settings.touches_per_batch))
    say(
        f"estimate from arithmetic: the towers take {operations / 1e12:.3g} TFLOP a step; this device multiplies "
        f"matrices at {rate / 1e12:.3g} TFLOP/s: {settings.iterations:,} steps take at least "
        f"{duration(settings.iterations * operations / rate)}"
    )
    time_first_steps(trainer)
    trainer.run()


def decode(trainer: Trainer, grasps: Sequence[Grasp]) -> None:
    """Decode all images of grasps into the trainer's memory, which keeps up to 4 GiB of photos and of gel images."""
    images = trainer.features.images
    with Bar("decoding", len(grasps), "grasps") as bar, worker_pool() as pool:
        for _ in map_in_order(pool, lambda grasp: (images.touch(grasp), [*map(images.photo, grasp.photos)]), grasps):
            bar.advance()


def tower_operations(config: Config, batch: PairBatch) -> int:
    """Return the floating-point operations of the towers for a batch, forward and backward: two per multiplication."""
    matcher, sizes, operations = config.matcher, config.preprocessing, 0
    for name, count, side in (
        (matcher.tower, len(batch.grasps) * matcher.fingers, sizes.touch_px),
        (matcher.photo_tower or matcher.tower, len(batch.photos) * len(sizes.views), sizes.photo_px),
    ):
        tower = build_tower(name, matcher.tower_output)
        with FlopCounterMode(display=False) as counter:  # of two images: batch normalisation refuses one
            tower(torch.zeros(2, 3, side, side)).sum().backward()
        operations += counter.get_total_flops() * count // 2
    return operations


def matrix_rate(device: torch.device, precision: str) -> float:
    """Return the floating-point operations per second of a large matrix product, the fastest of ten."""
    side, times = 4096 if device.type == "cuda" else 1024, []
    matrix = torch.rand(side, side, device=device)
    with autocast(device, precision):
        for _ in range(10):
            start = time.perf_counter()
            float((matrix @ matrix)[0, 0])  # waits for the device
            times.append(time.perf_counter() - start)
    return 2 * side**3 / min(times)


def time_first_steps(trainer: Trainer) -> None:
    """Let the trainer print the total time that the median of its first steps implies."""
    ends: list[float] = []

    def after_step(*_: object) -> None:
        ends.append(time.perf_counter())
        if len(ends) == TIMED_STEPS:
            hook.remove()
            step_s = statistics.median(end - start for start, end in itertools.pairwise(ends))
            steps, first = trainer.config.training.iterations, f"{TIMED_STEPS} steps, of {step_s:.3g} s"
            say(f"estimate from the first {first}: {steps:,} steps take {duration(step_s * steps)}")

    hook = trainer.optimizer.register_step_post_hook(after_step)


def duration(seconds: float) -> str:
    """Return a time as hours and minutes, or seconds if short."""
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes else f"{seconds:.1f} s"


if __name__ == "__main__":
    keep_freed_memory()
    sys.exit(main())
