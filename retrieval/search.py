"""From gel images to ranked objects: encode the touch, take candidates, rerank them by match logit from halves."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes.generation import Generation
from indexes.store import IndexStore
from retrieval import defaults
from retrieval.build import fingerprint
from retrieval.calibration import Calibration
from retrieval.checkpoint import Checkpoint, file_digest, load_checkpoint
from retrieval.encode import Image, encode_touches
from retrieval.errors import BadInput, CheckpointError
from retrieval.fusion import score_halves

DEFAULT_CANDIDATES = 1000


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

    def __init__(self, index: Path, generation: Generation, checkpoint: Checkpoint) -> None:
        self.index, self.generation, self.checkpoint = index, generation, checkpoint
        self.calibration: Calibration | None = None
        if "calibration" in generation.documents:
            self.calibration = Calibration.from_dict(generation.documents["calibration"])
        objects = [row["object_id"] for row in generation.rows]
        self._object_names, self._object_of_row = np.unique(np.array(objects, dtype=str), return_inverse=True)
        digests = [row["digest"] for row in generation.rows]
        self._content = np.unique(digests, return_inverse=True)[1] if len(set(digests)) < len(digests) else None

    @classmethod
    def open(cls, index: Path, *, model: str | Path | None = None, verify: bool = True) -> "Searcher":
        """Open the current generation of an index with the checkpoint that built it.

        model: where that checkpoint lies now, if it was moved. verify: compare the checksums of the index's files.
        Raises the errors of `indexes.store.IndexStore.open`, CheckpointError, and MismatchedIndex for another model.
        """
        generation = IndexStore(index).open(verify=verify, threads=1)  # one query at a time
        checkpoint = load_checkpoint(Path(model) if model else _model_of(generation))
        generation.require(fingerprint(checkpoint))
        return cls(index, generation, checkpoint)

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
        classifier judges, `top` at least; with no fewer than there are photos, or a model without trained embeddings,
        it judges all of them and no candidate stage runs. Several grasps count as independent given the object: their
        logits add. Raises BadInput, ImageError or NumericalError.
        """
        limit = DEFAULT_CANDIDATES if candidates is None else candidates
        if top < 1 or limit < 1 or not touches:
            raise BadInput(f"give at least one touch, top >= 1 and candidates >= 1; got {len(touches)}, {top}, {limit}")
        clock = _Clock()
        with clock("decode"):
            references = self._references(background)
            images = [self._load(touch, references) for touch in touches]
        with clock("encode"):
            code = encode_touches(self.checkpoint.matcher, images)
        with clock("candidates"):
            rows = self._candidates(code.embedding.numpy(), max(limit, top))
        with clock("rerank"):
            halves = self.generation.arrays["halves"]
            logits = score_halves(self.checkpoint.matcher.head, code.half, halves, rows)
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

    def _load(self, touch: Sequence[str | Path], references: Sequence[str | Path | None]) -> list[Image]:
        load = self.checkpoint.config.preprocessing.load_touch
        return [load(*pair) for pair in zip(self._one_per_finger("touch", touch), references, strict=True)]

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

    def _equal_for_equals(self, rows: NDArray[np.int64], logits: NDArray[np.float32]) -> NDArray[np.float32]:
        """Photos of equal bytes have equal logits; a matrix product may round its last rows in another way."""
        if self._content is None:
            return logits
        _, first, group = np.unique(self._content[rows], return_index=True, return_inverse=True)
        return logits[first][group]

    def _best_of_objects(
        self, rows: NDArray[np.int64], logits: NDArray[np.float32], top: int
    ) -> list[tuple[int, float]]:
        """(row, logit) of the best photo of each of the `top` best objects; ties by object, then by row."""
        objects = self._object_of_row[rows]
        order = np.lexsort((rows, objects, -logits))
        _, first = np.unique(objects[order], return_index=True)
        best = order[np.sort(first)[:top]]
        return [(int(rows[place]), float(logits[place])) for place in best]

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
            "objects": len(self._object_names),
            "scored": scored,
            "catalogue": str(self.catalogue),
            "model": str(self.checkpoint.path),
            "trained_on": self.checkpoint.provenance.get("source", "unknown"),
        }


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
