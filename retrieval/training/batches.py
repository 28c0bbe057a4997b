"""Features of the distinct images of pairs, from towers in training or from frozen towers with cached features."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import torch
from torch import Tensor

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, ImageCache
from retrieval.data.loading import TimedFunction, map_in_order, worker_count, worker_pool
from retrieval.data.pairs import PairBatch
from retrieval.errors import DatasetError, JobInterrupted
from retrieval.model.config import Config
from retrieval.model.encode import (
    Image,
    autocast,
    one_thread,
    photo_features,
    to_batch,
    touch_batch,
    touch_features,
)
from retrieval.model.fusion import Matcher
from retrieval.training import distributed
from retrieval.training.augmentation import augment_photos, augment_touches
from retrieval.training.disk_image_cache import DiskImageCache


@dataclass(frozen=True)
class LoadedBatch:
    """A batch with its images, or with the features themselves."""

    batch: PairBatch
    touches: Tensor
    photos: Tensor


class BatchImages:
    """Loader of the images of batches: worker threads (`retrieval.data.loading`), some batches ahead.

    No result depends on the settings of the loader (`TrainingConfig.workers`, `prefetch`, `pinned_memory`).
    """

    def __init__(self, config: Config, device: torch.device, *, keep_bytes: int = 4 << 30) -> None:
        self.config, self.device = config, device
        self.uses_background = config.preprocessing.background != "none"
        self.decoders = TimedFunction(config.preprocessing.load_touch), TimedFunction(config.preprocessing.load_photo)
        self._touch: ImageCache | DiskImageCache
        self._photo: ImageCache | DiskImageCache
        self._touch, self._photo = (ImageCache(load, keep_bytes) for load in self.decoders)
        self._ahead = ThreadPoolExecutor(1)
        self._workers = worker_pool(config.training.workers)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ahead.shutdown(cancel_futures=True)
        self._workers.shutdown(cancel_futures=True)

    @property
    def decode_rate(self) -> float | None:
        """Images that all workers together can decode each second; None if every image came from the cache."""
        seconds = [second for decoder in self.decoders for second in decoder.seconds]
        return worker_count(self.config.training.workers) * len(seconds) / sum(seconds) if seconds else None

    def touch(self, grasp: Grasp) -> list[Image]:
        """Return the preprocessed finger images of a grasp.

        Raises:
            DatasetError: A no-contact frame is missing.
        """
        return [self._touch(*files) for files in self._fingers(grasp)]

    def _fingers(self, grasp: Grasp) -> list[tuple[Path, ...]]:
        """Return the files of each finger image of a grasp."""
        if not self.uses_background:
            return [(path,) for path in grasp.touches]
        if len(grasp.backgrounds) != len(grasp.touches):
            raise DatasetError(
                f"the background policy needs a no-contact frame for each finger; {grasp.grasp_id} has "
                f'{len(grasp.backgrounds)} for {len(grasp.touches)}; set background = "none" or record them'
            )
        return list(zip(grasp.touches, grasp.backgrounds, strict=True))

    def files(self, grasp: Grasp) -> tuple[Path, ...]:
        """Return all files of the finger images of a grasp."""
        return grasp.touches + (grasp.backgrounds if self.uses_background else ())

    def photo(self, path: Path) -> Image:
        """Return a preprocessed photo."""
        return self._photo(path)

    def fill_cache(self, folder: Path, grasps: Sequence[Grasp], *, quiet: bool = False) -> None:
        """Decode the images of grasps into `folder`, and read them from there afterwards (`DiskImageCache`)."""
        settings = self.config.preprocessing
        by, workers = settings.digest(), self.config.training.workers
        self._touch = touches = DiskImageCache(settings.load_touch, folder, "touch", by, workers)
        touches.cache_decoded([files for grasp in grasps for files in self._fingers(grasp)], quiet=quiet)
        self._photo = photos = DiskImageCache(settings.load_photo, folder, "photo", by, workers)
        photos.cache_decoded([(grasp.photo,) for grasp in grasps], quiet=quiet)


class TrainedFeatures(BatchImages):
    """Features of towers in training: each rank encodes a part of the images and gathers the other parts."""

    def prepare(self, matcher: Matcher, batch: PairBatch, step: int = 0) -> "Future[LoadedBatch]":
        """Start loading this rank's part of the images of step `step`."""
        return self._ahead.submit(self._load, batch, step)

    def _load(self, batch: PairBatch, step: int) -> LoadedBatch:
        grasps = [batch.grasps[row] for row in distributed.rank_rows(len(batch.grasps))]
        photos = [batch.photos[row] for row in distributed.rank_rows(len(batch.photos))]
        touch_futures = [self._workers.submit(self.touch, grasp) for grasp in grasps]
        photo_futures = [self._workers.submit(self.photo, path) for path in photos]
        touch_images = touch_batch([future.result() for future in touch_futures])
        photo_images = to_batch([future.result() for future in photo_futures])
        if self.config.training.augment:
            touch_images, photo_images = self._augment(batch, step, touch_images, photo_images)
        return LoadedBatch(batch, self._to_device(touch_images), self._to_device(photo_images))

    def _augment(self, batch: PairBatch, step: int, touches: Tensor, photos: Tensor) -> tuple[Tensor, Tensor]:
        """Return this rank's images, augmented. The touches and photos of an object are mirrored together."""
        seed, objects = self.config.training.seed, 1 + int(batch.photo_objects.max())
        is_mirrored = np.random.default_rng([seed, 5, step]).random(objects) < 0.5
        touch_objects = batch.touch_objects[distributed.rank_rows(len(batch.grasps))]
        photo_objects = batch.photo_objects[distributed.rank_rows(len(batch.photos))]
        rng = np.random.default_rng([seed, 6, step, distributed.rank()])
        with one_thread():  # another thread computes the step
            return (
                augment_touches(touches, is_mirrored[touch_objects], rng),
                augment_photos(photos, len(self.config.preprocessing.views), is_mirrored[photo_objects], rng),
            )

    def _to_device(self, images: Tensor) -> Tensor:
        """Copy images to the device, from pinned memory while the device computes."""
        pinned = self.device.type == "cuda" and self.config.training.pinned_memory
        return (images.pin_memory() if pinned else images).to(self.device, non_blocking=pinned)

    def step_context(self) -> AbstractContextManager[None]:
        """Return the context of a training step; it changes nothing, since towers use every core."""
        return nullcontext()

    def train_features(self, matcher: Matcher, loaded: LoadedBatch) -> tuple[Tensor, Tensor]:
        """Return features of the batch's touches and photos; each distinct image passes through its tower once."""
        touches, photos = len(loaded.batch.grasps), len(loaded.batch.photos)
        with autocast(self.device, self.config.training.precision):
            touch = matcher.touch_features(loaded.touches)
            photo = matcher.photo_features(loaded.photos)
        return distributed.gather_rows(touch, touches), distributed.gather_rows(photo, photos)

    def eval_features(self, matcher: Matcher, pairs: PairBatch) -> tuple[Tensor, Tensor]:
        """Return features of the pairs' touches and photos, encoded without gradients."""
        touch = touch_features(matcher, map_in_order(self._workers, self.touch, pairs.grasps))
        return touch, photo_features(matcher, map_in_order(self._workers, self.photo, pairs.photos))


