"""A synthetic evaluation of a recording: results.json and timings.json in the format of `retrieve evaluate`.

The numbers are random and mean nothing; their shapes and ranges are realistic.
"""

import msgspec
import numpy as np

from retrieval.data.dataset import load_grasps, make_split
from retrieval.evaluation.results import Results, Timings, write_results
from retrieval.metrics.registry import METRICS
from retrieval.model.posterior import Posterior

SKILL = {
    "late_fusion": 1.6,
    "retrieve_rerank": 1.55,
    "contrastive": 1.2,
    "cca": 0.7,
    "chance": 0.0,
}
RANKS = ("recall_1", "recall_5", "recall_10", "map")


def summary(rng, value, chance):
    """Return a summary of results.json around the values (m,)."""
    value, width = np.atleast_1d(value), rng.uniform(0.02, 0.06)
    by_seed = np.clip(value + rng.normal(0, 0.01, (3, len(value))), 0, 1)
    return {
        "value": value.tolist(),
        "low": np.clip(value - width, 0, 1).tolist(),
        "high": np.clip(value + width, 0, 1).tolist(),
        "chance": np.atleast_1d(chance).tolist(),
        "queries": 792,
        "objects": 18,
        "few_objects": False,
        "gallery": "18 unseen objects, 792 photos; own photo left out",
        "repeats": by_seed.tolist(),
    }


def curve(skill, k):
    """Return a top-k accuracy curve that ends at 1; the diagonal without skill."""
    return (np.arange(1, k + 1) / k) ** (1 / (1 + 2.2 * skill))


def measures(rng, skill):
    """Return all measures of one method."""
    flat = {"pair_accuracy": (0.5 + 0.22 * skill, 0.5), "pair_auc": (0.5 + 0.26 * skill, 0.5)}
    for k in (5, 10):
        flat[f"topn_k{k}"] = (curve(skill, k), np.arange(1, k + 1) / k)
    for count in (1, 2, 3, 5, 8, 12, 20):
        flat[f"topn_k5_g{count}_p3"] = (curve(skill * (1 + 0.35 * np.log(count)), 5), np.arange(1, 6) / 5)
    flat["topn_k5_all_objects"] = (curve(skill * 0.9, 5), np.arange(1, 6) / 5)
    for index, key in enumerate(RANKS):
        flat[key] = (0.06 + 0.2 * skill + 0.05 * index, 0.06 + 0.05 * index)
    return {name: summary(rng, value, chance) for name, (value, chance) in flat.items()}


def reliability(rng):
    """Return a reliability diagram with ten bins, one of them empty."""
    centres = np.linspace(0.05, 0.95, 10)
    fractions = np.clip(centres + rng.normal(0, 0.04, 10), 0, 1)
    counts = rng.integers(5, 5000, 10)
    counts[3] = 0
    bins = [
        {"probability": float(probability), "frequency": float(fraction) if count else None, "count": int(count)}
        for probability, fraction, count in zip(centres, fractions, counts, strict=True)
    ]
    return {"ece": float(np.abs(centres - fractions).mean()), "bins": bins}


def roc(skill):
    """Return true-positive rates against false-positive rates."""
    alarms = np.linspace(0, 1, 60)
    return [[float(x), float(x ** (1 / (1 + skill)))] for x in alarms]


def decision(rng, skill):
    """Return measures of the separation between in-catalogue and out-of-catalogue objects."""
    return {
        "auroc": summary(rng, min(0.5 + 0.18 * skill, 1), 0.5),
        "false_accepts_at_95": summary(rng, max(0.95 - 0.3 * skill, 0), 0.95),
    }


def risk_coverage(skill):
    """Return top-1 errors against coverage: the error grows with coverage."""
    coverage = np.linspace(0.02, 1, 50)
    return [[float(x), float((1 - 0.5 * curve(skill, 5)[0]) * x ** (0.5 * skill))] for x in coverage]


def row(rng, name, split):
    """Return the row of one method in results.json."""
    skill = SKILL.get(name, 0.9)
    test, everyone = split["test"], [*split["train"], *split["validation"], *split["test"]]
    accuracy = float(curve(skill, 5)[0])
    by_object = {item: float(np.clip(rng.normal(accuracy, 0.2), 0, 1)) for item in everyone}
    pairs = [rng.choice(test, 2, replace=False).tolist() for _ in range(min(12, len(test)))]
    fractions = sorted(rng.uniform(0.1, 0.8, len(pairs)), reverse=True)
    found = measures(rng, skill)
    return {
        "method": name,
        "model": None,
        "measures": found,
        "best_params": [[{"components": 64, "ridge": 0.1, "seed": seed} if skill else {}] for seed in range(3)],
        "details": {
            "pair_threshold": {"at": 0.1, "source": "validation objects"},
            "per_object": {"test_candidates": {item: by_object[item] for item in test}, "all_candidates": by_object},
            "confusions": [
                {"object_id": a, "mistaken_for": b, "share": float(fraction)}
                for (a, b), fraction in zip(pairs, fractions, strict=True)
            ],
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
            },
            "verification": verification(np.random.default_rng(1)) if name == "late_fusion" else None,
        },
    }


