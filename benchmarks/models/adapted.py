"""Verification and the next grasp on VT60 after `retrieve adapt`, on objects that were not fitted.

    python -m benchmarks.models.adapted DATA/vt60 --init WEIGHTS --out FOLDER

Half of the instances of each class are left out, in the six ways of choosing two instance numbers of four. `retrieve
adapt` fits a checkpoint to the others. Then sequences of grasps of each left-out object are verified against each
left-out object, and the next grasp is replayed with a catalogue of all left-out objects. The thresholds of the first
table come from these sequences themselves: 22 fitted objects are too few for bounds in the checkpoint. Intervals of
error rates count each object as one trial, the others resample the objects. A stopped run continues.
"""

import argparse
import dataclasses
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.models.recognition import interval
from benchmarks.models.verify import scored_grasps
from retrieval.adaptation.recipe import adapt
from retrieval.console.memory import keep_freed_memory
from retrieval.data.dataset import Grasp, Split
from retrieval.evaluation.next_grasp import Replay, compare_policies, replay
from retrieval.evaluation.real import PROTOCOLS
from retrieval.evaluation.real.protocol import read_recording_facts
from retrieval.evaluation.verification import GRASPS, equal_error_rate, false_rejects
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.posterior import ScoredTouches
from retrieval.model.verification import VerificationSequences, error_rate, verification_sequences
from robot.importers.vt60 import import_vt60

FITS = 6
"""The first choices of the protocol: all pairs of instance numbers."""
TOUCHES = 40
"""Left-out touches of each object, at even distances in the order of capture."""
FARS = (0.2, 0.1)
_PLACE = re.compile(r"_img_(\d+)_.*_at_(-?\d+)_(-?\d+)_(-?\d+)\.")


class Scored(NamedTuple):
    """Left-out touches of one fit.

    Attributes:
        checkpoint: The fitted checkpoint.
        touches: Match logits of the touches with the photos.
        embeddings: (N, d) embeddings of the photos.
        places: (T, 3) coordinates of the touches, in the unit of the data set, which does not state it.
    """

    checkpoint: Checkpoint
    touches: ScoredTouches
    embeddings: NDArray[np.float64]
    places: NDArray[np.float64]


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, score and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of VT60, with touch/ and vision/")
    parser.add_argument("--init", default="imagenet", help="as in `retrieve adapt`")
    parser.add_argument("--out", type=Path, required=True, help="folder of the recording, features and checkpoints")
    parser.add_argument("--fits", type=int, default=FITS, help="number of fits")
    arguments = parser.parse_args(argv)
    keep_freed_memory()
    recording, cache = arguments.out / "recording", arguments.out / "features"
    if not (recording / "recording.json").exists():
        import_vt60(arguments.data, recording)
    facts = read_recording_facts(recording)
    folds = PROTOCOLS.load("vt60-choices").folds(facts, 0)[: arguments.fits]
    places, scored = touch_places(arguments.data), []
    for number, split in enumerate(folds):
        file = arguments.out / f"adapted-{number}.safetensors"
        if not file.exists():
            fitted = dataclasses.replace(split, train=(*split.train, *split.validation), validation=())
            adapt(recording, file, init=arguments.init, split=fitted, cache=cache)
        grasps = left_out(facts.grasps, split)
        scored.append(score(load_checkpoint(file), grasps, facts.names, places, cache))
    print("\n".join([*verification_table(scored), "", *next_grasp_table(scored)]))
    return 0


def left_out(grasps: list[Grasp], split: Split) -> list[Grasp]:
    """Return `TOUCHES` grasps of each test object."""
    grasps_of = defaultdict(list)
    for grasp in split.select(grasps, "test"):
        grasps_of[grasp.object_id].append(grasp)
    return [
        some[row]
        for some in grasps_of.values()
        for row in np.unique(np.linspace(0, len(some) - 1, TOUCHES).round().astype(int))
    ]


