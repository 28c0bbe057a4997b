"""Objects that were enrolled by touch: accuracy and "none of these" with photos, reference grasps and openings.

    python -m benchmarks.enrolment sessions FOLDER
        two rigs with one pair of gels each and 150 objects. 100 objects are enrolled by one to three grasps of one
        session. Queries are single grasps of the next session: of these objects, and of the 50 others
    python -m benchmarks.enrolment grasp FOLDER
        250 objects, 100 pairs of gels, four grasps of each object: one is enrolled with its photo, in turn, and the
        others are single queries. Openings are exact, or have the error of a gripper. Accuracies are means over all
        sets of K objects; for "none of these", catalogues of 100 objects have the query's object or lack it

No model was trained on these objects and gels. Intervals are 95 %, over objects; differences are paired. It writes
FOLDER/sessions.md or FOLDER/grasp.md. An interrupted run continues; FOLDER/answers has its answers. A query that is
refused (no contact) counts as a random guess with the verdict "none of these".
"""

import argparse
import json
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import retrieval
from models.recognition import interval, top1
from models.shipped import grasps_by_object, retrieve
from retrieval.data.dataset import Grasp, data_digest, load_grasps
from retrieval.data.opening import RANGE_MM
from retrieval.evaluation.reject import statistic
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure, object_means, object_weights, pooled, weight_below
from retrieval.metrics.table import ScoreTable
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import TorchEncoder
from retrieval.model.fusion_scorer import StoredPartials
from retrieval.model.gel_check import CONTACT
from retrieval.model.touch_reader import Stopwatch, TouchReader
from retrieval.model.touches import parse_grasps
from retrieval.search.opening import find_model

SEEDS, ENROLLED, OTHERS, REFERENCES = (531_000, 532_000), 100, 50, 3
"""Rigs of the part `sessions`; enrolled and other objects of each; grasps of each object in a session."""
SEED, OBJECTS, QUERIES, GELS = 540_000, 250, 3, 100
"""Rig of the part `grasp`; its objects, query grasps of each, and pairs of gels."""
SPARE = 12
"""Further objects, in place of objects that cannot be grasped."""
CANDIDATES, CATALOGUE, DRAWS = (100, 250), 100, 10
REFUSED = -50.0
"""Log likelihood ratio of every object for a query that is refused, and of an object whose references are refused."""

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
Grasps = Mapping[str, Sequence[Grasp]]


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

    def opening_mm(self, grasp: Grasp) -> float | None:
        """Return the opening of a grasp with the error."""
        if self.error_mm is None or grasp.opening_mm is None:
            return None
        error = np.random.default_rng(zlib.crc32(grasp.grasp_id.encode())).normal(0, self.error_mm)
        return float(np.clip(grasp.opening_mm + error, *RANGE_MM))


