"""`python -m benchmarks.colour_layout`: how often exchanged channels and mirrored images of 5 in 20 touches are found.

For every set of touches it draws recordings of 20 touches, unchanged and with 5 changed touches. A hit names the change
and exactly these 5 touches. Each simulated recording has its own sensor. Real recordings are drawn from the touches of
one data set: they share touches, so the exact binomial intervals hold for these touches only. The variable TOUCH_DATA
names a folder with billets/, physiclear/ and vt60/.

The second table compares gels with a simulated training sensor: how many are nearer to it with red and blue exchanged.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from retrieval.data.check.appearance_statistics import SmallImages, distance
from retrieval.data.check.colour_layout import CHANGES, changed_layout
from retrieval.data.images import read_rgb, to_float
from retrieval.data.resize import resize
from retrieval.metrics.k_way import binomial_interval
from robot.importers.physiclear import StrongestFrames
from robot.sim.gel.sensor import draw_sensor
from robot.sim.rig import SimRig

TOUCHES, CHANGED, RECORDINGS, SENSORS = 20, 5, 400, 500
GELS, COMPARED_GELS = 100, 300
"""No-contact gels of the mean gel, and gels of any make that are compared with it."""
SMALL = (6, 8)


def real_touches() -> Iterator[tuple[str, SmallImages]]:
    """Yield the touches (n, 6, 8, 3) of each data set that TOUCH_DATA has; of a video its strongest frame."""
    root = Path(os.environ.get("TOUCH_DATA", "data"))
    for name, pattern, step in (("billets", "*/*_touch.png", 1), ("vt60", "touch/*/*/*.jpg", 10)):
        if paths := sorted((root / name).glob(pattern))[::step]:
            yield name, np.array([resize(read_rgb(path), SMALL) for path in paths])
    if videos := sorted((root / "physiclear").glob("*.mov")):
        yield "physiclear", np.array([resize(to_float(StrongestFrames(path, 1).frame(0)), SMALL) for path in videos])


def simulated_touches(optics: str, seed: int) -> SmallImages:
    """Return 20 touches of one simulated sensor, of different objects."""
    rig, touches = SimRig(seed, optics=optics, fingers=("a",)), []
    for name in rig.object_ids(3 * TOUCHES):
        pressed = next(filter(None, (rig.press(name, number) for number in range(5))), None)
        if pressed and len(touches) < TOUCHES:
            touches.append(resize(to_float(pressed["touch_a"]), SMALL))
        if len(touches) == TOUCHES:
            break
    return np.array(touches)


def rates(recordings: list[SmallImages]) -> list[str]:
    """Return false alarms and, for each change, hits: with their exact 95 % intervals."""
    cells = [interval(sum(changed_layout(images) is not None for images in recordings), len(recordings))]
    for change, index in CHANGES.items():
        hits = 0
        for images in recordings:
            images = images.copy()
            images[:CHANGED] = images[:CHANGED][index]
            found = changed_layout(images)
            hits += found is not None and (found.change, found.rows.tolist()) == (change, list(range(CHANGED)))
        cells.append(interval(hits, len(recordings)))
    return cells


def interval(count: int, total: int) -> str:
    """Return "count of total, percent [low, high]"."""
    low, high = binomial_interval(count, total)
    return f"{count} of {total}: {100 * count / total:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def no_contact_gels(optics: str, count: int) -> SmallImages:
    """Return the no-contact gels of different simulated sensors."""
    return np.array(
        [resize(to_float(draw_sensor(seed, "a", optics=optics).background(1)), SMALL) for seed in range(count)]
    )


def main() -> None:
    """Print both tables."""
    rng, real = np.random.default_rng(0), dict(real_touches())
    print("| touches | false alarms, % |" + "".join(f" {change} |" for change in CHANGES))
    print("|---" * (2 + len(CHANGES)) + "|")
    for name, touches in real.items():
        drawn = [touches[rng.choice(len(touches), TOUCHES, replace=False)] for _ in range(RECORDINGS)]
        print(f"| {name} | {' | '.join(rates(drawn))} |", flush=True)
    for optics in ("gelsight_mini", "led", "varied", "grey"):
        simulated = [simulated_touches(optics, seed) for seed in range(SENSORS)]
        print(f"| simulated, {optics} | {' | '.join(rates(simulated))} |", flush=True)
    centre = np.median(no_contact_gels("led", GELS), axis=0)
    print("\n| gels against the mean simulated gel (led) | nearer with red and blue exchanged, % |\n|---|---|")
    for name, gels in {**real, "varied": no_contact_gels("varied", COMPARED_GELS)}.items():
        nearer = distance(gels[..., ::-1], centre) < distance(gels, centre)
        print(f"| {name} | {interval(int(nearer.sum()), len(gels))} |")


if __name__ == "__main__":
    main()
