"""From gel images to ranked objects: encode the touch, take candidates, rerank them by match logit from halves."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexes.generation import Generation
from indexes.store import IndexStore
from retrieval import defaults
from retrieval.calibration import Calibration
from retrieval.errors import BadInput, CheckpointError, NumericalError
from retrieval.judge import Judge
from retrieval.onnx_encoder import exported_beside
from retrieval.resize import RgbImage
from retrieval.stored import Stored, file_digest, fingerprint, read_judge, read_stored

DEFAULT_CANDIDATES = 1000
DECODERS = 2  # a touch has as many images
Floats = NDArray[np.float32]


class Encoder(Protocol):
    """What makes halves (G, hidden) and embeddings (G, embedding_dim) of touches: PyTorch or ONNX Runtime."""

    @property
    def name(self) -> str:
        """How it is called in the answer."""

    def encode(self, touches: Sequence[Sequence[RgbImage]]) -> tuple[Floats, Floats]:
        """Encode grasps, each its fingers' images."""


@dataclass(frozen=True)
class Match:
    """One object of a ranking, by its best photo. probability is None where the model was never calibrated."""

    rank: int
    object_id: str
    logit: float
    probability: float | None
    photo: str
    metadata: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class QueryResult:
    """A ranking. verdict: "match", "no match" (the best is below the reject threshold) or "uncalibrated"."""

    touches: list[list[str]]
    index: dict[str, Any]
    timing_ms: dict[str, float]
    verdict: str
    results: list[Match]

    def to_dict(self) -> dict[str, Any]:
        """The document of `retrieve query --json`."""
        return {
            "query": {"touches": self.touches},
            "index": self.index,
            "timing_ms": self.timing_ms,
            "verdict": self.verdict,
            "results": [match.to_dict() for match in self.results],
        }


