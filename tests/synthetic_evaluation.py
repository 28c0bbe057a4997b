"""A made-up evaluation of a recording: results.json and timings.json as `retrieve evaluate` writes them, drawn from a
seed. The numbers mean nothing; their shapes and ranges are real."""

import json

import numpy as np

from retrieval.data.dataset import load_grasps, make_split
from retrieval.evaluation import SCHEMA_VERSION
from retrieval.evaluation.audit import audit
from retrieval.model.posterior import Posterior

SKILL = {
    "late_fusion": 1.6,
    "set_fusion": 1.7,
    "retrieve_rerank": 1.55,
    "contrastive": 1.2,
    "contrastive_sigmoid": 1.1,
    "cca": 0.7,
    "plsca": 0.45,
    "chance": 0.0,
    "constant": 0.0,
}
RANKS = ("recall_1", "recall_5", "recall_10", "mrr", "map")


def summary(
    rng, value, chance, *, queries=792, objects=18, gallery="18 unseen objects, 792 photos; own photo left out"
):
    """A summary of results.json around the values (m,)."""
    value, width = np.atleast_1d(value), rng.uniform(0.02, 0.06)
    by_seed = np.clip(value + rng.normal(0, 0.01, (3, len(value))), 0, 1)
    return {
        "value": value.tolist(),
        "low": np.clip(value - width, 0, 1).tolist(),
        "high": np.clip(value + width, 0, 1).tolist(),
        "chance": np.atleast_1d(chance).tolist(),
        "queries": 792,
        "objects": 18,
        "gallery": "18 unseen objects, 792 photos; own photo left out",
        "by_seed": by_seed.tolist(),
    }


def curve(skill, k):
    """A guess curve that ends at 1; the diagonal for no skill."""
    return (np.arange(1, k + 1) / k) ** (1 / (1 + 2.2 * skill))


def measures(rng, skill):
    """Every measure of one method."""
    flat = {"pair_accuracy": (0.5 + 0.22 * skill, 0.5), "pair_auc": (0.5 + 0.26 * skill, 0.5)}
    for k in (5, 10):
        flat[f"topn_k{k}"] = (curve(skill, k), np.arange(1, k + 1) / k)
    for count in (1, 2, 3, 5, 8, 12, 20):
        flat[f"topn_k5_g{count}_p3"] = (curve(skill * (1 + 0.35 * np.log(count)), 5), np.arange(1, 6) / 5)
    for count in (2, 3, 5, 10, 20):
        flat[f"topn_k5_p{count}"] = (curve(skill * (1 + 0.1 * np.log(count)), 5), np.arange(1, 6) / 5)
    flat["topn_k5_all_objects"] = (curve(skill * 0.9, 5), np.arange(1, 6) / 5)
    for prefix in ("", "photo_to_touch_"):
        flat |= {f"{prefix}{key}": (0.06 + 0.2 * skill + 0.05 * at, 0.06 + 0.05 * at) for at, key in enumerate(RANKS)}
    flat |= dict.fromkeys(("objectfolder_touch_to_photo", "objectfolder_photo_to_touch"), (0.08 + 0.2 * skill, 0.07))
    flat |= {"paired_top1": (0.002 + 0.02 * skill, 0.0013), "paired_top5": (0.006 + 0.06 * skill, 0.0063)}
    return {name: summary(rng, value, chance) for name, (value, chance) in flat.items()}


def reliability(rng):
    """A diagram with ten bins, one of them empty."""
    centres = np.linspace(0.05, 0.95, 10)
    shares = np.clip(centres + rng.normal(0, 0.04, 10), 0, 1)
    counts = rng.integers(5, 5000, 10)
    counts[3] = 0
    bins = [
        {"probability": float(p), "frequency": float(s) if n else None, "count": int(n)}
        for p, s, n in zip(centres, shares, counts, strict=True)
    ]
    return {"ece": float(np.abs(centres - shares).mean()), "bins": bins}


