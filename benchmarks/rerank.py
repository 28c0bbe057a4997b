"""Rerank candidates with late interaction and without it, with the sizes of the shipped checkpoint.

python -m benchmarks.rerank
"""

import time

import numpy as np
from threadpoolctl import threadpool_limits

from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import FusionHead
from retrieval.model.fusion_scorer import StoredPartials, to_stored
from retrieval.model.shipped import shipped_model

CANDIDATES, REPETITIONS, CALLS = 1000, 5, 20


def measure(sizes: MatcherConfig, candidates: int = CANDIDATES, repetitions: int = REPETITIONS) -> str:
    """Compare reranking with and without cells, in CPU time of one thread; return the result as a sentence.

    Both arms run in turn and score the same random partial activations of one touch, as an index stores those of
    photos.
    """
    generator, width = np.random.default_rng(0), sizes.pooled_width
    touch = generator.normal(size=(1, sizes.touch_partial_width)).astype(np.float32)
    photos = generator.normal(size=(candidates, sizes.partial_width)).astype(np.float32)
    cells = photos[:, width:].reshape(candidates, -1, sizes.cell_dim)
    cells /= np.linalg.norm(cells, axis=2, keepdims=True)
    scorer = FusionHead(1, 1, sizes).scorer
    arrays = {"with": to_stored(photos, width), "without": to_stored(photos[:, :width], width)}
    size = {name: sum(array.nbytes for array in each.values()) // candidates for name, each in arrays.items()}
    ms: dict[str, list[float]] = {name: [] for name in arrays}
    with threadpool_limits(1, "blas"):
        for number in range(repetitions + 1):
            for name, each in arrays.items():
                stored, start = StoredPartials(each), time.process_time()
                for _ in range(CALLS):
                    scorer.logits(touch, stored)
                if number:  # the first is not counted
                    ms[name].append(1e3 * (time.process_time() - start) / CALLS)
    median, ratio = {name: np.median(each) for name, each in ms.items()}, np.divide(ms["with"], ms["without"])
    return (
        f"{candidates} candidates with {sizes.photo_cells**2} cells of {sizes.cell_dim} numbers take "
        f"{median['with']:.3g} ms of one thread, without cells {median['without']:.3g} ms: "
        f"{median['with'] / median['without']:.3g} times ({ratio.min():.3g} to {ratio.max():.3g}); a photo takes "
        f"{size['with']} and {size['without']} bytes"
    )


if __name__ == "__main__":
    print(measure(read_checkpoint_info(shipped_model()).config.matcher))
