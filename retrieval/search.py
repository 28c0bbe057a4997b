"""From gel images to ranked objects: encode the touch, take candidates, rerank them by match logit from halves."""

import copy
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes.generation import Generation
from indexes.store import IndexStore
from retrieval import defaults
from retrieval.answer import Match, QueryResult
from retrieval.calibration import Calibration
from retrieval.encoded import Encoded, Encoder, TouchReader
from retrieval.errors import BadInput
from retrieval.judge import Judge
from retrieval.listing import listed_photo, require_usable
from retrieval.objects import Objects
from retrieval.onnx_encoder import exported_beside
from retrieval.stopwatch import Stopwatch
from retrieval.stored import Stored, fingerprint, read_judge, read_stored
from retrieval.touches import AnyImage, AnyTouches, GivenImage

DEFAULT_CANDIDATES = 1000
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
        self.reader = TouchReader(checkpoint.config, encoder)
        self.calibration: Calibration | None = None
        if "calibration" in generation.documents:
            self.calibration = Calibration.from_dict(generation.documents["calibration"])
        self.catalogue = Path(generation.manifest.about["catalogue"])
        self.objects = Objects(generation)
        self._closed = False

    @classmethod
    def open(cls, index: str | Path, *, model: str | Path | None = None, verify: bool = True) -> "Searcher":
        """Open the current generation of an index with the checkpoint that built it.

        model: where that checkpoint lies now, if it was moved. verify: compare the checksums of the index's files.
        Touches are encoded by the export beside the checkpoint (`retrieval.export`) where there is one, and PyTorch is
        not imported then. Raises the errors of `indexes.store.IndexStore.open`, CheckpointError, and MismatchedIndex
        for another model.

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
        _require(generation, stored)
        require_usable(generation, stored.config.matcher.hidden)
        return cls(
            Path(index), generation, stored, exported_beside(stored) or _torch_encoder(stored), read_judge(stored.path)
        )

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
    ) -> QueryResult:
        """Rank the catalogue's objects for one object felt in one or more grasps.

        touches: one grasp, which is a list with an image for each finger in their order, or a list of several such
        grasps; for a model with one finger an image alone is a grasp too. An image is a path, the bytes of a file, a
        Pillow image, or an array (height, width, 3) of uint8, red first: what OpenCV reads is blue first and looks like
        any other array, so turn it by `image[..., ::-1]`. A file and its decoded array give the same answer.
        background: the fingers' no-contact frames, for a model that subtracts them and for no other. top: objects to
        return. candidates: photos per grasp that the full classifier judges, `top` at least, by default as many as the
        index was found to need; with no fewer than there are photos, or a model without trained embeddings, it judges
        all of them and no candidate stage runs. Several grasps count as independent given the object: their logits add.
        Raises BadInput, ImageError or NumericalError.
        """
        held = self._held()
        limit = held._limit(top, candidates)
        return held._answers([held.reader.grasps(touches)], background, top, limit)[0]

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        background: Sequence[AnyImage] | None = None,
        top: int = 10,
        candidates: int | None = None,
    ) -> list[QueryResult]:
        """Answer for several objects in the hand, each given as `query` takes it, in their order.

        Their touches are encoded in batches. The logits are those of single queries within 1e-4, as a batch rounds in
        another order. Where one object's touches are not fit, nothing is answered and the error names it.
        """
        held = self._held()
        limit = held._limit(top, candidates)
        asked = [held.reader.grasps(touches, of=f"object {number}, ") for number, touches in enumerate(objects, 1)]
        return held._answers(asked, background, top, limit) if asked else []

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> Encoded:
        """The unit embeddings (G, embedding_dim) and halves (G, hidden) of G grasps, given as `query` takes them.

        The inner product with a photo's embedding (`retrieval.embed_photos`) is the score by which candidates are
        found; it orders photos for one touch and is no probability. Match logits are
        `searcher.judge.logits(halves, photo_halves)`, added over the grasps.
        """
        held = self._held()
        grasps, references = held.reader.grasps(touches), held.reader.references(background)
        return held.reader.encode(grasps, references, Stopwatch())

    @property
    def default_candidates(self) -> int:
        """Photos that the classifier judges where a query says no number: as measured on the index, else 1000."""
        measured = self.generation.manifest.about.get("candidates")
        return int(measured["k"]) if measured else DEFAULT_CANDIDATES

    def _held(self) -> "Searcher":
        """This searcher with all it needs, so that `close` in another thread takes nothing away from a query."""
        held = copy.copy(self)
        if held._closed:
            raise BadInput(f"this searcher of {self.index} was closed; open the index again")
        return held

    def _limit(self, top: int, candidates: int | None) -> int:
        """Photos that are judged for each grasp."""
        limit = self.default_candidates if candidates is None else candidates
        if top < 1 or limit < 1:
            raise BadInput(f"top and candidates must be 1 or more; got {top} and {limit}")
        return max(top, limit)

    # The stages: each takes and gives what belongs to one object, images of all objects side by side ------------

    def _answers(
        self,
        asked: Sequence[Sequence[Sequence[GivenImage]]],
        background: Sequence[AnyImage] | None,
        top: int,
        limit: int,
    ) -> list[QueryResult]:
        clock = Stopwatch()
        references = self.reader.references(background)
        every = self.reader.encode([grasp for grasps in asked for grasp in grasps], references, clock)
        ends = np.cumsum([len(grasps) for grasps in asked])[:-1]
        halves, embeddings = np.split(every.halves, ends), np.split(every.embeddings, ends)
        with clock("candidates"):
            rows = [self._candidates(own, limit) for own in embeddings]
        with clock("rerank"):
            logits = [self._judged(own, found) for own, found in zip(halves, rows, strict=True)]
            ranked = [self.objects.best(self._rows(found), own, top) for own, found in zip(logits, rows, strict=True)]
        timing_ms = clock.finished(len(asked))
        return [
            self._answer(grasps, self._about(len(own)), timing_ms, best)
            for grasps, own, best in zip(asked, logits, ranked, strict=True)
        ]

    def _candidates(self, embeddings: Floats, k: int) -> Rows | None:
        """Rows to judge, the union over grasps; None for all, where the stage would leave nothing out."""
        if not self.checkpoint.config.has_embeddings or k >= self.generation.count:
            return None
        found = [rows for rows, _ in self.generation.search(embeddings, k)]
        return np.unique(np.concatenate(found))

    def _judged(self, halves: Floats, rows: Rows | None) -> Floats:
        """Match logits of the rows, summed over grasps."""
        logits = self.judge.logits(halves, self.generation.arrays["halves"], rows)
        return self.objects.equal_for_equals(self._rows(rows), logits)

    def _rows(self, rows: Rows | None) -> Rows:
        return np.arange(self.generation.count) if rows is None else rows

    def _answer(
        self,
        grasps: Sequence[Sequence[GivenImage]],
        about: dict[str, Any],
        timing_ms: dict[str, float],
        best: Sequence[tuple[int, float]],
    ) -> QueryResult:
        results = [self._match(rank, row, logit, len(grasps)) for rank, (row, logit) in enumerate(best, start=1)]
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            index=about,
            timing_ms=timing_ms,
            verdict=self._verdict(results[0], len(grasps)),
            results=results,
        )

    def _match(self, rank: int, row_number: int, logit: float, grasps: int) -> Match:
        photo = listed_photo(self.generation.rows[row_number])
        probability = float(self.calibration.probability(logit, grasps)) if self.calibration else None
        path = self.catalogue.absolute() / photo.path
        return Match(rank, photo.object_id, logit, probability, photo.path, photo.metadata, path)

    def _verdict(self, best: Match, grasps: int) -> str:
        if self.calibration is None:
            return "uncalibrated"
        log_odds = float(self.calibration.log_odds(best.logit, grasps))
        return "match" if log_odds >= self.calibration.reject_log_odds else "no match"

    def _about(self, scored: int) -> dict[str, Any]:
        return {
            "path": str(self.index),
            "generation": self.generation.name,
            "kind": self.generation.manifest.kind,
            "photos": self.generation.count,
            "objects": self.objects.count,
            "scored": scored,
            "encoder": self.encoder.name,
            "catalogue": str(self.catalogue),
            "model": str(self.checkpoint.path),
            "trained_on": self.checkpoint.provenance.get("source", "unknown"),
        }


def _require(generation: Generation, stored: Stored) -> None:
    wanted = fingerprint(stored)
    if wanted["checkpoint"] != generation.fingerprint.get("checkpoint"):
        from retrieval.checkpoint import load_checkpoint

        load_checkpoint(stored.path)  # a damaged one says so
    generation.require(wanted)


def _torch_encoder(stored: Stored) -> Encoder:
    """The towers in PyTorch, whose import takes longer than all the rest."""
    from retrieval.checkpoint import load_checkpoint
    from retrieval.encode import TorchEncoder

    return TorchEncoder(load_checkpoint(stored.path, known=stored).matcher)
