"""Objects that were enrolled by touch: top-1 accuracy and "none of these", with photos, reference grasps and openings.

    python -m benchmarks.enrolment FOLDER [--part grasp] [--jobs 2]

`--part grasp`: 250 objects with 100 pairs of gels, which no model was trained on. The catalogue has one photo of each
object and one grasp with its opening; three other grasps are queries, one by one. The openings are exact, or have the
error of a gripper. K objects are drawn from the catalogue at random; top-1 accuracy is the mean over all such draws.
For "none of these", each query is asked of catalogues of 100 objects with its object and without it.

Accuracies have 95 % intervals over objects; differences are paired. It writes FOLDER/PART.md. An interrupted collection
continues. A query that is refused (no contact) counts as a random guess with the verdict "none of these".
"""

import argparse
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import retrieval
from models.recognition import interval, top1
from models.shipped import retrieve
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.evaluation.reject import statistic
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure, object_means, object_weights, weight_below
from retrieval.metrics.table import ScoreTable
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.shipped import shipped_model

SEED, OBJECTS, SPARE, QUERIES, GELS = 530_000, 250, 12, 3, 100
"""Object set of the part `grasp`: its seed, objects, further ones in place of objects that cannot be grasped, query
grasps of each, and pairs of gels."""
CANDIDATES, CATALOGUE, DRAWS = (100, 250), 100, 10
REFUSED = -50.0
"""Log likelihood ratio of every object for a query that is refused."""

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Content:
    """What a catalogue has of each object: photo, number of reference grasps, error of their openings (None: none)."""

    photo: bool
    grasps: int
    error_mm: float | None = None

    def __str__(self) -> str:
        parts = ["photo"] * self.photo + [f"{self.grasps} grasp{'s' * (self.grasps > 1)}"] * (self.grasps > 0)
        if self.error_mm is not None:
            parts.append("opening" + f" with an error of {self.error_mm:g} mm" * (self.error_mm > 0))
        return ", ".join(parts)


CONTENTS = (Content(True, 0), Content(False, 1), Content(True, 1))


@dataclass(frozen=True, eq=False)
class Ratios:
    """Log likelihood ratios (Q, O) of the objects of a catalogue for queries of the objects `owner` (Q,).

    Objects from O on are not in the catalogue.
    """

    values: Floats
    owner: Numbers


