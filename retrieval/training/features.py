"""Features of towers that stand still, encoded once and kept on disk: what every method is fitted on and judged by."""

import dataclasses
import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp
from retrieval.data.images import read_rgb
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import BadInput, CheckpointError, DatasetError, NumericalError
from retrieval.model.checkpoint import read_tensors, tensors_digest, write_tensors
from retrieval.model.config import Config
from retrieval.model.encode import batches, default_device, photo_features, touch_features
from retrieval.model.fusion import Matcher
from retrieval.training.batches import BatchImages
from retrieval.training.disk_image_cache import ImageFiles, part_path

T = TypeVar("T")
log = logging.getLogger(__name__)

TOUCH_VARIANTS = ("touch", "low_pass", "no_contact")
"""What stands for a touch: the gel images; an 8 x 6 blur of each; the frames taken before the contact."""
PHOTO_VARIANTS = ("photo", "margin")
"""What of a photo is shown: all of it; its margin, where the object mostly is not."""
_MARGIN_DIVISOR = 8  # the share of a side that it takes
_PART = 512
_BATCH = 32


@dataclass(frozen=True, eq=False)
class Features:
    """Tower features of grasps: what every method is fitted on and judged by. One row per grasp.

    grasp_ids, object_ids: of each row. touch (G, fingers, F_touch) and photo (G, F_photo), float32; the photo is the
    one taken before that grasp. Raises BadInput for arrays of other shapes or types, NumericalError for a feature that
    is not finite, its grasp named.
    """

    grasp_ids: tuple[str, ...]
    object_ids: tuple[str, ...]
    touch: NDArray[np.float32]
    photo: NDArray[np.float32]

    def __post_init__(self) -> None:
        rows = (len(self.grasp_ids), len(self.object_ids), len(self.touch), len(self.photo))
        if self.touch.ndim != 3 or self.photo.ndim != 2 or len(set(rows)) != 1:
            raise BadInput(
                "features must be touch (G, fingers, F) and photo (G, F) with G grasp ids and G object ids; got "
                f"touch {self.touch.shape}, photo {self.photo.shape}, {rows[0]} and {rows[1]} ids"
            )
        if self.touch.dtype != np.float32 or self.photo.dtype != np.float32:
            raise BadInput(f"features must be float32; got touch {self.touch.dtype}, photo {self.photo.dtype}")
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
        """The grasps at `rows`, in that order."""
        return Features(
            tuple(self.grasp_ids[row] for row in rows),
            tuple(self.object_ids[row] for row in rows),
            self.touch[rows],
            self.photo[rows],
        )

    def of_objects(self, object_ids: Iterable[str]) -> "Features":
        """The grasps of these objects."""
        wanted = set(object_ids)
        return self.select(np.array([row for row, name in enumerate(self.object_ids) if name in wanted], np.int64))

    def concatenate(self, others: "Features") -> "Features":
        """These grasps, then those of `others`."""
        return Features(
            self.grasp_ids + others.grasp_ids,
            self.object_ids + others.object_ids,
            np.concatenate([self.touch, others.touch]),
            np.concatenate([self.photo, others.photo]),
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 over ids and features: equal exactly when the same is fitted on."""
        ids = json.dumps([self.grasp_ids, self.object_ids, self.touch.shape, self.photo.shape])
        digest = hashlib.sha256(ids.encode())
        for part in (self.touch, self.photo):
            digest.update(np.ascontiguousarray(part).data)
        return digest.hexdigest()

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """(G,) index of each row's object into `sorted(set(object_ids))`."""
        return np.unique(np.array(self.object_ids, dtype=object), return_inverse=True)[1].astype(np.int64)


def features_by_image(grasps: Iterable[Grasp], features: Features, device: torch.device) -> dict[str | Path, Tensor]:
    """Features of grasps by grasp id (of the touch, finger after finger) and by photo file, on `device`."""
    touch, photo = (torch.from_numpy(part).flatten(1).to(device) for part in (features.touch, features.photo))
    row_of = {grasp_id: row for row, grasp_id in enumerate(features.grasp_ids)}
    known: dict[str | Path, Tensor] = {}
    for grasp in grasps:
        row = row_of[grasp.grasp_id]
        known |= {grasp.grasp_id: touch[row], grasp.photo: photo[row]}
    return known


def low_pass(image: RgbImage) -> RgbImage:
    """An image (H, W, 3) of which nothing is left but an 8 x 6 blur of its colours, at its old size.

    Gaussian blur of a tenth of the width, then 8 x 6 pixels: lamps and gel drift of the capture stay, and coarse
    shape; whatever a method still finds in it is no sense of touch.
    """
    height, width = image.shape[:2]
    down, across = _low_pass_matrix(height, 6, width / 10), _low_pass_matrix(width, 8, width / 10)
    small = np.einsum("ih,hwc,jw->ijc", down, image, across, optimize=True)
    return resize(np.ascontiguousarray(small, dtype=np.float32), (height, width))


@lru_cache(maxsize=16)
def _low_pass_matrix(old: int, new: int, sigma: float) -> NDArray[np.float32]:
    """(new, old): one axis of a Gaussian blur and of the resizing after it, as one matrix: to blur whole pictures this
    widely takes longer than a tower does.
    """
    import cv2

    kernel = cv2.getGaussianKernel(round(8 * sigma) + 1 | 1, sigma, cv2.CV_32F)
    smooth = cv2.sepFilter2D(np.eye(old, dtype=np.float32), -1, np.ones(1, np.float32), kernel)
    return resize(np.repeat(smooth[..., None], 3, axis=2), (new, old))[..., 0]


class _LowPassPreprocessing(Preprocessing):
    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        return self.touch(low_pass(read_rgb(path)), None if reference is None else low_pass(read_rgb(reference)))


def photo_margin(image: RgbImage) -> RgbImage:
    """A photo (H, W, 3) of which nothing is left but a frame of an eighth of each side, around its mean colour."""
    high, wide = (max(1, side // _MARGIN_DIVISOR) for side in image.shape[:2])
    inside = np.zeros(image.shape[:2], dtype=np.bool_)
    inside[high:-high, wide:-wide] = True
    return np.where(inside[..., None], image[~inside].mean(0), image).astype(np.float32)


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
    """Features of all grasps by the towers of `matcher`, which stand still; each photo file is encoded once.

    cache: folder where they are kept in parts of 512, each under a digest of tower, preprocessing, variant and image
    files: a run that was stopped goes on, a second one reads. None keeps nothing. variant: one of `TOUCH_VARIANTS`; shown:
    one of `PHOTO_VARIANTS`. photo_features_from: features of these grasps and perhaps more, whose photos need no encoding again. Raises
    BadInput for another variant, DatasetError where a no-contact frame is needed and missing.
    """
    felt = [_grasp_for_variant(grasp, touch_variant) for grasp in grasps]
    device = default_device()
    matcher = deepcopy(matcher).to(device).eval()
    settings = _config_for_variants(config, touch_variant, photo_variant)
    with BatchImages(settings, device, keep_bytes=0) as images:
        touch_made_by = (touch_variant, _tower_digest(matcher.touch_tower), settings.preprocessing.digest())
        workers, encode = config.training.workers, partial(touch_features, matcher)
        touch = _FeatureCache(cache, touch_made_by, images.touch, encode, images.files, workers, quiet).rows(felt)
        if photo_features_from is None:
            photo_made_by = (photo_variant, _tower_digest(matcher.photo_tower), settings.preprocessing.digest())
            encode = partial(photo_features, matcher)
            parts = _FeatureCache(cache, photo_made_by, images.photo, encode, lambda file: (file,), workers, quiet)
            files = {path: row for row, path in enumerate(dict.fromkeys(grasp.photo for grasp in grasps))}
            photo = parts.rows(list(files))[[files[grasp.photo] for grasp in grasps]]
        else:
            row_of = {grasp_id: row for row, grasp_id in enumerate(photo_features_from.grasp_ids)}
            photo = photo_features_from.photo[[row_of[grasp.grasp_id] for grasp in grasps]]
    return Features(
        tuple(grasp.grasp_id for grasp in grasps),
        tuple(grasp.object_id for grasp in grasps),
        touch.reshape(len(touch), config.matcher.fingers, -1),
        photo,
    )


def _config_for_variants(config: Config, touch_variant: str, photo_variant: str) -> Config:
    for what, one, known in (
        ("what stands for a touch", touch_variant, TOUCH_VARIANTS),
        ("what of a photo is shown", photo_variant, PHOTO_VARIANTS),
    ):
        if one not in known:
            raise BadInput(f"{what} must be one of {', '.join(known)}; got {one!r}")
    if touch_variant == "low_pass" and photo_variant == "margin":
        raise BadInput("a blurred touch and the margin of a photo are two controls; ask for one of them")
    as_shown = (
        _LowPassPreprocessing
        if touch_variant == "low_pass"
        else _MarginPreprocessing
        if photo_variant == "margin"
        else None
    )
    if as_shown is None:
        return config
    return dataclasses.replace(config, preprocessing=as_shown(**config.preprocessing.to_dict()))


def _grasp_for_variant(grasp: Grasp, touch_variant: str) -> Grasp:
    """The grasp with the files in place of its touch that are to be encoded as one."""
    if touch_variant != "no_contact":
        return grasp
    if len(grasp.backgrounds) != len(grasp.touches):
        raise DatasetError(
            f"a frame before the contact is needed for each finger; {grasp.grasp_id} has {len(grasp.backgrounds)} for "
            f"{len(grasp.touches)}; record them, or leave this control out"
        )
    return dataclasses.replace(grasp, touches=grasp.backgrounds)


def _tower_digest(tower: nn.Module) -> str:
    return tensors_digest(tower.state_dict(), type(tower).__name__)


@dataclass(frozen=True)
class _FeatureCache(Generic[T]):
    """Features of images, part by part: read where a part is kept, else encoded and kept.

    made_by: variant, tower and preprocessing. load gives the image (or images) of an item, encode the features (B, F)
    of a list of these, files what an item is read from.
    """

    cache: Path | None
    made_by: tuple[str, ...]
    load: Callable[[T], Any]
    encode: Callable[[list[Any]], Tensor]
    files: Callable[[T], ImageFiles]
    workers: int | str
    quiet: bool

    def rows(self, items: Sequence[T]) -> NDArray[np.float32]:
        """The features (len(items), F) of items, in their order."""
        photo_variant = self.made_by[0]
        unit = "photos" if photo_variant in PHOTO_VARIANTS else "grasps"
        with (
            Bar(f"encode {photo_variant}", len(items), unit, quiet=self.quiet) as bar,
            worker_pool(self.workers) as pool,
        ):
            return np.concatenate([self._part(part, pool, bar) for part in batches(items, _PART)])

    def _part(self, items: list[T], pool: Executor, bar: Bar) -> NDArray[np.float32]:
        path = self._path(items)
        if path and (kept := _read_cached(path)) is not None and len(kept) == len(items):
            bar.advance(len(items))
            return kept.numpy()
        encoded = []
        for batch in batches(map_in_order(pool, self.load, items, _BATCH), _BATCH):
            encoded.append(self.encode(batch).cpu())
            bar.advance(len(batch))
        features = torch.cat(encoded)
        if path:
            write_tensors(path, {"features": features}, {"made_by": self.made_by})
        return features.numpy()

    def _path(self, items: list[T]) -> Path | None:
        """Where the features of these very images, made in this very way, are kept."""
        if self.cache is None:
            return None
        files = [self.files(item) for item in items]
        return part_path(self.cache, self.made_by[0], self.made_by[1:], files).with_suffix(".safetensors")


def _read_cached(path: Path) -> Tensor | None:
    """Features that are kept; None where there are none, or the file is damaged."""
    if not path.is_file():
        return None
    try:
        return read_tensors(path)[0]["features"]
    except CheckpointError as error:
        log.warning("%s; its images are encoded again", error)
        return None