def roc(skill):
    """Hits against false alarms."""
    alarms = np.linspace(0, 1, 60)
    return [[float(x), float(x ** (1 / (1 + skill)))] for x in alarms]


def decision(rng, skill):
    """How well "one of these" and "none of these" are parted."""
    return {
        "auroc": summary(rng, min(0.5 + 0.18 * skill, 1), 0.5),
        "false_accepts_at_95": summary(rng, max(0.95 - 0.3 * skill, 0), 0.95),
    }


def risk_coverage(skill):
    """Wrong first guesses against answers: more of them the more are answered, half of them where all are right."""
    share = np.linspace(0.02, 1, 50)
    return [[float(x), float((1 - 0.5 * curve(skill, 5)[0]) * x ** (0.5 * skill))] for x in share]


def examples(rng, grasps, objects, best):
    """Six queries with six photos each, mostly right or all wrong."""
    own = [grasp for grasp in grasps if grasp.object_id in objects]
    queries = []
    for at in rng.permutation(len(own))[:6]:
        same = [grasp.grasp_id for grasp in own if grasp.object_id == own[at].object_id and grasp is not own[at]]
        other = [grasp.grasp_id for grasp in own if grasp.object_id != own[at].object_id]
        ranked = rng.permutation(same)[: 3 if best else 0].tolist()
        ranked += rng.permutation(other)[: 6 - len(ranked)].tolist()
        rank = 1 if best else int(rng.integers(60, 500))
        queries.append(
            {"grasp_id": own[at].grasp_id, "object_id": own[at].object_id, "true_rank": rank, "ranked": ranked}
        )
    return queries


def some(rng, grasps, objects):
    """Two touches of these objects, each with the grasp of a photo that was found for it."""
    own = [grasp for grasp in grasps if grasp.object_id in objects]
    found = [grasp.grasp_id for grasp in grasps]
    return [
        {"grasp_id": own[at].grasp_id, "object_id": own[at].object_id, "found": str(rng.choice(found))}
        for at in rng.permutation(len(own))[:2]
    ]


def method(rng, name, grasps, split):
    """All that results.json says of one method."""
    skill = SKILL.get(name, 0.9)
    test, everyone = split["test"], [*split["train"], *split["validation"], *split["test"]]
    share = float(curve(skill, 5)[0])
    draw = {item: float(np.clip(rng.normal(share, 0.2), 0, 1)) for item in everyone}
    pairs = [rng.choice(test, 2, replace=False).tolist() for _ in range(min(12, len(test)))]
    shares = sorted(rng.uniform(0.1, 0.8, len(pairs)), reverse=True)
    return {
        "best_params": [{"components": 64, "ridge": 0.1, "p": 2, "seed": seed} for seed in range(3)]
        if skill
        else [{}] * 3,
        "measures": measures(rng, skill),
        "per_object": {"test_candidates": {item: draw[item] for item in test}, "all_candidates": draw},
        "confusions": [
            {"object_id": a, "mistaken_for": b, "share": float(s), "grasps": some(rng, grasps, [a])}
            for (a, b), s in zip(pairs, shares, strict=True)
        ],
        "examples_by_rank": {str(k): [some(rng, grasps, test) for _ in range(k)] for k in (5, 10)},
        "reliability": {kind: reliability(rng) for kind in ("pairs", "k5", "k10", "k5_g5")},
        "calibration": {
            "pairs": {"1": {"slope": 0.9, "intercept": -0.1}},
            "posteriors": {str(count): Posterior(slope=0.9 / count).to_dict() for count in (1, 3)},
        },
        "reject": {
            **decision(rng, skill),
            "balanced_accuracy": summary(rng, 0.5 + 0.12 * skill, 0.5),
            "roc": roc(skill),
            "risk_coverage": risk_coverage(skill),
            "by_grasps": {str(count): decision(rng, skill * (1 + 0.35 * np.log(count))) for count in (1, 3)},
        },
        "examples": {"best": examples(rng, grasps, test, True), "worst": examples(rng, grasps, test, False)},
    }


