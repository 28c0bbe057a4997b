"""Error rates of `retrieve verify` on objects that the model was not calibrated on.

    python -m benchmarks.models.verify RECORDING --model shipped

RECORDING holds grasps of unseen objects, five or more of each. Each sequence of four grasps is compared with every
object of the recording. Intervals resample the touched objects. "similar": the object whose photos are most similar.

The second table compares the sequential test with tests after a fixed number of grasps, whose thresholds give the same
false-accept rate on this recording.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.models.recognition import all_scores, interval
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.metrics.intervals import bootstrap_interval
from retrieval.metrics.measure import object_means
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.posterior import ScoredTouches
from retrieval.model.verification import (
    MAX_GRASPS,
    DecisionBounds,
    VerificationCalibration,
    VerificationSequences,
    verification_sequences,
)
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
    found = sequences(checkpoint, arguments.recording, arguments.cache)
    print("\n".join([*rate_table(checkpoint.verification, found), "", *length_table(checkpoint.verification, found)]))
    return 0


def sequences(checkpoint: Checkpoint, recording: Path, cache: Path | None) -> VerificationSequences:
    """Return the log likelihood ratios of sequences of grasps of a recording."""
    assert checkpoint.posterior is not None
    scored, embeddings = scored_grasps(checkpoint, load_grasps(recording), cache)
    return verification_sequences(scored, embeddings, checkpoint.posterior)


def scored_grasps(
    checkpoint: Checkpoint, grasps: list[Grasp], cache: Path | None
) -> tuple[ScoredTouches, NDArray[np.float64]]:
    """Return the match logits of the touches of all grasps with the photos of all, and the photos' embeddings."""
    features = encode_recording(grasps, checkpoint.matcher, checkpoint.config, cache)
    touches, photos = feature_partials(checkpoint.matcher, features)
    owner, own = features.owner, np.eye(len(features), dtype=bool)
    scored = ScoredTouches(all_scores(checkpoint, touches, photos), owner, owner, own)
    return scored, photos[:, checkpoint.config.matcher.cosine_columns].numpy().astype(np.float64)


def rate_table(calibration: VerificationCalibration, found: VerificationSequences) -> list[str]:
    """Return the lines of a Markdown table: stated and achieved rates."""
    lines = [
        "| stated FAR | FAR, random | FAR, similar | stated FRR | FRR | "
        + " | ".join(f"accepted within {count}" for count in range(1, MAX_GRASPS + 1))
        + " |",
        "|---|---|---|---|---|" + "---|" * MAX_GRASPS,
    ]
    for far in RATES:
        bounds = calibration.bounds(far)
        random = (found.impostor >= bounds.accept).mean(1)
        similar, stated = found.similar >= bounds.accept, bounds.false_rejects
        outcomes = [bounds.decide(ratios) for ratios in found.ratios]
        rejected = np.array([decision != "accept" for decision in outcomes])
        within = [found.genuine[count] >= bounds.accept for count in range(MAX_GRASPS)]
        cells = [cell(values, found.owner) for values in (random, similar)]
        cells += [interval(stated.value, stated.low, stated.high), cell(rejected, found.owner)]
        lines.append(f"| {far:g} | " + " | ".join(cells + [cell(values, found.owner) for values in within]) + " |")
    return lines


def length_table(calibration: VerificationCalibration, found: VerificationSequences) -> list[str]:
    """Return the lines of a Markdown table: grasps and false rejects of the sequential test and of fixed numbers."""
    lines = [
        "| FAR | test | grasps, right object | grasps, other object | FRR |",
        "|---|---|---|---|---|",
    ]
    impostor_owner = np.repeat(found.owner, found.impostor.shape[1])
    impostors = found.impostor_ratios.reshape(-1, MAX_GRASPS)
    for far in RATES:
        bounds = calibration.bounds(far)
        accepted, grasps = decisions(bounds, found.ratios)
        wrongly_accepted, impostor_grasps = decisions(bounds, impostors)
        achieved = wrongly_accepted.mean()
        cells = [cell(grasps, found.owner), cell(impostor_grasps, impostor_owner), cell(~accepted, found.owner)]
        lines.append(f"| {achieved:.3f} | sequential, stated {far:g} | " + " | ".join(cells) + " |")
        for count in range(1, MAX_GRASPS + 1):
            threshold = np.quantile(impostors[:, count - 1], 1 - achieved)
            rejected = cell(found.ratios[:, count - 1] < threshold, found.owner)
            lines.append(f"| {achieved:.3f} | {count} grasp{'s' * (count > 1)} | {count} | {count} | {rejected} |")
    return lines


def decisions(bounds: DecisionBounds, ratios: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return whether each sequence (S, MAX_GRASPS) is accepted, and after how many grasps it is decided (S,)."""
    never = MAX_GRASPS + 1
    accepts, rejects = (
        np.where(reached.any(1), reached.argmax(1) + 1, never)
        for reached in (ratios >= bounds.accept, ratios <= bounds.reject)
    )
    return accepts <= np.minimum(rejects, MAX_GRASPS), np.minimum(np.minimum(accepts, rejects), MAX_GRASPS)


def cell(values: NDArray[np.generic], owner: NDArray[np.int64]) -> str:
    """Return the mean over objects of values (S,) of sequences, with its interval."""
    means = object_means(values.astype(np.float64)[:, None], owner)[1]
    low, high = bootstrap_interval(means)
    return interval(means.mean(), max(low[0], 0), high[0])


if __name__ == "__main__":
    raise SystemExit(main())
