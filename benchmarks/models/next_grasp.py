"""Information of a further grasp, compared with `next_grasp_bits` of the answer before it.

    python -m benchmarks.models.next_grasp RECORDING --photos 2

The photos of each object's first grasps are the catalogue. One to three of its other grasps form a query, and one more
grasp is added: this measures the change of the answer (Kullback-Leibler divergence) and the decrease of its entropy.
Catalogues have 20 and 100 objects, with the object and without it in turn. The shipped checkpoint must not have been
trained on them. The estimate is in `retrieval.model.information`.
"""

import argparse
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from retrieval.data.dataset import load_grasps
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.information import information
from retrieval.model.posterior import NONE_PRIOR
from retrieval.search.build.build_index import build_index
from retrieval.search.defaults import shipped_model
from retrieval.search.query.searcher import Searcher

SIZES, GRASPS, DRAWS = (20, 100), (1, 2, 3), 8


def score_touches(folder, recording, photos):
    """Return match logits (T, N) of touches with photos, their objects (T,), (N,), and the posterior."""
    grasps = defaultdict(list)
    for grasp in load_grasps(recording):
        grasps[grasp.object_id].append(grasp)
    names = sorted(name for name, some in grasps.items() if len(some) > photos)
    for name in names:
        (folder / "catalog" / name).mkdir(parents=True)
        for number, grasp in enumerate(grasps[name][:photos]):
            (folder / "catalog" / name / f"{number}{grasp.photo.suffix}").symlink_to(grasp.photo.resolve())
    build_index(folder / "catalog", load_checkpoint(shipped_model()), folder / "index", quiet=True)
    with Searcher.open(folder / "index") as searcher:
        partials = searcher.generation.arrays["partials"]
        photo_objects = [names.index(row["object_id"]) for row in searcher.generation.rows]
        logits, owners = [], []
        for number, name in enumerate(names):
            codes = searcher.encode([[str(path) for path in grasp.touches] for grasp in grasps[name][photos:]])
            logits += [searcher.scorer.logits(partial[None], partials) for partial in codes.partials]
            owners += [number] * len(codes.partials)
        return np.array(logits, dtype=np.float64), np.array(owners), np.array(photo_objects), searcher.posterior


def answer(posterior, logits, shown, catalogue, grasps):
    """Return the probabilities of a catalogue's objects, with none last, and the information of this answer."""
    in_catalogue = np.isin(shown, catalogue)
    owner = np.searchsorted(catalogue, shown[in_catalogue])
    objects = posterior.object_logits(logits[in_catalogue], owner, np.bincount(owner), grasps)
    probabilities = posterior.probabilities(objects, grasps)
    estimate = information(
        posterior,
        grasps,
        probabilities.none,
        probabilities.objects.tolist(),
        objects=len(catalogue),
        none_prior=NONE_PRIOR,
    )
    return np.append(probabilities.objects, probabilities.none), estimate


def measured(logits, owners, shown, posterior, size, grasps, draw):
    """Return, for each query, the estimated bits, the bits of change, and the decrease of entropy."""
    found, names = [], np.unique(owners)
    for name in names:
        own = np.flatnonzero(owners == name)
        for number in range(DRAWS if len(own) > grasps else 0):
            *used, more = draw.permutation(own)[: grasps + 1]
            others = draw.permutation(names[names != name])[:size]
            catalogue = np.sort(others if number % 2 else np.append(others[1:], name))
            before, estimate = answer(posterior, logits[used].sum(0), shown, catalogue, grasps)
            after, later = answer(posterior, logits[[*used, more]].sum(0), shown, catalogue, grasps + 1)
            positive = after > 0
            divergence = np.sum(after[positive] * np.log2(after[positive] / before[positive]))
            found.append((estimate.next_grasp_bits, divergence, estimate.remaining_bits - later.remaining_bits))
    return np.array(found)


def main():
    """Print a row for each size of the catalogue and number of grasps: means, and means by thirds of the estimate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--photos", type=int, default=2, help="grasps of each object whose photos are the catalogue")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scored = score_touches(Path(folder), arguments.recording, arguments.photos)
    for size in SIZES:
        for grasps in GRASPS:
            found = measured(*scored, size, grasps, np.random.default_rng([size, grasps]))
            thirds = np.array_split(found[np.argsort(found[:, 0])], 3)
            texts = [" / ".join(f"{value:.3f}" for value in part.mean(0)) for part in (found, *thirds)]
            print(
                f"{size:4} objects, {grasps} grasps, {len(found)} queries: "
                f"estimated / divergence / entropy decrease {', '.join(texts)}"
            )


if __name__ == "__main__":
    sys.exit(main())
