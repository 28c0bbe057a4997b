"""Query an opened index: encode the touch, find candidates, rerank them by match logit, and give a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import NoReturn

import numpy as np

from indexes.errors import UnsupportedFormat
from indexes.store.generation import Generation
from retrieval.errors import BadInput
from retrieval.model.checkpoint_info import CheckpointInfo
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.onnx_encoder import find_export
from retrieval.model.posterior import NONE_PRIOR, Posterior, PosteriorProbabilities, require_prior
from retrieval.model.references import REFERENCE_ROWS
from retrieval.model.touch_reader import EncodedTouches, Stopwatch, TouchEncoder, TouchReader
from retrieval.model.touches import AnyImage, AnyTouches, InputImage, parse_grasps
from retrieval.model.verification import MAX_GRASPS, DecisionBounds
from retrieval.search.answer import (
    Match,
    QueryResult,
    Verification,
    gel_classes,
    is_clear,
    verdict_of,
)
from retrieval.search.objects import Objects
from retrieval.search.opening import OpenShards, open_index, scorer_for, torch_encoder
from retrieval.search.references import reference_summary
from retrieval.search.shard import FolderShard, RankedObject, ShardQuery, ShardResult, Shards


class Searcher:
    """An opened index with its model.

    Threads and forked processes may query it at the same time. Close it with `close` or a `with` block.

    >>> searcher = retrieval.open("index")
    >>> one = searcher.query(["a.png", "b.png"], top=2)
    >>> [match.rank for match in one.results]
    [1, 2]
    >>> mug, tin = [["a.png", "b.png"], ["a2.png", "b2.png"]], ["a2.png", "b2.png"]
    >>> len(searcher.query_many([mug, tin]))
    2
    >>> searcher.close()
    """

    def __init__(
        self,
        index: str | Path,
        shard: FolderShard | Shards,
        checkpoint: CheckpointInfo,
        encoder: TouchEncoder,
        scorer: FusionScorer,
    ) -> None:
        self.index, self.shard, self.checkpoint = index, shard, checkpoint
        self.encoder, self.scorer, self.info = encoder, scorer, shard.info
        self.gel_check = checkpoint.gel_check
        compares_contact = self.gel_check is not None and self.gel_check.level_above is not None
        self.reader = TouchReader(checkpoint.config, encoder, compares_contact)
        self.posterior: Posterior | None = None  # None: the model is not calibrated
        if self.info.calibration is not None:
            try:
                self.posterior = Posterior.from_dict(self.info.calibration)
            except BadInput as error:
                raise UnsupportedFormat(
                    f"{index}: the calibration has another version ({error}); run `retrieve build-index` again"
                ) from error
        self.catalogue = Path(self.info.about["catalogue"])
        self._closed = False

    @classmethod
    def open(
        cls,
        index: str | Path,
        *,
        model: str | Path | None = None,
        threads: int | None = None,
        shards: OpenShards | None = None,
    ) -> Searcher:
        """Open the current generation of an index or a sharded index, with the checkpoint that built it.

        If an export of the checkpoint (`retrieval.model.export`) is in its folder or in the user's cache, the export
        encodes touches, without PyTorch.

        Args:
            index: Its folder.
            model: Path of the checkpoint, if it was moved.
            threads: Number of threads of the encoder (with PyTorch: of the process). Default: the library's choice.
            shards: Function that opens the shards of a sharded index. Default: open them in this process.

        Raises:
            IndexesError: The index is missing, damaged, or of another model.
            CheckpointError: The checkpoint is missing or damaged.

        >>> import numpy as np
        >>> from PIL import Image
        >>> pictures = [np.asarray(Image.open(name)) for name in ("a.png", "b.png")]  # red first
        >>> with retrieval.open("index") as searcher:
        ...     from_arrays, from_files = searcher.query(pictures), searcher.query(["a.png", "b.png"])
        >>> from_arrays.results == from_files.results
        True
        """
        shard, stored = open_index(index, model, shards)
        encoder = find_export(stored, threads) or torch_encoder(stored, threads)
        scorer = shard.scorer if isinstance(shard, FolderShard) else scorer_for(stored, shard.info.about)
        return cls(Path(index), shard, stored, encoder, scorer)

    def close(self) -> None:
        """Release the index and the model; running queries continue. A second call does nothing."""
        self._closed = True
        for name in ("shard", "encoder", "reader", "scorer"):
            vars(self).pop(name, None)

    def __reduce__(self) -> NoReturn:
        raise BadInput(
            "a Searcher cannot be pickled: it has opened files and a model. Open the index in each process: "
            f"retrieval.open({str(self.index)!r})"
        )

    @property
    def generation(self) -> Generation:
        """The opened generation of an index folder. Raises BadInput for a sharded index."""
        return self.folder_shard.generation

    @property
    def objects(self) -> Objects:
        """The objects of the opened generation of an index folder. Raises BadInput for a sharded index."""
        return self.folder_shard.objects

    @property
    def folder_shard(self) -> FolderShard:
        """The shard of an opened index folder. Raises BadInput for a sharded index."""
        shard = self._snapshot().shard
        if not isinstance(shard, FolderShard):
            raise BadInput(f"{self.index} is a sharded index, but one index folder is required; open one of its shards")
        return shard

    def __enter__(self) -> Searcher:
        self._snapshot()  # refuses a closed searcher
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def query(
        self,
        touches: AnyTouches,
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> QueryResult:
        """Rank the objects of the catalogue by one or more grasps of the object in the hand.

        Grasps without contact are ignored. If any image is not a gel image, nothing is ranked. Match logits of grasps
        add up; `retrieval.model.posterior` converts them to probabilities of the objects and of "none of these".

        Args:
            touches: One grasp, a list with an image for each finger in their order; or a list of such grasps. For a
                model with one finger a single image is a grasp too. An image is a path, the bytes of a file, a Pillow
                image, or an array (height, width, 3) of uint8, red first (OpenCV: `image[..., ::-1]`).
            background: The fingers' no-contact frames, for a model that uses them.
            top: Number of objects to return.
            candidates: Number of photos that each shard reranks, at least `top`: those nearest to the sum of the
                grasps' embeddings. Default: as measured by `build-index`. All photos of the best objects, and of the
                objects with the nearest reference touches, are scored too. If a shard has no more photos than this
                number, or the model has no trained embeddings, all its photos are scored.
            none_prior: Prior probability that the catalogue lacks the object.

        Raises:
            BadInput: An argument is invalid.
            ImageError: An image cannot be read.
            NumericalError: A logit is not finite.
        """
        opened = self._snapshot()
        grasps = parse_grasps(touches, opened.reader.fingers)
        return opened._results([grasps], background, top, candidates, none_prior)[0]

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """Return one result for each of several objects in the hand; give each object's touches as for `query`.

        Touches are encoded in batches, so logits differ by at most 1e-4 from single queries. If the touches of one
        object are invalid, the error names the object and no query runs.
        """
        opened = self._snapshot()
        fingers = opened.reader.fingers
        parsed = [parse_grasps(one, fingers, of=f"object {number}, ") for number, one in enumerate(objects, 1)]
        return opened._results(parsed, background, top, candidates, none_prior)

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> EncodedTouches:
        """Return the unit embeddings (G, embedding_dim) and partial activations (G, touch_partial_width) of G grasps.

        The inner product of a grasp's embedding with a photo's (`retrieval.embed_photos`) orders candidates; it is not
        a probability. `searcher.scorer.logits(partials, photo_partials)` gives match logits, summed over the grasps.

        Args:
            touches: As for `query`.
            background: As for `query`.
        """
        opened = self._snapshot()
        grasps = parse_grasps(touches, opened.reader.fingers)
        codes = opened.reader.encode(grasps, opened.reader.no_contact_frames(background), Stopwatch())
        return EncodedTouches(codes.embeddings, codes.partials)

    def verify(
        self, touches: AnyTouches, expect: str, *, far: float = 0.01, background: Sequence[AnyImage] | None = None
    ) -> Verification:
        """Decide whether the object in the hand is the expected one, at a stated false-accept rate.

        Args:
            touches: As for `query`; at most the first four grasps with contact are used.
            expect: The expected object of the catalogue.
            far: False-accept rate: the fraction of other objects that is accepted.
            background: As for `query`.

        Raises:
            BadInput: The catalogue lacks the object, the rate is too small for the model's validation objects, or the
                model has no error rates.
        """
        opened = self._snapshot()
        number, bounds, posterior = opened.expected_object(expect, far)
        grasps = parse_grasps(touches, opened.reader.fingers)
        names = [[image.name for image in grasp] for grasp in grasps]
        codes = opened.reader.encode(grasps, opened.reader.no_contact_frames(background), Stopwatch())
        checked = gel_classes(opened.gel_check, codes)
        partials, classes = codes.partials[checked == CONTACT][:MAX_GRASPS], checked.tolist()
        if NOT_A_GEL in classes or not len(partials):
            decision = NOT_A_GEL if NOT_A_GEL in classes else NO_CONTACT
            return Verification(expect, decision, names, classes, [], None)
        shard = opened.folder_shard
        ratios = [
            float(posterior.log_ratio(shard.object_logit(number, partials[:count], posterior), count))
            for count in range(1, len(partials) + 1)
        ]
        return Verification(expect, bounds.decide(np.array(ratios)), names, classes, ratios, bounds)

    @property
    def can_verify(self) -> bool:
        """Whether the model has error rates for verification, and the index the model's cells."""
        has_cells = self.scorer.cell_dim == self.checkpoint.config.matcher.cell_dim
        return self.checkpoint.verification is not None and has_cells and self.posterior is not None

    def expected_object(self, expect: str, far: float) -> tuple[int, DecisionBounds, Posterior]:
        """Return the number of the expected object, the bounds of the decision and the posterior; raise as `verify`."""
        calibration, posterior = self.checkpoint.verification, self.posterior
        if not self.can_verify or calibration is None or posterior is None:
            raise BadInput(
                f"{self.checkpoint.path} has no error rates for verification with this index: fit a model with at "
                "least 20 objects of 5 grasps (`retrieve train`: validation objects), and build its index with its "
                "cells"
            )
        bounds = calibration.bounds(far)
        number = self.generation.rows.find_object(expect)
        if number < 0:
            raise BadInput(f"the catalogue of {self.index} has no object {expect!r}; give the name of its folder")
        return number, bounds, posterior

    def _snapshot(self) -> Searcher:
        """Return a copy with references to all resources, so that `close` in another thread cannot break a query."""
        opened = object.__new__(type(self))
        vars(opened).update(vars(self))
        if opened._closed:
            raise BadInput(f"this searcher of {self.index} is closed; open the index again")
        return opened

    def _results(
        self,
        objects: Sequence[Sequence[Sequence[InputImage]]],
        background: Sequence[AnyImage] | None,
        top: int,
        candidates: int | None,
        none_prior: float,
    ) -> list[QueryResult]:
        """Return a result for each object in the hand, which is given by its grasps."""
        counts: list[object] = [top] if candidates is None else [top, candidates]
        if not all(isinstance(count, int | np.integer) and count >= 1 for count in counts):
            raise BadInput(f"top and candidates must be whole numbers of 1 or more; got {top} and {candidates}")
        require_prior(none_prior)
        if not objects:
            return []
        clock, every = Stopwatch(), [grasp for grasps in objects for grasp in grasps]
        codes = self.reader.encode(every, self.reader.no_contact_frames(background), clock)
        shown, found, start = gel_classes(self.gel_check, codes), list[tuple[list[str], ShardResult | None]](), 0
        for grasps in objects:
            span = slice(start, start := start + len(grasps))
            classes, result = shown[span], None
            in_contact = (classes == CONTACT) & (classes != NOT_A_GEL).all()
            if in_contact.any():
                query = ShardQuery(codes.embeddings[span][in_contact], codes.partials[span][in_contact])
                result = self.shard.search(query, top, candidates, self.posterior)
            clock.add({stage: result.timing_ms[stage] if result else 0.0 for stage in ("candidates", "rerank")})
            found.append((classes.tolist(), result))
        timing_ms = clock.finish(len(objects))
        return [
            self._result(grasps, classes, timing_ms, result, none_prior)
            for grasps, (classes, result) in zip(objects, found, strict=True)
        ]

    def _result(
        self,
        grasps: Sequence[Sequence[InputImage]],
        classes: list[str],
        timing_ms: dict[str, float],
        found: ShardResult | None,
        none_prior: float,
    ) -> QueryResult:
        """Return the answer; `found` is None without a grasp with contact."""
        info, posterior, count = self.info, self.posterior, classes.count(CONTACT)
        probabilities, formula, more_grasps = None, None, None
        if found is not None and found.mass is not None and posterior is not None:
            logits = [one.logit for one in found.best]
            probabilities = posterior.probabilities_given(logits, found.mass, count, none_prior)
            if not probabilities.is_match and is_clear(float(probabilities.objects_if_present[0])):
                more_grasps = posterior.more_grasps(logits[0], found.mass.objects, count, none_prior)
            references = reference_summary(info.about)
            formula = {
                **posterior.to_dict(),
                "none_prior": none_prior,
                "grasps": count,
                "objects": info.objects,
                "scored_objects": found.objects,
                "unscored_probability": probabilities.unscored,
                **({REFERENCE_ROWS: references} if references else {}),
            }
        sharding = {"shards": info.shards} if info.shards > 1 else {}
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            grasps=classes,
            index={
                "path": str(self.index),
                "generation": info.name,
                "kind": info.kind,
                "photos": info.photos,
                "objects": info.objects,
                "scored": found.photos if found else 0,
                **sharding,
                "encoder": self.encoder.name,
                "catalogue": str(info.about["catalogue"]),
                "model": str(self.checkpoint.path),
                "trained_on": self.checkpoint.provenance.get("source", "unknown"),
            },
            timing_ms=timing_ms,
            verdict=verdict_of(classes, probabilities),
            none_probability=probabilities.none if probabilities else None,
            posterior=formula,
            results=self._ranking(found.best, probabilities) if found else [],
            more_grasps=more_grasps,
        )

    def _ranking(self, best: Sequence[RankedObject], probabilities: PosteriorProbabilities | None) -> list[Match]:
        ranking, base = [], self.catalogue.absolute()
        for place, (logit, photo, reference) in enumerate(best):
            probability = None if probabilities is None else float(probabilities.objects[place])
            if_present = None if probabilities is None else float(probabilities.objects_if_present[place])
            fields = (place + 1, photo.object_id, logit, probability, photo.path, photo.metadata)
            ranking.append(Match(*fields, base / photo.path, reference, if_present))
        return ranking
