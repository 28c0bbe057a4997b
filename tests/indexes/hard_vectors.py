"""Stiff and extreme inputs of vector search."""

import math
import tempfile
from collections.abc import Iterator

import numpy as np

import indexes
from indexes.kinds.measure import recall_against_exact
from indexes.kinds.vector_index import Floats, check_unit
from indexes.store.folder import IndexStore
from indexes.store.rows import Row
from tests.hard_case import HardCase, error_of

_SEARCH, _UNIT, _SCORES = "top k", "unit vectors", "inner products"


def hard_cases() -> Iterator[HardCase]:
    """Cases of vector search, in about a second."""
    yield _nan_vector()
    yield _nan_query()
    yield _zero_vector()
    yield _huge_vector()
    yield _tiny_vector()
    yield _ties_at_the_last_rank()
    yield _more_than_there_are()
    yield _float16_scores()
    yield _recall_among_equals()
    yield _overflowing_partial()


def _axes(count: int = 3) -> Floats:
    """(count, count) unit vectors at right angles."""
    return np.eye(count, dtype=np.float32)


def _spread(count: int, dim: int) -> Floats:
    """(count, dim) unit vectors in random directions."""
    drawn = np.random.default_rng([5]).normal(size=(count, dim))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.float32)


def _text(values: object) -> str:
    return np.array2string(np.asarray(values), precision=3, separator=", ")


def _nan_vector() -> HardCase:
    vectors = _axes()
    vectors[1, 0] = np.nan
    order = np.argsort(vectors @ _axes()[0])[::-1]
    ours, holds = error_of(lambda: check_unit(vectors, names=["mug", "cup", "jar"]), "'cup'", "nan")
    naive = f"argsort ranks photos {_text(order)}: the NaN is best"
    return HardCase(_UNIT, "one of three photos is NaN", "error that names it", naive, ours, holds, order[0] != 1)


def _nan_query() -> HardCase:
    import faiss

    query = np.full((1, 3), np.nan, np.float32)
    structure = faiss.IndexFlatIP(3)
    structure.add(_axes())
    found = structure.search(query, 2)[1][0]
    ours, holds = error_of(lambda: indexes.build(_axes()).search(query, 2), "query '0'", "nan")
    naive = f"FAISS returns rows {_text(found)}, and row -1 of a list is its last photo"
    return HardCase(_UNIT, "a query is NaN", "error that names it", naive, ours, holds, bool((found >= 0).all()))


def _zero_vector() -> HardCase:
    vectors = _axes()
    vectors[2] = 0.0
    cosine = float((vectors[2] / np.linalg.norm(vectors[2])) @ _axes()[0])
    ours, holds = error_of(lambda: indexes.build(vectors), "'2'", "got 0")
    return HardCase(
        _UNIT, "one vector is zero", "error that names it", f"cosine {cosine}", ours, holds, math.isfinite(cosine)
    )


def _huge_vector() -> HardCase:
    """Its cosine with itself is 1, but float32 squares overflow at 3e38."""
    vector = np.full((1, 4), 1e30, np.float32)
    unit = vector / np.sqrt((vector * vector).sum())
    ours, holds = error_of(lambda: indexes.build(vector), "'0'", "2e+30")
    must_hold = "error with its norm of 2e30"
    cosine = float((unit @ unit.T)[0, 0])
    return HardCase(
        _UNIT,
        "components of 1e30",
        must_hold,
        f"normalised to a cosine of {cosine} with itself",
        ours,
        holds,
        cosine == 1,
    )


def _tiny_vector() -> HardCase:
    """float32 squares underflow at 1e-45."""
    vector = np.full((1, 4), 1e-30, np.float32)
    norm = float(np.sqrt((vector * vector).sum()))
    ours, holds = error_of(lambda: indexes.build(vector), "'0'", "2e-30")
    must_hold = "error with its norm of 2e-30"
    return HardCase(_UNIT, "components of 1e-30", must_hold, f"a norm of {norm}", ours, holds, norm > 0)


def _ties_at_the_last_rank() -> HardCase:
    """Forty of 41 photos have the same score; a search returns the first six in the order (-score, row)."""
    vectors = np.repeat(_axes(8)[:1], 41, axis=0)
    vectors[40] = _axes(8)[1]
    query = np.asarray(_axes(8)[1:2] * 0.6 + _axes(8)[:1] * 0.8, np.float32)
    must = [0, 1, 2, 3, 4, 5]
    naive = np.argsort(query @ vectors.T)[0, ::-1][:6].tolist()
    ours = indexes.build(vectors).search(query, 6)[1][0].tolist()
    must_hold = f"rows {must}"
    return HardCase(_SEARCH, "40 equal photos, k = 6", must_hold, str(naive), str(ours), ours == must, naive == must)


def _more_than_there_are() -> HardCase:
    import faiss

    structure = faiss.IndexFlatIP(3)
    structure.add(_axes())
    naive = structure.search(_axes()[:1], 5)[1][0].tolist()
    ours = indexes.build(_axes()).search(_axes()[:1], 5)[1][0].tolist()
    must_hold = "all three, none twice"
    return HardCase(
        _SEARCH,
        "k = 5 of 3 photos",
        must_hold,
        f"FAISS pads with -1: {naive}",
        str(ours),
        ours == [0, 1, 2],
        -1 not in naive,
    )


def _float16_scores() -> HardCase:
    """Scores rounded to float16 create false ties."""
    query, vectors = _spread(4001, 64)[:1], _spread(4001, 64)[1:]
    naive = np.sort((query @ vectors.T).astype(np.float16)[0])[::-1][:100]
    ours = indexes.build(vectors).search(query, 100)[0][0]
    distinct = [len(np.unique(scores)) for scores in (naive, ours)]
    naive_words, words = (f"{count} distinct" for count in distinct)
    must_hold = "100 distinct scores among the best 100"
    return HardCase(
        _SCORES, "4000 photos, scores in float16", must_hold, naive_words, words, distinct[1] == 100, distinct[0] == 100
    )


def _recall_among_equals() -> HardCase:
    """All photos are equal, so every result is as good as the exact one."""
    vectors = np.repeat(_axes(8)[:1], 50, axis=0)
    index = indexes.build(vectors)
    exact = set(np.argsort(index.vectors @ vectors[0])[::-1][:10].tolist())
    naive = len(exact & set(index.search(vectors[:1], 10)[1][0].tolist())) / 10
    ours = recall_against_exact(index, vectors[:1], 10)
    return HardCase(
        "recall", "50 equal photos", "recall 1", f"{naive} by shared rows", f"{ours}", ours == 1, naive == 1
    )


def _overflowing_partial() -> HardCase:
    """The largest float16 is 65504; larger numbers become infinite, and infinity minus infinity is NaN."""
    partials = np.array([[1.0], [7e4]], np.float32).astype(np.float16)
    naive = float(partials[1, 0] - partials[1, 0])
    rows = [Row("cup", "cup", "1"), Row("mug", "mug", "2")]
    with tempfile.TemporaryDirectory() as folder:
        store = IndexStore(folder)
        ours, holds = error_of(lambda: store.write(rows, [{"embeddings": _axes(2), "partials": partials}]), "'mug'")
    words = f"a partial activation of {partials[1, 0]}, and {naive} in the next sum"
    return HardCase("partials", "7e4 in float16", "error that names it", words, ours, holds, math.isfinite(naive))
