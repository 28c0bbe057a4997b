"""Rerank candidates with stored partial activations: compared with the whole network, and without late interaction.

python -m benchmarks.rerank [--tower resnet50]
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.common import REPETITIONS, ResultLine, as_text, config_of, duration, in_turns, matcher_of, random_images
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.config import Config
from retrieval.model.encode import encode_photos, encode_touches, to_batch, touch_batch
from retrieval.model.fusion import FusionHead
from retrieval.model.fusion_scorer import StoredPartials, to_stored
from retrieval.search.defaults import shipped_model

BATCH = 16
CELL_DIM = 32
"""Length of a cell's vector where the configuration has none."""


def measure(
    config: Config, candidates: tuple[int, ...] = (100, 1000), sample: int = BATCH, repetitions: int = REPETITIONS
) -> Iterator[ResultLine]:
    """Yield one line for each number of candidates, and one for late interaction with the last number.

    The whole network runs on `sample` pairs, and its time is scaled. The matrix product is that of the head's second
    layer for all candidates, in numpy's BLAS library.
    """
    matcher, pre = matcher_of(config), config.preprocessing
    touch = random_images(config.matcher.fingers, pre.touch_px, seed=1)
    photos = random_images(sample, pre.photo_px, seed=2)
    partial, scorer = encode_touches(matcher, [touch]).partial.numpy(), matcher.head.scorer
    partials = encode_photos(matcher, photos).partial.numpy().astype(np.float16)
    one_touch, stacked = touch_batch([touch]), to_batch(photos)

    @torch.inference_mode()
    def whole_network() -> torch.Tensor:
        parts = stacked.split(BATCH)
        return torch.cat([matcher(one_touch.expand(len(part), -1, -1, -1, -1), part) for part in parts])

    reference = whole_network().numpy()
    error = float(np.abs(scorer.logits(partial, partials) - reference).max())
    assert error <= 0.02 * max(1.0, float(np.abs(reference).max())), "the two arms must give the same logits"
    stored = {count: np.resize(partials, (count, partials.shape[1])) for count in candidates}
    floats = {count: stored[count].astype(np.float32) for count in candidates}
    arms = {str(count): (lambda count=count: scorer.logits(partial, stored[count])) for count in candidates}
    arms |= {f"product {count}": (lambda count=count: floats[count] @ scorer.second.T) for count in candidates}
    times = in_turns({**arms, "touch": lambda: encode_touches(matcher, [touch]), "whole": whole_network}, repetitions)
    for count in candidates:
        scale = count / sample
        ratio, product_ratio = times.ratio("whole", str(count), scale), times.ratio(f"product {count}", str(count))
        ours, encoded, other = times.median(str(count)), times.median("touch"), scale * times.median("whole")
        yield ResultLine(
            "rerank",
            config.matcher.tower,
            f"{count} candidates take {duration(ours)} with partial activations and {duration(other)} by the whole "
            f"network on each pair ({sample} pairs measured, scaled): {as_text(ratio)}; {other / (ours + encoded):.3g} "
            f"times with the {duration(encoded)} for encoding the touch; {product_ratio[0]:.0%} of the rate of the "
            f"bare matrix product ({config.matcher.hidden} units); largest difference of a logit {error:.2g}",
            {
                "candidates": count,
                "partials_s": ours,
                "encode_s": encoded,
                "whole_s": other,
                "ratio": ratio[0],
                "share_of_product": product_ratio[0],
            },
            {"partials": times.seconds[str(count)], "product": times.seconds[f"product {count}"]},
        )
    yield measure_cells(config, candidates[-1], repetitions)


def measure_shipped() -> Iterator[ResultLine]:
    """Yield the line of `measure_cells` with the sizes of the shipped checkpoint."""
    yield measure_cells(read_checkpoint_info(shipped_model()).config)


def measure_cells(config: Config, candidates: int = 1000, repetitions: int = REPETITIONS) -> ResultLine:
    """Return the line that compares reranking with and without cells, in CPU time of one thread.

    Both arms score the same random partial activations of one touch, as an index stores those of photos.
    """
    sizes = dataclasses.replace(
        config.matcher, tower_output="stages", cosine=True, cell_dim=config.matcher.cell_dim or CELL_DIM
    )
    generator, width = np.random.default_rng(0), sizes.pooled_width
    touch = generator.normal(size=(1, sizes.touch_partial_width)).astype(np.float32)
    photos = generator.normal(size=(candidates, sizes.partial_width)).astype(np.float32)
    cells = photos[:, width:].reshape(candidates, -1, sizes.cell_dim)
    cells /= np.linalg.norm(cells, axis=2, keepdims=True)
    scorer = FusionHead(1, 1, sizes.hidden, 0.0, sizes.embedding_dim, sizes.cell_dim).scorer
    arrays = {"with": to_stored(photos, width), "without": to_stored(photos[:, :width], width)}
    stored = {name: StoredPartials(each) for name, each in arrays.items()}
    with threadpool_limits(1, "blas"):
        arms = {name: (lambda each=each: scorer.logits(touch, each)) for name, each in stored.items()}
        times = in_turns(arms, repetitions, time.process_time)
    ratio, bytes_each = (
        times.ratio("with", "without"),
        {name: sum(array.nbytes for array in each.values()) // candidates for name, each in arrays.items()},
    )
    return ResultLine(
        "rerank",
        config.matcher.tower,
        f"{candidates} candidates with {sizes.photo_cells**2} cells of {sizes.cell_dim} numbers take "
        f"{duration(times.median('with'))} of one thread, without cells {duration(times.median('without'))}: "
        f"{as_text(ratio)}; a photo takes {bytes_each['with']} and {bytes_each['without']} bytes",
        {
            "candidates": candidates,
            "cells_s": times.median("with"),
            "pooled_s": times.median("without"),
            "cells_ratio": ratio[0],
            "cells_bytes": bytes_each["with"],
            "pooled_bytes": bytes_each["without"],
        },
        times.seconds,
    )


def main() -> None:
    """Print the lines of a tower with random weights, and that of the shipped checkpoint's sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tower", default="mobilenet_v2")
    for line in (*measure(config_of(parser.parse_args().tower)), *measure_shipped()):
        print(line)


if __name__ == "__main__":
    main()