class FrozenFeatures(BatchImages):
    """Features of frozen towers: each image is encoded once."""

    def __init__(self, config: Config, device: torch.device, known: Mapping[str | Path, Tensor]) -> None:
        """Start with known features.

        Args:
            config: The configuration.
            device: Device of the features.
            known: Features by grasp id (of the touch) and by photo file that need no encoding
                (`retrieval.training.features.features_by_image`).
        """
        super().__init__(config, device, keep_bytes=0)  # images are read once, since their features are cached
        self._features: dict[str | Path, Tensor] = dict(known)

    def prepare(self, matcher: Matcher, batch: PairBatch, step: int = 0) -> "Future[LoadedBatch]":
        """Return the features of a batch, and encode new images before returning; `step` has no effect.

        This does not use the prefetch thread. PyTorch starts a separate team of workers for every calling thread, and
        two teams on the same cores wait for each other a hundred times as long as a step computes.
        """
        done: Future[LoadedBatch] = Future()
        done.set_result(self._cached_features(matcher, batch))
        return done

    @torch.inference_mode()
    def _cached_features(self, matcher: Matcher, batch: PairBatch) -> LoadedBatch:
        new = {grasp.grasp_id: grasp for grasp in batch.grasps if grasp.grasp_id not in self._features}
        if new:
            images = map_in_order(self._workers, self.touch, new.values())
            self._features.update(zip(new, touch_features(matcher, images), strict=True))
        photos = [path for path in batch.photos if path not in self._features]
        if photos:
            photo_images = map_in_order(self._workers, self.photo, photos)
            self._features.update(zip(photos, photo_features(matcher, photo_images), strict=True))
        touches = torch.stack([self._features[grasp.grasp_id] for grasp in batch.grasps])
        return LoadedBatch(batch, touches, torch.stack([self._features[path] for path in batch.photos]))

    def step_context(self) -> AbstractContextManager[None]:
        """Return the context of a training step: one thread, since more do not speed up the head's small products."""
        return one_thread()

    def train_features(self, matcher: Matcher, loaded: LoadedBatch) -> tuple[Tensor, Tensor]:
        """Return the features of the batch's touches and photos, as constants of the step."""
        return loaded.touches.clone(), loaded.photos.clone()

    def eval_features(self, matcher: Matcher, pairs: PairBatch) -> tuple[Tensor, Tensor]:
        """Return the features of the pairs' touches and photos."""
        loaded = self.prepare(matcher, pairs).result()
        return loaded.touches, loaded.photos


FeatureSource = TrainedFeatures | FrozenFeatures
"""The source of a training run's features."""


_CHUNK = 64


@torch.inference_mode()
def recorded_features(
    matcher: Matcher,
    source: FeatureSource,
    grasps: Sequence[Grasp],
    *,
    what: str,
    quiet: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[Tensor, dict[Path, Tensor]]:
    """Return features of the touches of grasps (G, fingers * F) and of each of their photo files (F,).

    Args:
        matcher: The model.
        source: The source of features.
        grasps: At least one grasp.
        what: Purpose of the features, for the progress bar and messages.
        quiet: No progress on stderr.
        should_stop: Called between parts.

    Raises:
        JobInterrupted: `should_stop()` returned True.
    """
    none = np.zeros(0, dtype=np.int64)
    touches: list[Tensor] = []
    photos: dict[Path, Tensor] = {}
    with Bar(f"encode for {what}", len(grasps), "grasps", quiet=quiet) as bar:
        for start in range(0, len(grasps), _CHUNK):
            if should_stop():
                raise JobInterrupted(f"stopped before the {what} was fitted")
            part = list(grasps[start : start + _CHUNK])
            files = list(dict.fromkeys(grasp.photo for grasp in part))
            batch = PairBatch(part, files, none, none, np.zeros(0, dtype=np.float32), none, none)
            touch, photo = source.eval_features(matcher, batch)
            touches.append(touch)
            photos |= zip(files, photo, strict=True)
            bar.advance(len(part))
    return torch.cat(touches), photos
