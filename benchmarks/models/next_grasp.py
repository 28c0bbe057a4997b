"""What another grasp tells, beside what the page says that it may be expected to tell.

    python -m benchmarks.models.next_grasp RECORDING --photos 2

The photos of each object's first grasps are the catalogue; of its other grasps one to three are asked about, and one
more is made: how far the answer moves (Kullback-Leibler divergence) and its entropy falls. Catalogues of 20
and 100 objects, with the object and without it in turn, with the shipped checkpoint, which must not have seen them.
"""

import argparse
import math
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from retrieval.data.dataset import load_grasps
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build.build_index import build_index
from retrieval.search.defaults import shipped_model
from retrieval.search.query.searcher import Searcher

SIZES, GRASPS, DRAWS = (20, 100), (1, 2, 3), 8


def worth(grasps, dependence):
    """So many grasps of one object weigh as much as this many that know nothing of each other."""
    return grasps / (1 + dependence * (grasps - 1))


def expected_bits(left, grasps, dependence):
    """What another grasp may be expected to tell, of so many bits that are left."""
    return left * (1 - math.exp(worth(grasps, dependence) - worth(grasps + 1, dependence)))


def another_grasp(answer):
    """Bits that another grasp is expected to tell, bits that are left, and what all these grasps would weigh."""
    believed = np.array([*(match.probability for match in answer.results), answer.none_probability])
    grasps, dependence = answer.posterior["grasps"], answer.posterior["dependence"]
    left = entropy(believed)
    return expected_bits(left, grasps, dependence), left, worth(grasps + 1, dependence)


def entropy(believed):
    """In bits."""
    some = believed[believed > 0]
    return float(-np.sum(some * np.log2(some)))


def judged(folder, recording, photos):
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
        halves = searcher.generation.arrays["halves"]
        shown = [names.index(row["object_id"]) for row in searcher.generation.rows]
        logits, owners = [], []
        for number, name in enumerate(names):
            codes = searcher.encode([[str(path) for path in grasp.touches] for grasp in grasps[name][photos:]])
            logits += [searcher.judge.logits(half[None], halves) for half in codes.halves]
            owners += [number] * len(codes.halves)
        return np.array(logits, dtype=np.float64), np.array(owners), np.array(shown), searcher.posterior


def believed_of(posterior, logits, shown, catalogue, grasps):
    """Probabilities of a catalogue's objects, and of none, last."""
    here = np.isin(shown, catalogue)
    owner = np.searchsorted(catalogue, shown[here])
    objects = posterior.object_logits(logits[here], owner, np.bincount(owner), grasps)
    belief = posterior.believe(objects, grasps)
    return np.append(belief.objects, belief.none)


def measured(logits, owners, shown, posterior, size, grasps, draw):
    """Of each question the bits that were expected, by which the answer moved, and by which its entropy fell."""
    found, names = [], np.unique(owners)
    for name in names:
        mine = np.flatnonzero(owners == name)
        for number in range(DRAWS if len(mine) > grasps else 0):
            *have, more = draw.permutation(mine)[: grasps + 1]
            others = draw.permutation(names[names != name])[:size]
            catalogue = np.sort(others if number % 2 else np.append(others[1:], name))
            before = believed_of(posterior, logits[have].sum(0), shown, catalogue, grasps)
            after = believed_of(posterior, logits[[*have, more]].sum(0), shown, catalogue, grasps + 1)
            kept = after > 0
            moved = np.sum(after[kept] * np.log2(after[kept] / before[kept]))
            left = entropy(before)
            expected = expected_bits(left, grasps, posterior.dependence)
            found.append((expected, moved, left - entropy(after)))
    return np.array(found)


def main():
    """Print a row for each size of the catalogue and number of grasps: means, and by thirds of what was expected."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--photos", type=int, default=2, help="grasps of each object whose photos are the catalogue")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        material = judged(Path(folder), asked.recording, asked.photos)
    for size in SIZES:
        for grasps in GRASPS:
            found = measured(*material, size, grasps, np.random.default_rng([size, grasps]))
            thirds = np.array_split(found[np.argsort(found[:, 0])], 3)
            told = [" / ".join(f"{value:.3f}" for value in part.mean(0)) for part in (found, *thirds)]
            print(f"{size:4} objects, {grasps} grasps, {len(found)} asked: expected / moved / fell {', '.join(told)}")


if __name__ == "__main__":
    sys.exit(main())