CEILINGS = {"touch_to_touch": "felt twice", "photo_to_photo": "seen twice"}
CONTROLS = {
    "no_contact": "the frame before contact stands in for the touch, in fitting and in judging",
    "low_pass": "each gel image reduced to 8 x 6 pixels, in fitting and in judging",
    "shuffled": "touches dealt to other training objects before fitting, so that there is nothing to learn",
}


def synthetic_results(recording, methods=tuple(SKILL), seed=0):
    """(results, timings) of an evaluation of the recording."""
    rng, grasps = np.random.default_rng(seed), load_grasps(recording)
    split = make_split(grasps, validation=0.16, test=0.2, seed=seed)
    found = {name: method(rng, name, grasps, split.to_dict()) for name in methods}
    results = {
        "schema_version": SCHEMA_VERSION,
        "software": "0.1.0",
        "recording": {
            "path_name": recording.name,
            "source": "simulated rig",
            "digest": "ab" * 32,
            "objects": len({grasp.object_id for grasp in grasps}),
            "grasps": len(grasps),
        },
        "split": split.to_dict(),
        "setting": {
            "preset": "mobilenet",
            "config": {"matcher": {"tower": "mobilenet"}, "training": {"iterations": 2000}},
            "seeds": [0, 1, 2],
            "draws": 10000,
            "features": {"touch": 1280, "photo": 1280, "fingers": 2, "digest": "cd" * 32},
        },
        "audit": audit(grasps, split, quiet=True),
        "methods": found,
        "controls": {
            name: {
                "description": what,
                "measures": {
                    "pair_accuracy": summary(rng, 0.5 + 0.05 * (name == "low_pass"), 0.5),
                    "topn_k5": summary(rng, curve(0.3 * (name == "low_pass"), 5), np.arange(1, 6) / 5),
                },
            }
            for name, what in CONTROLS.items()
        },
        "ceilings": {
            name: {
                "description": what,
                "measures": {
                    "pair_accuracy": summary(rng, 0.9, 0.5),
                    "topn_k5": summary(rng, curve(0.8, 5), np.arange(1, 6) / 5),
                },
            }
            for name, what in CEILINGS.items()
        },
        "low_contact": {
            "change": 2.5,
            "touches": 40,
            "methods": {
                name: {
                    part: {"topn_k5": summary(rng, curve(skill, 5), np.arange(1, 6) / 5)}
                    for part, skill in (("low_contact", 0.2), ("others", 0.8))
                }
                for name in methods
            },
        },
        "comparisons": [
            {
                "a": methods[0],
                "b": other,
                "measure": key,
                "difference": 0.12,
                "low": 0.06,
                "high": 0.18,
                "p": 0.0021,
            }
            for other in methods[1:]
            for key in ("pair_accuracy", "topn_k5")
        ],
    }
    return results, timings(rng, methods)


def timings(rng, methods):
    """Times between a microsecond and a minute."""
    return {
        "machine": {"cpus": 2, "threads": 1},
        "encode": {"touch_ms": 14.2, "photo_ms": 21.8, "where": "towers"},
        "methods": {
            name: {
                "fit_s": 60.0 * SKILL.get(name, 0.9),
                "encode_touch_ms": 0.21,
                "encode_photo_ms": 0.14,
                "score_us_per_photo": 1.3,
                "query_ms": float(10 ** rng.uniform(-1.5, 1.5)),
            }
            for name in methods
        },
    }


def write_synthetic_results(recording, out, methods=tuple(SKILL), change=None):
    """Write the evaluation under `out`, after `change(results)` where given; returns `out`."""
    results, times = synthetic_results(recording, methods)
    if change:
        change(results)
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_text(json.dumps(results, sort_keys=True))
    (out / "timings.json").write_text(json.dumps(times, sort_keys=True))
    return out
