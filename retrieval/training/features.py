"""Features of images: of towers in training, of frozen towers, and of whole recordings with a cache on disk.

All methods are fitted and scored on the latter.
"""

import dataclasses
import hashlib
import json
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.files import file_digest
from retrieval.console.progress import Bar
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.dataset import Grasp, ImageCache
from retrieval.data.images import read_rgb
from retrieval.data.loading import map_in_order, worker_count, worker_pool
from retrieval.data.pairs import PairBatch
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import DatasetError, NumericalError, RetrievalError
from retrieval.model.checkpoint import tensors_digest
from retrieval.model.config import Config
from retrieval.model.encode import (
    Image,
    autocast,
    batches,
    default_device,
    one_thread,
    photo_features,
    to_batch,
    touch_batch,
    touch_features,
)
from retrieval.model.fusion import Matcher
from retrieval.model.towers.tower import Tower
from retrieval.training import distributed
from retrieval.training.augmentation import augment_photos, augment_touches

T = TypeVar("T")
_BATCH, _CHUNK = 32, 64
_FORMAT = 1  # raised if the features of the same images change
_KEEP_BYTES = 4 << 30
"""Memory for decoded photos, and for decoded gel images, of all workers together."""

# Batches ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoadedBatch:
    """A batch with this rank's images, or with the features themselves."""

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


class _RankLoader(Dataset[LoadedBatch | RetrievalError]):
    """Loads this rank's images of a batch, in the processes of a `DataLoader`."""

    def __init__(self, config: Config, images: BatchImages) -> None:
        self.config, self.images, self.rank = config, images, distributed.rank()

    def __getitem__(self, part: tuple[int, PairBatch, list[int], list[int]]) -> LoadedBatch | RetrievalError:
        """Return the images of the rank's touches and photos, or the error: a `DataLoader` would add a traceback."""
        step, batch, touch_rows, photo_rows = part
        try:
            touches = touch_batch([self.images.touch(batch.grasps[row]) for row in touch_rows])
            photos = to_batch([self.images.photo(batch.photos[row]) for row in photo_rows])
        except RetrievalError as error:
            return error
        if self.config.training.augment:
            seed, views = self.config.training.seed, len(self.config.preprocessing.views)
            # The touches and photos of an object are mirrored together.
            is_mirrored = np.random.default_rng([seed, 5, step]).random(1 + int(batch.photo_objects.max())) < 0.5
            rng = np.random.default_rng([seed, 6, step, self.rank])
            touches = augment_touches(touches, is_mirrored[batch.touch_objects[touch_rows]], rng)
            photos = augment_photos(photos, views, is_mirrored[batch.photo_objects[photo_rows]], rng)
        return LoadedBatch(batch, touches, photos)


