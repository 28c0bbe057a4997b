"""What the approximations are measured on: a model, grasps that it never saw, and catalogues blended from them.

Everything is made when it is first asked for: a row that needs no recording makes none.
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
    """How much is measured. photos: of the blended catalogue; queries: touches asked there; touches: touches whose
    images are encoded again in every setting; repeats: of every time, whose median is taken. quick: smallest grids.
    """

    photos: int = 100_000
    queries: int = 200
    touches: int = 240
    repeats: int = 7
    quick: bool = False


QUICK = Scale(photos=2000, queries=12, touches=12, repeats=2, quick=True)


@dataclass(frozen=True, eq=False)
class BlendedCatalogue:
    """N photos. halves (N, half) float16, as an index keeps them. embeddings: name of what made them -> (N, d)."""

    partials: NDArray[np.float16]
    embeddings: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Sample:
    """Grasps of objects that the model has not seen: of each object the photos of the first half of its grasps, and
    the touches of the others. No grasp gives both.

    model: a checkpoint's file. recording: gives the folder, and may first collect it. folder: where encoded features
    are kept.
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
        return load_checkpoint(self.model)

    @cached_property
    def grasps(self) -> list[Grasp]:
        """Grasps of unseen objects with two grasps or more, in order of objects. Raises DatasetError for none."""
        folder, split = self.recording(), self.checkpoint.split
        seen = {*split.train, *split.validation} if split else set()
        found = [grasp for grasp in load_grasps(folder) if grasp.object_id not in seen]
        names = [grasp.object_id for grasp in found]
        kept = [grasp for grasp in found if names.count(grasp.object_id) > 1]
        if len({grasp.object_id for grasp in kept}) < 2:
            raise DatasetError(
                f"{folder} must hold two objects or more that the model was not trained on, each with two grasps or "
                "more; give another --recording, or none and one is collected"
            )
        return sorted(kept, key=lambda grasp: (grasp.object_id, grasp.grasp_id))

    @cached_property
    def digest(self) -> str:
        """A digest of the grasps: of their ids and images."""
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
        """Rows of `grasps` whose touches are queries, in a random order: the first n are of many objects."""
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
        """ "half" (n, hidden), and embeddings by name, of the touches at these rows of `grasps`."""
        return self._codes(self.features.touch[rows].reshape(len(rows), -1), photo=False)

    def photo_encodings(self, rows: NDArray[np.int64]) -> dict[str, Array]:
        """As `touch_encodings`, of the photos at these rows."""
        return self._codes(self.features.photo[rows], photo=True)

    @torch.inference_mode()
    def _codes(self, features: Array, photo: bool) -> dict[str, Array]:
        matcher, config = self.checkpoint.matcher, self.checkpoint.config
        given = torch.from_numpy(features)
        code: ImageEncoding = matcher.photo_encoding(given) if photo else matcher.touch_encoding(given)
        codes = {"partial": code.partial.numpy()}
        if matcher.candidate_encoder is not None:
            by_pruner = (
                matcher.candidate_encoder.photo(code.partial)
                if photo
                else matcher.candidate_encoder.touch(code.partial)
            )
            codes["candidate encoder"] = by_pruner.numpy()
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
        """`scale.photos` photos: each a blend w A + (1 - w) B of the features of two, w uniform in 1/2..1.

        Blends lie where the model's photos lie, in clumps around them; white noise would not.
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
        """Codes of the touches that are asked on `catalogue`."""
        return self.touch_encodings(self.touch_rows[: self.scale.queries])

    @cached_property
    def exhaustive_top1(self) -> NDArray[np.int64]:
        """For each of `queries` the photo of `catalogue` that the full classifier ranks first of all; kept in `folder`,
        since it takes the longest.
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
            for partial_activation in partials:
                found.append(int(self.logits(partial_activation, self.catalogue.partials).argmax()))
                bar.advance()
        return found

    def logits(self, partial_activation: Array, photos: NDArray[Any], rows: NDArray[np.int64] | None = None) -> Array:
        """Match logits of one touch, or summed over touches (G, half), with photos (N, half), at `rows` or all."""
        return score_partials(
            self.checkpoint.matcher.head, torch.from_numpy(np.atleast_2d(partial_activation)), photos, rows
        )


def blend(features: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, F): w A + (1 - w) B of rows of (n, F), A and B drawn at random, w uniform in 1/2..1."""
    one, other = rng.integers(len(features), size=(2, count))
    weight = rng.uniform(0.5, 1.0, size=(count, 1)).astype(np.float32)
    return np.asarray(weight * features[one] + (1 - weight) * features[other])
