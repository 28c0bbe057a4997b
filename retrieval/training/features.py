"""Features of frozen towers, encoded once and cached on disk; all methods are fitted and scored on them."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.files import file_digest
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.data.images import read_rgb
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import DatasetError, NumericalError
from retrieval.model.checkpoint import tensors_digest
from retrieval.model.config import Config
from retrieval.model.encode import batches, default_device, photo_features, touch_features
from retrieval.model.fusion import Matcher
from retrieval.model.towers.tower import Tower
from retrieval.training.batches import BatchImages

T = TypeVar("T")

TOUCH_VARIANTS = ("touch", "low_pass", "no_contact")
"""Inputs of the touch tower: gel images; low-pass gel images (8 x 6); no-contact frames."""
PHOTO_VARIANTS = ("photo", "margin")
"""Inputs of the photo tower: whole photos; only the margin, which rarely shows the object."""
_MARGIN_DIVISOR = 8  # the margin is 1 / _MARGIN_DIVISOR of each side
_BATCH = 32
_FORMAT = 1  # raised if the features of the same images change


@dataclass(frozen=True, eq=False)
class Features:
    """Tower features of G grasps, one row each.

    Attributes:
        grasp_ids: Id of each grasp.
        object_ids: Object of each grasp.
        touch: (G, fingers, F_touch) float32.
        photo: (G, F_photo) float32, of the photo taken before the grasp.

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
        names = set(object_ids)
        return self.select(np.array([row for row, name in enumerate(self.object_ids) if name in names], np.int64))

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
    return {grasp.grasp_id: touch[row] for grasp, row in rows} | {grasp.photo: photo[row] for grasp, row in rows}


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
    high, wide = (max(1, side // _MARGIN_DIVISOR) for side in image.shape[:2])
    inside = np.zeros(image.shape[:2], dtype=np.bool_)
    inside[high:-high, wide:-wide] = True
    return np.where(inside[..., None], image[~inside].mean(0), image).astype(np.float32)


class _LowPassPreprocessing(Preprocessing):
    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        return self.touch(low_pass(read_rgb(path)), None if reference is None else low_pass(read_rgb(reference)))


class _MarginPreprocessing(Preprocessing):
    def load_photo(self, path: str | Path) -> RgbImage:
        return self.photo(photo_margin(read_rgb(path)))


def encode_recording(
    grasps: Sequence[Grasp],
    matcher: Matcher,
    config: Config,
    cache: Path | None,
    *,
    touch_variant: str = "touch",
    photo_variant: str = "photo",
    photo_features_from: Features | None = None,
    quiet: bool = False,
) -> Features:
    """Return features of grasps by the frozen towers of `matcher`; each photo file is encoded once.

    Args:
        grasps: The grasps.
        matcher: The matcher.
        config: The configuration, for preprocessing.
        cache: Folder of the cache of features, whose keys are digests of tower, preprocessing, variant and image files.
            None to store nothing.
        touch_variant: One of `TOUCH_VARIANTS`.
        photo_variant: One of `PHOTO_VARIANTS`; "margin" only with whole touches.
        photo_features_from: Features of at least these grasps; their photo features are used without encoding.
        quiet: No progress on stderr.

    Raises:
        DatasetError: A required no-contact frame is missing, or a file cannot be read.
    """
    touched, preprocessing = grasps, config.preprocessing
    if touch_variant == "no_contact":
        for grasp in grasps:
            if len(grasp.backgrounds) != len(grasp.touches):
                raise DatasetError(
                    f"each finger needs a no-contact frame; {grasp.grasp_id} has {len(grasp.backgrounds)} for "
                    f"{len(grasp.touches)}; record them, or leave this control out"
                )
        touched = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in grasps]
    if kind := {"low_pass": _LowPassPreprocessing, "margin": _MarginPreprocessing}.get(
        touch_variant if photo_variant == "photo" else photo_variant
    ):
        preprocessing = kind(**preprocessing.to_dict())
    matcher = deepcopy(matcher).to(default_device()).eval()
    images, digest = BatchImages(preprocessing), preprocessing.digest()
    made_by = touch_variant, _tower_digest(matcher.touch_tower), digest
    touch = _encoded(cache, made_by, touched, images.touch, partial(touch_features, matcher), images.files, quiet)
    if photo_features_from is None:
        files = {path: row for row, path in enumerate(dict.fromkeys(grasp.photo for grasp in grasps))}
        made_by, encode = (photo_variant, _tower_digest(matcher.photo_tower), digest), partial(photo_features, matcher)
        photo = _encoded(cache, made_by, list(files), images.photo, encode, lambda file: (file,), quiet)
        photo = photo[[files[grasp.photo] for grasp in grasps]]
    else:
        row_of = {grasp_id: row for row, grasp_id in enumerate(photo_features_from.grasp_ids)}
        photo = photo_features_from.photo[[row_of[grasp.grasp_id] for grasp in grasps]]
    return Features(
        tuple(grasp.grasp_id for grasp in grasps),
        tuple(grasp.object_id for grasp in grasps),
        touch.reshape(len(touch), config.matcher.fingers, -1),
        photo,
    )


def _tower_digest(tower: Tower) -> str:
    return tensors_digest(tower.state_dict(), f"{type(tower).__name__} {tower.output} {tower.cells}")


def _encoded(
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
    features (B, F) of a list of images, `files` the files of an item.
    """
    unit = "photos" if made_by[0] in PHOTO_VARIANTS else "grasps"
    with (
        Bar(f"encode {made_by[0]}", len(items), unit, quiet=quiet) as bar,
        worker_pool() as pool,
        Cache(cache / "cache.sqlite") if cache else nullcontext() as store,
    ):
        keys = [_cache_key(made_by, files(item)) for item in items] if store else []
        stored = store.get_all(keys) if store else {}
        found = {row: stored[key] for row, key in enumerate(keys) if key in stored}
        missing = [row for row in range(len(items)) if row not in found]
        bar.advance(len(found))
        images = map_in_order(pool, load, [items[row] for row in missing], _BATCH)
        for rows, batch in zip(batches(missing, _BATCH), batches(images, _BATCH), strict=True):
            encoded = {row: each.tobytes() for row, each in zip(rows, encode(batch).cpu().numpy(), strict=True)}
            if store:
                store.add({keys[row]: content for row, content in encoded.items()})
            found |= encoded
            bar.advance(len(rows))
    return np.stack([np.frombuffer(found[row], np.float32) for row in range(len(items))])


def _cache_key(made_by: tuple[str, ...], files: tuple[Path, ...]) -> str:
    """Return the key of an item. Raises DatasetError if an image cannot be read."""
    try:
        return cache_key("features", _FORMAT, *made_by, [file_digest(path) for path in files])
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read ({error.strerror}); run `retrieve check`") from error