def main(argv: Sequence[str] | None = None) -> int:
    """Collect the grasps, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("sessions", "grasp"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", default="shipped", help="another checkpoint than the shipped one")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    folder, checkpoint = arguments.folder, load_checkpoint(find_model(arguments.model)[0])
    folder.mkdir(parents=True, exist_ok=True)
    part = sessions if arguments.part == "sessions" else one_grasp
    text = "\n\n".join(part(folder, checkpoint, arguments.jobs))
    (folder / f"{arguments.part}.md").write_text(text + "\n")
    print(text)
    return 0


def sessions(folder: Path, checkpoint: Checkpoint, jobs: int) -> Iterator[str]:
    """Yield the tables of enrolled objects in another session."""
    known, errors = (False, True), (None, 0.0)
    contents = [Content(photo, grasps, error) for grasps in (1, 2, 3) for error in errors for photo in known]
    found: dict[Content, list[dict[str, Measure]]] = {content: [] for content in (Content(True, 0), *contents)}
    for number, seed in enumerate(SEEDS):
        out = folder / f"rig-{seed}"
        for session, objects in (("monday", ENROLLED), ("tuesday", ENROLLED + SPARE + OTHERS)):
            size = ("--objects", objects + SPARE, "--grasps", REFERENCES, "--seed", seed, "--jobs", jobs)
            retrieve("collect", "--rig", "sim", *size, "--session", session, "--out", out)
        touched = grasps_by_object(load_grasps(out))
        monday, tuesday = (
            {name: [grasp for grasp in part if grasp.session == session] for name, part in touched.items()}
            for session in ("monday", "tuesday")
        )
        complete = [name for name, part in tuesday.items() if len(part) == REFERENCES]
        references = {name: monday[name] for name in complete if len(monday[name]) == REFERENCES}
        references = dict([*references.items()][:ENROLLED])
        queries = [*references, *[name for name in complete if not monday[name]][:OTHERS]]
        encoded = encode(checkpoint, {name: tuesday[name] for name in queries})
        for content, rigs in found.items():
            values = answer(out, checkpoint, content, references, encoded)
            rigs.append(enrolled_measures(values, encoded.owner, rig=number))
    joined = {
        content: {name: pooled([rig[name] for rig in rigs]) for name in rigs[0]} for content, rigs in found.items()
    }
    bases = {
        "touches only": lambda one: Content(False, one.grasps),
        "no opening": lambda one: replace(one, error_mm=None),
    }
    yield from tables(joined, bases | {"one grasp": lambda one: replace(one, grasps=1)})


def one_grasp(folder: Path, checkpoint: Checkpoint, jobs: int) -> Iterator[str]:
    """Yield the tables of one photo and one enrolled grasp."""
    rig = folder / "gels.toml"
    rig.write_text(f'rig = "sim"\ngels = {GELS}\n')
    size = ("--objects", OBJECTS + SPARE, "--grasps", 1 + QUERIES, "--seed", SEED, "--jobs", jobs)
    retrieve("collect", "--rig", rig, *size, "--out", folder / "unseen")
    touched = grasps_by_object(load_grasps(folder / "unseen"))
    complete = [(name, part) for name, part in touched.items() if len(part) > QUERIES][:OBJECTS]
    contents = [Content(True, 0), Content(False, 1), Content(False, 1, 0.0)]
    contents += [Content(True, 1, error) for error in (None, 0.0, 0.1, 1.0, 3.0)]
    every, found = encode(checkpoint, dict(complete)), dict[Content, dict[str, Measure]]()
    for content in contents:
        values, owners = [], []
        for turn in range(1 + QUERIES):
            references = {name: part[turn : turn + 1] for name, part in complete}
            asked = np.arange(len(every.owner)) % (1 + QUERIES) != turn
            queries = Queries(*(part[asked] for part in every))
            values.append(answer(folder / "unseen", checkpoint, content, references, queries))
            owners.append(queries.owner)
        found[content] = drawn_measures(np.concatenate(values), np.concatenate(owners))
    bases = {"photo": lambda one: Content(True, 0), "no opening": lambda one: replace(one, error_mm=None)}
    yield from tables(found, bases)


class Queries(NamedTuple):
    """Single grasps, their objects (Q,), partial activations (Q, P), and whether the gel check accepts them."""

    grasps: NDArray[np.object_]
    owner: Numbers
    partials: NDArray[np.float32]
    accepted: NDArray[np.bool_]


def encode(checkpoint: Checkpoint, queries: Grasps) -> Queries:
    """Encode all grasps; objects are numbered in this order."""
    grasps = [grasp for part in queries.values() for grasp in part]
    owner = np.repeat(np.arange(len(queries)), [len(part) for part in queries.values()])
    reader = TouchReader(checkpoint.config, TorchEncoder(checkpoint.matcher))
    touches = parse_grasps([list(grasp.touches) for grasp in grasps], reader.fingers)
    codes = reader.encode(touches, reader.no_contact_frames(None), Stopwatch())
    check, accepted = checkpoint.gel_check, np.ones(len(grasps), bool)
    if check is not None and codes.readings is not None:
        accepted = np.array(check.classify(codes.readings)) == CONTACT
    return Queries(np.array(grasps, dtype=object), owner, codes.partials, accepted)


def answer(recording: Path, checkpoint: Checkpoint, content: Content, references: Grasps, queries: Queries) -> Floats:
    """Build an index of the references with this content; return log likelihood ratios (Q, O) of its objects."""
    of_references = data_digest([grasp for part in references.values() for grasp in part])
    file = recording.with_name("answers") / f"{checkpoint.digest[:12]}, {of_references[:12]}, {content}.npy"
    if file.is_file():
        return np.asarray(np.load(file))
    catalogue, index = (recording.with_name(f"{recording.name}-{what}") for what in ("catalog", "index"))
    write_catalogue(catalogue, content, references)
    retrieval.build_index(catalogue, checkpoint, index)
    values = np.full((len(queries.grasps), len(references)), REFUSED)
    with retrieval.open(index) as searcher:
        shard, posterior = searcher.folder_shard, searcher.posterior
        objects, photos = shard.objects, StoredPartials(shard.generation.arrays)
        columns = np.array([objects.find(name) for name in references])
        for row in np.flatnonzero(queries.accepted):
            opening = np.array([content.opening_mm(queries.grasps[row])], dtype=np.float64)  # None becomes NaN
            partials = queries.partials[row : row + 1]
            evidence = objects.compare_references(partials, opening)
            logits = objects.score(np.arange(len(photos)), shard.scorer.logits(partials, photos), evidence, 1).logits
            values[row, columns >= 0] = posterior.log_ratio(logits, 1)[columns[columns >= 0]]
    file.parent.mkdir(exist_ok=True)
    np.save(file, values)
    return values


def write_catalogue(folder: Path, content: Content, references: Grasps) -> None:
    """Write a catalogue folder with this content of each object."""
    shutil.rmtree(folder, ignore_errors=True)
    lines = []
    for name, grasps in references.items():
        (folder / name).mkdir(parents=True)
        if content.photo:
            shutil.copyfile(grasps[0].photo, folder / name / f"photo{grasps[0].photo.suffix}")
        for number, grasp in enumerate(grasps[: content.grasps]):
            for finger, file in zip("ab", grasp.touches, strict=False):
                shutil.copyfile(file, folder / name / f"touch_{number}_{finger}{file.suffix}")
            touch = f"{name}/touch_{number}_a{grasp.touches[0].suffix}"
            lines.append(json.dumps({"file_name": touch, "opening_mm": content.opening_mm(grasp)}) + "\n")
    (folder / "metadata.jsonl").write_text("".join(lines))


def enrolled_measures(values: Floats, owner: Numbers, rig: int) -> dict[str, Measure]:
    """Return accuracy and "none of these" of ratios (Q, O), for queries (Q,) of objects 0 to O - 1 and of others."""
    count, listed = values.shape[1], owner < values.shape[1]
    scores = ScoreTable(values[listed], owner[listed], np.arange(count), np.zeros((listed.sum(), count), bool))
    parts = values[None, listed], values[None, ~listed], owner[listed], owner[~listed]
    found = {f"top-1 of {count}": top1(scores, count, 1)} | open_set(*parts)
    return {name: replace(each, owner=each.owner + 1000 * rig) for name, each in found.items()}


def drawn_measures(values: Floats, owner: Numbers) -> dict[str, Measure]:
    """Return accuracy and "none of these" of ratios (Q, O) in random parts of the catalogue, for queries (Q,)."""
    count = values.shape[1]
    scores = ScoreTable(values, owner, np.arange(count), np.zeros(values.shape, bool))
    rng, size, drawn = np.random.default_rng(0), min(CATALOGUE, count - 1), list[Floats]()
    for _ in range(DRAWS):
        keys = rng.random(values.shape)
        keys[np.arange(len(owner)), owner] = -1  # the own object is drawn first
        drawn.append(np.take_along_axis(values, np.argsort(keys, axis=1)[:, : size + 1], 1))
    every = np.array(drawn)
    found = {f"top-1 of {k}": top1(scores, k, 1) for k in CANDIDATES if k <= count}
    return found | open_set(every[..., :-1], every[..., 1:], owner, owner)


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


def tables(
    found: Mapping[Content, Mapping[str, Measure]], bases: Mapping[str, Callable[[Content], Content]]
) -> Iterator[str]:
    """Yield a Markdown table of each measure, with the paired differences to other contents."""
    for name in next(iter(found.values())):
        lines = [f"| {name} | value | " + " | ".join(f"difference to {base}" for base in bases) + " |"]
        lines.append("|---|---|" + "---|" * len(bases))
        for content, measures in found.items():
            summary = summarise([measures[name]])
            cells = [interval(summary.value[0], summary.low[0], summary.high[0])]
            for base in (choose(content) for choose in bases.values()):
                against = compare([measures[name]], [found.get(base, measures)[name]])
                cells.append(
                    interval(against.value, against.low, against.high) if base in found and base != content else ""
                )
            lines.append(f"| {content} | {' | '.join(cells)} |")
        yield "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