def _ignore_interruption(worker: int) -> None:
    """Leave Ctrl-C to the main process, which ends the training after the current step."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class TrainedFeatures:
    """Features of towers in training: each rank encodes a part of the images and gathers the other parts."""

    step_context = nullcontext  # of a training step: towers use every core

    def __init__(self, config: Config, device: torch.device, camera: PhotoCamera = USUAL_CAMERA) -> None:
        workers = config.training.workers
        # On a CPU the towers use every core, so workers would only take time from them.
        self._workers = workers if isinstance(workers, int) else worker_count() if device.type == "cuda" else 0
        self.config, self.device = config, device
        self.images = BatchImages(config.preprocessing, camera, _KEEP_BYTES // max(1, self._workers))

    def batches(self, matcher: Matcher, batches: Iterable[tuple[int, PairBatch]]) -> Iterator[LoadedBatch]:
        """Yield this rank's part of each batch, given with its step; the same parts for any number of workers."""
        rows = distributed.rank_rows
        loader = DataLoader(
            _RankLoader(self.config, self.images),
            batch_size=None,
            sampler=((step, batch, rows(len(batch.grasps)), rows(len(batch.photos))) for step, batch in batches),
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
        touches, photos = len(loaded.batch.grasps), len(loaded.batch.photos)
        with autocast(self.device, self.config.training.precision):
            touch = matcher.touch_features(loaded.touches)
            photo = matcher.photo_features(loaded.photos)
        return distributed.gather_rows(touch, touches), distributed.gather_rows(photo, photos)

    def eval_features(self, matcher: Matcher, grasps: Sequence[Grasp], photos: Sequence[Path]) -> tuple[Tensor, Tensor]:
        """Return features of touches and photos, encoded without gradients."""
        return _encoded(matcher, self.images, grasps, photos)


class FrozenFeatures:
    """Features of frozen towers: each image is encoded once."""

    step_context = staticmethod(one_thread)  # of a training step: more do not speed up the head's small products

    def __init__(self, config: Config, known: Mapping[str | Path, Tensor], camera: PhotoCamera = USUAL_CAMERA) -> None:
        """Start with features by grasp id (of the touch) and by photo file that need no encoding."""
        self.images = BatchImages(config.preprocessing, camera)  # images are read once
        self._features: dict[str | Path, Tensor] = dict(known)

    def batches(self, matcher: Matcher, batches: Iterable[tuple[int, PairBatch]]) -> Iterator[LoadedBatch]:
        """Yield the features of each batch, given with its step; new images are encoded when their batch comes."""
        return (LoadedBatch(batch, *self.eval_features(matcher, batch.grasps, batch.photos)) for _, batch in batches)

    def train_features(self, matcher: Matcher, loaded: LoadedBatch) -> tuple[Tensor, Tensor]:
        """Return the features of the batch's touches and photos, as constants of the step."""
        return loaded.touches.clone(), loaded.photos.clone()

    @torch.inference_mode()
    def eval_features(self, matcher: Matcher, grasps: Sequence[Grasp], photos: Sequence[Path]) -> tuple[Tensor, Tensor]:
        """Return the features of touches and photos; new images are encoded."""
        new = {grasp.grasp_id: grasp for grasp in grasps if grasp.grasp_id not in self._features}
        new_photos = [path for path in photos if path not in self._features]
        touch, photo = _encoded(matcher, self.images, list(new.values()), new_photos)
        self._features |= zip(new, touch, strict=True)
        self._features |= zip(new_photos, photo, strict=True)
        touches = torch.stack([self._features[grasp.grasp_id] for grasp in grasps])
        return touches, torch.stack([self._features[path] for path in photos]) if photos else touches[:0]


FeatureSource = TrainedFeatures | FrozenFeatures
"""The source of a training run's features."""


def _encoded(
    matcher: Matcher, images: BatchImages, grasps: Sequence[Grasp], photos: Sequence[Path]
) -> tuple[Tensor, Tensor]:
    """Return features of the touches of grasps, and of photos, encoded without gradients."""
    with worker_pool() as pool:
        touch = touch_features(matcher, map_in_order(pool, images.touch, grasps)) if grasps else torch.zeros(0)
        photo = photo_features(matcher, map_in_order(pool, images.photo, photos)) if photos else torch.zeros(0)
    return touch, photo


@torch.inference_mode()
def recorded_features(
    matcher: Matcher, source: FeatureSource, grasps: Sequence[Grasp], *, quiet: bool = False
) -> tuple[Tensor, dict[Path, Tensor]]:
    """Return features of the touches of grasps (G, fingers * F) and of each of their photo files (F,)."""
    touches: list[Tensor] = []
    photos: dict[Path, Tensor] = {}
    with Bar("encoding", len(grasps), "grasps", quiet=quiet) as bar:
        for part in batches(grasps, _CHUNK):
            files = list(dict.fromkeys(path for grasp in part for path in grasp.photos))
            touch, photo = source.eval_features(matcher, part, files)
            touches.append(touch)
            photos |= zip(files, photo, strict=True)
            bar.advance(len(part))
    return torch.cat(touches), photos


# Recordings ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Features:
    """Tower features of G grasps: of touches (G, fingers, F_touch), and of the photos taken before (G, F_photo).

    F_photo is 0 in a recording of touches only.

    Raises:
        NumericalError: A feature is not finite.
    """

    grasp_ids: tuple[str, ...]
    object_ids: tuple[str, ...]
    touch: NDArray[np.float32]
    photo: NDArray[np.float32]

    def __post_init__(self) -> None:
        for what, part in (("touch", self.touch), ("photo", self.photo)):
            bad = np.flatnonzero(~np.isfinite(part).all(axis=tuple(range(1, part.ndim))))
            if len(bad):
                raise NumericalError(
                    f"{what} features must be finite; grasp {self.grasp_ids[bad[0]]} has a NaN or infinite one: the "
                    "tower has diverged, or its weights are damaged"
                )

    def __len__(self) -> int:
        return len(self.grasp_ids)

    def select(self, rows: NDArray[np.int64]) -> "Features":
        """Return the grasps at `rows`, in that order."""
        return Features(
            tuple(self.grasp_ids[row] for row in rows),
            tuple(self.object_ids[row] for row in rows),
            self.touch[rows],
            self.photo[rows],
        )

    def of_objects(self, object_ids: Iterable[str]) -> "Features":
        """Return the grasps of these objects."""
        return self.select(np.flatnonzero(np.isin(self.object_ids, list(object_ids))))

    def concatenate(self, others: "Features") -> "Features":
        """Return these grasps, followed by those of `others`."""
        return Features(
            self.grasp_ids + others.grasp_ids,
            self.object_ids + others.object_ids,
            np.concatenate([self.touch, others.touch]),
            np.concatenate([self.photo, others.photo]),
        )

    def pooled(self, matcher: Matcher) -> "Features":
        """Return these features, of the towers of `matcher`, without the cells at their end."""
        touch, photo = matcher.pooled_counts
        if (touch, photo) == (self.touch.shape[2], self.photo.shape[1]):
            return self  # keeps the digest, which takes long to compute
        return dataclasses.replace(self, touch=self.touch[..., :touch], photo=self.photo[:, :photo])

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of ids and features."""
        ids = json.dumps([self.grasp_ids, self.object_ids, self.touch.shape, self.photo.shape])
        digest = hashlib.sha256(ids.encode())
        for part in (self.touch, self.photo):
            digest.update(np.ascontiguousarray(part).data)
        return digest.hexdigest()

    @property
    def touch_rows(self) -> NDArray[np.float32]:
        """(G, fingers * F_touch) features of the touches."""
        return self.touch.reshape(len(self), -1)

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """(G,) index of each row's object into `sorted(set(object_ids))`."""
        return np.unique(np.array(self.object_ids, dtype=object), return_inverse=True)[1].astype(np.int64)


def features_by_image(grasps: Iterable[Grasp], features: Features, device: torch.device) -> dict[str | Path, Tensor]:
    """Return features on `device`: of touches (fingers concatenated) by grasp id, and of photos by file."""
    touch, photo = (torch.from_numpy(part).to(device) for part in (features.touch_rows, features.photo))
    row_of = {grasp_id: row for row, grasp_id in enumerate(features.grasp_ids)}
    rows = [(grasp, row_of[grasp.grasp_id]) for grasp in grasps]
    touches: dict[str | Path, Tensor] = {grasp.grasp_id: touch[row] for grasp, row in rows}
    return touches | {path: photo[row] for grasp, row in rows for path in grasp.photos}


def low_pass(image: RgbImage) -> RgbImage:
    """Return an image (H, W, 3) reduced to 8 x 6 pixels and enlarged to its old size.

    A Gaussian blur of a tenth of the width precedes the reduction. Lamps, gel drift and coarse shape remain, so a
    method's score on such images does not come from fine tactile detail.
    """
    height, width = image.shape[:2]
    down, across = _low_pass_matrix(height, 6, width / 10), _low_pass_matrix(width, 8, width / 10)
    small = np.einsum("ih,hwc,jw->ijc", down, image, across, optimize=True)
    return resize(np.ascontiguousarray(small, dtype=np.float32), (height, width))


@lru_cache(maxsize=16)
def _low_pass_matrix(old: int, new: int, sigma: float) -> NDArray[np.float32]:
    """Return a matrix (new, old) that blurs and resizes one axis: blurring whole pictures would take longer."""
    import cv2

    kernel = cv2.getGaussianKernel(round(8 * sigma) + 1 | 1, sigma, cv2.CV_32F)
    smooth = cv2.sepFilter2D(np.eye(old, dtype=np.float32), -1, np.ones(1, np.float32), kernel)
    return resize(np.repeat(smooth[..., None], 3, axis=2), (new, old))[..., 0]


def photo_margin(image: RgbImage) -> RgbImage:
    """Return a photo (H, W, 3) with only its margin (an eighth of each side); the rest is the margin's mean colour."""
    high, wide = (max(1, side // 8) for side in image.shape[:2])
    inside = np.zeros(image.shape[:2], dtype=np.bool_)
    inside[high:-high, wide:-wide] = True
    return np.where(inside[..., None], image[~inside].mean(0), image).astype(np.float32)


class _LowPassPreprocessing(Preprocessing):
    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        return self.touch(low_pass(read_rgb(path)), None if reference is None else low_pass(read_rgb(reference)))


class _MarginPreprocessing(Preprocessing):
    def load_photo(self, path: str | Path, camera: PhotoCamera = USUAL_CAMERA) -> RgbImage:
        return self.photo(photo_margin(read_rgb(path)))


def encode_recording(
    grasps: Sequence[Grasp],
    matcher: Matcher,
    config: Config,
    cache: Path | None,
    *,
    touch_variant: str = "touch",
    photo_variant: str = "photo",
    camera: PhotoCamera = USUAL_CAMERA,
    quiet: bool = False,
) -> Features:
    """Return features of grasps by the frozen towers of `matcher`; each photo file is encoded once.

    Args:
        grasps: The grasps.
        matcher: The matcher.
        config: The configuration, for preprocessing.
        cache: Folder of the cache of features, whose keys are digests of tower, preprocessing, variant and image files.
            None to store nothing.
        touch_variant: "touch" for gel images, "low_pass" for low-pass ones (8 x 6), "no_contact" for the no-contact
            frames, which every grasp must then have.
        photo_variant: "photo" for whole photos; "margin" for their margin, which rarely shows the object, only with
            whole touches; "none" if no photo is needed.
        camera: The camera of the photos (`recording_camera`).
        quiet: No progress on stderr.

    Raises:
        DatasetError: A no-contact frame that the preprocessing requires is missing, or a file cannot be read.
    """
    touched, preprocessing = grasps, config.preprocessing
    if touch_variant == "no_contact":
        touched = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in grasps]
    if kind := {"low_pass": _LowPassPreprocessing, "margin": _MarginPreprocessing}.get(
        photo_variant if photo_variant == "margin" else touch_variant
    ):
        preprocessing = kind(**preprocessing.to_dict())
    matcher = deepcopy(matcher).to(default_device()).eval()
    images, digest = BatchImages(preprocessing, camera), preprocessing.digest()
    made_by = touch_variant, _tower_digest(matcher.touch_tower), digest
    touch = _encoded_once(cache, made_by, touched, images.touch, partial(touch_features, matcher), images.files, quiet)
    if photo_variant == "none":
        photo = np.zeros((len(grasps), 0), np.float32)
    else:
        files = {path: row for row, path in enumerate(dict.fromkeys(grasp.photo for grasp in grasps))}
        seen, encode = f"{digest} {tuple(camera)}", partial(photo_features, matcher)
        made_by = photo_variant, _tower_digest(matcher.photo_tower), seen
        photo = _encoded_once(cache, made_by, list(files), images.photo, encode, lambda file: (file,), quiet)
        photo = photo[[files[grasp.photo] for grasp in grasps]]
    return Features(
        tuple(grasp.grasp_id for grasp in grasps),
        tuple(grasp.object_id for grasp in grasps),
        touch.reshape(len(touch), config.matcher.fingers, -1),
        photo,
    )


def _tower_digest(tower: Tower) -> str:
    return tensors_digest(tower.state_dict(), f"{type(tower).__name__} {tower.output} {tower.cells}")


_UNITS = {
    "touch": "touches",
    "low_pass": "low-pass touches",
    "no_contact": "no-contact frames",
    "photo": "photos",
    "margin": "margins of photos",
}
"""What progress calls the images of each variant."""


def _encoded_once(
    cache: Path | None,
    made_by: tuple[str, ...],
    items: Sequence[T],
    load: Callable[[T], Any],
    encode: Callable[[list[Any]], Tensor],
    files: Callable[[T], tuple[Path, ...]],
    quiet: bool,
) -> NDArray[np.float32]:
    """Return the features (len(items), F) of items: read from the cache, or encoded and stored.

    `made_by` are variant, tower and preprocessing. `load` returns the image (or images) of an item, `encode` the
    features (B, F) of a list of images, `files` the files of an item. Raises DatasetError if one cannot be read.
    """
    with (
        Bar("encoding", len(items), _UNITS[made_by[0]], quiet=quiet) as bar,
        worker_pool() as pool,
        Cache(cache / "cache.sqlite") if cache else nullcontext() as store,
    ):
        try:
            digests = [[file_digest(path) for path in files(item)] for item in items] if store else []
        except OSError as error:
            raise DatasetError(f"{error.filename} cannot be read ({error.strerror}); run `retrieve check`") from error
        keys = [cache_key("features", _FORMAT, *made_by, each) for each in digests] or [*map(str, range(len(items)))]
        found = dict(store.get_all(keys)) if store else {}
        missing = list({key: row for row, key in enumerate(keys) if key not in found}.values())
        bar.advance(len(items) - len(missing))
        images = map_in_order(pool, load, [items[row] for row in missing], _BATCH)
        for rows, batch in zip(batches(missing, _BATCH), batches(images, _BATCH), strict=True):
            encoded = {keys[row]: each.tobytes() for row, each in zip(rows, encode(batch).cpu().numpy(), strict=True)}
            if store:
                store.add(encoded)
            found |= encoded
            bar.advance(len(rows))
    return np.stack([np.frombuffer(found[key], np.float32) for key in keys])
