"""Query an opened index: encode the touch, find candidates, rerank them by match logit, and give a verdict."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from indexes.errors import UnsupportedFormat
from indexes.store.generation import Generation
from retrieval.data.storage import url_or_path
from retrieval.errors import BadInput
from retrieval.model.checkpoint_info import CheckpointInfo, read_scorer
from retrieval.model.fusion_scorer import CONTACT, NO_CONTACT, NOT_A_GEL, FusionScorer
from retrieval.model.onnx_encoder import find_export
from retrieval.model.posterior import NONE_PRIOR, Posterior, PosteriorProbabilities, require_prior
from retrieval.model.reference_calibration import REFERENCE_ROWS
from retrieval.model.touches import (
    AnyImage,
    AnyTouches,
    EncodedTouches,
    InputImage,
    Stopwatch,
    TouchEncoder,
    TouchReader,
    parse_grasps,
)
from retrieval.search.query.answer import MATCH, NONE_OF_THESE, UNCALIBRATED, Match, QueryResult, is_clear
from retrieval.search.query.objects import Objects
from retrieval.search.query.opening import OpenShards, open_index
from retrieval.search.query.reference_touches import reference_summary
from retrieval.search.query.shard import FolderShard, Shard, ShardQuery, ShardResult

Floats = NDArray[np.float32]


class Searcher:
    """An opened index with its model, for any number of queries.

    Any number of threads may query it at once, and a process forked from this one too: no thread or lock outlives a
    query. `close` it, or open it by `with`; a query that is under way then is answered.

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
        self, index: str | Path, shard: Shard, checkpoint: CheckpointInfo, encoder: TouchEncoder, scorer: FusionScorer
    ) -> None:
        self.index, self.shard, self.checkpoint = index, shard, checkpoint
        self.encoder, self.scorer, self.info = encoder, scorer, shard.info
        self.gel_check = checkpoint.gel_check
        compares_contact = self.gel_check is not None and self.gel_check.level_above is not None
        self.reader = TouchReader(checkpoint.config, encoder, compares_contact)
        self.posterior: Posterior | None = None  # where the model was never calibrated
        if self.info.calibration is not None:
            try:
                self.posterior = Posterior.from_dict(self.info.calibration)
            except BadInput as error:
                raise UnsupportedFormat(
                    f"the calibration in {index} is of another version ({error}); run `retrieve build-index` again"
                ) from error
        self.catalogue = Path(self.info.about["catalogue"])
        self._closed = False

    @classmethod
    def open(
        cls,
        index: str | Path,
        *,
        model: str | Path | None = None,
        verify: bool = True,
        threads: int | None = None,
        shards: OpenShards | None = None,
    ) -> "Searcher":
        """Open the current generation of an index, or of a sharded index, with the checkpoint that built it.

        Touches are encoded by the export of the checkpoint (`retrieval.model.export`) if one lies beside it or in the
        user's cache, without PyTorch.

        Args:
            index: Its folder; or the URL of a sharded index, whose shards are fetched once into the user's cache.
            model: Path of the checkpoint, if it was moved.
            verify: Compare the checksums of the index's files.
            threads: Number of threads that encode a touch; None: the library's choice. PyTorch has one number for all
                computation of a process.
            shards: Opens the shards of a sharded index; None: in this process.

        Raises:
            IndexesError: The index is missing, damaged, or of another model.
            CheckpointError: The checkpoint is missing or damaged.

        >>> import numpy as np
        >>> from PIL import Image
        >>> pictures = [np.asarray(Image.open(name)) for name in ("a.png", "b.png")]  # as cameras give them
        >>> with retrieval.open("index") as searcher:
        ...     from_arrays, from_files = searcher.query(pictures), searcher.query(["a.png", "b.png"])
        >>> from_arrays.results == from_files.results
        True
        """
        shard, stored = open_index(index, model, verify, shards)
        encoder = find_export(stored, threads) or torch_encoder(stored, threads)
        return cls(url_or_path(index), shard, stored, encoder, read_scorer(stored.path))

    def close(self) -> None:
        """Release index and model; queries in other threads are answered first. Does nothing twice."""
        self._closed = True
        for name in ("shard", "encoder", "reader", "scorer"):
            vars(self).pop(name, None)

    def __reduce__(self) -> NoReturn:
        raise BadInput(
            "a Searcher cannot be pickled, as it holds opened files and a model; open the index in each process: "
            f"retrieval.open({str(self.index)!r})"
        )

    @property
    def generation(self) -> Generation:
        """The opened generation of an index folder. Raises BadInput for a sharded index."""
        return self._folder.generation

    @property
    def objects(self) -> Objects:
        """The objects of that generation."""
        return self._folder.objects

    @property
    def _folder(self) -> FolderShard:
        shard = self._snapshot().shard
        if not isinstance(shard, FolderShard):
            raise BadInput(f"{self.index} is a cluster of index folders, and this wants one; open a shard of it")
        return shard

    def __enter__(self) -> "Searcher":
        return self._snapshot()

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

        Only grasps with contact count. Match logits of several grasps add; `retrieval.model.posterior` states how the
        sums become probabilities of the objects and of "none of these".

        Args:
            touches: One grasp, a list with an image for each finger in their order; or a list of such grasps. For a
                model with one finger an image alone is a grasp too. An image is a path, the bytes of a file, a Pillow
                image, or an array (height, width, 3) of uint8, red first: OpenCV reads blue first, so turn its arrays
                by `image[..., ::-1]`. A file and its decoded array give the same answer.
            background: The fingers' no-contact frames, for a model that subtracts them or compares with them.
            top: Number of objects to return.
            candidates: Number of photos to rerank, at least `top`: those nearest to all grasps together; None: as
                measured for the index. All photos are reranked if they are no more than that, or if the model has no
                trained embeddings.
            none_prior: Prior probability that the catalogue lacks the object.

        Raises:
            BadInput: An argument is invalid.
            ImageError: An image cannot be read.
            NumericalError: A logit is not finite.
        """
        held = self._snapshot()
        grasps = parse_grasps(touches, held.reader.fingers)
        return held._answers(grasps, [slice(len(grasps))], background, top, candidates, none_prior)[0]

    def query_cumulative(
        self,
        touches: AnyTouches,
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """Return what `query` answers after the first grasp, after the first two, and so on; each is encoded once.

        >>> with retrieval.open("index") as searcher:
        ...     after_one, after_two = searcher.query_cumulative([["a.png", "b.png"], ["a2.png", "b2.png"]])
        >>> len(after_one.touches), len(after_two.touches)
        (1, 2)
        """
        held = self._snapshot()
        grasps = parse_grasps(touches, held.reader.fingers)
        spans = [slice(count) for count in range(1, len(grasps) + 1)]
        return held._answers(grasps, spans, background, top, candidates, none_prior)

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """Return the answer for each of several objects in the hand, given as `query` takes them.

        Touches are encoded in batches, so logits are within 1e-4 of those of single queries. If the touches of one
        object cannot be used, the error names it and nothing is answered.
        """
        held = self._snapshot()
        asked = [
            parse_grasps(touches, held.reader.fingers, of=f"object {number}, ")
            for number, touches in enumerate(objects, 1)
        ]
        ends = np.cumsum([len(grasps) for grasps in asked]).tolist()
        spans = [slice(end - len(grasps), end) for end, grasps in zip(ends, asked, strict=True)]
        every = [grasp for grasps in asked for grasp in grasps]
        return held._answers(every, spans, background, top, candidates, none_prior)

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> EncodedTouches:
        """Return the unit embeddings (G, embedding_dim) and partial activations (G, half) of G grasps.

        The inner product of a grasp's embedding with a photo's (`retrieval.embed_photos`) orders candidates; it is not
        a probability. Match logits, summed over the grasps, are `searcher.scorer.logits(partials, photo_partials)`.

        Args:
            touches: As `query` takes them.
            background: As `query` takes it.
        """
        held = self._snapshot()
        grasps = parse_grasps(touches, held.reader.fingers)
        codes = held.reader.encode(grasps, held.reader.no_contact_frames(background), Stopwatch())
        return EncodedTouches(codes.embeddings, codes.partials)

    def _snapshot(self) -> "Searcher":
        """This searcher with all it needs, so that `close` in another thread takes nothing away from a query."""
        held = object.__new__(type(self))
        vars(held).update(vars(self))
        if held._closed:
            raise BadInput(f"this searcher of {self.index} was closed; open the index again")
        return held

    def _answers(
        self,
        grasps: Sequence[Sequence[InputImage]],
        spans: Sequence[slice],
        background: Sequence[AnyImage] | None,
        top: int,
        candidates: int | None,
        none_prior: float,
    ) -> list[QueryResult]:
        """An answer for each object in the hand; each span selects the grasps of one object."""
        require_counts(top, candidates)
        require_prior(none_prior)
        if not grasps:
            return []
        clock = Stopwatch()
        codes = self.reader.encode(grasps, self.reader.no_contact_frames(background), clock)
        shown = np.full(len(codes.partials), CONTACT)
        if self.gel_check is not None and codes.readings is not None:
            shown = np.array(self.gel_check.classify(codes.readings, codes.levels))
        judged = []
        for its in spans:
            felt = (shown[its] == CONTACT) & (shown[its] != NOT_A_GEL).all()
            own = ShardQuery(codes.embeddings[its][felt], codes.partials[its][felt])
            judged.append(self._score(own, top, candidates, none_prior, clock))
        timing_ms = clock.finish(len(spans))
        return [
            self._answer(grasps[its], shown[its].tolist(), codes.embeddings[its], timing_ms, found, none_prior)
            for its, found in zip(spans, judged, strict=True)
        ]

    def _score(
        self, felt: ShardQuery, top: int, candidates: int | None, none_prior: float, clock: Stopwatch
    ) -> "_ScoredQuery | None":
        """The best objects and their posterior; None without a grasp with contact."""
        if not len(felt.partials):
            clock.add({"candidates": 0.0, "rerank": 0.0})
            return None
        found = self.shard.search(felt, top, candidates, self.posterior)
        clock.add({stage: found.timing_ms[stage] for stage in ("candidates", "rerank")})
        posterior_probabilities = None
        if self.posterior is not None and found.mass is not None:
            logits = [one.logit for one in found.best]
            posterior_probabilities = self.posterior.probabilities_given(
                logits, found.mass, len(felt.partials), none_prior
            )
        return _ScoredQuery(found, len(felt.partials), posterior_probabilities)

    def _answer(
        self,
        grasps: Sequence[Sequence[InputImage]],
        shown: list[str],
        embeddings: Floats,
        timing_ms: dict[str, float],
        judged: "_ScoredQuery | None",
        none_prior: float,
    ) -> QueryResult:
        info, posterior_probabilities = self.info, judged.posterior_probabilities if judged else None
        verdict = _verdict(shown, posterior_probabilities)
        searched = judged.found.searched if judged else info.photos
        shares = {"shards": info.shards, "searched": searched / info.photos} if info.shards > 1 else {}
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            grasps=shown,
            index={
                "path": str(self.index),
                "generation": info.name,
                "kind": info.kind,
                "photos": info.photos,
                "objects": info.objects,
                "scored": judged.found.photos if judged else 0,
                **shares,
                "encoder": self.encoder.name,
                "catalogue": str(info.about["catalogue"]),
                "model": str(self.checkpoint.path),
                "trained_on": self.checkpoint.provenance.get("source", "unknown"),
            },
            timing_ms=timing_ms,
            verdict=verdict,
            none_probability=posterior_probabilities.none if posterior_probabilities else None,
            posterior=self._formula(judged, none_prior) if judged else None,
            results=self._ranking(judged) if judged else [],
            more_grasps=self._more_grasps(judged, none_prior) if verdict == NONE_OF_THESE and judged else None,
            embeddings=embeddings,
        )

    def _more_grasps(self, judged: "_ScoredQuery", none_prior: float) -> int | None:
        """Further grasps after which the verdict is expected to be a match; None where the ranking is not clear."""
        mass, posterior_probabilities = judged.found.mass, judged.posterior_probabilities
        if (
            self.posterior is None
            or posterior_probabilities is None
            or mass is None
            or not is_clear(float(posterior_probabilities.objects_if_present[0]))
        ):
            return None
        return self.posterior.more_grasps(judged.found.best[0].logit, mass.objects, judged.grasps, none_prior)

    def _ranking(self, judged: "_ScoredQuery") -> list[Match]:
        ranking, base, posterior_probabilities = [], self.catalogue.absolute(), judged.posterior_probabilities
        for rank, (logit, photo, reference) in enumerate(judged.found.best, start=1):
            probability = None if posterior_probabilities is None else float(posterior_probabilities.objects[rank - 1])
            if_present = (
                None if posterior_probabilities is None else float(posterior_probabilities.objects_if_present[rank - 1])
            )
            told = (rank, photo.object_id, logit, probability, photo.path, photo.metadata)
            ranking.append(Match(*told, base / photo.path, reference, if_present))
        return ranking

    def _formula(self, judged: "_ScoredQuery", none_prior: float) -> dict[str, Any] | None:
        """The formula of the probabilities, with the numbers of this answer."""
        if self.posterior is None or judged.posterior_probabilities is None:
            return None
        return {
            **self.posterior.to_dict(),
            "none_prior": none_prior,
            "grasps": judged.grasps,
            "objects": self.info.objects,
            "scored_objects": judged.found.objects,
            "unscored_probability": judged.posterior_probabilities.unscored,
            **({REFERENCE_ROWS: told} if (told := reference_summary(self.info.about)) else {}),
        }


class _ScoredQuery(NamedTuple):
    """The result for one object in the hand, the number of its grasps with contact, and the posterior."""

    found: ShardResult
    grasps: int
    posterior_probabilities: PosteriorProbabilities | None


def _verdict(shown: Sequence[str], posterior_probabilities: PosteriorProbabilities | None) -> str:
    if NOT_A_GEL in shown:
        return NOT_A_GEL
    if CONTACT not in shown:
        return NO_CONTACT
    if posterior_probabilities is None:
        return UNCALIBRATED
    return MATCH if posterior_probabilities.is_match else NONE_OF_THESE


def require_counts(top: int, candidates: int | None) -> None:
    """Raises BadInput for numbers of objects or candidates that are none."""
    given: list[object] = [top] if candidates is None else [top, candidates]
    if not all(isinstance(count, int | np.integer) and count >= 1 for count in given):
        raise BadInput(f"top and candidates must be whole numbers of 1 or more; got {top} and {candidates}")


def torch_encoder(stored: CheckpointInfo, threads: int | None = None) -> TouchEncoder:
    """The towers in PyTorch, whose import takes longer than all the rest."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.encode import TorchEncoder

    return TorchEncoder(load_checkpoint(stored.path, info=stored).matcher, threads)
