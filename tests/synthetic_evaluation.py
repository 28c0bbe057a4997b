"""A synthetic evaluation: results.json in the format of `retrieve evaluate`, with random numbers."""

import msgspec
import numpy as np

from retrieval.evaluation.results import Results, write_results
from retrieval.metrics.registry import METRICS

PROTOCOL = "unseen-objects"
OBJECTS = [f"object-{number}" for number in range(12)]
SPLIT = {"train": OBJECTS[:6], "validation": OBJECTS[6:8], "test": OBJECTS[8:]}


def summary(rng, chance=(0.5,)):
    """Return a summary of results.json: rising values above chance, with an interval and three repeats."""
    value = np.sort(rng.uniform(chance, 1))
    parts = {"value": value, "low": value - 0.03, "high": value + 0.03, "chance": np.array(chance)}
    return {name: np.clip(numbers, 0, 1).tolist() for name, numbers in parts.items()} | {
        "queries": 792,
        "objects": 18,
        "few_objects": False,
        "gallery": "18 unseen objects, 792 photos",
        "repeats": [value.tolist()] * 3,
    }


def measures(rng):
    """Return all measures of one method; those of top-n accuracy are curves."""
    curves = {key: 10 if key == "topn_k10" else 5 for key in METRICS if key.startswith("topn")}
    return {
        key: summary(rng, np.arange(1, curves[key] + 1) / curves[key] if key in curves else (0.5,)) for key in METRICS
    }


def details(rng, name):
    """Return single objects and decisions of one method."""
    bins = [{"probability": p, "frequency": p**2, "count": count} for p, count in ((0.1, 9), (0.5, 0), (0.9, 4000))]
    curve = np.linspace([0, 0], [1, 1], 60).tolist()
    return {
        "pair_threshold": {"at": 0.1, "source": "validation objects"},
        "per_object": {
            "test_candidates": {name: rng.uniform() for name in SPLIT["test"]},
            "all_candidates": {name: rng.uniform() for name in OBJECTS},
        },
        "confusions": [{"object_id": OBJECTS[8], "mistaken_for": OBJECTS[9], "share": 0.4}],
        "reliability": {kind: {"ece": 0.04, "bins": bins} for kind in ("k5", "k10")},
        "posterior": {"slope": 0.9, "offset": -0.1},
        "reject": {
            **{key: summary(rng) for key in ("auroc", "balanced_accuracy")},
            "roc": curve,
        },
        "verification": verification() if name == "late_fusion" else None,
    }


def verification():
    """Return error rates of verification."""

    def rate(value, low, high, needed):
        return {"value": value, "low": low, "high": high, "objects_needed": needed}

    frr = {"0.001": rate(None, None, None, 1246), "0.01": rate(0.2345, 0.1, 0.4, 78), "0.1": rate(0.01, 0, 0.06, 25)}
    known = {"objects": 80, "sequences": 640, "eer": rate(0.0512, 0.02, 0.11, 35), "frr": frr}
    unknown = known | {"eer": rate(None, None, None, None)}
    return {"random": {"1": known, "3": known}, "similar": {"1": unknown, "3": known}}


def control(rng, description, method):
    return {"description": description, "method": method, "measures": {"pair_accuracy": summary(rng)}}


def synthetic_protocol(methods):
    """Return the results of one protocol of results.json, as JSON types."""
    rng = np.random.default_rng(0)
    difference = {"value": 0.12, "low": 0.06, "high": 0.18, "few_objects": False, "p": 0.0021}
    row = {"model": None, "best_params": [[{}]]}
    return {
        "title": "Unseen objects",
        "rule": "Methods are fitted on the training objects.",
        "published_results": ["The paper reports 64.3 % on other objects."],
        "main": "pair_accuracy",
        "labels": [[key, metric.label] for key, metric in METRICS.items()],
        "unit": "object",
        "recording": {"name": "lab", "source": "simulated rig", "digest": "ab" * 32, "objects": 12, "grasps": 36},
        "folds": [[SPLIT]],
        "rows": {
            name: row | {"method": name, "measures": measures(rng), "details": details(rng, name)} for name in methods
        },
        "controls": {
            "permuted": control(rng, "touches are permuted", "late_fusion"),
            "no_contact": control(rng, "the no-contact frame replaces the touch", "late_fusion"),
        },
        "ceilings": {"touch_to_touch": control(rng, "two touches of one object", "cca")},
        "comparisons": [
            {"a": other, "b": methods[0], "measure": "pair_accuracy", "difference": difference} for other in methods[1:]
        ],
    }


def write_synthetic_results(out, methods):
    """Write results.json to `out`; return `out`."""
    setting = {"preset": "mobilenet", "config": {"matcher": {}}, "model": None, "compared": {}, "seeds": [0, 1, 2]}
    protocols = {PROTOCOL: synthetic_protocol(methods)}
    results = {"setting": setting, "protocols": protocols, "skipped": {}, "software": "0.1.0"}
    out.mkdir(parents=True, exist_ok=True)
    write_results(out / "results.json", msgspec.convert(results, Results))
    return out
