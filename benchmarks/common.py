"""Helpers of every benchmark: models with random weights, random images, and arms timed in turn."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from retrieval.model.config import Config, load_config
from retrieval.model.fusion import Matcher

REPETITIONS = 5
MIN_SECONDS = 0.2


@dataclass(frozen=True)
class ResultLine:
    """One result.

    Attributes:
        benchmark: name of the benchmark.
        tower: name of the tower or of the case.
        text: the result as a sentence.
        figures: the numbers by name.
        each: the time of each repetition of each arm, for the range.
    """

    benchmark: str
    tower: str
    text: str
    figures: dict[str, float]
    each: dict[str, list[float]] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.benchmark}, {self.tower}: {self.text}"


@dataclass(frozen=True)
class Times:
    """Seconds of each arm in each repetition."""

    seconds: dict[str, list[float]]

    def median(self, arm: str) -> float:
        """Return the median seconds of an arm."""
        return float(np.median(self.seconds[arm]))

    def ratio(self, slow: str, fast: str, scale: float = 1.0) -> tuple[float, float, float]:
        """Return how many times longer `slow` took: by the medians, and the range over single repetitions."""
        each = scale * np.array(self.seconds[slow]) / np.array(self.seconds[fast])
        return scale * self.median(slow) / self.median(fast), float(each.min()), float(each.max())


def in_turns(
    arms: Mapping[str, Callable[[], object]], repetitions: int, clock: Callable[[], float] = time.perf_counter
) -> Times:
    """Run every arm once unmeasured, then all of them in turn, `repetitions` times.

    A short arm is called repeatedly for about `MIN_SECONDS` in its turn, and the mean of the calls is used. `clock`
    returns seconds; those of `time.process_time` are CPU time.
    """
    calls = {name: max(1, int(MIN_SECONDS / _seconds(arm, 1, clock))) for name, arm in arms.items()}
    seconds: dict[str, list[float]] = {name: [] for name in arms}
    for _ in range(repetitions):
        for name, arm in arms.items():
            seconds[name].append(_seconds(arm, calls[name], clock))
    return Times(seconds)


def _seconds(arm: Callable[[], object], calls: int, clock: Callable[[], float]) -> float:
    start = clock()
    for _ in range(calls):
        arm()
    return (clock() - start) / calls


def config_of(tower: str) -> Config:
    """Return the preset `small` for the tower of that name, otherwise the paper's with this tower; random weights."""
    config = load_config("small" if tower == "small" else "paper")
    return dataclasses.replace(
        config,
        matcher=dataclasses.replace(config.matcher, tower=tower),
        training=dataclasses.replace(config.training, init="random"),
    )


def matcher_of(config: Config) -> Matcher:
    """Return a matcher with random weights, in evaluation mode."""
    torch.manual_seed(0)
    return Matcher(config.matcher).eval()


def random_images(count: int, px: int, seed: int) -> list[np.ndarray]:
    """Return images (px, px, 3) float32 in 0..1."""
    return list(np.random.default_rng(seed).random((count, px, px, 3), dtype=np.float32))


def as_text(ratio: tuple[float, float, float]) -> str:
    """Return the ratio and its range over the repetitions as text."""
    return "{:.3g} times ({:.3g} to {:.3g})".format(*ratio)


def duration(seconds: float) -> str:
    """Return seconds or milliseconds with three digits as text."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def spread(figures: Sequence[float], unit: str) -> str:
    """Return median, minimum and maximum as text."""
    if not figures:
        return ""
    values = (float(np.median(figures)), min(figures), max(figures))
    median, least, greatest = (f"{value:,.0f}" if value >= 100 else f"{value:.3g}" for value in values)
    return f"{median} ({least} to {greatest}) {unit}"
