"""The number of candidates to rerank, measured on the catalogue with touches that the checkpoint stores for this.

The exhaustive top-1 of a touch is the photo that the fusion head ranks first if it scores every photo. The agreement@k
with exhaustive search is the fraction of touches whose exhaustive top-1 is among the k candidates. The smallest k of
`candidate_steps` with an agreement of `TARGET` is used.

The cost of exhaustive search grows with the catalogue, so larger catalogues use fewer touches. A measurement is kept
until a tenth of the photos has changed.
"""

import time
from collections.abc import Mapping
from itertools import takewhile
from statistics import median
from typing import Any

import numpy as np
import torch

from indexes.kinds.vector_index import Floats, VectorIndex
from retrieval.console.progress import Bar
from retrieval.metrics.intervals import binomial_interval
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion_scorer import Partials

TARGET = 0.99
"""Agreement@k that the chosen number of candidates reaches."""
EXHAUSTIVE_LIMIT = 500
"""Up to this number of photos, all are scored and nothing is measured."""
TIMED_QUERIES = 15
MIN_QUERIES = 50
MEASUREMENT_FLOPS = 1e12
"""Floating-point operations for exhaustive search: one or two minutes of one core, 76 touches over 100,000 photos with
`hidden` = 256."""
MAX_CHANGED_FRACTION = 0.10
"""Fraction of a catalogue that may change before the number of candidates is measured again."""


def measure_candidates(checkpoint: Checkpoint, index: VectorIndex, partials: Partials) -> dict[str, Any] | None:
    """Return the number of candidates and its measurement, the entry "candidates" of a manifest.

    Args:
        checkpoint: The model, with the touches that it stores to measure with.
        index: The vector index over the embeddings of N photos.
        partials: Partial activations (N, partial_width) of the photos, perhaps memory-mapped.

    Returns:
        The entry; None if the checkpoint stores no touches to measure with.
    """
    photos = len(partials)
    if photos <= EXHAUSTIVE_LIMIT or not checkpoint.config.has_embeddings:
        return {"k": photos, "top1_agreement": 1.0, "queries": 0, "photos": photos}
    stored = query_codes(checkpoint, _affordable(checkpoint, photos))
    if stored is None:
        return None
    scorer, (touches, queries) = checkpoint.matcher.head.scorer, stored
    top1, taken = [], []
    with Bar("measuring the candidate search", len(queries), "touches") as bar:
        for touch in touches:
            start = time.perf_counter()
            top1.append(int(scorer.logits(touch[None], partials).argmax()))
            taken.append(time.perf_counter() - start)
            bar.advance()
    exhaustive_ms = ms = 1e3 * median(taken)
    for k in candidate_steps(photos):
        hits = sum(best in rows for best, rows in zip(top1, index.candidates(queries, k), strict=True))
        if hits / len(queries) >= TARGET:
            break
    if k < photos:
        taken = []
        for number in range(min(TIMED_QUERIES, len(touches))):
            start = time.perf_counter()
            rows = np.sort(index.candidates(queries[number : number + 1], k)[0])
            scorer.logits(touches[number : number + 1], partials, rows)
            taken.append(time.perf_counter() - start)
        ms = 1e3 * median(taken)
    return {
        "k": k,
        "top1_agreement": hits / len(queries),
        "interval": list(binomial_interval(hits, len(queries))),
        "queries": len(queries),
        "ms": ms,
        "exhaustive_ms": exhaustive_ms,
        "photos": photos,
    }


def kept_measurement(before: Mapping[str, Any] | None, photos: int, encoded: int) -> dict[str, Any] | None:
    """Return the measurement of the previous generation; None if a new one is necessary.

    Args:
        before: The entry "candidates" of its manifest, for the same model and kind.
        photos: Number of photos now.
        encoded: Number of photos that were encoded now.
    """
    if not before or not before["queries"]:
        return None
    if max(abs(photos - before["photos"]), encoded) > MAX_CHANGED_FRACTION * before["photos"]:
        return None
    return {**before, "k": photos if before["k"] >= before["photos"] else before["k"]}


def candidate_steps(photos: int) -> list[int]:
    """Return the numbers of candidates to try: `EXHAUSTIVE_LIMIT`, its doubles below `photos`, and `photos`."""
    return [*takewhile(lambda k: k < photos, (EXHAUSTIVE_LIMIT << power for power in range(40))), photos]


@torch.inference_mode()
def query_codes(checkpoint: Checkpoint, count: int) -> tuple[Floats, Floats] | None:
    """Return the touches that a checkpoint stores to measure with, at most `count`.

    Returns:
        Partial activations (Q, partial_width) and unit embeddings (Q, d), float32. None if the checkpoint stores no
        touches or has no candidate encoder that embeds them.
    """
    encoder = checkpoint.matcher.candidate_encoder
    if checkpoint.queries is None or not len(checkpoint.queries) or encoder is None:
        return None
    partials = checkpoint.queries[:count].astype(np.float32)
    pooled = torch.from_numpy(partials[:, : checkpoint.config.matcher.pooled_width])
    return partials, encoder.touch(pooled.to(next(encoder.parameters()).device)).cpu().numpy()


def _affordable(checkpoint: Checkpoint, photos: int) -> int:
    """Return the number of touches that can score every photo within `MEASUREMENT_FLOPS`, at least `MIN_QUERIES`.

    One score is a product with a square matrix, and one of the cells of the touch with those of the photo.
    """
    settings = checkpoint.config.matcher
    cells = settings.fingers * settings.touch_cells**2 * settings.photo_cells**2 * settings.cell_dim
    return max(MIN_QUERIES, int(MEASUREMENT_FLOPS / (2.0 * photos * (settings.hidden**2 + cells))))


def candidates_sentence(candidates: Mapping[str, Any] | None, photos: int) -> str:
    """Return a measurement as text: the number of candidates and their agreement with exhaustive search.

    Args:
        candidates: The entry of the manifest; None without touches to measure with.
        photos: Number of photos now; a kept entry has the number of photos that were measured.
    """
    if candidates is None:
        return "The checkpoint stores no touches to measure the number of candidates with."
    k = candidates["k"]
    if not candidates["queries"]:
        return f"The fusion head scores all {photos} photos."
    low, high = candidates["interval"]
    hits = round(candidates["top1_agreement"] * candidates["queries"])
    scored = "scores every photo" if k >= photos else f"reranks the best {k} of {photos} photos"
    return (
        f"The fusion head {scored}. The candidates contain the exhaustive top-1 for {hits} of {candidates['queries']} "
        f"validation touches (95 % interval {low:.3f} to {high:.3f}). Search and reranking take "
        f"{candidates['ms']:.3g} ms, scoring all photos {candidates['exhaustive_ms']:.3g} ms."
    )
