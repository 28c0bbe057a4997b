"""Features of the images of grasps: by towers in training, batch by batch, or by frozen towers."""

import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from retrieval.console.progress import Bar
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.dataset import Grasp, ImageCache
from retrieval.data.loading import map_in_order, worker_count, worker_pool
from retrieval.data.pairs import PairBatch
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import DatasetError, RetrievalError
from retrieval.model.config import Config
from retrieval.model.encode import (
    Image,
    autocast,
    batches,
    one_thread,
    photo_features,
    to_batch,
    touch_batch,
    touch_features,
)
from retrieval.model.fusion import Matcher
from retrieval.training.augmentation import augment_photos, augment_touches

_CHUNK = 64
_KEEP_BYTES = 4 << 30
"""Memory for decoded photos, and for decoded gel images, of all workers together."""


@dataclass(frozen=True)
class LoadedBatch:
    """A batch with its images, or with their features."""

    batch: PairBatch
    touches: Tensor
    photos: Tensor

    def pin_memory(self) -> "LoadedBatch":
        """Return a copy in page-locked memory; a `DataLoader` calls this."""
        return replace(self, touches=self.touches.pin_memory(), photos=self.photos.pin_memory())


class BatchImages:
    """The preprocessed images of grasps; up to `keep_bytes` of touches, and of photos, are kept in memory.

    `photo` returns the preprocessed photo of a path; all photos are by one camera.
    """

    def __init__(self, settings: Preprocessing, camera: PhotoCamera = USUAL_CAMERA, keep_bytes: int = 0) -> None:
        self.uses_background, load_photo = settings.background != "none", partial(settings.load_photo, camera=camera)
        self._touch, self.photo = (ImageCache(load, keep_bytes) for load in (settings.load_touch, load_photo))

    def touch(self, grasp: Grasp) -> list[Image]:
        """Return the preprocessed finger images of a grasp.

        Raises:
            DatasetError: A no-contact frame is missing.
        """
        if not self.uses_background:
            return [self._touch(path) for path in grasp.touches]
        if len(grasp.backgrounds) != len(grasp.touches):
            raise DatasetError(
                f"the background policy needs a no-contact frame for each finger; {grasp.grasp_id} has "
                f'{len(grasp.backgrounds)} for {len(grasp.touches)}; set background = "none" or record them'
            )
        return [self._touch(*files) for files in zip(grasp.touches, grasp.backgrounds, strict=True)]

    def files(self, grasp: Grasp) -> tuple[Path, ...]:
        """Return all files of the finger images of a grasp."""
        return grasp.touches + (grasp.backgrounds if self.uses_background else ())


class _BatchLoader(Dataset[LoadedBatch | RetrievalError]):
    """Loads the images of a batch, in the processes of a `DataLoader`."""

    def __init__(self, config: Config, images: BatchImages) -> None:
        self.config, self.images = config, images

    def __getitem__(self, numbered: tuple[int, PairBatch]) -> LoadedBatch | RetrievalError:
        """Return the images of the batch of a step, or the error: a `DataLoader` would add a traceback."""
        step, batch = numbered
        try:
            touches = touch_batch([self.images.touch(grasp) for grasp in batch.grasps])
            photos = to_batch([self.images.photo(photo) for photo in batch.photos])
        except RetrievalError as error:
            return error
        if self.config.training.augment:
            seed, views = self.config.training.seed, len(self.config.preprocessing.views)
            # The touches and photos of an object are mirrored together.
            is_mirrored = np.random.default_rng([seed, 5, step]).random(1 + int(batch.photo_objects.max())) < 0.5
            rng = np.random.default_rng([seed, 6, step])
            touches = augment_touches(touches, is_mirrored[batch.touch_objects], rng)
            photos = augment_photos(photos, views, is_mirrored[batch.photo_objects], rng)
        return LoadedBatch(batch, touches, photos)