class Searcher:
    """An opened index with its model, for any number of queries."""

    def __init__(self, index: Path, generation: Generation, checkpoint: Stored, encoder: Encoder, judge: Judge) -> None:
        self.index, self.generation, self.checkpoint = index, generation, checkpoint
        self.encoder, self.judge = encoder, judge
        self.calibration: Calibration | None = None
        if "calibration" in generation.documents:
            self.calibration = Calibration.from_dict(generation.documents["calibration"])
        self._object_of_row = generation.codes("object_id")
        self._original = _originals(generation.codes("digest"))
        self._threads = ThreadPoolExecutor(DECODERS, "decode")

    @classmethod
    def open(cls, index: str | Path, *, model: str | Path | None = None, verify: bool = True) -> "Searcher":
        """Open the current generation of an index with the checkpoint that built it.

        model: where that checkpoint lies now, if it was moved. verify: compare the checksums of the index's files.
        Touches are encoded by the export beside the checkpoint (`retrieval.export`) where there is one, and PyTorch is
        not imported then. Raises the errors of `indexes.store.IndexStore.open`, CheckpointError, and MismatchedIndex
        for another model.
        """
        generation = IndexStore(index).open(verify=verify, threads=1)  # one query at a time
        stored = read_stored(Path(model) if model else _model_of(generation))
        _require(generation, stored)
        return cls(
            Path(index), generation, stored, exported_beside(stored) or _torch_encoder(stored), read_judge(stored.path)
        )

    @property
    def catalogue(self) -> Path:
        """The folder of photos that the index was built from."""
        return Path(self.generation.manifest.about["catalogue"])

    def query(
        self,
        touches: Sequence[Sequence[str | Path]],
        *,
        background: Sequence[str | Path] | None = None,
        top: int = 10,
        candidates: int | None = None,
    ) -> QueryResult:
        """Rank the catalogue's objects for one object felt in one or more grasps.

        touches: for each grasp its gel images, in finger order. background: the fingers' no-contact frames, for a
        model that subtracts them and for no other. top: objects to return. candidates: photos per grasp that the full
        classifier judges, `top` at least, by default as many as the index was found to need; with no fewer than there
        are photos, or a model without trained embeddings, it judges all of them and no candidate stage runs. Several
        grasps count as independent given the object: their logits add. Raises BadInput, ImageError or NumericalError.
        """
        limit = self.default_candidates if candidates is None else candidates
        if top < 1 or limit < 1 or not touches:
            raise BadInput(f"give at least one touch, top >= 1 and candidates >= 1; got {len(touches)}, {top}, {limit}")
        clock = _Clock()
        with clock("decode"):
            images = self._load(touches, self._references(background))
        with clock("encode"):
            touch_halves, embeddings = _finite(self.encoder.encode(images))
        with clock("candidates"):
            rows = self._candidates(embeddings, max(limit, top))
        with clock("rerank"):
            logits = self.judge.logits(touch_halves, self.generation.arrays["halves"], rows)
            judged = np.arange(self.generation.count) if rows is None else rows
            best = self._best_of_objects(judged, self._equal_for_equals(judged, logits), top)
        results = [self._match(rank, row, logit, len(touches)) for rank, (row, logit) in enumerate(best, start=1)]
        return QueryResult(
            touches=[[str(path) for path in touch] for touch in touches],
            index=self._about(self.generation.count if rows is None else len(rows)),
            timing_ms=clock.finished(),
            verdict=self._verdict(results[0], len(touches)),
            results=results,
        )

    @property
    def default_candidates(self) -> int:
        """Photos that the classifier judges where a query says no number: as measured on the index, else 1000."""
        measured = self.generation.manifest.about.get("candidates")
        return int(measured["k"]) if measured else DEFAULT_CANDIDATES

    def _references(self, background: Sequence[str | Path] | None) -> Sequence[str | Path | None]:
        """The no-contact frame of each finger, None for a model that looks at no such frame."""
        policy = self.checkpoint.config.preprocessing.background
        if background is None and policy != "none":
            raise BadInput(
                f'this model subtracts the untouched gel (background = "{policy}"): give a no-contact frame for each '
                "finger with --background"
            )
        if background is not None and policy == "none":
            raise BadInput("this model takes gel images as they are and would not look at --background; leave it out")
        return [None] * self._fingers if background is None else self._one_per_finger("background", background)

    def _load(
        self, touches: Sequence[Sequence[str | Path]], references: Sequence[str | Path | None]
    ) -> list[list[RgbImage]]:
        """The images of all grasps, decoded side by side; of several bad files the first is told."""
        load = self.checkpoint.config.preprocessing.load_touch
        pairs = [list(zip(self._one_per_finger("touch", touch), references, strict=True)) for touch in touches]
        jobs = [[self._threads.submit(load, *pair) for pair in touch] for touch in pairs]
        return [[job.result() for job in touch] for touch in jobs]

    def _one_per_finger(self, what: str, files: Sequence[str | Path]) -> Sequence[str | Path]:
        if len(files) != self._fingers:
            raise BadInput(
                f"this model takes {self._fingers} gel image(s) for one {what}; got {len(files)}: "
                + ", ".join(str(path) for path in files)
            )
        return files

    @property
    def _fingers(self) -> int:
        return self.checkpoint.config.matcher.fingers

    def _candidates(self, embeddings: NDArray[np.float32], k: int) -> NDArray[np.int64] | None:
        """Rows to judge, the union over grasps; None for all, where the stage would leave nothing out."""
        if not self.checkpoint.config.has_embeddings or k >= self.generation.count:
            return None
        found = [rows for rows, _ in self.generation.search(embeddings, k)]
        return np.unique(np.concatenate(found))

    def _equal_for_equals(self, rows: NDArray[np.int64], logits: Floats) -> Floats:
        """Photos of equal bytes have equal logits; a matrix product may round its last rows in another way."""
        if self._original is None:
            return logits
        original, of_original = self._original[rows], np.empty(self.generation.count, dtype=np.float32)
        of_original[original[::-1]] = logits[::-1]  # the last assignment counts: that of the first equal photo
        equal: Floats = of_original[original]
        return equal

    def _best_of_objects(self, rows: NDArray[np.int64], logits: Floats, top: int) -> list[tuple[int, float]]:
        """(row, logit) of the best photo of each of the `top` best objects; ties by object, then by row."""
        looked_at = 8 * top
        while True:
            near = _largest(logits, looked_at)
            objects = self._object_of_row[rows[near]]
            order = np.lexsort((rows[near], self._object_ranks(rows[near], logits[near]), -logits[near]))
            _, first = np.unique(objects[order], return_index=True)
            if len(first) >= top or len(near) == len(rows):
                best = near[order[np.sort(first)[:top]]]
                return [(int(rows[place]), float(logits[place])) for place in best]
            looked_at *= 8

    def _object_ranks(self, rows: NDArray[np.int64], logits: Floats) -> NDArray[np.int64]:
        """Of each row, its object's place in the order of names; all 0 where no tie asks for it, as it parses rows."""
        if len(np.unique(logits)) == len(logits):
            return np.zeros(len(rows), dtype=np.int64)
        names = np.array([self.generation.rows[row]["object_id"] for row in rows])
        return np.unique(names, return_inverse=True)[1]

    def _match(self, rank: int, row_number: int, logit: float, grasps: int) -> Match:
        row = self.generation.rows[row_number]
        probability = float(self.calibration.probability(logit, grasps)) if self.calibration else None
        return Match(rank, row["object_id"], logit, probability, row["path"], row["metadata"])

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
            "objects": int(self._object_of_row.max()) + 1,
            "scored": scored,
            "encoder": self.encoder.name,
            "catalogue": str(self.catalogue),
            "model": str(self.checkpoint.path),
            "trained_on": self.checkpoint.provenance.get("source", "unknown"),
        }


def _finite(code: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    for name, values in zip(("half", "embedding"), code, strict=True):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise NumericalError(f"the {name} of touch {bad[0] + 1} holds a NaN or infinite number; the model is unfit")
    return code


def _originals(contents: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """For each photo the first one of equal bytes, which `contents` numbers; None where no two are equal."""
    _, first = np.unique(contents, return_index=True)
    return first[contents] if len(first) < len(contents) else None


def _largest(values: Floats, count: int) -> NDArray[np.int64]:
    """Places of the `count` largest values, and of all that equal the least of them."""
    if count >= len(values):
        return np.arange(len(values))
    return np.flatnonzero(values >= np.partition(values, len(values) - count)[len(values) - count])


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


def _model_of(generation: Generation) -> Path:
    """The checkpoint that built an index: where it lay then, else wherever a default has the same digest."""
    path = Path(generation.manifest.about["checkpoint"])
    if path.is_file():
        return path
    with suppress(CheckpointError):
        other, _ = defaults.find_model(None)
        if file_digest(other) == generation.fingerprint["checkpoint"]:
            return other
    raise CheckpointError(
        f"the model of this index is no longer at {path}; name it with --model, or build the index again"
    )


class _Clock:
    """Milliseconds of named stages and in total."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stages[stage] = 1e3 * (time.perf_counter() - start)

    def finished(self) -> dict[str, float]:
        """The stages in their order, and "total" since the clock was made."""
        return {**self._stages, "total": 1e3 * (time.perf_counter() - self._start)}
