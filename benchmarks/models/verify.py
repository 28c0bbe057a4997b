"""Error rates of `retrieve verify` on objects that the model was not calibrated on.

    python -m benchmarks.models.verify RECORDING --model shipped

RECORDING holds grasps of unseen objects, five or more of each. Each sequence of four grasps is compared with every
object of the recording. Intervals resample the touched objects. "similar": the object whose photos are most similar.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.models.recognition import all_scores
from retrieval.data.dataset import load_grasps
from retrieval.metrics.intervals import bootstrap_interval
from retrieval.metrics.measure import object_means
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.posterior import ScoredTouches
from retrieval.model.verification import MAX_GRASPS, verification_sequences
from retrieval.search.defaults import find_model
from retrieval.training.distil import feature_partials
from retrieval.training.features import encode_recording

RATES = (0.1, 0.05, 0.01)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--model", default="shipped")
    parser.add_argument("--cache", type=Path, help="folder for encoded features")
    arguments = parser.parse_args(argv)
    choice = arguments.model
    checkpoint = load_checkpoint(find_model(choice)[0])
    if checkpoint.verification is None:
        parser.error(f"{choice} has no error rates for verification")
    print("\n".join(table(checkpoint, arguments.recording, arguments.cache)))
    return 0


def table(checkpoint: Checkpoint, recording: Path, cache: Path | None) -> list[str]:
    """Return the lines of a Markdown table: stated and achieved rates."""
    assert checkpoint.verification is not None
    assert checkpoint.posterior is not None
    features = encode_recording(load_grasps(recording), checkpoint.matcher, checkpoint.config, cache)
    touches, photos = feature_partials(checkpoint.matcher, features)
    owner, own = features.owner, np.eye(len(features), dtype=bool)
    scored = ScoredTouches(all_scores(checkpoint, touches, photos), owner, owner, own)
    columns = checkpoint.config.matcher.cosine_columns
    found = verification_sequences(scored, photos[:, columns].numpy().astype(np.float64), checkpoint.posterior)
    lines = [
        "| stated FAR | FAR, random | FAR, similar | stated FRR | FRR | "
        + " | ".join(f"accepted within {count}" for count in range(1, MAX_GRASPS + 1))
        + " |",
        "|---|---|---|---|---|" + "---|" * MAX_GRASPS,
    ]
    for far in RATES:
        bounds = checkpoint.verification.bounds(far)
        random = (found.impostor >= bounds.accept).mean(1)
        similar, stated = found.similar >= bounds.accept, bounds.false_rejects
        decisions = [bounds.decide(ratios) for ratios in found.ratios]
        rejected = np.array([decision != "accept" for decision in decisions])
        within = [found.genuine[count] >= bounds.accept for count in range(MAX_GRASPS)]
        cells = [cell(values, found.owner) for values in (random, similar)]
        cells += [f"{stated.value:.3f} [{stated.low:.3f}, {stated.high:.3f}]", cell(rejected, found.owner)]
        lines.append(f"| {far:g} | " + " | ".join(cells + [cell(values, found.owner) for values in within]) + " |")
    return lines


def cell(values: NDArray[np.generic], owner: NDArray[np.int64]) -> str:
    """Return the mean over objects of values (S,) of sequences, with its interval."""
    means = object_means(values.astype(np.float64)[:, None], owner)[1]
    low, high = bootstrap_interval(means)
    return f"{means.mean():.3f} [{max(low[0], 0):.3f}, {min(high[0], 1):.3f}]"


if __name__ == "__main__":
    raise SystemExit(main())
