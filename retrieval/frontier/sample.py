"""Inputs of the frontier measurements: a model, grasps of unseen objects, and a catalogue blended from them.

Everything is computed on first use: a row without a recording collects none.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.console.progress import Bar
from retrieval.data.dataset import AnyRecording, Grasp, data_digest, folder_of, load_grasps, recording_camera
from retrieval.errors import DatasetError
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.fusion import ImageEncoding
from retrieval.training.distil import blend
from retrieval.training.features import Features, encode_recording

Array = NDArray[np.float32]
_BLOCK = 8192


@dataclass(frozen=True)
class Scale:
    """Scale of the measurements.

    Attributes:
        photos: Photos of the blended catalogue.
        queries: Query touches.
        repeats: Timings of each point; the result is their median.
        quick: Whether to use the smallest grids.
    """

    photos: int = 100_000
    queries: int = 200
    repeats: int = 7
    quick: bool = False


@dataclass(frozen=True, eq=False)
class Sample:
    """Grasps of unseen objects: photos of the first half of each object's grasps, touches of the second half.

    No grasp provides both a photo and a touch. Codes of images are dictionaries: "partial" (n, partial_width) is the
    partial activations, every other name an embedding (n, d).

    Attributes:
        model: File of the checkpoint.
        recording: Function that returns the recording, and may collect it first.
        folder: Folder of the cache.
        scale: Scale of the measurements.
    """

    model: Path
    recording: Callable[[], AnyRecording]
    folder: Path
    scale: Scale

    @cached_property
    def checkpoint(self) -> Checkpoint:
        """The loaded model."""
        return load_checkpoint(self.model).without_cells()

    @cached_property
    def _folder(self) -> Path:
        return folder_of(self.recording())

    @cached_property
    def grasps(self) -> list[Grasp]:
        """Grasps of unseen objects with at least two grasps each, sorted by object; at least two objects."""
        split = self.checkpoint.split
        trained = {*split.train, *split.validation} if split else set()
        unseen = [grasp for grasp in load_grasps(self._folder) if grasp.object_id not in trained]
        names = [grasp.object_id for grasp in unseen]
        usable = [grasp for grasp in unseen if names.count(grasp.object_id) > 1]
        if len({grasp.object_id for grasp in usable}) < 2:
            raise DatasetError(
                f"{self._folder} needs at least 2 objects that the model was not trained on, with at least 2 "
                "grasps each. Give another --recording, or omit it to collect one."
            )
        return sorted(usable, key=lambda grasp: (grasp.object_id, grasp.grasp_id))

    @cached_property
    def digest(self) -> str:
        """Digest of the ids and images of the grasps."""
        return data_digest(self.grasps)

    @cached_property
    def features(self) -> Features:
        """Tower features of `grasps`."""
        model = self.checkpoint
        camera = recording_camera(self._folder, self.grasps, model.config.preprocessing)
        return encode_recording(self.grasps, model.matcher, model.config, self.folder / "features", camera=camera)

    @cached_property
    def photo_rows(self) -> NDArray[np.int64]:
        """Rows of `grasps` whose photos are in the catalogue."""
        owner = np.unique([grasp.object_id for grasp in self.grasps], return_inverse=True)[1]
        place = np.arange(len(owner)) - np.searchsorted(owner, owner)  # among the grasps of its object
        return np.flatnonzero(place < np.bincount(owner)[owner] // 2)

    @property
    def touch_rows(self) -> NDArray[np.int64]:
        """Rows of `grasps` whose touches are queries, in random order, so that the first n have many objects."""
        return np.random.default_rng([0, 1]).permutation(np.setdiff1d(np.arange(len(self.grasps)), self.photo_rows))

    # Codes -------------------------------------------------------------------------------------------------

    @cached_property
    def queries(self) -> dict[str, Array]:
        """Codes of the query touches."""
        rows = self.touch_rows[: self.scale.queries]
        return self._codes(self.features.touch[rows].reshape(len(rows), -1), photo=False)

    @cached_property
    def real_photo_codes(self) -> dict[str, Array]:
        """Codes of the photos of `photo_rows`."""
        return self._codes(self.features.photo[self.photo_rows], photo=True)

    @cached_property
    def catalogue(self) -> dict[str, NDArray[Any]]:
        """Codes of blends of two photos each; partial activations are float16, as in an index.

        Blends are clustered around real photos, unlike white noise.
        """
        generator, features = torch.Generator().manual_seed(0), torch.from_numpy(self.features.photo)
        blocks: dict[str, list[NDArray[Any]]] = {}
        for start in range(0, self.scale.photos, _BLOCK):
            blended = blend(features, min(_BLOCK, self.scale.photos - start), generator)
            for name, codes in self._codes(blended.numpy(), photo=True).items():
                blocks.setdefault(name, []).append(codes.astype(np.float16) if name == "partial" else codes)
        return {name: np.concatenate(parts) for name, parts in blocks.items()}

    @torch.inference_mode()
    def _codes(self, features: Array, photo: bool) -> dict[str, Array]:
        matcher = self.checkpoint.matcher
        inputs = torch.from_numpy(features)
        code: ImageEncoding = matcher.photo_encoding(inputs) if photo else matcher.touch_encoding(inputs)
        codes = {"partial": code.partial.numpy()}
        if (encoder := matcher.candidate_encoder) is not None:
            codes["candidate encoder"] = (encoder.photo if photo else encoder.touch)(code.partial).numpy()
        if self.checkpoint.config.training.trains_embeddings:
            codes["contrastive embedding"] = code.embedding.numpy()
        return codes

    @property
    def embeddings(self) -> list[str]:
        """Names of the model's embeddings, first that in which search finds its candidates; perhaps none."""
        return [name for name in self.queries if name != "partial"]

    # Logits ------------------------------------------------------------------------------------------------

    @cached_property
    def exhaustive_top1(self) -> NDArray[np.int64]:
        """The photo of `catalogue` that the fusion head ranks first, for each of `queries`."""
        partials, found = self.queries["partial"], list[int]()
        with Bar("ranking all photos exactly", len(partials), "queries") as bar:
            for touch_partial in partials:
                found.append(int(self.logits(touch_partial, self.catalogue["partial"]).argmax()))
                bar.advance()
        return np.array(found, dtype=np.int64)

    def logits(self, touch_partial: Array, photos: NDArray[Any], rows: NDArray[np.int64] | None = None) -> Array:
        """Return match logits of a touch's partial activations (h,) with those of `rows` of photos (N, h)."""
        return self.checkpoint.matcher.head.scorer.logits(touch_partial[None], photos, rows)
