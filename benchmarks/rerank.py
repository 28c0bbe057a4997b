"""Rerank candidates with stored partial activations, compared with the whole network on every pair."""

from collections.abc import Iterator

import numpy as np
import torch

from benchmarks.common import REPETITIONS, ResultLine, as_text, duration, in_turns, matcher_of, random_images
from retrieval.model.config import Config
from retrieval.model.encode import encode_photos, encode_touches, to_batch, touch_batch
from retrieval.model.fusion import scorer_of

BATCH = 16


def measure(
    config: Config, candidates: tuple[int, ...] = (100, 1000), sample: int = BATCH, repetitions: int = REPETITIONS
) -> Iterator[ResultLine]:
    """Yield one line for each number of candidates.

    The whole network runs on `sample` pairs, and its time is scaled. The matrix product is that of the head's second
    layer for all candidates, in numpy's BLAS library.
    """
    matcher, pre = matcher_of(config), config.preprocessing
    touch = random_images(config.matcher.fingers, pre.touch_px, seed=1)
    photos = random_images(sample, pre.photo_px, seed=2)
    partial, scorer = encode_touches(matcher, [touch]).partial.numpy(), scorer_of(matcher.head)
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
