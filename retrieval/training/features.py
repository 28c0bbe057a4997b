"""Features of frozen towers, encoded once and cached on disk; all methods are fitted and scored on them."""

import dataclasses
import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from _touch_retrieval.files import file_digest
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
from retrieval.model.towers.tower import Tower
from retrieval.training.batches import BatchImages

T = TypeVar("T")
log = logging.getLogger(__name__)

TOUCH_VARIANTS = ("touch", "low_pass", "no_contact")
"""Inputs of the touch tower: gel images; low-pass gel images (8 x 6); no-contact frames."""
PHOTO_VARIANTS = ("photo", "margin")
"""Inputs of the photo tower: whole photos; only the margin, which rarely shows the object."""
_MARGIN_DIVISOR = 8  # the margin is 1 / _MARGIN_DIVISOR of each side
_PART = 512
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
        BadInput: An array has the wrong shape or type.
        NumericalError: A feature is not finite.
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

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """(G,) index of each row's object into `sorted(set(object_ids))`."""
        return np.unique(np.array(self.object_ids, dtype=object), return_inverse=True)[1].astype(np.int64)


def features_by_image(grasps: Iterable[Grasp], features: Features, device: torch.device) -> dict[str | Path, Tensor]:
    """Return features on `device`: of touches (fingers concatenated) by grasp id, and of photos by file."""
    touch, photo = (torch.from_numpy(part).flatten(1).to(device) for part in (features.touch, features.photo))
    row_of = {grasp_id: row for row, grasp_id in enumerate(features.grasp_ids)}
    known: dict[str | Path, Tensor] = {}
    for grasp in grasps:
        row = row_of[grasp.grasp_id]
        known |= {grasp.grasp_id: touch[row], grasp.photo: photo[row]}
    return known


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
    """Return a matrix (new, old) that blurs and resizes one axis.

    Blurring whole pictures this widely would take longer than a tower.
    """
    import cv2

    kernel = cv2.getGaussianKernel(round(8 * sigma) + 1 | 1, sigma, cv2.CV_32F)
    smooth = cv2.sepFilter2D(np.eye(old, dtype=np.float32), -1, np.ones(1, np.float32), kernel)
    return resize(np.repeat(smooth[..., None], 3, axis=2), (new, old))[..., 0]


class _LowPassPreprocessing(Preprocessing):
    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        return self.touch(low_pass(read_rgb(path)), None if reference is None else low_pass(read_rgb(reference)))


def photo_margin(image: RgbImage) -> RgbImage:
    """Return a photo (H, W, 3) with only its margin (an eighth of each side); the rest is the margin's mean colour."""
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
    """Return features of grasps by the frozen towers of `matcher`; each photo file is encoded once.

    Args:
        grasps: The grasps.
        matcher: The matcher.
        config: The configuration, for preprocessing.
        cache: Folder of cached parts of 512 images; a later or resumed run reads them. A part's name is a digest of
            tower, preprocessing, variant and image files. None to store nothing.
        touch_variant: One of `TOUCH_VARIANTS`.
        photo_variant: One of `PHOTO_VARIANTS`; "margin" only with whole touches.
        photo_features_from: Features of at least these grasps; their photo features are used without encoding.
        quiet: No progress on stderr.

    Raises:
        BadInput: A variant is unknown.
        DatasetError: A required no-contact frame is missing.
    """
    touched = [_grasp_for_variant(grasp, touch_variant) for grasp in grasps]
    device = default_device()
    matcher = deepcopy(matcher).to(device).eval()
    settings = _config_for_variants(config, touch_variant, photo_variant)
    images, digest = BatchImages(settings, keep_bytes=0), settings.preprocessing.digest()
    made_by, encode = (touch_variant, _tower_digest(matcher.touch_tower), digest), partial(touch_features, matcher)
    touch = _encoded(cache, made_by, touched, images.touch, encode, images.files, quiet)
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


def _config_for_variants(config: Config, touch_variant: str, photo_variant: str) -> Config:
    for what, one, known in (
        ("touch_variant", touch_variant, TOUCH_VARIANTS),
        ("photo_variant", photo_variant, PHOTO_VARIANTS),
    ):
        if one not in known:
            raise BadInput(f"{what} must be one of {', '.join(known)}; got {one!r}")
    if touch_variant != "low_pass" and photo_variant != "margin":
        return config
    kind = _LowPassPreprocessing if touch_variant == "low_pass" else _MarginPreprocessing
    return dataclasses.replace(config, preprocessing=kind(**config.preprocessing.to_dict()))


def _grasp_for_variant(grasp: Grasp, touch_variant: str) -> Grasp:
    """Return the grasp with its touch replaced by the files of the variant."""
    if touch_variant != "no_contact":
        return grasp
    if len(grasp.backgrounds) != len(grasp.touches):
        raise DatasetError(
            f"each finger needs a no-contact frame; {grasp.grasp_id} has {len(grasp.backgrounds)} for "
            f"{len(grasp.touches)}; record them, or leave this control out"
        )
    return dataclasses.replace(grasp, touches=grasp.backgrounds)


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
    """Return the features (len(items), F) of items, in parts: read from the cache folder, or encoded and stored.

    `made_by` are variant, tower and preprocessing. `load` returns the image (or images) of an item, `encode` the
    features (B, F) of a list of images, `files` the files of an item.
    """
    unit, parts = "photos" if made_by[0] in PHOTO_VARIANTS else "grasps", []
    with Bar(f"encode {made_by[0]}", len(items), unit, quiet=quiet) as bar, worker_pool() as pool:
        for part in batches(items, _PART):
            path = _cache_path(cache, made_by, [files(item) for item in part]) if cache else None
            features = _read_cached(path) if path else None
            if features is None or len(features) != len(part):
                encoded = []
                for batch in batches(map_in_order(pool, load, part, _BATCH), _BATCH):
                    encoded.append(encode(batch).cpu())
                    bar.advance(len(batch))
                features = torch.cat(encoded)
                if path:
                    write_tensors(path, {"features": features}, {"made_by": made_by})
            else:
                bar.advance(len(part))
            parts.append(features.numpy())
    return np.concatenate(parts)


def _cache_path(cache: Path, made_by: tuple[str, ...], files: list[tuple[Path, ...]]) -> Path:
    """Return the cache file of a part. Raises DatasetError if an image cannot be read."""
    try:
        digests = [[file_digest(path) for path in each] for each in files]
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read ({error.strerror}); run `retrieve check`") from error
    key = hashlib.sha256(json.dumps([_FORMAT, *made_by, digests]).encode()).hexdigest()
    return cache / f"{made_by[0]}-{key[:32]}.safetensors"


def _read_cached(path: Path) -> Tensor | None:
    """Return cached features, or None if there are none or the file is damaged."""
    if not path.is_file():
        return None
    try:
        return read_tensors(path)[0]["features"]
    except CheckpointError as error:
        log.warning("%s; its images are encoded again", error)
        return None
