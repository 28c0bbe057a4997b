"""Operating points: kind of index and number of candidates, by agreement with exhaustive search."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from indexes import load_kind
from indexes.kinds.flat import FlatIndex
from indexes.store.folder import IndexStore
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import Matcher
from retrieval.search.build import measuring
from retrieval.search.build.measuring import ExhaustiveBench, NeighbourBench, SearchPoint, can_measure, query_codes
from retrieval.search.build.operating import (
    SearchRequirements,
    carry_over,
    choose_by_agreement,
    choose_by_neighbours,
    exhaustive_record,
    needs_measurement,
    operating_point_sentence,
)
from tests import plugins
from tests.conftest import TINY

PHOTOS, TOUCHES = 70, 40


def checkpoint_of(candidate_width=8, queries=TOUCHES):
    """A matcher with random weights whose queries are random partial activations."""
    torch.manual_seed(0)
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, candidate_width=candidate_width))
    partials = np.random.default_rng(1).normal(size=(queries, config.matcher.partial_width)).astype(np.float16)
    matcher = Matcher(config.matcher).eval()
    return Checkpoint(
        Path("m"),
        "0" * 64,
        config,
        {},
        gel_check=None,
        verification=None,
        matcher=matcher,
        split=None,
        queries=partials,
    )


@pytest.fixture
def checkpoint():
    return checkpoint_of()


@pytest.fixture
def gallery(checkpoint):
    """Distinct vectors, the row of each photo in them, and partial activations.

    The last ten photos are copies of the first ten, and the first vector has no photo.
    """
    partials = (
        np.random.default_rng(2).normal(size=(PHOTOS, checkpoint.config.matcher.partial_width)).astype(np.float16)
    )
    partials[-10:] = partials[:10]
    with torch.inference_mode():
        embeddings = checkpoint.matcher.candidate_encoder.photo(torch.from_numpy(partials.astype(np.float32))).numpy()
    slots = np.concatenate([np.arange(PHOTOS - 10), np.arange(10)]) + 1
    return np.concatenate([embeddings[50:51], embeddings[:-10]]), slots, partials


@pytest.fixture(autouse=True)
def _short_ladder(monkeypatch):
    monkeypatch.setattr(measuring, "EXHAUSTIVE_LIMIT", 4)


def top1_found(checkpoint, vectors, slots, partials, k):
    """By plain loops: number of touches whose best photo, or its copy, has fewer than k distinct better embeddings."""
    embeddings, found = vectors[slots], 0
    for touch in torch.from_numpy(checkpoint.queries.astype(np.float32)):
        with torch.inference_mode():
            logits = [
                float(checkpoint.matcher.head(touch, torch.from_numpy(partial)))
                for partial in partials.astype(np.float32)
            ]
            query = checkpoint.matcher.candidate_encoder.touch(touch).numpy()
        best = embeddings[int(np.argmax(logits))]
        better = {row.tobytes() for row in embeddings if row @ query > best @ query}
        found += len(better) < k
    return found


@pytest.mark.parametrize("k", [4, 8, 16, 32])
def test_top1_agreement_equals_two_plain_loops(k, checkpoint, gallery):
    bench = ExhaustiveBench(checkpoint, *gallery)
    point = bench.point(bench.index_of_kind("flat"), k)
    assert (point.found, point.queries) == (top1_found(checkpoint, *gallery, k), TOUCHES)


def test_scoring_every_photo_finds_every_top1_without_search(checkpoint, gallery, monkeypatch):
    bench = ExhaustiveBench(checkpoint, *gallery)
    index = bench.index_of_kind("flat")
    monkeypatch.setattr(index, "search", None)
    point = bench.point(index, PHOTOS)
    assert (point.recall, point.search_ms, point.rerank_ms) == (1.0, 0.0, bench.exhaustive_ms)


def test_by_default_exact_search_uses_the_smallest_k_with_the_recall(checkpoint, gallery):
    point = choose_by_agreement(ExhaustiveBench(checkpoint, *gallery), SearchRequirements())
    enough = [k for k in (4, 8, 16, 32, 64) if top1_found(checkpoint, *gallery, k) >= 0.99 * TOUCHES]
    assert point.kind == "flat"
    assert point.candidates["k"] == min([*enough, PHOTOS])
    assert point.candidates["top1_agreement"] >= 0.99
    assert point.candidates["interval"][0] < point.candidates["top1_agreement"]


def test_a_lower_recall_needs_fewer_candidates(checkpoint, gallery):
    bench = ExhaustiveBench(checkpoint, *gallery)
    low, high = (
        choose_by_agreement(bench, SearchRequirements("flat", min_recall=recall)).candidates["k"]
        for recall in (0.3, 1.0)
    )
    assert low < high


def test_more_photos_are_measured_with_fewer_touches_but_never_too_few(checkpoint, gallery, monkeypatch):
    one = 2.0 * PHOTOS * checkpoint.config.matcher.hidden**2
    monkeypatch.setattr(measuring, "MIN_QUERIES", 5)
    for flops, queries in ((1e12, TOUCHES), (20 * one, 20), (one, 5)):
        monkeypatch.setattr(measuring, "MEASUREMENT_FLOPS", flops)
        assert ExhaustiveBench(checkpoint, *gallery).queries == queries


def test_times_are_medians_of_search_and_rerank(checkpoint, gallery, monkeypatch):
    """Search and reranking advance the clock by 9, 1, 2 ms and 4, 6, 100 ms."""
    now = [0.0]
    bench = ExhaustiveBench(checkpoint, *gallery, clock=lambda: now[0])
    index, reranked = bench.index_of_kind("flat"), []
    search, search_times, rerank_times = index.candidates, iter((9, 1, 2)), iter((4, 6, 100))

    def slow_search(queries, k):
        now[0] += next(search_times) / 1e3
        return search(queries, k)

    def slow_scorer(head, touch, partials, rows):
        now[0] += next(rerank_times) / 1e3
        reranked.append(rows.tolist())

    monkeypatch.setattr(measuring, "TIMED_QUERIES", 3)
    monkeypatch.setattr(index, "candidates", slow_search)
    monkeypatch.setattr(measuring, "score_partials", slow_scorer)
    assert bench.times(index, 8) == pytest.approx((2.0, 6.0))
    for rows in reranked:  # eight different photos, in their order on the disk
        assert rows == sorted(set(rows))
        assert len(rows) == 8


@dataclasses.dataclass
class ScriptedIndex:
    """An index without search settings."""

    kind: str

    def search_variants(self):
        yield self


class Scripted:
    """A bench with given points: {(kind, k): (found of 100, search ms, rerank ms)}; k = 1000 means all photos."""

    count, exhaustive_ms, steps = 1000, 50.0, (250, 500, 1000)

    def __init__(self, points):
        self.points, self.built_kinds = points, []

    def index_of_kind(self, kind):
        self.built_kinds.append(kind)
        return ScriptedIndex(kind)

    def kinds_to_try(self):
        return ["ivf_sq8", "hnsw"]

    def point(self, index, k):
        found, search, rerank = (100, 0.0, 50.0) if k >= self.count else self.points.get((index.kind, k), (0, 1.0, 1.0))
        return SearchPoint(index.kind, load_kind("flat").parameters_type(), k, found, 100, search, rerank)

    def times(self, index, k):
        point = self.point(index, k)
        return point.search_ms, point.rerank_ms


EXACT = {("flat", 250): (97, 2.0, 1.0), ("flat", 500): (99, 2.0, 2.5), ("flat", 100): (90, 2.0, 0.5)}
QUICK = {**EXACT, ("ivf_sq8", 500): (99, 0.5, 2.5), ("hnsw", 500): (100, 0.2, 2.5)}


@pytest.mark.parametrize(
    ("requirements", "points", "kind", "k", "message"),
    [
        (SearchRequirements(), QUICK, "flat", 500, ""),
        (SearchRequirements(min_recall=0.95), EXACT | {("ivf_sq8", 500): (99, 0.1, 2.0)}, "ivf_sq8", 500, ""),
        (SearchRequirements(min_recall=0.99), QUICK, "flat", 500, ""),  # search is faster than reranking
        (SearchRequirements(max_ms=5), QUICK, "flat", 500, ""),
        (SearchRequirements(max_ms=4), QUICK, "ivf_sq8", 500, ""),
        (SearchRequirements(max_ms=2.8), QUICK, "hnsw", 500, ""),
        (
            SearchRequirements(max_ms=2.6),
            QUICK,
            "flat",
            100,
            "does not reach a recall of 0.99. No measured setting meets all requirements",
        ),
        (SearchRequirements(max_ms=0.1), QUICK, "hnsw", 500, "is slower than 0.1 ms. No measured setting meets all"),
        (
            SearchRequirements(min_recall=0.99, max_ms=1),
            QUICK,
            "hnsw",
            500,
            "is slower than 1 ms. No measured setting meets all requirements",
        ),
        (SearchRequirements("ivf_sq8"), QUICK, "ivf_sq8", 500, ""),
        (SearchRequirements("ivf_sq8"), EXACT, "ivf_sq8", 1000, ""),  # all are scored before a top-1 is lost
        (
            SearchRequirements("flat", max_ms=1),
            QUICK,
            "flat",
            500,
            "is slower than 1 ms. No measured setting meets all requirements",
        ),
    ],
)
def test_the_requirements_decide(requirements, points, kind, k, message):
    point = choose_by_agreement(Scripted(points), requirements)
    assert (point.kind, point.candidates["k"]) == (kind, k)
    assert message in point.reason
    assert bool(message) == ("No measured setting meets" in point.reason)


def test_an_approximate_kind_is_built_only_if_exact_search_is_not_sufficient():
    for requirements, built in (
        (SearchRequirements(), {"flat"}),
        (SearchRequirements(max_ms=5), {"flat"}),
        (SearchRequirements(max_ms=4), {"flat", "ivf_sq8"}),
    ):
        bench = Scripted(QUICK)
        choose_by_agreement(bench, requirements)
        assert set(bench.built_kinds) == built


def test_few_photos_are_all_scored_unless_that_may_be_too_slow():
    assert not needs_measurement(4, SearchRequirements())
    assert not needs_measurement(4, SearchRequirements(min_recall=1.0))
    assert needs_measurement(5, SearchRequirements())
    assert needs_measurement(4, SearchRequirements(max_ms=5))
    assert (
        operating_point_sentence(exhaustive_record(4, SearchRequirements()), 4)
        == "The fusion head scores all 4 photos."
    )


def test_a_measurement_is_reused_until_a_tenth_of_the_photos_changed(checkpoint, gallery):
    record = choose_by_agreement(ExhaustiveBench(checkpoint, *gallery), SearchRequirements()).candidates
    assert carry_over(record, SearchRequirements(), PHOTOS, 0) == record
    after = carry_over(record, SearchRequirements(), PHOTOS + 4, 4)
    assert after == {**record, "changed": 4}
    assert carry_over(after, SearchRequirements(), PHOTOS + 7, 3)["changed"] == 7
    assert carry_over(after, SearchRequirements(), PHOTOS + 8, 4) is None
    assert carry_over(record, SearchRequirements(min_recall=0.5), PHOTOS, 0) is None
    assert carry_over(exhaustive_record(4, SearchRequirements()), SearchRequirements(), 5, 1) is None
    assert carry_over(None, SearchRequirements(), PHOTOS, 0) is None
    exhaustive = {**exhaustive_record(1000, SearchRequirements()), "queries": 50}
    assert carry_over(exhaustive, SearchRequirements(), 1001, 1)["k"] == 1001


def test_the_sentence_of_a_point_has_its_interval():
    record = {"k": 500, "top1_agreement": 0.99, "interval": [0.9455, 0.9997], "queries": 100, "ms": 4.5}
    record |= {"exhaustive_ms": 50.0, "requirements": dataclasses.asdict(SearchRequirements()), "photos": 1000}
    assert operating_point_sentence(record, 1000) == (
        "The fusion head reranks the best 500 of 1000 photos. The candidates contain the exhaustive top-1 for 99 of "
        "100 validation touches (95 % interval 0.946 to 1.000). Search and reranking take 4.5 ms, scoring all photos "
        "50 ms."
    )


def test_the_sentence_of_a_reused_measurement_has_the_present_number_of_photos():
    requirements = SearchRequirements()
    record = {"k": 1000, "top1_agreement": 1.0, "interval": [0.96, 1.0], "queries": 100, "ms": 4.5, "changed": 0}
    record |= {"exhaustive_ms": 5.0, "requirements": dataclasses.asdict(requirements), "photos": 1000}
    fewer = carry_over(record, requirements, 950, 50)
    assert "The fusion head scores every photo." in operating_point_sentence(fewer, 950)
    again = carry_over(fewer, requirements, 990, 40)
    assert "The fusion head scores every photo." in operating_point_sentence(again, 990)
    more = carry_over(record | {"k": 500}, requirements, 1050, 50)
    assert "reranks the best 500 of 1050 photos." in operating_point_sentence(more, 1050)


def test_measuring_needs_touches_and_a_candidate_encoder():
    assert can_measure(checkpoint_of())
    assert not can_measure(checkpoint_of(candidate_width=0))
    assert not can_measure(checkpoint_of(queries=0))
    with pytest.raises(BadInput, match="must have touches to measure with"):
        query_codes(checkpoint_of(candidate_width=0))


# By neighbours ------------------------------------------------------------------------------------------------------


def unit(count, dim=16):
    vectors = np.random.default_rng(0).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_without_a_time_bound_exact_search_is_chosen_and_no_vector_is_read():
    for requirements in (SearchRequirements(), SearchRequirements(min_recall=0.9)):
        point = choose_by_neighbours(None, None, requirements)
        assert (point.kind, point.candidates) == ("flat", None)
        assert "there is no time bound" in point.reason
    assert choose_by_neighbours(None, None, SearchRequirements("hnsw", max_ms=1.0)).kind == "hnsw"


@pytest.fixture
def timed(monkeypatch):
    """Set the milliseconds of a search of each kind, and record the kinds that are built."""
    ms, built = {}, []
    monkeypatch.setattr(measuring, "query_ms", lambda index, queries, k, clock: ms[index.kind])
    real = NeighbourBench.index_of_kind
    monkeypatch.setattr(NeighbourBench, "index_of_kind", lambda bench, kind: built.append(kind) or real(bench, kind))
    return ms, built


@pytest.mark.parametrize(
    ("ms", "kind", "message"),
    [
        ({"flat": 3.0}, "flat", ""),
        ({"flat": 30.0, "ivf_sq8": 0.5}, "ivf_sq8", ""),
        ({"flat": 30.0, "ivf_sq8": 8.0, "hnsw": 2.0}, "hnsw", ""),
        ({"flat": 30.0, "ivf_sq8": 8.0, "hnsw": 9.0}, "ivf_sq8", "slower than 5 ms. No measured setting meets all"),
        ({"flat": 30.0, "ivf_sq8": 40.0, "hnsw": 50.0}, "flat", "slower than 5 ms. No measured setting meets all"),
    ],
)
def test_the_first_kind_with_time_and_recall_is_chosen(ms, kind, message, timed):
    timed[0].update(ms)
    vectors = np.repeat(unit(900), 2, axis=0)  # copies are not measured
    point = choose_by_neighbours(vectors, np.repeat(np.arange(900), 2) * 2, SearchRequirements(max_ms=5))
    assert point.kind == kind
    assert set(timed[1]) == set(ms)
    assert message in point.reason
    assert bool(message) == ("No measured setting meets" in point.reason)
    found, of = map(int, point.reason.split(" finds ")[1].split(" neighbours")[0].split(" of "))
    assert of == 640
    assert found >= 0.99 * of


def test_a_kind_that_needs_more_vectors_is_not_tried():
    assert NeighbourBench(unit(700)).kinds_to_try() == ["ivf_sq8", "hnsw"]
    assert NeighbourBench(unit(600)).kinds_to_try() == ["hnsw"]


class Newcomer(FlatIndex):
    """A kind that a user's package adds."""

    kind, exact, auto_try, min_vectors = "newcomer", False, True, 5


def test_a_new_kind_is_a_class_in_an_installed_package(monkeypatch, tmp_path):
    plugins.install(tmp_path / "site", monkeypatch, indexes={"newcomer": f"{__name__}:Newcomer"})
    assert NeighbourBench(unit(700)).kinds_to_try() == ["ivf_sq8", "hnsw", "newcomer"]
    assert SearchRequirements("newcomer").kind == "newcomer"
    rows = [{"id": str(number)} for number in range(20)]
    IndexStore(tmp_path).write(rows, unit(20), fingerprint={}, kind="newcomer")
    found = IndexStore(tmp_path).open()
    assert (type(found.index), found.manifest.recall["value"]) == (Newcomer, 1.0)


def test_the_time_of_a_neighbour_search_is_measured():
    bench = NeighbourBench(unit(100))
    point = bench.point(bench.index_of_kind("flat"), 10)
    assert (point.recall, point.rerank_ms) == (1.0, 0.0)
    assert point.search_ms > 0