def touch_places(data: Path) -> dict[str, tuple[float, ...]]:
    """Return the coordinates of each touch by the name of its grasp, from the names of the files."""
    found = {}
    for path in (data / "touch").glob("*/*/*.jpg"):
        if match := _PLACE.search(path.name):
            number, *place = match.groups()
            found[f"{path.parent.parent.name}-{path.parent.name}-{number}"] = tuple(map(float, place))
    return found


def score(
    checkpoint: Checkpoint,
    grasps: list[Grasp],
    names: Sequence[str],
    places: dict[str, tuple[float, ...]],
    cache: Path,
) -> Scored:
    """Score the touches of left-out objects with their photos. Any photo may be compared: VT60 pairs them at random.

    `names`: the names of all objects. Objects are numbered by them.
    """
    scored, embeddings = scored_grasps(checkpoint, grasps, cache)
    owner = np.array([names.index(grasp.object_id) for grasp in grasps])
    touches = ScoredTouches(scored.logits, owner, owner, np.zeros_like(scored.own))
    return Scored(checkpoint, touches, embeddings, np.array([places[grasp.grasp_id] for grasp in grasps]))


def verification_table(fits: Sequence[Scored]) -> list[str]:
    """Return a Markdown table of error rates by kind of impostor and number of grasps, over all fits."""
    header = " | ".join(f"FRR at FAR {far:g}" for far in FARS)
    lines = [f"| impostor | grasps | EER | {header} |", "|---|---|---|" + "---|" * len(FARS)]
    objects = len(np.unique(np.concatenate([fit.touches.touch_owner for fit in fits])))
    drawn_by_grasps: dict[int, list[VerificationSequences]] = {grasps: [] for grasps in GRASPS}
    for fit in fits:
        posterior = fit.checkpoint.posterior
        assert posterior is not None
        for grasps, drawn in drawn_by_grasps.items():
            drawn.append(verification_sequences(fit.touches, fit.embeddings, posterior, 0, grasps))
    for kind in ("random", "similar"):
        for grasps, drawn in drawn_by_grasps.items():
            genuine = np.concatenate([each.genuine[-1] for each in drawn])
            impostors = np.concatenate([each.impostor.ravel() if kind == "random" else each.similar for each in drawn])
            rates = [equal_error_rate(genuine, impostors), *(false_rejects(far, genuine, impostors) for far in FARS)]
            stated = [error_rate(rate, objects) for rate in rates]
            cells = [interval(each.value, each.low, each.high) for each in stated]
            lines.append(f"| {kind} | {grasps} | {' | '.join(cells)} |")
    return lines


def next_grasp_table(fits: Sequence[Scored]) -> list[str]:
    """Return a Markdown table of the policies for the next grasp, over all fits."""
    each = [replay(fit.touches, fit.places, seed=0) for fit in fits]
    candidates = len(np.unique(fits[0].touches.photo_owner))
    together = Replay(
        np.concatenate([one.owner for one in each]),
        {policy: np.concatenate([one.ranks_first[policy] for one in each]) for policy in each[0].ranks_first},
    )
    entry = compare_policies([together], candidates, seed=0)
    about = f"{entry['objects']} left-out objects, {entry['sequences']} sequences, {candidates} candidates"
    counts = " | ".join(f"{count} grasps" for count in range(1, 6))
    lines = [about, "", f"| next grasp | {counts} | grasps to 80 % | relative to random |", "|---|" + "---|" * 7]
    for policy, found in entry["policies"].items():
        cells = [interval(*ends) for ends in found["accuracy"]]
        cells += [number(found[name]) for name in ("grasps_needed", "relative_to_random")]
        lines.append(f"| {policy} | {' | '.join(cells)} |")
    return lines


def number(found: dict[str, float | None]) -> str:
    """Return a number of grasps with its interval; a dash where the accuracy is not reached."""
    value, low, high = (
        "-" if each is None else f"{each:.2f}" for each in (found["value"], found["low"], found["high"])
    )
    return f"{value} [{low}, {high}]"


if __name__ == "__main__":
    raise SystemExit(main())