def _ignore_interruption(worker: int) -> None:
    """Leave Ctrl-C to the main process, which ends the training after the current step."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class TrainedFeatures:
    """Features of towers in training."""

    step_context = nullcontext  # of a training step: towers use every core

    def __init__(self, config: Config, device: torch.device, camera: PhotoCamera = USUAL_CAMERA) -> None:
        workers = config.training.workers
        # On a CPU the towers use every core, so workers would only take time from them.
        self._workers = workers if isinstance(workers, int) else worker_count() if device.type == "cuda" else 0
        self.config, self.device = config, device
        self.images = BatchImages(config.preprocessing, camera, _KEEP_BYTES // max(1, self._workers))

    def batches(self, matcher: Matcher, batches: Iterable[tuple[int, PairBatch]]) -> Iterator[LoadedBatch]:
        """Yield each batch, given with its step, with its images; the same ones for any number of workers."""
        loader = DataLoader(
            _BatchLoader(self.config, self.images),
            batch_size=None,
            sampler=batches,
            num_workers=self._workers,
            pin_memory=self.device.type == "cuda",
            worker_init_fn=_ignore_interruption,
        )
        for loaded in loader:
            if isinstance(loaded, RetrievalError):
                raise loaded
            touches, photos = (each.to(self.device, non_blocking=True) for each in (loaded.touches, loaded.photos))
            yield replace(loaded, touches=touches, photos=photos)

    def train_features(self, matcher: Matcher, loaded: LoadedBatch) -> tuple[Tensor, Tensor]:
        """Return features of the batch's touches and photos; each distinct image passes through its tower once."""
        with autocast(self.device, self.config.training.precision):
            return matcher.touch_features(loaded.touches), matcher.photo_features(loaded.photos)

    def eval_features(self, matcher: Matcher, grasps: Sequence[Grasp], photos: Sequence[Path]) -> tuple[Tensor, Tensor]:
        """Return features of the touches of grasps, and of photos, encoded without gradients."""
        with worker_pool() as pool:
            touch = touch_features(matcher, map_in_order(pool, self.images.touch, grasps)) if grasps else torch.zeros(0)
            photo = photo_features(matcher, map_in_order(pool, self.images.photo, photos)) if photos else torch.zeros(0)
        return touch, photo


class FrozenFeatures:
    """Features of frozen towers, by grasp id (of the touch) and by photo file (`features_by_image`)."""

    step_context = staticmethod(one_thread)  # of a training step: more do not speed up the head's small products

    def __init__(self, features: Mapping[str | Path, Tensor]) -> None:
        self._features = features

    def batches(self, matcher: Matcher, batches: Iterable[tuple[int, PairBatch]]) -> Iterator[LoadedBatch]:
        """Yield the features of each batch, given with its step."""
        return (LoadedBatch(batch, *self.eval_features(matcher, batch.grasps, batch.photos)) for _, batch in batches)

    def train_features(self, matcher: Matcher, loaded: LoadedBatch) -> tuple[Tensor, Tensor]:
        """Return the features of the batch's touches and photos."""
        return loaded.touches, loaded.photos

    def eval_features(self, matcher: Matcher, grasps: Sequence[Grasp], photos: Sequence[Path]) -> tuple[Tensor, Tensor]:
        """Return the features of touches and photos."""
        touches = torch.stack([self._features[grasp.grasp_id] for grasp in grasps])
        return touches, torch.stack([self._features[path] for path in photos]) if photos else touches[:0]


FeatureSource = TrainedFeatures | FrozenFeatures
"""The source of a training run's features."""


@torch.inference_mode()
def recorded_features(
    matcher: Matcher, source: FeatureSource, grasps: Sequence[Grasp]
) -> tuple[Tensor, dict[Path, Tensor]]:
    """Return features of the touches of grasps (G, fingers * F) and of each of their photo files (F,)."""
    touches: list[Tensor] = []
    photos: dict[Path, Tensor] = {}
    with Bar("encoding", len(grasps), "grasps") as bar:
        for part in batches(grasps, _CHUNK):
            files = list(dict.fromkeys(path for grasp in part for path in grasp.photos))
            touch, photo = source.eval_features(matcher, part, files)
            touches.append(touch)
            photos |= zip(files, photo, strict=True)
            bar.advance(len(part))
    return torch.cat(touches), photos
