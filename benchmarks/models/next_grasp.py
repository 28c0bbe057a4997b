"""What a further grasp tells, compared with `next_grasp_bits` of the answer before it (`retrieval.model.information`).

    python -m benchmarks.models.next_grasp RECORDING --photos 2

The photos of each object's first grasps are the catalogue; of its other grasps one to three are asked about, and one
more is made: how far the answer moves (Kullback-Leibler divergence) and its entropy falls. Catalogues of 20
and 100 objects, with the object and without it in turn, with the shipped checkpoint, which must not have seen them.
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
    """Match logits (T, N) of touches with photos, whose they are (T,), (N,), and the posterior."""
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
        shown = [names.index(row["object_id"]) for row in searcher.generation.rows]
        logits, owners = [], []
        for number, name in enumerate(names):
            codes = searcher.encode([[str(path) for path in grasp.touches] for grasp in grasps[name][photos:]])
            logits += [searcher.scorer.logits(partial[None], partials) for partial in codes.partials]
            owners += [number] * len(codes.partials)
        return np.array(logits, dtype=np.float64), np.array(owners), np.array(shown), searcher.posterior


def answer(posterior, logits, shown, catalogue, grasps):
    """Probabilities of a catalogue's objects, of none last; and the information of this answer."""
    here = np.isin(shown, catalogue)
    owner = np.searchsorted(catalogue, shown[here])
    objects = posterior.object_logits(logits[here], owner, np.bincount(owner), grasps)
    belief = posterior.probabilities(objects, grasps)
    told = information(
        posterior, grasps, belief.none, belief.objects.tolist(), objects=len(catalogue), none_prior=NONE_PRIOR
    )
    return np.append(belief.objects, belief.none), told


def measured(logits, owners, shown, posterior, size, grasps, draw):
    """Of each question the bits that were expected, by which the answer moved, and by which its entropy fell."""
    found, names = [], np.unique(owners)
    for name in names:
        mine = np.flatnonzero(owners == name)
        for number in range(DRAWS if len(mine) > grasps else 0):
            *have, more = draw.permutation(mine)[: grasps + 1]
            others = draw.permutation(names[names != name])[:size]
            catalogue = np.sort(others if number % 2 else np.append(others[1:], name))
            before, told = answer(posterior, logits[have].sum(0), shown, catalogue, grasps)
            after, later = answer(posterior, logits[[*have, more]].sum(0), shown, catalogue, grasps + 1)
            kept = after > 0
            moved = np.sum(after[kept] * np.log2(after[kept] / before[kept]))
            found.append((told.next_grasp_bits, moved, told.remaining_bits - later.remaining_bits))
    return np.array(found)


def main():
    """Print a row for each size of the catalogue and number of grasps: means, and by thirds of what was expected."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--photos", type=int, default=2, help="grasps of each object whose photos are the catalogue")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        material = score_touches(Path(folder), asked.recording, asked.photos)
    for size in SIZES:
        for grasps in GRASPS:
            found = measured(*material, size, grasps, np.random.default_rng([size, grasps]))
            thirds = np.array_split(found[np.argsort(found[:, 0])], 3)
            told = [" / ".join(f"{value:.3f}" for value in part.mean(0)) for part in (found, *thirds)]
            print(f"{size:4} objects, {grasps} grasps, {len(found)} asked: expected / moved / fell {', '.join(told)}")


if __name__ == "__main__":
    sys.exit(main())