def main(argv: Sequence[str] | None = None) -> int:
    """Collect the grasps, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", type=int, default=OBJECTS)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    folder, objects = arguments.folder, arguments.objects
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder / "gels.toml"
    rig.write_text(f'rig = "sim"\ngels = {GELS}\n')
    size = ("--objects", objects + SPARE, "--grasps", 1 + QUERIES, "--seed", SEED, "--jobs", arguments.jobs)
    if code := retrieve("collect", "--rig", rig, *size, "--out", folder / "unseen"):
        return code
    every = by_object(load_grasps(folder / "unseen"))
    grasps = dict([one for one in every.items() if len(one[1]) > QUERIES][:objects])
    checkpoint = load_checkpoint(shipped_model())
    references, queries = ({name: part[some] for name, part in grasps.items()} for some in (slice(1), slice(1, None)))
    found = {
        str(content): measures(answer(folder, checkpoint, content, references, queries), min(CATALOGUE, objects - 1))
        for content in CONTENTS
    }
    text = table(found, str(CONTENTS[0]))
    (folder / "grasp.md").write_text(text + "\n")
    print(text)
    return 0


def by_object(grasps: Sequence[Grasp]) -> dict[str, list[Grasp]]:
    """Return the grasps of each object."""
    found: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        found.setdefault(grasp.object_id, []).append(grasp)
    return found


def answer(
    folder: Path,
    checkpoint: Checkpoint,
    content: Content,
    references: Mapping[str, Sequence[Grasp]],
    queries: Mapping[str, Sequence[Grasp]],
) -> Ratios:
    """Build an index of the references with this content, and return its answers to each query."""
    catalogue, index = folder / "catalog", folder / "index"
    shutil.rmtree(catalogue, ignore_errors=True)
    for name, grasps in references.items():
        (catalogue / name).mkdir(parents=True)
        if content.photo:
            shutil.copyfile(grasps[0].photo, catalogue / name / f"photo{grasps[0].photo.suffix}")
        for number, grasp in enumerate(grasps[: content.grasps]):
            for finger, file in zip("ab", grasp.touches, strict=False):
                shutil.copyfile(file, catalogue / name / f"touch_{number}_{finger}{file.suffix}")
    retrieval.build_index(catalogue, checkpoint, index, quiet=True)
    numbers = {name: number for number, name in enumerate([*references, *(queries.keys() - references.keys())])}
    asked = [(numbers[name], grasp) for name, grasps in queries.items() for grasp in grasps]
    values = np.full((len(asked), len(references)), REFUSED)
    with retrieval.open(index) as searcher:
        results = searcher.query_many([list(grasp.touches) for _, grasp in asked], top=len(references))
        for row, result in zip(values, results, strict=True):
            for match in result.results:
                row[numbers[match.object_id]] = searcher.posterior.log_ratio(match.logit, 1)
    return Ratios(values, np.array([number for number, _ in asked]))


def measures(ratios: Ratios, size: int) -> dict[str, Measure]:
    """Return top-1 accuracy and "none of these" of queries whose objects are all in the catalogue."""
    values, owner, count = ratios.values, ratios.owner, ratios.values.shape[1]
    scores = ScoreTable(values, owner, np.arange(count), np.zeros(values.shape, bool))
    found = {f"K = {k}": top1(scores, k, 1) for k in CANDIDATES if k <= count}
    rng, present, absent = np.random.default_rng(0), list[Floats](), list[Floats]()
    rows = np.arange(len(owner))
    for _ in range(DRAWS):
        keys = rng.random(values.shape)
        keys[rows, owner] = -1  # the own object is drawn first
        drawn = np.take_along_axis(values, np.argsort(keys, axis=1)[:, : size + 1], 1)
        present.append(drawn[:, :-1])
        absent.append(drawn[:, 1:])
    return found | open_set(np.array(present), np.array(absent), owner, owner)


def open_set(present: Floats, absent: Floats, listed: Numbers, unlisted: Numbers) -> dict[str, Measure]:
    """Return AUROC and verdicts of queries whose object is in the catalogue, and of others.

    Args:
        present: (D, P, K) log likelihood ratios of K objects in D draws, for queries of listed objects.
        absent: (D, A, K) the same for queries of objects that are not listed.
        listed: (P,) objects of the first queries.
        unlisted: (A,) objects of the others.
    """
    above, below = np.zeros(len(listed)), np.zeros(len(unlisted))
    for with_it, without in zip(present, absent, strict=True):
        with_score, without_score = statistic(with_it), statistic(without)
        above += weight_below(with_score, without_score, object_weights(unlisted)) / len(present)
        below += (1 - weight_below(without_score, with_score, object_weights(listed))) / len(present)
    matched = [(part.max(2) > np.log(part.shape[2])).mean(0) for part in (present, absent)]
    gallery = f"{present.shape[2]} objects"
    return {
        '"none", AUROC': two_samples(above, below, listed, unlisted, gallery),
        "false accepts": Measure(matched[1][:, None], unlisted, np.array([0.5]), gallery),
        "false rejects": Measure(1 - matched[0][:, None], listed, np.array([0.5]), gallery),
    }


def two_samples(first: Floats, second: Floats, listed: Numbers, unlisted: Numbers, gallery: str) -> Measure:
    """Return a measure that is a mean over pairs of a query of each sample, given each query's mean over the others.

    Each object's value is a pseudo-value, so that the interval over objects has the variance of DeLong et al. (1988).
    """
    objects = np.union1d(listed, unlisted)
    values = np.full(len(objects), object_means(first[:, None], listed)[1].mean())
    for part, owner in ((first, listed), (second, unlisted)):
        names, means = object_means(part[:, None], owner)
        values[np.searchsorted(objects, names)] += len(objects) / len(names) * (means[:, 0] - means.mean())
    return Measure(values[:, None], objects, np.array([0.5]), gallery)


def table(found: Mapping[str, Mapping[str, Measure]], base: str) -> str:
    """Return a Markdown table of all contents, with the paired differences to the content `base`."""
    names = list(found[base])
    lines = ["| catalogue | " + " | ".join(f"{name} | difference" for name in names) + " |"]
    lines.append("|---|" + "---|---|" * len(names))
    for content, each in found.items():
        cells = []
        for name in names:
            summary, against = summarise([each[name]]), compare([each[name]], [found[base][name]])
            cells.append(interval(summary.value[0], summary.low[0], summary.high[0]))
            cells.append("" if content == base else interval(against.value, against.low, against.high))
        lines.append(f"| {content} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
