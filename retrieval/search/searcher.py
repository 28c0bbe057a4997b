"""From gel images to ranked objects: encode the touch, take candidates, rerank them by match logit from halves."""

import copy
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexes.errors import UnsupportedFormat
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from retrieval.errors import BadInput
from retrieval.model.judge import CONTACT, NO_CONTACT, NOT_A_GEL, Judge
from retrieval.model.onnx_encoder import exported_beside
from retrieval.model.posterior import NONE_PRIOR, Belief, Posterior, require_prior
from retrieval.model.stored import Stored, fingerprint, read_judge, read_stored
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
from retrieval.search import defaults
from retrieval.search.answer import MATCH, NONE_OF_THESE, UNCALIBRATED, Match, QueryResult
from retrieval.search.objects import JudgedObjects, Objects, listed_photo, require_usable

DEFAULT_CANDIDATES = 1000
COMPLETED = 20
"""Objects, at least, of which every photo is judged."""
Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


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

    def __init__(self, index: Path, generation: Generation, checkpoint: Stored, encoder: Encoder, judge: Judge) -> None:
        self.index, self.generation, self.checkpoint = index, generation, checkpoint
        self.encoder, self.judge = encoder, judge
        self.gel_check = checkpoint.gel_check
        compares = self.gel_check is not None and self.gel_check.level_above is not None
        self.reader = TouchReader(checkpoint.config, encoder, compares)
        self.posterior: Posterior | None = None  # where the model was never calibrated
        if "calibration" in generation.documents:
            try:
                self.posterior = Posterior.from_dict(generation.documents["calibration"])
            except BadInput as error:
                raise UnsupportedFormat(
                    f"the calibration in {index} is of another version ({error}); run `retrieve build-index` again"
                ) from error
        self.catalogue = Path(generation.manifest.about["catalogue"])
        self.objects = Objects(generation)
        self._closed = False

    @classmethod
    def open(
        cls, index: str | Path, *, model: str | Path | None = None, verify: bool = True, threads: int | None = None
    ) -> "Searcher":
        """Open the current generation of an index with the checkpoint that built it.

        model: where that checkpoint lies now, if it was moved. verify: compare the checksums of the index's files.
        threads: with which touches are encoded, in PyTorch by whatever else computes in this process too; None leaves
        the choice to the library.
        Touches are encoded by the export beside the checkpoint (`retrieval.model.export`) where there is one, and
        PyTorch is not imported then. Raises the errors of `indexes.store.folder.IndexStore.open`, CheckpointError, and
        MismatchedIndex for another model.

        >>> import numpy as np
        >>> from PIL import Image
        >>> pictures = [np.asarray(Image.open(name)) for name in ("a.png", "b.png")]  # as cameras give them
        >>> with retrieval.open("index") as searcher:
        ...     from_arrays, from_files = searcher.query(pictures), searcher.query(["a.png", "b.png"])
        >>> from_arrays.results == from_files.results
        True
        """
        generation = IndexStore(index).open(verify=verify, threads=1)  # one query at a time
        stored = read_stored(Path(model) if model else defaults.model_of(generation.manifest))
        if stored.digest != generation.fingerprint.get("checkpoint"):
            from retrieval.model.checkpoint import load_checkpoint

            load_checkpoint(stored.path)  # a damaged one says so
        generation.require(fingerprint(stored))
        require_usable(generation, stored.config.matcher.half)
        encoder = exported_beside(stored, threads) or torch_encoder(stored, threads)
        return cls(Path(index), generation, stored, encoder, read_judge(stored.path))

    def close(self) -> None:
        """Let go of index and model; what is under way in other threads is finished first. Does nothing twice."""
        self._closed = True
        for name in ("generation", "encoder", "reader", "judge", "objects"):
            vars(self).pop(name, None)

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

        touches: one grasp, which is a list with an image for each finger in their order, or a list of several such
        grasps; for a model with one finger an image alone is a grasp too. An image is a path, the bytes of a file, a
        Pillow image, or an array (height, width, 3) of uint8, red first: what OpenCV reads is blue first and looks like
        any other array, so turn it by `image[..., ::-1]`. A file and its decoded array give the same answer.
        background: the fingers' no-contact frames, for a model that subtracts them, and for one that was taught by
        them what a contact is. top: objects to return. candidates: photos per grasp that the full classifier judges,
        `top` at least, by default as many as the index was found to need; with no fewer than there are photos, or a
        model without trained embeddings, it judges all of them and no candidate stage runs. none_prior: probability,
        before anything is felt, that the catalogue lacks the object. Match logits of several grasps add; what the sum
        is worth, and how objects and "none of these" get their probabilities, stands in `retrieval.model.posterior`.
        Only grasps with contact are judged. Raises BadInput, ImageError or NumericalError.
        """
        held = self._held()
        limit = held._limit(top, candidates)
        grasps = read_grasps(touches, held.reader.fingers)
        return held._answers(grasps, [slice(len(grasps))], background, top, limit, none_prior)[0]

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
        limit = held._limit(top, candidates)
        grasps = read_grasps(touches, held.reader.fingers)
        asked = [slice(count) for count in range(1, len(grasps) + 1)]
        return held._answers(grasps, asked, background, top, limit, none_prior)

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

        Their touches are encoded in batches. The logits are those of single queries within 1e-4, as a batch rounds in
        another order. Where one object's touches are not fit, nothing is answered and the error names it.
        """
        held = self._held()
        limit = held._limit(top, candidates)
        asked = [
            read_grasps(touches, held.reader.fingers, of=f"object {number}, ")
            for number, touches in enumerate(objects, 1)
        ]
        ends = np.cumsum([len(grasps) for grasps in asked]).tolist()
        spans = [slice(end - len(grasps), end) for end, grasps in zip(ends, asked, strict=True)]
        every = [grasp for grasps in asked for grasp in grasps]
        return held._answers(every, spans, background, top, limit, none_prior) if asked else []

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> Encoded:
        """The unit embeddings (G, embedding_dim) and halves (G, half) of G grasps, given as `query` takes them.

        The inner product with a photo's embedding (`retrieval.embed_photos`) is the score by which candidates are
        found; it orders photos for one touch and is no probability. Match logits are
        `searcher.judge.logits(halves, photo_halves)`, added over the grasps.
        """
        held = self._held()
        grasps = read_grasps(touches, held.reader.fingers)
        references = held.reader.references(background)
        codes = held.reader.encode(grasps, references, Stopwatch())
        return Encoded(codes.embeddings, codes.halves)

    def _held(self) -> "Searcher":
        """This searcher with all it needs, so that `close` in another thread takes nothing away from a query."""
        held = copy.copy(self)
        if held._closed:
            raise BadInput(f"this searcher of {self.index} was closed; open the index again")
        return held

    def _limit(self, top: int, candidates: int | None) -> int:
        """Photos that are judged for each grasp: as many as asked for, else as measured on the index, else 1000."""
        measured = self.generation.manifest.about.get("candidates") or {"k": DEFAULT_CANDIDATES}
        limit = int(measured["k"]) if candidates is None else candidates
        if top < 1 or limit < 1:
            raise BadInput(f"top and candidates must be 1 or more; got {top} and {limit}")
        return max(top, limit)

    # The stages: each takes and gives what belongs to one object, images of all objects side by side ------------

    def _answers(
        self,
        grasps: Sequence[Sequence[GivenImage]],
        asked: Sequence[slice],
        background: Sequence[AnyImage] | None,
        top: int,
        limit: int,
        none_prior: float,
    ) -> list[QueryResult]:
        """An answer for each of `asked`, which names the grasps that are of its object."""
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
            with clock("candidates"):
                rows = self._candidates(embeddings[felt], limit)
            with clock("rerank"):
                judged.append(self._judged(halves[felt], rows, top, none_prior))
        timing_ms = clock.finished(len(asked))
        return [
            self._answer(grasps[its], own.tolist(), embeddings, timing_ms, found, top, none_prior)
            for its, (own, _, embeddings), found in zip(asked, parts, judged, strict=True)
        ]

    def _candidates(self, embeddings: Floats, k: int) -> Rows:
        """Rows to judge, the union over grasps; all of them where the stage would leave nothing out."""
        if not len(embeddings):
            return np.zeros(0, dtype=np.int64)
        if not self.checkpoint.config.has_embeddings or k >= self.generation.count:
            return np.arange(self.generation.count)
        found = [rows for rows, _ in self.generation.search(embeddings, k)]
        return np.unique(np.concatenate(found))

    def _judged(self, halves: Floats, rows: Rows, top: int, none_prior: float) -> "_Judged | None":
        """Objects by their judged photos, and what is believed of them; None where nothing was felt.

        Candidates are some photos of an object: of the best objects the others are judged as well.
        """
        if not len(halves):
            return None
        meaning, logits = self.posterior or Posterior(), self._logits(halves, rows)
        objects = self.objects.judged(rows, logits, meaning, len(halves))
        if len(rows) < self.generation.count:
            best = objects.numbers[self.objects.best(objects, max(top, COMPLETED))]
            rest = self.objects.rest_of(best, rows)
        else:
            rest = rows[:0]
        if len(rest):
            rows = np.concatenate([rows, rest])
            logits = self.objects.equal_for_equals(rows, np.concatenate([logits, self._logits(halves, rest)]))
            objects = self.objects.judged(rows, logits, meaning, len(halves))
        if self.posterior is None:
            return _Judged(len(rows), len(halves), objects, None)
        unjudged = self.objects.count - len(objects.numbers)
        # Without a sample of them, these are taken to be like the least of the judged ones, which candidates are not
        # expected to be.
        sample = objects.logits.min(keepdims=True)
        if unjudged and len(drawn := self.objects.sample_without(objects.numbers)):
            sample = self.objects.judged(drawn, self._logits(halves, drawn), meaning, len(halves)).logits
        belief = self.posterior.believe(
            objects.logits, len(halves), none_prior=none_prior, unjudged=unjudged, sample=sample
        )
        return _Judged(len(rows), len(halves), objects, belief)

    def _logits(self, halves: Floats, rows: Rows) -> Floats:
        """Match logits of the rows, summed over grasps."""
        every = len(rows) == self.generation.count
        logits = self.judge.logits(halves, self.generation.arrays["halves"], None if every else rows)
        return self.objects.equal_for_equals(rows, logits)

    def _answer(
        self,
        grasps: Sequence[Sequence[GivenImage]],
        shown: list[str],
        embeddings: Floats,
        timing_ms: dict[str, float],
        judged: "_Judged | None",
        top: int,
        none_prior: float,
    ) -> QueryResult:
        belief = judged.belief if judged else None
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            grasps=shown,
            index={
                "path": str(self.index),
                "generation": self.generation.name,
                "kind": self.generation.manifest.kind,
                "photos": self.generation.count,
                "objects": self.objects.count,
                "scored": judged.photos if judged else 0,
                "encoder": self.encoder.name,
                "catalogue": str(self.catalogue),
                "model": str(self.checkpoint.path),
                "trained_on": self.checkpoint.provenance.get("source", "unknown"),
            },
            timing_ms=timing_ms,
            verdict=_verdict(shown, belief),
            none_probability=belief.none if belief else None,
            posterior=self._meaning(judged, none_prior) if judged else None,
            results=self._ranking(judged, top) if judged else [],
            embeddings=embeddings,
        )

    def _ranking(self, judged: "_Judged", top: int) -> list[Match]:
        objects, belief = judged.objects, judged.belief
        ranking = []
        for rank, place in enumerate(self.objects.best(objects, top), start=1):
            photo = listed_photo(self.generation.rows[int(objects.rows[place])])
            probability = None if belief is None else float(belief.objects[place])
            path, logit = self.catalogue.absolute() / photo.path, float(objects.logits[place])
            ranking.append(Match(rank, photo.object_id, logit, probability, photo.path, photo.metadata, path))
        return ranking

    def _meaning(self, judged: "_Judged", none_prior: float) -> dict[str, Any] | None:
        """The formula of the probabilities, with the numbers of this answer."""
        if self.posterior is None or judged.belief is None:
            return None
        return {
            **self.posterior.to_dict(),
            "none_prior": none_prior,
            "grasps": judged.grasps,
            "objects": self.objects.count,
            "judged_objects": len(judged.objects.numbers),
            "unjudged_probability": judged.belief.unjudged,
        }


class _Judged(NamedTuple):
    """What was judged for one object in the hand: so many photos, by so many grasps."""

    photos: int
    grasps: int
    objects: JudgedObjects
    belief: Belief | None


def _verdict(shown: Sequence[str], belief: Belief | None) -> str:
    if NOT_A_GEL in shown:
        return NOT_A_GEL
    if CONTACT not in shown:
        return NO_CONTACT
    if belief is None:
        return UNCALIBRATED
    return MATCH if belief.objects.max() > belief.none else NONE_OF_THESE


def torch_encoder(stored: Stored, threads: int | None = None) -> Encoder:
    """The towers in PyTorch, whose import takes longer than all the rest."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.encode import TorchEncoder

    return TorchEncoder(load_checkpoint(stored.path, known=stored).matcher, threads)
