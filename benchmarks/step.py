"""One training step on the paper's batch, compared with the same number of pairs one at a time and as one batch.

    ours        6 touches encoded once, and 24 photos, each the positive of one touch and the negative of another
    touches     6 touches encoded once, and 48 photos, none shared by two touches
    batch       48 pairs in one batch, each touch 8 times in it
    one         pair by pair: forward, backward, and one step of the optimiser on the sum

The gradients of the first three on the same pairs are equal (tests/retrieval/training/test_batches.py). Those of pair
by pair are equal too if batch normalisation uses the running statistics; in training mode it would normalise a batch of
one.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import ResultLine, as_text, duration, in_turns, matcher_of, random_images
from retrieval.data.pairs import PairBatch
from retrieval.model.config import Config
from retrieval.model.encode import to_batch, touch_batch
from retrieval.training.step import WeightedLosses, batch_loss
from retrieval.training.train import set_training_mode

Index = np.ndarray


def measure(config: Config, touches: int = 6, photos_each: int = 8, repetitions: int = 3) -> Iterator[ResultLine]:
    """Yield one line. Each touch has as many photos of its own object as of other objects."""
    matcher, pre, pairs = matcher_of(config), config.preprocessing, touches * photos_each
    set_training_mode(matcher, config.training)
    for norm in (matcher.touch_norm, matcher.photo_norm):
        norm.eval()  # one pair has no variance of features to standardise by
    optimizer = torch.optim.Adam(matcher.parameters(), lr=1e-6)
    grasps = [random_images(config.matcher.fingers, pre.touch_px, seed=number) for number in range(touches)]
    touch, photo = touch_batch(grasps), to_batch(random_images(pairs, pre.photo_px, seed=99))
    owner = np.repeat(np.arange(touches), photos_each)
    shared = shared_photos(touches, photos_each)

    def backward(touch: Tensor, photo: Tensor, batch: PairBatch, weight: float = 1.0) -> None:
        features = matcher.touch_features(touch), matcher.photo_features(photo)
        (
            weight * batch_loss(matcher, WeightedLosses(config.training.weights, matcher, 9), batch, *features)[0]
        ).backward()

    def step(passes: Callable[[], None]) -> None:
        optimizer.zero_grad(set_to_none=True)
        passes()
        optimizer.step()

    def one_by_one() -> None:
        for pair in range(pairs):
            labels = np.array([float(pair % photos_each < photos_each // 2)])
            alone = pair_batch(np.zeros(1, int), np.zeros(1, int), labels)
            backward(touch[owner[pair]][None], photo[pair][None], alone, 1 / pairs)

    alone = np.arange(pairs)
    arms = {
        "ours": lambda: backward(touch, photo[: shared.max() + 1], pair_batch(owner, shared, labels)),
        "touches": lambda: backward(touch, photo, pair_batch(owner, alone, labels)),
        "batch": lambda: backward(touch[owner], photo, pair_batch(alone, alone, labels)),
        "one": one_by_one,
    }
    labels = (alone % photos_each < photos_each // 2).astype(np.float32)
    times = in_turns({name: lambda passes=passes: step(passes) for name, passes in arms.items()}, repetitions)
    ratios = {arm: times.ratio(arm, "ours") for arm in ("one", "batch", "touches")}
    yield ResultLine(
        "step",
        config.matcher.tower,
        f"{touches} touches x {photos_each} photos take {duration(times.median('ours'))} with shared images; pair by "
        f"pair {as_text(ratios['one'])} as long, as one batch of {pairs} pairs {as_text(ratios['batch'])}, with photos "
        f"of its own for each touch {as_text(ratios['touches'])}",
        {"ours_s": times.median("ours"), **{f"ratio_{arm}": ratio[0] for arm, ratio in ratios.items()}},
    )


def shared_photos(touches: int, photos_each: int) -> Index:
    """Return photo numbers (pairs,): a touch's own, then as many of the next touches, one of each in turn."""
    own = photos_each // 2
    rows = []
    for touch in range(touches):
        others = [(touch + 1 + turn % (touches - 1)) % touches for turn in range(photos_each - own)]
        rows += [touch * own + number for number in range(own)]
        rows += [other * own + number % own for number, other in enumerate(others)]
    return np.array(rows)


def pair_batch(touch_index: Index, photo_index: Index, labels: Index) -> PairBatch:
    """Return the pairs as arguments of the loss; every touch is of another object."""
    photo_objects = np.zeros(photo_index.max() + 1, np.int64)
    photo_objects[photo_index[labels == 1]] = touch_index[labels == 1]
    touch_objects = np.arange(touch_index.max() + 1)
    return PairBatch([], [], touch_index, photo_index, labels.astype(np.float32), touch_objects, photo_objects)
