"""Fit gel optics to real presses and test them on held-out presses.

    python -m benchmarks.optics.photometric --out FOLDER

The fitting presses make all choices (benchmarks.optics.model_choice). A held-out press is predicted as the sensor's own
unpressed picture plus the model's change, and compared over a crop of 200 x 200 pixels around the ball. Centre and
contact radius of the held-out press are fitted to its picture, with fixed colours (benchmarks.optics.least_squares).
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.optics.image_error import PictureError
from benchmarks.optics.least_squares import Matrix
from benchmarks.optics.model_choice import Fit, fit, held_out_error, picture_error, select, to_optics
from benchmarks.optics.real_presses import BALLS_MM, Presses, find_presses, read_presses
from robot.errors import BadRobotInput, RobotError

FIT_COUNT = {"gelsight": 36, "gelsight_mini": 18}
SPLITS = 5
DEGREES = (1, 2, 3, 4)
SOURCE = (
    "fitted to the ball presses in the Python package taxim 1.4.1 (MIT licence, T. Schneider; Si & Yuan, RA-L 2022)"
)

# Evaluation ------------------------------------------------------------------------------------------------


@dataclass
class Scores:
    """Errors of one way of predicting, by press; several splits may hold out the same press."""

    by_press: dict[int, list[PictureError]] = field(default_factory=dict)

    def add(self, index: int, error: PictureError) -> None:
        """Record the error on one held-out press."""
        self.by_press.setdefault(index, []).append(error)

    def per_press(self) -> Matrix:
        """Return l1, mse, ssim, psnr of each press, the mean over its splits: (presses, 4)."""
        return np.array([np.mean(errors, axis=0) for errors in self.by_press.values()])

    def summary(self, seed: int = 0, draws: int = 2000) -> dict[str, dict[str, float]]:
        """Return mean and 95 % bootstrap interval over presses for each measure."""
        table = self.per_press()
        rng = np.random.default_rng([seed, 0xB007])
        means = table[rng.integers(0, len(table), (draws, len(table)))].mean(axis=1)
        low, high = np.percentile(means, [2.5, 97.5], axis=0)
        keys = PictureError._fields
        return {
            key: {"mean": float(table[:, at].mean()), "low": float(low[at]), "high": float(high[at])}
            for at, key in enumerate(keys)
        }


def splits(count: int, fit_count: int, number: int = SPLITS) -> Iterator[tuple[list[int], list[int]]]:
    """Yield random (fitting, held-out) presses, by seeds 0, 1, ..."""
    for seed in range(number):
        order = [int(one) for one in np.random.default_rng([seed, 0x5B117]).permutation(count)]
        yield sorted(order[:fit_count]), sorted(order[fit_count:])


def evaluate(presses: Presses, *, number: int = SPLITS) -> dict[str, Scores]:
    """Return held-out errors of every way of predicting, over `number` splits."""
    out: dict[str, Scores] = {}
    for chosen, held_out in splits(len(presses), FIT_COUNT[presses.name], number):
        models = _models(presses, chosen)
        for index in held_out:
            out.setdefault("background only", Scores()).add(index, picture_error(presses, index, 0.0))
            for name, model in models.items():
                out.setdefault(name, Scores()).add(index, held_out_error(presses, index, model))
    return out


def _models(presses: Presses, chosen: Sequence[int]) -> dict[str, Fit]:
    """Return the model of the shipped kind, and the same of every degree."""
    setting = select(presses, chosen)
    return {
        "as shipped (aligned)": fit(presses, chosen, setting),
        **{by_degree(degree): fit(presses, chosen, replace(setting, degree=degree)) for degree in DEGREES},
    }


def by_degree(degree: int) -> str:
    """Return the row name of the shipped kind of model of this degree."""
    return f"as shipped, degree {degree}"


# Command ---------------------------------------------------------------------------------------------------


def document(presses: Presses, scores: dict[str, Scores]) -> dict[str, Any]:
    """Return the content of a shipped file: source, the model fitted to every press, and its held-out results."""
    everything = range(len(presses))
    setting = select(presses, everything)
    fitted = fit(presses, everything, setting)
    figures = {name: one.summary() for name, one in scores.items()}
    model = json.dumps(asdict(to_optics(presses, fitted)))
    return {
        "sensor": presses.name,
        "source": SOURCE,
        "setting": asdict(setting),
        "blur_px": fitted.blur_px,
        "held_out": {
            name: {key: {part: round(number, 4) for part, number in value.items()} for key, value in one.items()}
            for name, one in figures.items()
        },
        "model": json.loads(model, parse_float=lambda text: float(f"{float(text):.6g}")),
    }


def table(presses: Presses, scores: dict[str, Scores]) -> str:
    """Return the held-out results as text: mean and 95 % interval over presses."""
    fitted, held = FIT_COUNT[presses.name], len(presses) - FIT_COUNT[presses.name]
    lines = [f"{presses.name}: fitted on {fitted}, tested on {held} other presses, {SPLITS} random splits", ""]
    lines.append(f"{'':54}{'L1':>18}{'MSE':>22}{'SSIM':>21}{'PSNR dB':>21}")
    for name, one in scores.items():
        cells = [
            f"{value['mean']:8.{digits}f} [{value['low']:.{digits}f}, {value['high']:.{digits}f}]"
            for value, digits in zip(one.summary().values(), (2, 1, 3, 2), strict=True)
        ]
        lines.append(f"{name:54}" + "".join(f"{cell:>21}" for cell in cells))
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit, test, print, and write <out>/<sensor>.json; return 0, or the error's exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.optics.photometric", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--data", type=Path, help="folder with <sensor>/dataPack.npz (default: the package taxim)")
    parser.add_argument("--out", type=Path, required=True, help="folder for <sensor>.json")
    parser.add_argument("--sensor", choices=sorted(BALLS_MM), action="append", help="default: all")
    options = parser.parse_args(arguments)
    try:
        for name in options.sensor or BALLS_MM:
            _run(options.data or find_presses(), name, options.out)
    except RobotError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _run(folder: Path, name: str, out: Path) -> None:
    presses = read_presses(folder, name)
    scores = evaluate(presses, number=SPLITS)
    print(table(presses, scores), flush=True)
    content = json.dumps(document(presses, scores), indent=1)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{name}.json").write_text(content + "\n")
    except OSError as error:
        raise BadRobotInput(f"{out} cannot be written: {error.strerror}; give another --out") from error


if __name__ == "__main__":
    raise SystemExit(main())
