"""From gel images to ranked objects: encode the touch, take candidates, rerank them by match logit from halves."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from indexes.errors import UnsupportedFormat
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from retrieval.data.storage import place_of
from retrieval.errors import BadInput
from retrieval.model.judge import CONTACT, NO_CONTACT, NOT_A_GEL, Judge
from retrieval.model.onnx_encoder import exported
from retrieval.model.posterior import NONE_PRIOR, Belief, Posterior, require_prior
from retrieval.model.stored import Stored, read_judge
from retrieval.model.touches import (
    AnyImage,
    AnyTouches,
    Encoded,
    Encoder,
    GivenImage,
    Stopwatch,
    TouchReader,
    read_grasps,
)
from retrieval.search.query.answer import MATCH, NONE_OF_THESE, UNCALIBRATED, Match, QueryResult, is_clear
from retrieval.search.query.objects import Objects
from retrieval.search.query.opening import OpenShards, folder_shard, open_cluster, stored_for
from retrieval.search.query.references import ROWS, told_of
from retrieval.search.query.shard import Felt, FolderShard, Judged, Shard
from retrieval.search.sharding.object_store import is_cluster, read_cluster

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

    def __init__(self, index: str | Path, shard: Shard, checkpoint: Stored, encoder: Encoder, judge: Judge) -> None:
        self.index, self.shard, self.checkpoint = index, shard, checkpoint
        self.encoder, self.judge, self.described = encoder, judge, shard.described
        self.gel_check = checkpoint.gel_check
        compares = self.gel_check is not None and self.gel_check.level_above is not None
        self.reader = TouchReader(checkpoint.config, encoder, compares)
        self.posterior: Posterior | None = None  # where the model was never calibrated
        if self.described.calibration is not None:
            try:
                self.posterior = Posterior.from_dict(self.described.calibration)
            except BadInput as error:
                raise UnsupportedFormat(
                    f"the calibration in {index} is of another version ({error}); run `retrieve build-index` again"
                ) from error
        self.catalogue = Path(self.described.about["catalogue"])
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
        """Open the current generation of an index, or of a cluster of them, with the checkpoint that built it.

        * `index`: its folder; of a cluster the URL too, from which shards are fetched once into the user's cache.
        * `model`: where that checkpoint lies now, if it was moved.
        * `verify`: compare the checksums of the index's files.
        * `threads`: how many encode a touch; None leaves the choice to the library. PyTorch has one number for all that
          computes in a process.
        * `shards`: what opens the shards of a cluster; None opens them in this process.

        Touches are encoded by the export of the checkpoint where one lies beside it (`retrieval.model.export`) or in
        the user's cache; PyTorch is not imported then. Raises the errors of `indexes.store.folder.IndexStore.open`,
        CheckpointError, and MismatchedIndex for another model.

        >>> import numpy as np
        >>> from PIL import Image
        >>> pictures = [np.asarray(Image.open(name)) for name in ("a.png", "b.png")]  # as cameras give them
        >>> with retrieval.open("index") as searcher:
        ...     from_arrays, from_files = searcher.query(pictures), searcher.query(["a.png", "b.png"])
        >>> from_arrays.results == from_files.results
        True
        """
        if is_cluster(index):
            manifest = read_cluster(index)
            stored = stored_for(manifest, model)
            shard = shards(index, manifest, stored) if shards else open_cluster(index, manifest, stored, verify)
        else:
            generation = IndexStore(index).open(verify=verify, threads=1)  # one query at a time
            stored = stored_for(generation.manifest, model)
            shard = folder_shard(generation, stored)
        encoder = exported(stored, threads) or torch_encoder(stored, threads)
        return cls(place_of(index), shard, stored, encoder, read_judge(stored.path))

    def close(self) -> None:
        """Let go of index and model; what is under way in other threads is finished first. Does nothing twice."""
        self._closed = True
        for name in ("shard", "encoder", "reader", "judge"):
            vars(self).pop(name, None)

    def __reduce__(self) -> NoReturn:
        raise BadInput(
            "a Searcher cannot be pickled, as it holds opened files and a model; open the index in each process: "
            f"retrieval.open({str(self.index)!r})"
        )

    @property
    def generation(self) -> Generation:
        """The opened generation, where one index folder is searched. Raises BadInput for a cluster."""
        return self._folder.generation

    @property
    def objects(self) -> Objects:
        """The objects of that generation."""
        return self._folder.objects

    @property
    def _folder(self) -> FolderShard:
        shard = self._held().shard
        if not isinstance(shard, FolderShard):
            raise BadInput(f"{self.index} is a cluster of index folders, and this wants one; open a shard of it")
        return shard

    def __enter__(self) -> "Searcher":
        return self._held()

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
        """Which of the catalogue's objects was felt in one or more grasps, or none of them?

        * `touches`: one grasp, a list with an image for each finger in their order; or a list of several such grasps.
          For a model with one finger an image alone is a grasp too. An image is a path, the bytes of a file, a Pillow
          image, or an array (height, width, 3) of uint8, red first: what OpenCV reads is blue first and looks like any
          other array, so turn it by `image[..., ::-1]`. A file and its decoded array give the same answer.
        * `background`: the fingers' no-contact frames, for a model that subtracts them, and for one that was taught by
          them what a contact is.
        * `top`: how many objects to return.
        * `candidates`: how many photos the full classifier judges, `top` at least: those nearest to all grasps
          together. By default as many as the index was found to need. Where that is no fewer than there are photos, or
          the model has no trained embeddings, every photo is judged and nothing is searched.
        * `none_prior`: probability, before anything is felt, that the catalogue lacks the object.

        Only grasps with contact are judged. Match logits of several grasps add; `retrieval.model.posterior` says what
        the sum is worth and how objects and "none of these" get their probabilities. Raises BadInput, ImageError or
        NumericalError.
        """
        held = self._held()
        require_counts(top, candidates)
        grasps = read_grasps(touches, held.reader.fingers)
        return held._answers(grasps, [slice(len(grasps))], background, top, candidates, none_prior)[0]

    def query_growing(
        self,
        touches: AnyTouches,
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """What `query` answers after the first grasp, after the first two, and so on to all of them; every grasp is
        encoded once.

        >>> with retrieval.open("index") as searcher:
        ...     after_one, after_two = searcher.query_growing([["a.png", "b.png"], ["a2.png", "b2.png"]])
        >>> len(after_one.touches), len(after_two.touches)
        (1, 2)
        """
        held = self._held()
        require_counts(top, candidates)
        grasps = read_grasps(touches, held.reader.fingers)
        asked = [slice(count) for count in range(1, len(grasps) + 1)]
        return held._answers(grasps, asked, background, top, candidates, none_prior)

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """Answer for several objects in the hand, each given as `query` takes it, in their order.

        Their touches are encoded in batches. Logits are within 1e-4 of those of single queries, as a batch rounds in
        another order. Where the touches of one object cannot be used, nothing is answered and the error names it.
        """
        held = self._held()
        require_counts(top, candidates)
        asked = [
            read_grasps(touches, held.reader.fingers, of=f"object {number}, ")
            for number, touches in enumerate(objects, 1)
        ]
        ends = np.cumsum([len(grasps) for grasps in asked]).tolist()
        spans = [slice(end - len(grasps), end) for end, grasps in zip(ends, asked, strict=True)]
        every = [grasp for grasps in asked for grasp in grasps]
        return held._answers(every, spans, background, top, candidates, none_prior) if asked else []

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> Encoded:
        """The unit embeddings (G, embedding_dim) and halves (G, half) of G grasps, given as `query` takes them.

        The inner product of a grasp's embedding with a photo's (`retrieval.embed_photos`) is the score by which
        candidates are found; it orders photos for one touch and is no probability. Match logits, summed over the
        grasps, are `searcher.judge.logits(halves, photo_halves)`.
        """
        held = self._held()
        grasps = read_grasps(touches, held.reader.fingers)
        references = held.reader.references(background)
        codes = held.reader.encode(grasps, references, Stopwatch())
        return Encoded(codes.embeddings, codes.halves)

    def _held(self) -> "Searcher":
        """This searcher with all it needs, so that `close` in another thread takes nothing away from a query."""
        held = object.__new__(type(self))
        vars(held).update(vars(self))
        if held._closed:
            raise BadInput(f"this searcher of {self.index} was closed; open the index again")
        return held

    # The stages: each takes and gives what belongs to one object, images of all objects side by side ------------

    def _answers(
        self,
        grasps: Sequence[Sequence[GivenImage]],
        asked: Sequence[slice],
        background: Sequence[AnyImage] | None,
        top: int,
        candidates: int | None,
        none_prior: float,
    ) -> list[QueryResult]:
        """An answer for each object in the hand; each slice of `asked` names the grasps that are of one object."""
        require_prior(none_prior)
        clock = Stopwatch()
        references = self.reader.references(background)
        codes = self.reader.encode(grasps, references, clock)
        shown = np.full(len(codes.halves), CONTACT)
        if self.gel_check is not None and codes.readings is not None:
            shown = np.array(self.gel_check.judge(codes.readings, codes.levels))
        parts = [(shown[own], codes.halves[own], codes.embeddings[own]) for own in asked]
        judged = []
        for own, halves, embeddings in parts:
            felt = (own == CONTACT) & (own != NOT_A_GEL).all()
            judged.append(self._judged(Felt(embeddings[felt], halves[felt]), top, candidates, none_prior, clock))
        timing_ms = clock.finished(len(asked))
        return [
            self._answer(grasps[its], own.tolist(), embeddings, timing_ms, found, none_prior)
            for its, (own, _, embeddings), found in zip(asked, parts, judged, strict=True)
        ]

    def _judged(
        self, felt: Felt, top: int, candidates: int | None, none_prior: float, clock: Stopwatch
    ) -> "_Judged | None":
        """The best objects, and what is believed of them; None where nothing was felt."""
        if not len(felt.halves):
            clock.add({"candidates": 0.0, "rerank": 0.0})
            return None
        found = self.shard.ask(felt, top, candidates, self.posterior)
        clock.add({stage: found.timing_ms[stage] for stage in ("candidates", "rerank")})
        if self.posterior is None or found.mass is None:
            return _Judged(found, len(felt.halves), None)
        belief = self.posterior.share([one.logit for one in found.best], found.mass, len(felt.halves), none_prior)
        return _Judged(found, len(felt.halves), belief)

    def _answer(
        self,
        grasps: Sequence[Sequence[GivenImage]],
        shown: list[str],
        embeddings: Floats,
        timing_ms: dict[str, float],
        judged: "_Judged | None",
        none_prior: float,
    ) -> QueryResult:
        belief = judged.belief if judged else None
        verdict = _verdict(shown, belief)
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            grasps=shown,
            index={
                "path": str(self.index),
                "generation": self.described.name,
                "kind": self.described.kind,
                "photos": self.described.photos,
                "objects": self.described.objects,
                "scored": judged.found.photos if judged else 0,
                **(self._shares(judged) if self.described.shards > 1 else {}),
                "encoder": self.encoder.name,
                "catalogue": str(self.described.about["catalogue"]),
                "model": str(self.checkpoint.path),
                "trained_on": self.checkpoint.provenance.get("source", "unknown"),
            },
            timing_ms=timing_ms,
            verdict=verdict,
            none_probability=belief.none if belief else None,
            posterior=self._meaning(judged, none_prior) if judged else None,
            results=self._ranking(judged) if judged else [],
            more_grasps=self._more_grasps(judged, none_prior) if verdict == NONE_OF_THESE else None,
            embeddings=embeddings,
        )

    def _more_grasps(self, judged: "_Judged | None", none_prior: float) -> int | None:
        """Further grasps after which the verdict is expected to be a match; None where the ranking is not clear."""
        if not (self.posterior and judged and judged.belief and (mass := judged.found.mass)):
            return None
        if not is_clear(float(judged.belief.objects_if_present[0])):
            return None
        return self.posterior.more_grasps(judged.found.best[0].logit, mass.objects, judged.grasps, none_prior)

    def _shares(self, judged: "_Judged | None") -> dict[str, Any]:
        """For an index of several shards: how many there are, and which share of all photos could be searched."""
        searched = self.described.photos if judged is None else judged.found.searched
        return {"shards": self.described.shards, "searched": searched / self.described.photos}

    def _ranking(self, judged: "_Judged") -> list[Match]:
        ranking, base, belief = [], self.catalogue.absolute(), judged.belief
        for rank, (logit, photo, reference) in enumerate(judged.found.best, start=1):
            probability = None if belief is None else float(belief.objects[rank - 1])
            if_present = None if belief is None else float(belief.objects_if_present[rank - 1])
            told = (rank, photo.object_id, logit, probability, photo.path, photo.metadata)
            ranking.append(Match(*told, base / photo.path, reference, if_present))
        return ranking

    def _meaning(self, judged: "_Judged", none_prior: float) -> dict[str, Any] | None:
        """The formula of the probabilities, with the numbers of this answer."""
        if self.posterior is None or judged.belief is None:
            return None
        return {
            **self.posterior.to_dict(),
            "none_prior": none_prior,
            "grasps": judged.grasps,
            "objects": self.described.objects,
            "judged_objects": judged.found.objects,
            "unjudged_probability": judged.belief.unjudged,
            **({ROWS: told} if (told := told_of(self.described.about)) else {}),
        }


class _Judged(NamedTuple):
    """What was found for one object in the hand by so many grasps, and what is believed of it."""

    found: Judged
    grasps: int
    belief: Belief | None


def _verdict(shown: Sequence[str], belief: Belief | None) -> str:
    if NOT_A_GEL in shown:
        return NOT_A_GEL
    if CONTACT not in shown:
        return NO_CONTACT
    if belief is None:
        return UNCALIBRATED
    return MATCH if belief.is_match else NONE_OF_THESE


def require_counts(top: int, candidates: int | None) -> None:
    """Raises BadInput for numbers of objects or candidates that are none."""
    given: list[object] = [top] if candidates is None else [top, candidates]
    if not all(isinstance(count, int | np.integer) and count >= 1 for count in given):
        raise BadInput(f"top and candidates must be whole numbers of 1 or more; got {top} and {candidates}")


def torch_encoder(stored: Stored, threads: int | None = None) -> Encoder:
    """The towers in PyTorch, whose import takes longer than all the rest."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.encode import TorchEncoder

    return TorchEncoder(load_checkpoint(stored.path, known=stored).matcher, threads)
