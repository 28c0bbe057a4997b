"""Measure answers from a catalogue of 30 simulated objects: verdict, ranking, P(object | present), advice.

    python -m benchmarks.models.answers RECORDING [RECORDING ...] [--photos 3] [--references 0] [--touches 5]

The photos of each object's first grasps are the catalogue, its next touches reference touches, its last touches the
queries, in as many orders. Each query is run against 30 objects with the true one, and against 30 others, with the
shipped checkpoint, which must not have been trained on them. An object's logit does not depend on the rest of the
catalogue, so one index of all objects of a recording gives the logits of all these catalogues. Intervals resample
objects.
"""

import argparse
import itertools
import shutil
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.models.recognition import interval
from benchmarks.models.verdicts import redrawn, resampled
from retrieval.data.dataset import load_grasps
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build.build_index import build_index
from retrieval.search.defaults import shipped_model
from retrieval.search.query.answer import is_clear
from retrieval.search.query.searcher import Searcher
from retrieval.search.query.shard import ShardQuery

OBJECTS = 30
FALSE_ACCEPTS = 0.05
BINS = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)


@dataclass(frozen=True)
class Answer:
    """An answer to some grasps of one object.

    Attributes:
        right: whether the first object is right.
        match: whether the verdict is "match".
        if_present: P(first object | present).
        more: the number of further grasps that the answer recommends, or None.
        odds: P(first object) / P(none of these).
    """

    right: bool
    match: bool
    if_present: float
    more: int | None
    odds: float

    @property
    def advice(self):
        """Kind of advice for the verdict "none of these"."""
        if not is_clear(self.if_present):
            return "the ranking is not clear"
        return "more grasps hardly change it" if self.more is None else "another grasp would help"


@dataclass(frozen=True)
class Series:
    """Answers after the first grasp, after two, ...

    Attributes:
        owner: the object of the grasps.
        present: whether the catalogue contains it.
        answers: the answers.
    """

    owner: str
    present: bool
    answers: list[Answer]


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    parser.add_argument("--photos", type=int, default=3, help="grasps of each object whose photos are the catalogue")
    parser.add_argument("--references", type=int, default=0, help="grasps of each object that are reference touches")
    parser.add_argument("--touches", type=int, default=5, help="grasps of each object that are queries")
    arguments = parser.parse_args()
    counts = (arguments.photos, arguments.references, arguments.touches)
    series = [one for recording in arguments.recordings for one in answer_series(recording, *counts)]
    print(f"{len({one.owner for one in series})} objects, {len(series) // 2} orders of their grasps")
    for table in (verdicts, calibration, advised):
        print("\n".join(table(series)) + "\n")


def answer_series(recording, photos, references, touches):
    """Yield two series of answers for each object and order of its grasps: with the object and without it."""
    with tempfile.TemporaryDirectory() as folder:
        queries = arrange(recording, photos, references, touches, Path(folder, "catalog"))
        build_index(Path(folder, "catalog"), load_checkpoint(shipped_model()), Path(folder, "index"), quiet=True)
        with Searcher.open(Path(folder, "index")) as searcher:
            names, rng = np.array(sorted(queries)), np.random.default_rng(0)
            for name in names:
                codes = searcher.encode(queries[name])
                for start in range(touches):
                    order = np.roll(np.arange(touches), -start)
                    logits = [logits_of(searcher, codes, order[:count], len(names)) for count in range(1, touches + 1)]
                    others = rng.permutation(names[names != name])
                    for catalogue in (np.append(others[: OBJECTS - 1], name), others[:OBJECTS]):
                        answers = [answer(searcher.posterior, own, catalogue, name) for own in enumerate(logits, 1)]
                        yield Series(f"{recording.name} {name}", name in catalogue, answers)


def logits_of(searcher, codes, rows, count):
    """Return the logit of each object after these grasps."""
    found = searcher.shard.search(
        ShardQuery(codes.embeddings[rows], codes.partials[rows]), count, None, searcher.posterior
    )
    return {one.photo.object_id: one.logit for one in found.best}


def arrange(recording, photos, references, touches, catalogue):
    """Fill a catalogue; return the query touches of each object."""
    grasps = defaultdict(list)
    for grasp in load_grasps(recording):
        grasps[grasp.object_id].append(grasp)
    queries = {}
    for name, own in grasps.items():
        if len(own) < photos + references + touches:
            continue
        (catalogue / name).mkdir(parents=True)
        for number, grasp in enumerate(own[:photos]):
            shutil.copyfile(grasp.photo, catalogue / name / f"{number}{grasp.photo.suffix}")
        for number, grasp in enumerate(own[photos : photos + references]):
            for finger, touch in zip("ab", grasp.touches, strict=True):
                shutil.copyfile(touch, catalogue / name / f"touch_{number}_{finger}{touch.suffix}")
        queries[name] = [[str(path) for path in grasp.touches] for grasp in own[-touches:]]
    return queries


