"""Sequences of touches, and which of them are compared: across sessions, within one, or late touches with early ones.

A sequence is the touches of one object with the same `sequence_id`, such as the frames of one press video; a grasp
without one is a sequence of its own. The score of two sequences is the cosine of their first principal components;
scaling and components are fitted without the query.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp
from retrieval.errors import DatasetError
from retrieval.evaluation.inputs import thin_grasps
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables, Metric
from retrieval.metrics.table import ScoreTable

COMPONENTS = 60
MOST_TOUCHES = 12
"""Early touches, and late ones, of an object at most."""

Sessions = Literal["across", "within", "all"]
"""The gallery of a query: the other sessions, its own session, or all."""
Vectors = NDArray[np.float64]
Rows = NDArray[np.int64]


def cosines(fitted: Vectors, queries: Vectors, gallery: Vectors, components: int = COMPONENTS) -> NDArray[np.float32]:
    """Return the cosines (Q, G) of queries (Q, F) and gallery (G, F).

    They are scaled and reduced to principal components, which are those of the vectors `fitted` (N, F), at most N - 1.
    """
    mean, deviation = fitted.mean(0), fitted.std(0)
    deviation = np.where(deviation > 1e-9 * max(1.0, np.abs(mean).max()), deviation, np.inf)
    scaled = (fitted - mean) / deviation
    # Use the Gram matrix: there are fewer sequences than features.
    values, directions = np.linalg.eigh(scaled @ scaled.T)
    used = np.flatnonzero(values > 1e-9 * max(values[-1], 1e-12))[::-1][: min(components, len(fitted) - 1)]
    axes = scaled.T @ (directions[:, used] / np.sqrt(values[used]))
    query_codes, codes = (((vectors - mean) / deviation) @ axes for vectors in (queries, gallery))
    norms = [np.maximum(np.linalg.norm(each, axis=1), 1e-12) for each in (query_codes, codes)]
    return np.asarray(query_codes @ codes.T / np.outer(*norms), np.float32)


def leave_one_out_scores(vectors: Vectors, components: int = COMPONENTS) -> NDArray[np.float32]:
    """Return the `cosines` (S, S) of vectors (S, F); each row is fitted to all other vectors. 0 on the diagonal."""
    scores = np.zeros((len(vectors), len(vectors)), np.float32)
    for row in range(len(vectors)):
        others = np.arange(len(vectors)) != row
        scores[row, others] = cosines(vectors[others], vectors[[row]], vectors[others], components)[0]
    return scores


@dataclass(frozen=True, eq=False)
class Round:
    """Numbers of the sequences that are queries, gallery, and those to which scaling and components are fitted.

    If queries and gallery are the same, each sequence is compared with all others.
    """

    name: str
    queries: Rows
    gallery: Rows
    fitted: Rows

    @property
    def is_leave_one_out(self) -> bool:
        """Whether each sequence is compared with all others."""
        return self.queries is self.gallery

    def scores(self, vectors: Vectors) -> NDArray[np.float32]:
        """Return the scores (Q, G) by the vectors (S, F) of all sequences."""
        if self.is_leave_one_out:
            return leave_one_out_scores(vectors[self.queries])
        return cosines(vectors[self.fitted], vectors[self.queries], vectors[self.gallery])


@dataclass(frozen=True, eq=False)
class Sequences:
    """The sequences of a recording in the order of capture, and the rounds in which they are compared.

    Attributes:
        grasps: Their grasps.
        names: Name of each sequence.
        owner: (S,) object number of each sequence, in the order of the sorted names.
        rows: Places of the grasps of each.
        rounds: The comparisons; their queries are pooled.
        is_across_sessions: Whether queries and gallery are from different sessions.
        remark: What became of grasps that name no session.
    """

    grasps: Sequence[Grasp]
    names: tuple[str, ...]
    owner: NDArray[np.int64]
    rows: tuple[Rows, ...]
    rounds: tuple[Round, ...]
    is_across_sessions: bool
    remark: str = ""

    @classmethod
    def of(cls, grasps: Sequence[Grasp], sessions: Sessions = "all") -> Self:
        """Group grasps by object, session and sequence.

        One session follows the other. Grasps without a session are left out if there are several. If every object has
        one sequence, its last touches are compared with its first ones.

        Raises:
            DatasetError: There are fewer than two objects, or one has fewer than two sequences; or sessions have fewer
                than two objects in common.
        """
        named = {grasp.session for grasp in grasps} - {None}
        unnamed, remark = sum(grasp.session is None for grasp in grasps), ""
        if sessions != "all" and named and unnamed:
            remark = f" {unnamed} grasps name no session and are left out."
            if len(named) == 1:
                remark = f" Sessions are not compared: {unnamed} grasps name none, all others the same one."
        if sessions == "all" or len(named) < 2:
            grasps = [replace(grasp, session="") for grasp in grasps]
        order = list(dict.fromkeys(grasp.session for grasp in grasps if grasp.session is not None))
        grasps = [grasp for session in order for grasp in grasps if grasp.session == session]
        places = _places(grasps)
        if is_late := len(places) == len({name for name, _, _ in places}) > 1:
            grasps = _early_and_late(grasps)
            places = _places(grasps)
        objects, owner = np.unique([name for name, _, _ in places], return_inverse=True)
        part = np.array([session for _, session, _ in places])
        rows_of = {name: np.flatnonzero(part == name) for name in dict.fromkeys(part.tolist())}
        if is_late or (sessions == "across" and len(rows_of) > 1):
            pairs = list(itertools.permutations(rows_of, 2))[: 1 if is_late else None]
            rounds = [one for pair in pairs if len(set(owner[(one := _round(owner, rows_of, *pair)).gallery])) > 1]
            if not rounds:
                raise DatasetError(
                    "Touch to touch needs at least 2 objects with 3 touches each, of one session, or 2 objects of 2 "
                    f"sessions, but no two of {', '.join(rows_of) or 'the parts'} have such objects in common. Use "
                    "--protocol touch-to-touch-within, or record more touches."
                )
        else:
            rounds = [Round(name, rows, rows, rows) for name, rows in rows_of.items()]
            for name, found in rows_of.items():
                counts = np.bincount(owner[found], minlength=len(objects))
                fewest = np.where(counts, counts, len(owner)).argmin()
                if np.count_nonzero(counts) < 2 or counts[fewest] < 2:
                    raise DatasetError(
                        f"Touch to touch needs at least 2 objects with 2 sequences each, but {name or 'the recording'} "
                        f"has {np.count_nonzero(counts)} object(s), and {objects[fewest]} has {counts[fewest]} "
                        "sequence(s)."
                    )
        rows = tuple(np.array(each, np.int64) for each in places.values())
        is_across = not (is_late or rounds[0].is_leave_one_out)
        return cls(grasps, tuple(name for _, _, name in places), owner, rows, tuple(rounds), is_across, remark)

    @property
    def rule(self) -> str:
        """What is compared, in sentences with counts."""
        if self.rounds[0].is_leave_one_out:
            where = " of its session" * bool(self.rounds[0].name)
            return f"Each sequence is compared with all others{where}.{self.remark}"
        how = (
            "Only objects that both sessions have are compared. The order of capture is that of the whole recording."
            if self.is_across_sessions
            else "Each object has one sequence: touches of its last third are compared with those of its first third, "
            f"at most {MOST_TOUCHES} of each."
        )
        counts = (
            f"{one.name}: {len(one.queries)} queries, {len(one.gallery)} references of "
            f"{len(set(self.owner[one.gallery].tolist()))} objects"
            for one in self.rounds
        )
        return f"{how} {'; '.join(counts)}.{self.remark}"

    def mean(self, features: NDArray[np.float32]) -> Vectors:
        """Return the mean (S, F) of features (G, F) over the grasps of each sequence."""
        return np.stack([features[rows].mean(0, dtype=np.float64) for rows in self.rows])

    def measures(
        self, metrics: Mapping[str, Metric], vectors: Vectors, permutations: Sequence[int | None] = (None,)
    ) -> dict[str, list[Measure]]:
        """Return the measures by the vectors (S, F) of all sequences; the first metric also of each of two rounds.

        There is one measure for each of `permutations`, seeds with which the objects of the gallery are permuted.
        """
        scores = [one.scores(vectors) for one in self.rounds]
        measures: dict[str, list[Measure]] = defaultdict(list)
        for seed in permutations:
            rng = None if seed is None else np.random.default_rng([seed, 41])
            tables = [self._table(*pair, rng) for pair in zip(self.rounds, scores, strict=True)]
            for name, metric in metrics.items():
                parts = [part for table in tables if (part := _measure(metric, table))]
                measures[name].append(pooled(parts))
                for number, part in enumerate(parts if name == next(iter(metrics)) and len(parts) == 2 else ()):
                    measures[f"{name}_{number}"].append(pooled([part]))
        return measures

    def _table(self, one: Round, scores: NDArray[np.float32], rng: np.random.Generator | None) -> ScoreTable:
        """Return the scores of a round with their objects; a sequence is not compared with itself."""
        queries, gallery = self.owner[one.queries], self.owner[one.gallery]
        if rng:
            gallery = rng.permutation(gallery)
            queries = gallery if one.is_leave_one_out else queries
        return ScoreTable(scores, queries, gallery, one.queries[:, None] == one.gallery, "sequences")


def _measure(metric: Metric, table: ScoreTable) -> Measure | None:
    measure = metric.compute(MethodScoreTables(table, table, {}, None, 0))
    if measure is None or table.own.any():
        return measure
    return replace(measure, gallery=f"{len(table.objects)} objects, {len(table.photo_owner)} sequences")


def _places(grasps: Sequence[Grasp]) -> dict[tuple[str, str, str], list[int]]:
    """Return the places of the grasps of each object, session and sequence."""
    places: dict[tuple[str, str, str], list[int]] = {}
    for place, grasp in enumerate(grasps):
        key = grasp.object_id, grasp.session or "", grasp.sequence_id or grasp.grasp_id
        places.setdefault(key, []).append(place)
    return places


def _early_and_late(grasps: Sequence[Grasp]) -> list[Grasp]:
    """Return the first and the last touches of each object, as sequences of their own; the middle third is left out."""
    grasps_of: dict[str, list[Grasp]] = defaultdict(list)
    for grasp in grasps:
        grasps_of[grasp.object_id].append(replace(grasp, sequence_id=None))
    found = []
    for some in grasps_of.values():
        third = len(some) // 3
        for part, chosen in (("early", some[:third]), ("late", some[len(some) - third :])):
            found += [replace(grasp, session=part) for grasp in thin_grasps(chosen, MOST_TOUCHES)]
    return found


def _round(owner: NDArray[np.int64], rows_of: dict[str, Rows], references: str, queries: str) -> Round:
    """Return the comparison of two parts: of the objects of both, fitted to all references."""
    common = np.intersect1d(owner[rows_of[references]], owner[rows_of[queries]])
    query_rows, gallery = (rows_of[name][np.isin(owner[rows_of[name]], common)] for name in (queries, references))
    return Round(f"{queries} against {references}", query_rows, gallery, rows_of[references])
