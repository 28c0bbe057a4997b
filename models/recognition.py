"""Recognition of one object among 10, 100 and 1,000, and of objects that the catalogue lacks.

    python -m models.recognition RECORDING --distractors PHOTOS --out FOLDER --model old=A --model new=B

RECORDING holds grasps of objects that no model was trained on; rows with five grasps and three photos need eight of
each. PHOTOS is a folder to which one photo of each of 1,000 further objects of the catalogue is collected. Every query
is one to five grasps of an object. Every candidate has photos that were not taken in these grasps. Top-1 accuracies are
means over draws of the other candidates; intervals resample the touched objects. A model with late interaction is also
scored without its cells, as in an index of `build-index --no-cells`. Differences are to the first model, on the same
queries. A touch that the gel check refuses gives no evidence. It writes FOLDER/recognition.json, and reuses the
features of RECORDING.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, softmax

from models.pictures import collect_pictures
from retrieval.console.progress import Bar, show_progress
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.data.loading import map_in_order, worker_pool
from retrieval.evaluation.reject import reject
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure
from retrieval.metrics.table import ScoreTable, object_scores
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import batches, photo_features
from retrieval.model.posterior import Posterior
from retrieval.report import numbers
from retrieval.search.opening import find_model
from retrieval.training.calibration.checkpoint import refused_touches
from retrieval.training.calibration.posterior import IdentificationTrials
from retrieval.training.calibration.scores import score_grasps
from retrieval.training.calibration.verification import verification_sequences
from retrieval.training.distil import feature_partials
from retrieval.training.features import encode_recording

QUERIES = ((1, 1), (2, 1), (3, 3), (5, 3))
"""Grasps of a query, and photos of a touched candidate."""
CANDIDATES = (10, 100, 1000)
SETS = 4
"""Sets of several grasps of each object."""
CATALOGUE = 100
"""Objects for "none of these"; each catalogue leaves one of them out."""
DRAWS = 4
SURE, STATED_FAR = 0.9, 0.1
"""Smallest stated probability, and false-accept rate, that are compared with what happens."""
DISTRACTORS, SEED = 1000, 181_000
"""Photo-only objects, and the seed of their object set."""
interval = partial(numbers.interval, write="{:.3f}".format)
"""Writes a value with its interval."""


def main(argv: Sequence[str] | None = None) -> int:
    """Score every model and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--distractors", type=Path, help="folder of photo-only objects")
    parser.add_argument("--model", action="append", required=True, help="NAME=FILE; FILE may be `shipped`")
    parser.add_argument("--first-finger", action="store_true", help="use only finger a")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    show_progress()
    arguments.out.mkdir(parents=True, exist_ok=True)
    grasps = load_grasps(arguments.recording)
    if arguments.first_finger:
        grasps = [replace(each, touches=each.touches[:1], backgrounds=each.backgrounds[:1]) for each in grasps]
    found: dict[str, dict[str, Measure]] = {}
    for name, _, file in (choice.partition("=") for choice in arguments.model):
        checkpoint = load_checkpoint(find_model(file)[0])
        found[name] = measures(checkpoint, grasps, arguments.distractors, arguments.out / "features")
        print(f"{name}: {statements(checkpoint, grasps, arguments.out / 'features')}")
        if checkpoint.config.matcher.cell_dim:
            pooled = checkpoint.without_cells()
            found[f"{name}, no cells"] = measures(pooled, grasps, arguments.distractors, arguments.out / "features")
    first = next(iter(found.values()))
    rows: dict[str, dict[str, Any]] = {
        name: {
            key: {
                **asdict(summarise([value])),
                "against_first": asdict(compare([value], [first[key]])),
            }
            for key, value in each.items()
        }
        for name, each in found.items()
    }
    (arguments.out / "recognition.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))
    return 0


def measures(
    checkpoint: Checkpoint, grasps: Sequence[Grasp], distractors: Path | None, cache: Path
) -> dict[str, Measure]:
    """Return the measures of a checkpoint by name."""
    features = encode_recording(grasps, checkpoint.matcher, checkpoint.config, cache)
    touches, photos = feature_partials(checkpoint.matcher, features)
    owner, objects = features.owner, len(set(features.object_ids))
    others = photos[:0]
    if distractors:
        pictures = collect_pictures("photo", distractors, objects=DISTRACTORS, seed=SEED, jobs=2)
        others = photo_partials(checkpoint, [picture.file for picture in pictures])
    photo_owner = np.concatenate([owner, objects + np.arange(len(others))])
    scores = all_scores(checkpoint, touches, torch.cat([photos, others]))
    scores[refused_touches(checkpoint, torch.from_numpy(features.touch_rows))] = np.median(scores)
    found: dict[str, Measure] = {}
    for count, shown in QUERIES:
        queries = grasp_sets(owner, count, shown)
        if not len(queries):
            continue
        own = np.zeros((len(queries), len(photo_owner)), dtype=bool)
        np.put_along_axis(own, queries, True, axis=1)
        scored = ScoreTable(scores[queries].sum(1), owner[queries[:, 0]], photo_owner, own)
        what = f"{count} grasp{'s' * (count > 1)}, {shown} photo{'s' * (shown > 1)}"
        for k in CANDIDATES:
            if len(scored.objects) >= k:
                found[f"K = {k:,}, {what}"] = top1(scored, k, shown)
        if checkpoint.posterior is not None and objects >= CATALOGUE:
            small = scored.select(scored.touch_owner < CATALOGUE, photo_owner < CATALOGUE)
            weighted = replace(small, scores=checkpoint.posterior.weight(count) * small.scores)
            found[f"none of these, AUROC, {what}"] = reject(Posterior(1.0, checkpoint.posterior.offset), weighted).auroc
    return found


def statements(checkpoint: Checkpoint, grasps: Sequence[Grasp], cache: Path) -> str:
    """Return how well stated probabilities and a stated false-accept rate hold on these objects.

    The catalogue has all objects but one (at most 1,000), with all photos but the query's own. The probability is that
    of one grasp, at even odds of "none of these". The rates are those of a claim within four grasps.
    """
    posterior, calibration = checkpoint.posterior, checkpoint.verification
    if posterior is None or calibration is None:
        return "the model states no probabilities or error rates"
    features = encode_recording(grasps, checkpoint.matcher, checkpoint.config, cache)
    touches, photo_rows = (torch.from_numpy(part) for part in (features.touch_rows, features.photo))
    photos = {grasp.photo: row for grasp, row in zip(grasps, photo_rows, strict=True)}
    scored = score_grasps(checkpoint.matcher, grasps, touches, photos)
    assert scored is not None
    checked = scored.without_evidence(refused_touches(checkpoint, touches))
    sets = scored.draw_sets(1, None, np.random.default_rng(0))
    trials = IdentificationTrials.of(checked, sets)
    present = trials.catalogues[-1][:, :-1]
    ratios = np.take_along_axis(trials.log_ratios(posterior), present, 1) - np.log(present.shape[1])
    stated = softmax(np.column_stack([np.zeros(len(ratios)), ratios]), axis=1)[:, 1:]
    sure = stated.max(1) >= SURE
    bounds = calibration.bounds(STATED_FAR)
    claims, genuine = verification_sequences(scored, posterior), verification_sequences(checked, posterior)
    measured = {f"stated {SURE} and more is right": (stated.argmax(1)[sure] == 0, scored.touch_owner[sets[sure, 0]])}
    if claims is not None and genuine is not None:  # enough grasps of an object
        false_accepts, false_rejects = claims.impostor >= bounds.accept, genuine.ratios.max(1) < bounds.accept
        measured[f"false accepts at a stated {STATED_FAR}"] = false_accepts.mean(1), claims.owner
        measured["false rejects"] = false_rejects, genuine.owner
    parts = []
    for what, (values, owner) in measured.items():
        if not len(values):
            continue
        parts.append(f"{what}: {mean_interval(values, owner)} of {len(values)}")
    return "; ".join(parts)


def mean_interval(values: ArrayLike, owner: NDArray[np.int64]) -> str:
    """Return the mean of values (N,) with its interval over their objects (N,)."""
    cell = summarise([Measure(np.asarray(values, float)[:, None], owner, np.zeros(1), "")])
    return interval(cell.value[0], cell.low[0], cell.high[0])


def top1(table: ScoreTable, k: int, photos: int) -> Measure:
    """Return the top-1 accuracy of each row among its object and k - 1 random others, in closed form.

    Of n others, b score higher and e equal. The row's object is first with probability
    [C(n - b + 1, k) - C(n - b - e, k)] / [(e + 1) C(n, k - 1)]: no higher one is drawn, and ties are broken at random.
    """
    scores = object_scores(table, photos, DRAWS, seed=0)
    true = np.take_along_axis(scores, np.searchsorted(table.objects, table.touch_owner)[None, :, None], 2)
    higher, equal = (scores > true).sum(2), (scores == true).sum(2) - 1
    n = len(table.objects) - 1
    first, all_tied_lost, draws = (
        log_binomial(count, size) for count, size in ((n - higher + 1, k), (n - higher - equal, k), (n, k - 1))
    )
    values = ((np.exp(first - draws) - np.exp(all_tied_lost - draws)) / (equal + 1)).mean(0)
    return Measure(values[:, None], table.touch_owner, np.array([1 / k]), f"{k} of these objects: {table.gallery}")


def log_binomial(n: NDArray[np.int64] | int, k: int) -> NDArray[np.float64]:
    """Return log C(n, k); -inf if n < k."""
    n = np.asarray(n, dtype=np.float64)
    logarithm = gammaln(n + 1) - gammaln(np.maximum(n - k, 0) + 1) - gammaln(k + 1)
    return np.asarray(np.where(n >= k, logarithm, -np.inf))


def grasp_sets(owner: NDArray[np.int64], count: int, photos: int) -> NDArray[np.int64]:
    """Return rows (S, count): `count` grasps of one object that has at least `photos` other grasps."""
    if count == 1:
        return np.array([[row] for row in range(len(owner)) if (owner == owner[row]).sum() > photos])
    rng = np.random.default_rng([0, count])
    each = [np.flatnonzero(owner == name) for name in np.unique(owner)]
    drawn = [
        rng.choice(rows, count, replace=False) for rows in each if len(rows) >= count + photos for _ in range(SETS)
    ]
    return np.array(drawn, dtype=np.int64).reshape(-1, count)


@torch.inference_mode()
def photo_partials(checkpoint: Checkpoint, files: Sequence[Path], camera: PhotoCamera = USUAL_CAMERA) -> torch.Tensor:
    """Return partial activations (N, partial) of photos by this camera."""
    encoded, load_photo = [], partial(checkpoint.config.preprocessing.load_photo, camera=camera)
    with Bar("encode photos", len(files), "photos") as bar, worker_pool() as pool:
        for images in batches(map_in_order(pool, load_photo, files), 32):
            features = photo_features(checkpoint.matcher, images)
            encoded.append(checkpoint.matcher.photo_encoding(features).partial)
            bar.advance(len(images))
    return torch.cat(encoded)


@torch.inference_mode()
def all_scores(checkpoint: Checkpoint, touches: torch.Tensor, photos: torch.Tensor) -> NDArray[np.float32]:
    """Return match logits (T, N)."""
    parts = []
    with Bar("score", len(touches), "touches") as bar:
        for part in torch.split(touches, 4):
            score = partial(checkpoint.matcher.head.eval().all_logits, part)
            parts.append(torch.cat([score(some) for some in torch.split(photos, 512)], dim=1))
            bar.advance(len(part))
    return np.asarray(torch.cat(parts).numpy())


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return a Markdown table of all measures and models."""
    first = next(iter(rows))
    headings = [first, *(part for name in rows if name != first for part in (name, f"{name} - {first}"))]
    lines = ["| measure | chance | " + " | ".join(headings) + " |", "|---|---|" + "---|" * len(headings)]
    for key, summary in rows[first].items():
        if not all(key in each for each in rows.values()):  # a model without a posterior has no "none of these"
            continue
        cells = [f"{summary['chance'][0]:.3f}"]
        for name, each in rows.items():
            cells.append(interval(*(each[key][part][0] for part in ("value", "low", "high"))))
            if name != first:
                cells.append(interval(*(each[key]["against_first"][part] for part in ("value", "low", "high"))))
        lines.append(f"| {key} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
