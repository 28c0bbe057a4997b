"""Features of whole recordings by frozen towers, with a cache on disk. All methods are fitted and scored on them."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from _touch_retrieval.cache import Cache, cache_key
from _touch_retrieval.files import file_digest
from retrieval.console.progress import Bar
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.dataset import Grasp
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.errors import DatasetError, NumericalError
from retrieval.model.checkpoint import tensors_digest
from retrieval.model.config import Config
from retrieval.model.encode import (
    batches,
    default_device,
    photo_features,
    touch_features,
)
from retrieval.model.fusion import Matcher
from retrieval.model.towers.tower import Tower
from retrieval.training.batches import BatchImages
from retrieval.training.controls import LowPassPreprocessing, MarginPreprocessing

T = TypeVar("T")
_BATCH = 32
_FORMAT = 1  # raised if the features of the same images change


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


def encode_recording(
    grasps: Sequence[Grasp],
    matcher: Matcher,
    config: Config,
    cache: Path | None,
    *,
    touch_variant: str = "touch",
    photo_variant: str = "photo",
    camera: PhotoCamera = USUAL_CAMERA,
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

    Raises:
        DatasetError: A no-contact frame that the preprocessing requires is missing, or a file cannot be read.
    """
    touched, preprocessing = grasps, config.preprocessing
    if touch_variant == "no_contact":
        touched = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in grasps]
    if kind := {"low_pass": LowPassPreprocessing, "margin": MarginPreprocessing}.get(
        photo_variant if photo_variant == "margin" else touch_variant
    ):
        preprocessing = kind(**preprocessing.to_dict())
    matcher = deepcopy(matcher).to(default_device()).eval()
    images, digest = BatchImages(preprocessing, camera), preprocessing.digest()
    made_by = touch_variant, _tower_digest(matcher.touch_tower), digest
    touch = _encoded_once(cache, made_by, touched, images.touch, partial(touch_features, matcher), images.files)
    if photo_variant == "none":
        photo = np.zeros((len(grasps), 0), np.float32)
    else:
        files = {path: row for row, path in enumerate(dict.fromkeys(grasp.photo for grasp in grasps))}
        seen, encode = f"{digest} {tuple(camera)}", partial(photo_features, matcher)
        made_by = photo_variant, _tower_digest(matcher.photo_tower), seen
        photo = _encoded_once(cache, made_by, list(files), images.photo, encode, lambda file: (file,))
        photo = photo[[files[grasp.photo] for grasp in grasps]]
    return Features(
        tuple(grasp.grasp_id for grasp in grasps),
        tuple(grasp.object_id for grasp in grasps),
        touch.reshape(len(touch), config.matcher.fingers, -1),
        photo,
    )


def _tower_digest(tower: Tower) -> str:
    return tensors_digest(tower.state_dict(), f"{type(tower).__name__} {tower.output} {tower.cells}")


def _encoded_once(
    cache: Path | None,
    made_by: tuple[str, ...],
    items: Sequence[T],
    load: Callable[[T], Any],
    encode: Callable[[list[Any]], Tensor],
    files: Callable[[T], tuple[Path, ...]],
) -> NDArray[np.float32]:
    """Return the features (len(items), F) of items: read from the cache, or encoded and stored.

    `made_by` are variant, tower and preprocessing. `load` returns the image (or images) of an item, `encode` the
    features (B, F) of a list of images, `files` the files of an item. Raises DatasetError if one cannot be read.
    """
    with (
        Bar("encoding", len(items), "touches or photos") as bar,
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
