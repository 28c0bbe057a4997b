"""Accuracy of heads on frozen towers with one part of the training left out, and against the number of objects.

    python -m benchmarks.models.parts RECORDING ... --validation VALIDATION --test TEST --out FOLDER

Each RECORDING has training objects, VALIDATION chooses the step, and TEST is scored. The towers are those of the
shipped checkpoint, the heads those of the preset relief-large. A row is one training: the whole, the whole without one
part, the whole on fewer objects, or the whole with another seed (--seeds). --only names rows, so that two processes can
share the work; rows that were trained before are read. The table has the top-1 accuracy among 10 and 100 objects, with
95 % intervals over test objects, and the paired difference to the whole.
"""

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.models.recognition import interval, measures, summary_cell
from benchmarks.models.shipped import PRESET, tower_weights
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.methods.late_fusion import frozen_matcher, trained_checkpoint
from retrieval.methods.method import MethodSettings
from retrieval.metrics.intervals import compare, summarise
from retrieval.metrics.measure import Measure
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.config import Config, load_config
from retrieval.search.defaults import find_model
from retrieval.training.features import Features, encode_recording

WHOLE = "whole"
SHOWN = ("K = 10, 1 grasp, 1 photo", "K = 100, 1 grasp, 1 photo", "K = 100, 2 grasps, 1 photo")


def matcher(**changes: Any) -> Callable[[Config], Config]:
    """Return a function that changes settings of the table [matcher]."""
    return lambda config: dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, **changes))


def training(**changes: Any) -> Callable[[Config], Config]:
    """Return a function that changes settings of the table [training]."""
    return lambda config: dataclasses.replace(config, training=dataclasses.replace(config.training, **changes))


def weights(**changes: float) -> Callable[[Config], Config]:
    """Return a function that changes weights of losses."""
    return lambda config: training(weights={**config.training.weights, **changes})(config)


def views(*names: str) -> Callable[[Config], Config]:
    """Return a function that changes the views of a photo."""
    return lambda config: dataclasses.replace(
        config, preprocessing=dataclasses.replace(config.preprocessing, views=names)
    )


PARTS: Mapping[str, Callable[[Config], Config]] = {
    WHOLE: lambda config: config,
    "no late interaction": matcher(cell_dim=0),
    "no loss of the pooled logit": weights(pooled_listwise=0.0),
    "match loss only": weights(listwise=0.0, pooled_listwise=0.0),
    "SigLIP's loss for the listwise loss": weights(listwise=0.0, pooled_listwise=0.0, sigmoid=1.0),
    "no cosine": matcher(cosine=False, candidate_linear=0, projection_hidden=0),
    "no standardisation": matcher(standardise=False),
    "no exchange of fingers": training(shuffle_fingers=False),
    "batches of 32 objects": training(touches_per_batch=32),
    "no crop of the object": views("grey"),
    "no grey view": views("crop"),
}
"""Rows by name: each changes one part of the configuration."""


def main(argv: Sequence[str] | None = None) -> int:
    """Train the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="+")
    parser.add_argument("--validation", type=Path, required=True)
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--model", default="shipped", help="checkpoint whose towers are used")
    parser.add_argument("--objects", type=int, default=3200, help="training objects, except in the rows of --counts")
    parser.add_argument("--counts", type=int, nargs="*", default=[], help="rows with other numbers of objects")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of the whole, with seeds 0, 1, ...")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--only", nargs="*", help="train only the whole and these rows")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    config = base_config(arguments)
    rows = {name: (change(config), arguments.objects, 0) for name, change in PARTS.items()}
    rows |= {f"seed {seed}": (config, arguments.objects, seed) for seed in range(1, arguments.seeds)}
    for count in arguments.counts:
        rows |= {f"{count:,} objects": (config, count, 0)}
        rows |= {f"{count:,} objects, no late interaction": (PARTS["no late interaction"](config), count, 0)}
    if arguments.only is not None:
        rows = {name: rows[name] for name in dict.fromkeys([WHOLE, *arguments.only])}
    recordings = [[grasp for part in arguments.recording for grasp in load_grasps(part)]]
    recordings += [load_grasps(part) for part in (arguments.validation, arguments.test)]
    found = {name: trained_row(name, row, recordings, arguments.out) for name, row in rows.items()}
    print(table(found))
    return 0


def base_config(arguments: argparse.Namespace) -> Config:
    """Return the preset with the towers of the model."""
    config = load_config(PRESET)
    files = tower_weights(arguments.out, load_checkpoint(find_model(arguments.model)[0]))
    steps = config.training.with_iterations(arguments.steps)
    return dataclasses.replace(config, training=dataclasses.replace(steps, **files))


def trained_row(
    name: str, row: tuple[Config, int, int], recordings: Sequence[Sequence[Grasp]], out: Path
) -> dict[str, Measure]:
    """Train one row, or read it, and return its measures on the test recording."""
    config, count, seed = row
    towers = frozen_matcher(matcher(cell_dim=load_config(PRESET).matcher.cell_dim)(config))
    train, validation = (encode_recording(part, towers, config, out / "features") for part in recordings[:2])
    if not config.matcher.cell_dim:
        train, validation = train.pooled(towers), validation.pooled(towers)
    folder = out / name.replace(" ", "-").replace(",", "").replace("'", "")
    settings = MethodSettings(config, seed, folder, quiet=False)
    made = trained_checkpoint(settings, first_objects(train, count), validation)
    found = measures(made, recordings[2], None, out / "features")
    print(name, *(f"{key}: {found[key].by_object()[1].mean():.3f}" for key in SHOWN), sep="  ", flush=True)
    return found


def first_objects(features: Features, count: int) -> Features:
    """Return the features of the first `count` objects in a fixed order: smaller sets are nested."""
    names = list(dict.fromkeys(features.object_ids))
    return features if count >= len(names) else features.of_objects(names[:count])


def table(found: Mapping[str, Mapping[str, Measure]]) -> str:
    """Return a Markdown table of all rows."""
    heads = [name.removesuffix(", 1 photo") for name in SHOWN]
    lines = [f"| training | {' | '.join(heads)} | {heads[1]}: difference |", "|---|" + "---|" * (len(SHOWN) + 1)]
    for name, row in found.items():
        cells = []
        for key in SHOWN:
            cells.append(summary_cell(summarise([row[key]], seed=0)))
        difference = compare([row[SHOWN[1]]], [found[WHOLE][SHOWN[1]]], seed=0)
        cells.append("" if name == WHOLE else interval(*(difference[part] for part in ("difference", "low", "high"))))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