def answer(posterior, grasps_and_logits, catalogue, name):
    """Return the answer from a catalogue, by the logits of its objects after this many grasps."""
    grasps, logits = grasps_and_logits
    own = np.array([logits[one] for one in catalogue])
    probabilities, best = posterior.probabilities(own, grasps), int(own.argmax())
    match, if_present = (
        bool(probabilities.objects[best] > probabilities.none),
        float(probabilities.objects_if_present[best]),
    )
    more = None if match or not is_clear(if_present) else posterior.more_grasps(own[best], len(own), grasps)
    odds = float(probabilities.objects[best] / probabilities.none)
    return Answer(catalogue[best] == name, match, if_present, more, odds)


def verdicts(series):
    """Yield table rows by the number of grasps."""
    yield (
        "| grasps | R@1 | match, right | match, wrong | none, ranking right | none, ranking wrong | absent: match "
        f"| none at {FALSE_ACCEPTS:.0%} false accepts |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for grasps in range(1, len(series[0].answers) + 1, 2):
        present, absent = split(series, grasps)
        cells = [
            fraction(present, lambda one: one.right),
            fraction(present, lambda one: one.match and one.right),
            fraction(present, lambda one: one.match and not one.right),
            fraction(present, lambda one: not one.match and one.right),
            fraction(present, lambda one: not one.match and not one.right),
            fraction(absent, lambda one: one.match),
            called_absent(present, absent),
        ]
        yield f"| {grasps} | " + " | ".join(cells) + " |"


def split(series, grasps):
    """Return (owner, answer) pairs with the object in the catalogue, and without."""
    every = [
        [(one.owner, one.answers[grasps - 1]) for one in series if one.present is there] for there in (True, False)
    ]
    return every[0], every[1]


def fraction(pairs, holds):
    """Return the fraction for which it holds, with its interval over objects."""
    values = np.array([holds(one) for _, one in pairs], dtype=float)
    return over_objects(pairs, lambda rows: float(values[rows].mean()))


def called_absent(present, absent):
    """Return the fraction of present objects that are not accepted if `FALSE_ACCEPTS` of the absent ones are."""
    there, not_there = (np.array([one.odds for _, one in pairs]) for pairs in (present, absent))

    def rate(rows):
        return float(np.mean(there[rows] <= np.quantile(not_there[rows], 1 - FALSE_ACCEPTS)))

    return over_objects(present, rate)


def over_objects(pairs, measure):
    """Return a measure of rows of the pairs, with its interval over objects."""
    owners = np.unique([owner for owner, _ in pairs], return_inverse=True)[1]
    return interval(*resampled(measure, np.arange(len(pairs)), list(redrawn(owners))))


def calibration(series):
    """Yield P(object | present) of the first object against its accuracy, in bins, for present objects."""
    yield "| grasps | P(object given present) | all: answers, mean, right | none of these: answers, mean, right |"
    yield "|---|---|---|---|"
    for grasps in (1, 3):
        present, _ = split(series, grasps)
        for low, high in itertools.pairwise(BINS):
            own = [one for _, one in present if low < one.if_present <= high]
            cells = [counted(own), counted([one for one in own if not one.match])]
            yield f"| {grasps} | {low} to {high} | " + " | ".join(cells) + " |"


def counted(own):
    """Return number of answers, mean probability, and fraction of right ones."""
    if not own:
        return "0"
    means = np.mean([(one.if_present, one.right) for one in own], axis=0)
    return f"{len(own)}, {means[0]:.2f}, {means[1]:.2f}"


def advised(series):
    """Yield the outcome of "none of these" after the recommended grasps, or else after all grasps."""
    yield "| grasps | advice | present: answers, ranking right, then match, match right | absent: answers, then match |"
    yield "|---|---|---|---|"
    for grasps in range(1, len(series[0].answers)):
        for advice in ("another grasp would help", "more grasps hardly change it", "the ranking is not clear"):
            cells = []
            for present in (True, False):
                own = [one for one in series if one.present is present and not one.answers[grasps - 1].match]
                own = [one.answers for one in own if one.answers[grasps - 1].advice == advice]
                own = [
                    each for each in own if grasps + (each[grasps - 1].more or 0) <= len(each)
                ]  # enough grasps exist
                later = [each[grasps + (each[grasps - 1].more or len(each) - grasps) - 1] for each in own]
                matches = sum(one.match for one in later)
                right = sum(each[grasps - 1].right for each in own)
                right_matches = sum(one.match and one.right for one in later)
                cells.append(
                    f"{len(own)}, {right}, {matches}, {right_matches}" if present else f"{len(own)}, {matches}"
                )
            yield f"| {grasps} | {advice} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