def verification(rng):
    """Return error rates of verification that fall with the number of grasps; the lowest rate is refused."""

    def rate(value, needed):
        interval = {"value": value, "low": value / 2, "high": 2 * value}
        return {**(dict.fromkeys(interval) if needed > 80 else interval), "objects_needed": needed}

    def one(difficulty):
        return {
            "objects": 80,
            "sequences": 640,
            "eer": rate(float(0.1 * difficulty), 40),
            "frr": {"0.1": rate(0.1 * difficulty, 25), "0.01": rate(0.3 * difficulty, 78), "0.001": rate(0.6, 246)},
        }

    difficulties = {"random": 1.0, "similar": 1.2}
    return {
        kind: {str(grasps): one(difficulty * rng.uniform(0.9, 1) / grasps) for grasps in (1, 2, 3, 5)}
        for kind, difficulty in difficulties.items()
    }


CEILINGS = {"touch_to_touch": "two touches of one object", "photo_to_photo": "two photos of one object"}
CONTROLS = {
    "permuted": "touches are permuted among training objects before fitting, so there is nothing to learn",
    "no_contact": "the no-contact frame replaces the touch in fitting and in scoring",
    "low_pass": "each gel image is reduced to 8 x 6 pixels in fitting and in scoring",
}
PROTOCOL = "unseen-objects"


def control(rng, text, method, skill):
    """Return the entry of a control or a ceiling."""
    found = {"pair_accuracy": summary(rng, 0.5 + 0.2 * skill, 0.5)}
    found["topn_k5"] = summary(rng, curve(skill, 5), np.arange(1, 6) / 5)
    return {"description": text, "method": method, "measures": found}


def synthetic_protocol(recording, methods=tuple(SKILL), seed=0):
    """Return the results of one protocol of results.json, as JSON types."""
    rng, grasps = np.random.default_rng(seed), load_grasps(recording)
    split = make_split(grasps, validation=0.16, test=0.2, seed=seed).to_dict()
    difference = {"value": 0.12, "low": 0.06, "high": 0.18, "few_objects": False, "p": 0.0021}
    return {
        "title": "Unseen objects",
        "rule": "Methods are fitted on the training objects.",
        "published_results": ["The paper reports 64.3 % on other objects."],
        "main": "pair_accuracy",
        "labels": [[key, metric.label] for key, metric in METRICS.items()],
        "unit": "object",
        "recording": {
            "name": recording.name,
            "source": "simulated rig",
            "digest": "ab" * 32,
            "objects": len({grasp.object_id for grasp in grasps}),
            "grasps": len(grasps),
        },
        "features": {"touch": 1280, "photo": 1280, "fingers": 2, "digest": "cd" * 32},
        "folds": [[split]],
        "rows": {name: row(rng, name, split) for name in methods},
        "controls": {
            name: control(rng, text, "late_fusion", 0.2 * (name == "low_pass")) for name, text in CONTROLS.items()
        },
        "ceilings": {name: control(rng, text, "cca", 0.8) for name, text in CEILINGS.items()},
        "comparisons": [
            {"a": methods[0], "b": other, "measure": key, "difference": difference}
            for other in methods[1:]
            for key in ("pair_accuracy", "topn_k5")
        ],
    }


def synthetic_results(protocols):
    """Return results.json of these protocols by name, as JSON types."""
    config = {"matcher": {"tower": "mobilenet"}, "training": {"iterations": 2000}}
    setting = {
        "preset": "mobilenet",
        "config": config,
        "model": None,
        "compared": {},
        "seeds": [0, 1, 2],
    }
    return {"setting": setting, "protocols": protocols, "skipped": {}, "software": "0.1.0"}


def synthetic_timings(methods, seed=0):
    """Return timings.json with times between a microsecond and a minute, as JSON types."""
    rng = np.random.default_rng(seed)
    rows = {
        name: {
            "fit_s": 60.0 * SKILL.get(name, 0.9),
            "encode_touch_ms": 0.21,
            "encode_photo_ms": 0.14,
            "score_us_per_photo": 1.3,
            "query_ms": float(10 ** rng.uniform(-1.5, 1.5)),
        }
        for name in methods
    }
    return {
        "cpus": 2,
        "threads": 1,
        "protocols": {PROTOCOL: {"tower_touch_ms": 14.2, "tower_photo_ms": 21.8, "rows": rows}},
    }


def write_synthetic_results(recording, out, methods=tuple(SKILL)):
    """Write the evaluation to `out`; return `out`."""
    out.mkdir(parents=True, exist_ok=True)
    results = synthetic_results({PROTOCOL: synthetic_protocol(recording, methods)})
    write_results(out / "results.json", msgspec.convert(results, Results))
    write_results(out / "timings.json", msgspec.convert(synthetic_timings(methods), Timings))
    return out
