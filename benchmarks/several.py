"""`python -m benchmarks.several [--sizes 1e4 1e5] [--grasps 2 4 8] [--recording R --features F] [--json]`.

This benchmark compares two ways to find candidates for several grasps of one object: one joint search for the k photos
nearest to the sum of the grasps' embeddings (as queries do), and the union of one search per grasp. Catalogues are
drawn as in `benchmarks.scale`. Each set consists of a touch of the recording and the next touches of its object. The
exhaustive top-1 of a set is the photo with the greatest sum of match logits. It is searched among the `SEARCHED`
nearest photos of both ways; its rank stays far below this limit (the worst rank is printed). Ranks are those of exact
cosines. Candidate search in the index of `--kind` and reranking are timed on one thread, both ways in turn.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scale import TARGET, TIMED, BlendedPhotos, blended_photos, collected
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from retrieval.data.dataset import load_grasps
from retrieval.methods.selection import next_rows_of_object
from retrieval.metrics.k_way import binomial_interval
from retrieval.search.build.measuring import EXHAUSTIVE_LIMIT
from retrieval.search.defaults import shipped_model
from retrieval.search.query.shard import combined_embedding
from retrieval.training.distil import feature_partials
from retrieval.training.features import encode_recording

SEARCHED = 4096
Rows = NDArray[np.int64]
Way = Callable[[np.ndarray], Rows]


def ways(made: Generation, k: int) -> dict[str, Way]:
    """Return functions from embeddings (G, d) of grasps to the sorted rows of the candidates."""
    return {
        "together": lambda embeddings: np.sort(made.candidates(combined_embedding(embeddings), k)[0]),
        "each": lambda embeddings: np.unique(np.concatenate(made.candidates(embeddings, k))),
    }


def ranks_by_way(queries: np.ndarray, photos: np.ndarray, scorer: Callable[[Rows], np.ndarray]) -> dict[str, int]:
    """Return the rank, from 1, of the exhaustive top-1 of grasps (G, d) among photos (N, d), for each way."""
    cosines = queries @ photos.T
    scores = {"together": cosines.sum(0, keepdims=True), "each": cosines}
    near = [_nearest(each, SEARCHED // len(score)) for score in scores.values() for each in score]
    rows = np.unique(np.concatenate(near))
    top1 = rows[scorer(rows).argmax()]
    return {name: 1 + int((score > score[:, [top1]]).sum(1).min()) for name, score in scores.items()}


def _nearest(scores: np.ndarray, count: int) -> Rows:
    return np.arange(len(scores)) if count >= len(scores) else np.argpartition(-scores, count)[:count]


def measure(
    crowd: BlendedPhotos, made: Generation, partials: np.ndarray, sets: Rows, k: int
) -> Iterator[dict[str, Any]]:
    """Yield a line of figures for each way; sets (S, G) contain rows of touch partial activations (T, width)."""
    queries, photos = crowd.embeddings(partials, "touch"), made.embeddings[made.slots]
    stored, ranks = made.arrays["partials"], []
    for chosen in sets:
        ranks.append(
            ranks_by_way(
                queries[chosen], photos, lambda rows, chosen=chosen: crowd.scorer.logits(partials[chosen], stored, rows)
            )
        )
    counts, seconds = _timed(crowd, made, partials, queries, sets, k)
    for way in counts:
        order = np.sort([rank[way] for rank in ranks])
        contained = int((order <= k).sum())
        low, high = binomial_interval(contained, len(order))
        yield {
            "photos": made.count,
            "grasps": sets.shape[1],
            "way": way,
            "sets": len(order),
            "needed": int(order[int(np.ceil(TARGET * len(order))) - 1]),
            "worst": int(order[-1]),
            "k": k,
            "found": contained / len(order),
            "low": low,
            "high": high,
            "reranked": float(np.mean(counts[way])),
            "name_ms": 1e3 * float(np.median([searching for searching, _ in seconds[way]])),
            "rerank_ms": 1e3 * float(np.median([reranking for _, reranking in seconds[way]])),
        }


def _timed(
    crowd: BlendedPhotos, made: Generation, partials: np.ndarray, queries: np.ndarray, sets: Rows, k: int
) -> tuple[dict[str, list[int]], dict[str, list[tuple[float, float]]]]:
    """Return, for each way and the first `TIMED` sets, numbers of candidates, and seconds of search and reranking."""
    counts: dict[str, list[int]] = {name: [] for name in ways(made, k)}
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in counts}
    for chosen in sets[:TIMED]:
        for name, way in ways(made, k).items():
            start = time.perf_counter()
            rows = way(queries[chosen])
            between = time.perf_counter()
            crowd.scorer.logits(partials[chosen], made.arrays["partials"], rows)
            seconds[name].append((between - start, time.perf_counter() - between))
            counts[name].append(len(rows))
    return counts, seconds


def sets_of(owner: Rows, grasps: int, maximum: int) -> Rows:
    """Return (S, grasps) rows, each set of one object with enough grasps, at most `maximum` sets."""
    enough = np.flatnonzero(np.bincount(owner)[owner] >= grasps)
    return np.random.default_rng(0).permutation(enough[next_rows_of_object(owner[enough], grasps)])[:maximum]


def line(figures: dict[str, Any]) -> str:
    """Return the figures as text."""
    return (
        "{photos:,} photos, {grasps} grasps, nearest to {way}: 99 % of {sets} exhaustive top-1s within the first "
        "{needed} (worst {worst}); of k = {k} found {found:.1%} [{low:.1%}, {high:.1%}], {reranked:.0f} reranked, "
        "search {name_ms:.3g} ms, rerank {rerank_ms:.3g} ms"
    ).format(**figures)


def main() -> None:
    """Print two lines for each size and number of grasps."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.several", description=__doc__.split("\n\n")[1])
    parser.add_argument("--sizes", nargs="+", type=float, default=[1e4, 1e5])
    parser.add_argument("--grasps", nargs="+", type=int, default=[2, 4, 8], help="grasps per set")
    parser.add_argument("--sets", type=int, default=1000, help="maximum number of sets for each number of grasps")
    parser.add_argument(
        "--candidates", type=int, default=EXHAUSTIVE_LIMIT, help="k (default: the first value that a build tries)"
    )
    parser.add_argument("--kind", default="flat", help="kind of index")
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument("--recording", type=Path, help="recording whose photos are blended (default: one is collected)")
    parser.add_argument("--features", type=Path, help="file to store encoded features")
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = arguments.recording or collected(folder)
        features = arguments.features or folder / "features"
        crowd, grasps = blended_photos(arguments.model, recording, features), load_grasps(recording)
        matcher, config = crowd.checkpoint.matcher, crowd.checkpoint.config
        partials = feature_partials(matcher, encode_recording(grasps, matcher, config, features))[0].numpy()
        owner = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1]
        for size in map(int, arguments.sizes):
            store = IndexStore(folder / f"index-{size}")
            made = store.write_blocks(crowd.blocks(0, size, 0), fingerprint={}, kind=arguments.kind, threads=1)
            for count in (count for count in arguments.grasps if count <= np.bincount(owner).max()):
                sets = sets_of(owner, count, arguments.sets)
                for figures in measure(crowd, made, partials, sets, min(arguments.candidates, size)):
                    print(json.dumps(figures) if arguments.json else line(figures), flush=True)


if __name__ == "__main__":
    main()
