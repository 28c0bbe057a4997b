"""One training step on the paper's batch with each image encoded once, against the same pairs without sharing."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from retrieval.config import Config
from retrieval.dataset import PairBatch
from retrieval.encode import to_batch, touch_batch
from retrieval.train import batch_loss, set_training_mode
from tests.benchmarks.common import Line, as_text, duration, in_turns, matcher_of, random_images

Features = Callable[[], tuple[Tensor, Tensor]]


def measure(config: Config, touches: int = 6, photos_each: int = 8, repetitions: int = 3) -> Iterator[Line]:
    """One line. Every touch has its own photos, half of them of its object; no photo is shared."""
    matcher, pre, pairs = matcher_of(config), config.preprocessing, touches * photos_each
    optimizer = torch.optim.Adam(matcher.parameters(), lr=1e-6)
    grasps = [random_images(config.matcher.fingers, pre.touch_px, seed=number) for number in range(touches)]
    touch, photo = touch_batch(grasps), to_batch(random_images(pairs, pre.photo_px, seed=99))
    owner = np.repeat(np.arange(touches), photos_each)
    each_touch = touch[owner]

    def shared() -> tuple[Tensor, Tensor]:
        return matcher.touch_features(touch), matcher.photo_features(photo)

    def repeated() -> tuple[Tensor, Tensor]:
        return matcher.touch_features(each_touch), matcher.photo_features(photo)

    def one_by_one() -> tuple[Tensor, Tensor]:
        features = [
            (matcher.touch_features(t[None]), matcher.photo_features(p[None]))
            for t, p in zip(each_touch, photo, strict=True)
        ]
        return torch.cat([t for t, _ in features]), torch.cat([p for _, p in features])

    def loss(features: Features, index: np.ndarray) -> tuple[Tensor, Tensor]:
        return batch_loss(matcher, config.training, _batch(index, owner, photos_each), *features())

    def step(features: Features, index: np.ndarray) -> None:
        set_training_mode(matcher, config.training)
        optimizer.zero_grad(set_to_none=True)
        loss(features, index)[0].backward()
        optimizer.step()

    alone = np.arange(pairs)
    with torch.inference_mode():  # in evaluation mode, where no batch statistics differ, the arms agree
        torch.testing.assert_close(loss(shared, owner)[1], loss(repeated, alone)[1], rtol=1e-3, atol=1e-3)
    arms = {
        "shared": lambda: step(shared, owner),
        "repeated": lambda: step(repeated, alone),
        "one": lambda: step(one_by_one, alone),
    }
    times = in_turns(arms, repetitions)
    one, repeat = times.ratio("one", "shared"), times.ratio("repeated", "shared")
    ours, slow, batched = (times.median(arm) for arm in ("shared", "one", "repeated"))
    yield Line(
        "step",
        config.matcher.tower,
        f"{touches} touches x {photos_each} photos take {duration(ours)} with shared images, {duration(slow)} pair by "
        f"pair: {as_text(one)}; {duration(batched)} as one batch of {pairs} pairs with repeated touches: "
        f"{as_text(repeat)}",
        {"shared_s": ours, "one_by_one_s": slow, "repeated_s": batched, "ratio": one[0], "ratio_repeated": repeat[0]},
    )


def _batch(touch_index: np.ndarray, objects: np.ndarray, photos_each: int) -> PairBatch:
    pairs = len(objects)
    return PairBatch(
        grasps=[],
        photos=[],
        touch_index=touch_index,
        photo_index=np.arange(pairs),
        labels=(np.arange(pairs) % photos_each < photos_each // 2).astype(np.float32),
        touch_objects=objects[np.unique(touch_index, return_index=True)[1]],
        photo_objects=objects,
    )
