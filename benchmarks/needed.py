"""`python -m benchmarks.needed [--sizes 1e3 1e4 1e5 1e6 1e7] [--recording R --features F] [--json]`.

This benchmark measures how many candidates contain the exhaustive top-1 as the catalogue grows. Catalogues are drawn as
in `benchmarks.scale`, block by block; each is the beginning of the next. No block is stored, so only time grows. For
each touch, the exhaustive top-1 is found first (the photo with the greatest match logit), then its rank by the
candidate encoder. As in `benchmarks.scale`, one half of the checkpoint's touches chooses k: `MARGIN` times the number
of candidates that contain the exhaustive top-1 for 99 % of them. The other half and the recording's touches, up to
`--held-out`, evaluate the choice.

All photos are scored in bfloat16. Photos with a logit close to the best so far are also scored in float32: within
`SAFE` times the largest difference between both precisions in the first block. So the top-1 is practically always that
of float32. A thousand touches of ten million photos take an hour and a half on one thread.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.scale import HELD_OUT, MARGIN, TARGET, BlendedPhotos, blended_photos, collected
from retrieval.console.progress import Bar
from retrieval.metrics.k_way import binomial_interval
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.search.defaults import shipped_model

SAFE = 2.0
"""Factor of the largest difference between the precisions in the first block."""


class CoarseScorer:
    """The fusion head's layers in bfloat16."""

    def __init__(self, scorer: FusionScorer) -> None:
        self._width = len(scorer.out)
        layers = (scorer.second, scorer.second_bias, scorer.out)
        self._second, self._bias, self._out = (torch.from_numpy(layer).bfloat16() for layer in layers)
        self._constant = float(scorer.out_bias[0])

    @torch.inference_mode()
    def logits(self, touches: NDArray[np.float32], photos: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
        """Yield (len(photos),) logits for each touch partial."""
        photo_partials = torch.from_numpy(photos[:, : self._width]).bfloat16()
        direct_terms = touches[:, self._width :] @ photos[:, self._width :].T + self._constant
        for touch, direct_term in zip(touches, direct_terms, strict=True):
            hidden = (photo_partials + torch.from_numpy(touch[: self._width]).bfloat16()).relu_()
            second = torch.addmm(self._bias, hidden, self._second.T).relu_()
            yield (second @ self._out).float().numpy() + direct_term


def exhaustive_top1(
    crowd: BlendedPhotos, touches: NDArray[np.float32], sizes: Sequence[int]
) -> tuple[NDArray[Any], float]:
    """Find the exhaustive top-1 of each touch at each catalogue size.

    Returns:
        The candidate encoder's cosine (sizes, touches) of each touch with its top-1, and the fraction of pairs that
            were also scored in float32.
    """
    coarse, scorer, queries = CoarseScorer(crowd.scorer), crowd.scorer, crowd.embeddings(touches, "touch")
    best, cosines = np.full(len(touches), -np.inf, np.float32), np.empty(len(touches), np.float32)
    margin, rescored = np.inf, 0
    found = []
    for photos, embeddings, ends in _blocks(crowd, sizes, "exhaustive top-1"):
        error = 0.0
        for number, logits in enumerate(coarse.logits(touches, photos)):
            near = np.flatnonzero(logits > best[number] - margin)
            if not len(near):
                continue
            exact = scorer.logits(touches[[number]], photos, near)
            rescored += len(near)
            error = max(error, float(np.abs(exact - logits[near]).max()))
            if exact.max() > best[number]:
                best[number], row = exact.max(), near[exact.argmax()]
                cosines[number] = queries[number] @ embeddings[row]
        margin = SAFE * error if np.isinf(margin) else margin
        if ends:
            found.append(cosines.copy())
    return np.array(found), rescored / (sizes[-1] * len(touches))


def ranks_of(
    crowd: BlendedPhotos, touches: NDArray[np.float32], sizes: Sequence[int], cosines: NDArray[Any]
) -> NDArray[Any]:
    """Return the rank, from 1, of each exhaustive top-1 by the candidate encoder: (sizes, touches)."""
    queries, before = crowd.embeddings(touches, "touch"), np.zeros(cosines.shape, np.int64)
    at = 0
    for _, embeddings, ends in _blocks(crowd, sizes, "ranks"):
        scores = queries @ embeddings.T
        for size in range(at, len(sizes)):
            before[size] += (scores > cosines[size, :, None] + 1e-6).sum(1)
        at += ends
    return before + 1


def _blocks(crowd: BlendedPhotos, sizes: Sequence[int], name: str) -> Iterator[tuple[Any, Any, bool]]:
    """Yield partial activations and embeddings in blocks, and whether one of the sizes ends with the block."""
    start = 0
    with Bar(name, sizes[-1], "photos") as bar:
        for size in sizes:
            for block in crowd.blocks(start, size, 0):
                start += len(block.rows)
                yield block.arrays["partials"].astype(np.float32), block.embeddings, start == size
                bar.advance(len(block.rows))


def lines(sizes: Sequence[int], ranks: NDArray[Any], choosing: int) -> Iterator[dict[str, float]]:
    """Yield the results of each size. The first `choosing` touches choose k, the others evaluate it."""
    for size, order in zip(sizes, ranks, strict=True):
        needed_by_choosing, needed_by_all = _needed(order[:choosing]), _needed(order)
        reranked = min(MARGIN * needed_by_choosing, size)
        evaluated = order[choosing:]
        contained = int((evaluated <= reranked).sum())
        low, high = binomial_interval(contained, len(evaluated))
        recall = {
            "taken": reranked,
            "touches": len(evaluated),
            "found": contained / len(evaluated),
            "low": low,
            "high": high,
        }
        needed = {"needed": needed_by_all, "needed_by_chosen": needed_by_choosing}
        yield {"photos": size, **needed, "worst": int(order.max()), **recall}


def _needed(order: NDArray[Any]) -> int:
    """Return the number of candidates that contains the target fraction of these ranks."""
    return int(np.sort(order)[int(np.ceil(TARGET * len(order))) - 1])


def main() -> None:
    """Print a line for each size, then the growth of candidates."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.needed", description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", nargs="+", type=float, default=[1e3, 1e4, 1e5, 1e6])
    parser.add_argument("--held-out", type=int, default=HELD_OUT, help="touches that evaluate the choice")
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument(
        "--recording", type=Path, help="recording whose photos are blended (default: a small one is collected)"
    )
    parser.add_argument("--features", type=Path, help="file to store encoded features")
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    sizes = sorted(int(size) for size in arguments.sizes)
    with tempfile.TemporaryDirectory() as made:
        crowd = blended_photos(arguments.model, arguments.recording or collected(Path(made)), arguments.features)
    touches = np.concatenate([crowd.touches, crowd.held_out[: arguments.held_out]])
    start = time.perf_counter()
    cosines, rescored = exhaustive_top1(crowd, touches, sizes)
    table = list(lines(sizes, ranks_of(crowd, touches, sizes, cosines), len(crowd.touches)))
    for line in table:
        shown = {name: value if isinstance(value, int) else round(value, 4) for name, value in line.items()}
        print(json.dumps(line) if arguments.json else "  ".join(f"{name} {value}" for name, value in shown.items()))
    for name in ("needed", "taken"):
        power = np.polyfit(np.log([line["photos"] for line in table]), np.log([line[name] for line in table]), 1)[0]
        print(json.dumps({"slope": name, "value": power}) if arguments.json else f"N^{power:.2f}  {name}")
    print(f"{time.perf_counter() - start:.0f} s; {rescored:.2%} of pairs also scored in float32")


if __name__ == "__main__":
    main()
