"""Speed-up by a GPU: building, querying, training and simulating, on a device and on the processor in turn.

    python -m benchmarks.gpu [--device cuda] [--tower mobilenet_v2] [--json]

The towers are those of the commands, moved to the device: images come from the processor and codes go back, as in a
build. Scoring and simulation run in numpy on the processor: they are timed once, to show what a GPU does not speed up.
"""

import argparse
import copy
import dataclasses
import json
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch

from benchmarks import grasp
from benchmarks.common import ResultLine, as_text, config_of, duration, in_turns, matcher_of, random_images
from benchmarks.step import pair_batch, shared_photos
from retrieval.model.config import Config
from retrieval.model.encode import default_device, encode_photos, encode_touches, to_batch, touch_batch
from retrieval.model.fusion import Matcher, scorer_of
from retrieval.model.towers import TOWERS
from retrieval.training.step import WeightedLosses, batch_loss
from retrieval.training.train import set_training_mode

PHOTOS, RERANKED, REPETITIONS = 64, 1000, 5


def measure(
    config: Config, device: torch.device | str, photos: int = PHOTOS, repetitions: int = REPETITIONS
) -> Iterator[ResultLine]:
    """Yield a line each for building, querying and training; times include waiting for the device."""
    matcher, pre, target = matcher_of(config), config.preprocessing, torch.device(device)
    arms = {"cpu": matcher, str(target): copy.deepcopy(matcher).to(target)}
    images = random_images(photos, pre.photo_px, seed=1)
    strips = [np.concatenate([image] * len(pre.views), axis=1) for image in images]
    touch = random_images(config.matcher.fingers, pre.touch_px, seed=2)
    partials = np.random.default_rng(0).normal(size=(RERANKED, config.matcher.partial_width)).astype(np.float16)
    scorer = scorer_of(matcher.head)

    def query(model: Matcher) -> object:
        return scorer.logits(encode_touches(model, [touch]).partial.numpy(), partials)

    tasks: dict[str, Callable[[Matcher], object]] = {
        f"build, {photos} photos in batches of 16": lambda model: encode_photos(model, strips),
        f"query, one touch, {RERANKED} photos scored": query,
    }
    for name, work in tasks.items():
        yield _line(
            name,
            config,
            {arm: _waiting(partial(work, model), target) for arm, model in arms.items()},
            repetitions,
        )
    steps = {arm: _waiting(_step(model, config, photos), target) for arm, model in arms.items()}
    yield _line("train, a step of 6 touches x 8 photos", config, steps, repetitions)


def _line(name: str, config: Config, arms: dict[str, Callable[[], object]], repetitions: int) -> ResultLine:
    times = in_turns(arms, repetitions)
    processor, device = "cpu", list(arms)[-1]
    ratio = times.ratio(processor, device)
    text = f"{name}: {duration(times.median(device))} on {device}, {duration(times.median(processor))} on the processor"
    text += f": {as_text(ratio)}"
    return ResultLine(
        "gpu", config.matcher.tower, text, {f"{arm}_s": times.median(arm) for arm in arms} | {"ratio": ratio[0]}
    )


def _step(matcher: Matcher, config: Config, photos: int, touches: int = 6) -> Callable[[], object]:
    """Return a training step on the matcher's device, from images in the processor's memory."""
    set_training_mode(matcher, config.training)
    for norm in (matcher.touch_norm, matcher.photo_norm):
        norm.eval()
    pre, device = config.preprocessing, next(matcher.parameters()).device
    optimizer = torch.optim.Adam(matcher.parameters(), lr=1e-6)
    shared = shared_photos(touches, 8)
    grasps = [random_images(config.matcher.fingers, pre.touch_px, seed=number) for number in range(touches)]
    own = [np.concatenate([each] * len(pre.views), axis=1) for each in random_images(shared.max() + 1, pre.photo_px, 9)]
    labels = (np.arange(len(shared)) % 8 < 4).astype(np.float32)
    batch = pair_batch(np.repeat(np.arange(touches), 8), shared, labels)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        features = matcher.touch_features(touch_batch(grasps, device)), matcher.photo_features(to_batch(own, device))
        batch_loss(matcher, WeightedLosses(config.training.weights, matcher, 9), batch, *features)[0].backward()
        optimizer.step()

    return step


def _waiting(work: Callable[[], object], device: torch.device) -> Callable[[], object]:
    """Return the work followed by a wait for the device."""
    if device.type != "cuda":
        return work

    def done() -> None:
        work()
        torch.cuda.synchronize(device)

    return done


def main() -> None:
    """Print each line as soon as it is available."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", default=str(default_device()))
    parser.add_argument("--tower", choices=sorted(TOWERS), default="mobilenet_v2")
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    for lines in (
        measure(config_of(arguments.tower), arguments.device),
        grasp.measure(objects=4, grasps=1, collected=0),
    ):
        for line in lines:
            print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
