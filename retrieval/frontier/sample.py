"""Inputs of the frontier measurements: a model, grasps of unseen objects, and catalogues blended from them.

Everything is computed on first use: a row without a recording collects none.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, data_digest, load_grasps
from retrieval.errors import DatasetError
from retrieval.evaluation.cache import cached_document
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.fusion import ImageEncoding, score_partials
from retrieval.training.features import Features, encode_recording

Array = NDArray[np.float32]
_BLOCK = 8192


@dataclass(frozen=True)
class Scale:
    """Scale of the measurements.

    Attributes:
        photos: Photos of the blended catalogue.
        queries: Query touches for that catalogue.
        touches: Touches whose images are encoded in every setting.
        repeats: Timings of each point; the result is their median.
        quick: Whether to use the smallest grids.
    """

    photos: int = 100_000
    queries: int = 200
    touches: int = 240
    repeats: int = 7
    quick: bool = False


QUICK = Scale(photos=2000, queries=12, touches=12, repeats=2, quick=True)


@dataclass(frozen=True, eq=False)
class BlendedCatalogue:
    """A catalogue of N blended photos.

    Attributes:
        partials: (N, partial_width) float16 partial activations, as in an index.
        embeddings: Name of the embedding -> (N, d).
    """

    partials: NDArray[np.float16]
    embeddings: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Sample:
    """Grasps of unseen objects: photos of the first half of each object's grasps, touches of the second half.

    No grasp provides both a photo and a touch.

    Attributes:
        model: File of the checkpoint.
        recording: Function that returns the folder of the recording, and may collect it first.
        folder: Folder of encoded features.
        scale: Scale of the measurements.
        quiet: No output on stderr.
        seed: Seed of the random draws.
    """

    model: Path
    recording: Callable[[], Path]
    folder: Path
    scale: Scale
    quiet: bool = False
    seed: int = field(default=0)

    @cached_property
    def checkpoint(self) -> Checkpoint:
        """The loaded model."""
        return load_checkpoint(self.model).without_cells()

    @cached_property
    def grasps(self) -> list[Grasp]:
        """Grasps of unseen objects with at least two grasps, sorted by object.

        Raises:
            DatasetError: There are fewer than two such objects.
        """
        folder, split = self.recording(), self.checkpoint.split
        trained = {*split.train, *split.validation} if split else set()
        unseen = [grasp for grasp in load_grasps(folder) if grasp.object_id not in trained]
        names = [grasp.object_id for grasp in unseen]
        usable = [grasp for grasp in unseen if names.count(grasp.object_id) > 1]
        if len({grasp.object_id for grasp in usable}) < 2:
            raise DatasetError(
                f"{folder} needs at least 2 objects that the model was not trained on, with at least 2 grasps each. "
                "Give another --recording, or omit it to collect one."
            )
        return sorted(usable, key=lambda grasp: (grasp.object_id, grasp.grasp_id))

    @cached_property
    def digest(self) -> str:
        """Digest of the ids and images of the grasps."""
        return data_digest(self.grasps)

    @cached_property
    def features(self) -> Features:
        """Tower features of `grasps`."""
        checkpoint = self.checkpoint
        return encode_recording(self.grasps, checkpoint.matcher, checkpoint.config, self.folder, quiet=self.quiet)

    @cached_property
    def photo_rows(self) -> NDArray[np.int64]:
        """Rows of `grasps` whose photos are in the catalogue."""
        return np.flatnonzero(self._is_photo)

    @cached_property
    def touch_rows(self) -> NDArray[np.int64]:
        """Rows of `grasps` whose touches are queries, in random order, so that the first n have many objects."""
        rows = np.flatnonzero(~self._is_photo)
        return np.random.default_rng([self.seed, 1]).permutation(rows)

    @cached_property
    def _is_photo(self) -> NDArray[np.bool_]:
        names = np.array([grasp.object_id for grasp in self.grasps])
        first = np.array([int(np.argmax(names == name)) for name in names])
        counts = np.array([int(np.count_nonzero(names == name)) for name in names])
        return np.asarray(np.arange(len(names)) - first < counts // 2)

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """Object number of each of `grasps`."""
        return np.unique([grasp.object_id for grasp in self.grasps], return_inverse=True)[1].astype(np.int64)

    # Codes -------------------------------------------------------------------------------------------------

    def touch_encodings(self, rows: NDArray[np.int64]) -> dict[str, Array]:
        """Return "partial" (n, partial_width) and embeddings by name of the touches at these rows of `grasps`."""
        return self._codes(self.features.touch[rows].reshape(len(rows), -1), photo=False)

    def photo_encodings(self, rows: NDArray[np.int64]) -> dict[str, Array]:
        """Return the same as `touch_encodings` for the photos at these rows."""
        return self._codes(self.features.photo[rows], photo=True)

    @torch.inference_mode()
    def _codes(self, features: Array, photo: bool) -> dict[str, Array]:
        matcher, config = self.checkpoint.matcher, self.checkpoint.config
        inputs = torch.from_numpy(features)
        code: ImageEncoding = matcher.photo_encoding(inputs) if photo else matcher.touch_encoding(inputs)
        codes = {"partial": code.partial.numpy()}
        if matcher.candidate_encoder is not None:
            encoder = matcher.candidate_encoder
            encoded = encoder.photo(code.partial) if photo else encoder.touch(code.partial)
            codes["candidate encoder"] = encoded.numpy()
        if config.training.trains_embeddings:
            codes["contrastive embedding"] = code.embedding.numpy()
        return codes

    @cached_property
    def real_photo_codes(self) -> dict[str, Array]:
        """Codes of the photos of `photo_rows`."""
        return self.photo_encodings(self.photo_rows)

    # Catalogue ---------------------------------------------------------------------------------------------

    @cached_property
    def catalogue(self) -> BlendedCatalogue:
        """Blended photos: each is w A + (1 - w) B of the features of two photos, w uniform in 1/2..1.

        Blends are clustered around real photos, unlike white noise.
        """
        rng = np.random.default_rng([self.seed, 2])
        blocks: dict[str, list[Array]] = {}
        for start in range(0, self.scale.photos, _BLOCK):
            blended = blend(self.features.photo, min(_BLOCK, self.scale.photos - start), rng)
            for name, part in self._codes(blended, photo=True).items():
                blocks.setdefault(name, []).append(part)
        partials = np.concatenate([part.astype(np.float16) for part in blocks.pop("partial")])
        return BlendedCatalogue(partials, {name: np.concatenate(parts) for name, parts in blocks.items()})

    @cached_property
    def queries(self) -> dict[str, Array]:
        """Codes of the query touches for `catalogue`."""
        return self.touch_encodings(self.touch_rows[: self.scale.queries])

    @cached_property
    def exhaustive_top1(self) -> NDArray[np.int64]:
        """The photo of `catalogue` that the fusion head ranks first, for each of `queries`.

        It is stored in `folder`, because it takes the longest.
        """
        scale = self.scale
        cache_key = {"model": self.checkpoint.digest, "grasps": self.digest, "seed": self.seed, "photos": scale.photos}
        path = self.folder / "exhaustive_top1.json"
        return np.array(
            cached_document(path, cache_key | {"queries": scale.queries}, self._find_exhaustive_top1), dtype=np.int64
        )

    def _find_exhaustive_top1(self) -> list[int]:
        partials, found = self.queries["partial"], list[int]()
        with Bar("exhaustive rerank", len(partials), "queries", quiet=self.quiet) as bar:
            for touch_partial in partials:
                found.append(int(self.logits(touch_partial, self.catalogue.partials).argmax()))
                bar.advance()
        return found

    def logits(self, touch_partials: Array, photos: NDArray[Any], rows: NDArray[np.int64] | None = None) -> Array:
        """Return match logits of one touch, or summed over several, with photos.

        Args:
            touch_partials: (partial_width,) of one touch or (G, partial_width) of several.
            photos: (N, partial_width) of the photos.
            rows: Rows of `photos` to score; None for all.
        """
        return score_partials(
            self.checkpoint.matcher.head, torch.from_numpy(np.atleast_2d(touch_partials)), photos, rows
        )


def blend(features: Array, count: int, rng: np.random.Generator) -> Array:
    """Return blends (count, F): w A + (1 - w) B of random rows A and B of (n, F), w uniform in 1/2..1."""
    one, other = rng.integers(len(features), size=(2, count))
    weight = rng.uniform(0.5, 1.0, size=(count, 1)).astype(np.float32)
    return np.asarray(weight * features[one] + (1 - weight) * features[other])
